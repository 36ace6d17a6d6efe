"""Data from an environment: random actions for the warm start, rollouts of a policy, both through TorchRL."""

from __future__ import annotations

import atexit
import contextlib
import copy
import functools
import multiprocessing.util
import os
import shutil
import signal
import tempfile
import warnings
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_sspl.data.store import TransitionStore, without_padding
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import ConfigError, MissingDependencyError
from torchrl_sspl.sets import Region

BACKENDS = ("sync", "process", "ray")
_BATCH = 2048  # transitions at a time; an episode that a batch cuts in two costs two frames more
_EPISODE = 64  # steps up to which no episode is cut
_SOCKET = 103  # bytes of the longest name of a socket that macOS takes; Linux takes 107


def _worker() -> int:
    """Number of this process among those that its parent has begun, on top of the parent's own; 0 of a main one."""
    return sum(multiprocessing.current_process()._identity)  # type: ignore[attr-defined]


class RandomActions(TensorDictModuleBase):
    """Policy that draws actions uniformly from the bounds of an environment, with a random generator of its own.

    Without a seed it draws others every time. Workers of a collector, which get copies, draw actions of their own; whichever process
    makes the policy, it draws the same. Source: paper Section IV-D.
    """

    def __init__(self, env: EnvBase, seed: int | None = None) -> None:
        super().__init__()
        self.in_keys: list[str] = []
        self.out_keys = ["action"]
        space = env.action_spec_unbatched.space
        self._low, self._high, self._seed = space.low, space.high, seed
        self._generator: torch.Generator | None = None
        self._home = _worker()  # copies carry it along

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"`` ``(*batch, action_dim)``."""
        if self._generator is None:  # here, so that the policy can be sent to another process
            self._generator = torch.Generator(device=self._low.device)
            if self._seed is None:
                self._generator.seed()
            else:
                self._generator.manual_seed(self._seed + 1_000_003 * (_worker() - self._home))
        shape = (*tensordict.batch_size, *self._low.shape)
        unit = torch.rand(shape, generator=self._generator, device=self._low.device)
        return tensordict.set("action", self._low + unit * (self._high - self._low))

    def get_extra_state(self) -> Tensor:
        """State of the generator: a collector that goes on draws what it would have drawn."""
        return torch.zeros(0, dtype=torch.uint8) if self._generator is None else self._generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Restores what ``get_extra_state`` returned."""
        self._generator = torch.Generator(device=self._low.device) if len(state) else None
        if self._generator is not None:
            self._generator.set_state(state.cpu().clone())


class ExploringPolicy(TensorDictModuleBase):
    """Rollout policy that explores: noise on its actions, and random actions in some of the environments.

    Whole episodes are random or follow the policy: what the policy leads to, such as standing still, is not seen when
    every other action is random.

    Args:
        policy: pixels -> ``"action"``.
        low, high: bounds of the action ``(action_dim,)``.
        exploration: standard deviation of the noise, as a share of the half range.
        random_share: share of the environments with uniformly random actions; of a single one, share of the steps.
        predict: what a policy with memory expects to see next, from the action that is taken
            (:class:`~torchrl_sspl.modules.Predict`).

    Source: none.
    """

    low: Tensor
    high: Tensor

    def __init__(
        self,
        policy: nn.Module,
        low: Tensor,
        high: Tensor,
        exploration: float,
        random_share: float,
        predict: TensorDictModuleBase | None = None,
    ) -> None:
        super().__init__()
        self.in_keys = list(getattr(policy, "in_keys", ["pixels"]))
        self.out_keys: list[Any] = ["action", *([] if predict is None else predict.out_keys)]
        self.policy, self.exploration, self.random_share, self.predict = policy, exploration, random_share, predict
        self.register_buffer("low", low.clone())
        self.register_buffer("high", high.clone())

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"`` ``(*batch, action_dim)``."""
        decided = self.policy(tensordict.select(*self.in_keys))
        action = decided["action"]
        half = (self.high - self.low) / 2
        noisy = action + self.exploration * half * torch.randn_like(action)
        uniform = self.low + (self.high - self.low) * torch.rand_like(action)
        n = action.shape[0] if action.ndim > 1 else 1
        if n > 1:
            swap = (torch.arange(n, device=action.device) < round(self.random_share * n)).reshape(-1, *[1] * (action.ndim - 1))
        else:
            swap = torch.rand_like(action[..., :1]) < self.random_share
        decided["action"] = torch.where(swap, uniform, noisy.clamp(self.low, self.high))
        if self.predict is not None:
            decided = self.predict(decided)
        return tensordict.update(decided.select(*self.out_keys))


def collect_random(
    env: EnvBase | Callable[[], EnvBase], n: int, *, seed: int | None = None, **options: Any
) -> TransitionStore:
    """Collect n transitions under uniformly random actions; the arguments are those of :func:`collect_rollouts`.

    Source: paper, Section IV-D (warm start on uniform random actions). Deviation: none.

    Example:
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> len(collect_random(PendulumEnv(batch_size=[8]), 100, seed=0))
        100
    """
    probe = env if isinstance(env, EnvBase) else env()
    policy = RandomActions(probe, None if seed is None else seed + 1)
    return collect_rollouts(env, policy, n, seed=seed, **options)


def collect_rollouts(
    env: EnvBase | Callable[[], EnvBase],
    policy: Callable[[TensorDictBase], TensorDictBase],
    n: int,
    *,
    seed: int | None = None,
    steps: int | None = None,
    region: Region | None = None,
    store: TransitionStore | None = None,
    keep_state: bool = False,
    **collector: Any,
) -> TransitionStore:
    """Collect n transitions under a policy.

    Args:
        env: environment, or a function that makes one (required by backends with other processes).
        policy: writes ``"action"``; let it write nothing else (``selected_out_keys=["action"]``), it is carried along.
        n: number of transitions.
        seed: seed of states and actions; with the direct backend the result is then the same every time.
        steps: longest episode; 1 gives independent transitions. Default: until the environment ends it.
        region: set from which episodes of a :class:`~torchrl_sspl.envs.SafetyEnv`, with transforms or without, start, such as
            ``env.safe_set``. Default: the environment's ``initial_set``.
        store: store to add to. Default: a new one of capacity n.
        keep_state: keep true states in a new store, for evaluation.
        **collector: arguments of ``torchrl.collectors.Collector``, such as ``backend`` (``"direct"``),
            ``num_collectors``.

    Returns the store with n more transitions. Raises ConfigError if ``n`` or ``steps`` is not positive, or ``region``
    is given with a function or an environment that is no SafetyEnv. Source: Algorithm 1 of the paper (rollouts of the policy join D). Deviation: none.

    Example:
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> still, env = lambda rows: rows.set("action", torch.zeros(*rows.shape, 1)), PendulumEnv(batch_size=[8])
        >>> len(collect_rollouts(env, still, 40, seed=0, steps=10, region=env.safe_set))
        40
    """
    if n < 1 or (steps is not None and steps < 1):
        raise ConfigError(f"collection: expected n >= 1 and steps >= 1 or None, received {n} and {steps}.")
    if region is not None and not isinstance(env, EnvBase):
        raise ConfigError("region: expected with an environment only, received it with a function that makes one.")
    if store is None:
        store = TransitionStore(n, keep_state=keep_state)
    if isinstance(env, EnvBase) and seed is not None:
        env.set_seed(seed)  # before the collector resets it
    width = (env if isinstance(env, EnvBase) else env()).numel()
    at_once = max(_BATCH // width, min(steps or 1, _EPISODE))
    options = {"backend": "direct", "frames_per_batch": max(1, min(-(-n // width), at_once)) * width}
    options.update(collector)
    if options["backend"] == "direct":
        options.setdefault("return_same_td", True)  # what is collected is copied into the store at once
    else:
        _shorten_sockets()
    with _starting_in(env, region):
        with warnings.catch_warnings():
            # Step counter and memory are two transforms of one environment, which is what TorchRL makes of them.
            warnings.filterwarnings("ignore", "Nested TransformedEnvs", UserWarning)
            source = Collector(
                env, policy, total_frames=-1, max_frames_per_traj=steps, trust_policy=True,
                auto_register_policy_transforms="prior" in getattr(policy, "in_keys", ()), **options,
            )  # fmt: skip
        try:
            if seed is not None and not isinstance(env, EnvBase):
                source.set_seed(seed)
            missing = n
            for data in source:
                data = without_padding(data)
                # Environments last, so that a last batch that is larger than needed is cut in time.
                rows = data[..., : -(-missing * data.shape[-1] // data.numel())].reshape(-1)[:missing]
                store.extend(rows)
                missing -= rows.shape[0]
                if missing == 0:
                    break
        finally:
            source.shutdown(close_env=not isinstance(env, EnvBase))  # ours to close only if made here
    return store


def make_collector(
    make_env: Callable[..., EnvBase],
    policy: TensorDictModuleBase,
    *,
    backend: str = "sync",
    workers: int = 1,
    frames_per_batch: int,
    total_frames: int,
    init_random_frames: int = 0,
    max_frames_per_traj: int | None = None,
    policy_device: torch.device | str = "cpu",
    ray_address: str = "",
    seed: int | None = None,
) -> BaseCollector:
    """A TorchRL collector in this process, in others of this machine, or on a Ray cluster.

    Batches have the same size and the same layout in all three. Environments live on the CPU; every batch begins with
    resets, so that nothing depends on where a worker had stopped. With ``"process"`` and ``"ray"`` the workers hold
    copies of the policy, which ``update_policy_weights_`` renews (``SSPLTrainer`` does so after every batch).

    Args:
        make_env: ``(seed=...) -> environment``; it has to be picklable for other processes.
        policy: writes ``"action"``.
        backend: ``"sync"``, ``"process"`` or ``"ray"``.
        workers: number of collectors, 1 for ``"sync"``.
        frames_per_batch: transitions per batch, over all workers.
        total_frames: transitions to collect in all.
        init_random_frames: transitions under random actions at the beginning.
        max_frames_per_traj: steps after which an episode is cut; ``None`` leaves that to the environment.
        policy_device: device of the policy; other processes always use the CPU.
        ray_address: address of a running cluster; ``""`` starts Ray on this machine.
        seed: seed of the environments; workers get different ones.

    Returns the collector. Raises ConfigError if the backend is unknown, or the numbers do not go together;
    MissingDependencyError if Ray is asked for and not installed. Source: none.

    Example:
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> make = functools.partial(PendulumEnv, batch_size=[4], image_size=16)
        >>> collector = make_collector(make, RandomActions(make()), frames_per_batch=16, total_frames=32, seed=0)
        >>> [batch.numel() for batch in collector]
        [16, 16]
    """
    if backend not in BACKENDS:
        raise ConfigError(f"collector.backend: expected one of {', '.join(BACKENDS)}, received {backend!r}.")
    if workers < 1 or (backend == "sync" and workers != 1):
        raise ConfigError(f"collector.workers: expected 1 with backend 'sync', else at least 1, received {workers}.")
    if frames_per_batch % workers:
        raise ConfigError(
            f"collector.frames_per_batch: expected a multiple of the {workers} workers, received {frames_per_batch}."
        )
    options: dict[str, Any] = {
        "frames_per_batch": frames_per_batch, "total_frames": total_frames, "init_random_frames": init_random_frames,
        "max_frames_per_traj": max_frames_per_traj, "reset_at_each_iter": True, "trust_policy": True,
    }  # fmt: skip
    base = 0 if seed is None else seed
    makers = [functools.partial(make_env, seed=base + 7919 * k) for k in range(workers)]
    if backend == "sync":
        return Collector(
            makers[0](), policy, policy_device=policy_device, env_device="cpu", storing_device="cpu",
            auto_register_policy_transforms=False, **options,
        )  # fmt: skip
    copied = copy.deepcopy(policy).cpu()
    if backend == "process":
        _shorten_sockets()
        collector = Collector(
            makers, copied, backend="process", sync=True, cat_results="stack", auto_register_policy_transforms=False,
            # Control-C reaches workers too: without them the trainer could not save its state.
            init_fn=functools.partial(signal.signal, signal.SIGINT, signal.SIG_IGN), **options,
        )  # fmt: skip
    else:
        collector = _ray_collector(makers, copied, ray_address, options)
    atexit.register(_end, weakref.ref(collector))
    return collector


def _shorten_sockets() -> None:
    """Lets this process and its workers keep their sockets elsewhere where ``TMPDIR`` is too long for the name of one.

    Workers hand over tensors through them. Of a batch that cannot be handed over nobody tells the collector, which waits for it
    for ever (https://github.com/python/cpython/issues/132124; newer versions of Python mend it).
    """
    longest = _SOCKET - len("/listener-01234567")
    if os.name == "nt" or len(os.fsencode(multiprocessing.util.get_temp_dir())) <= longest:
        return
    for place in ("/tmp", "/var/tmp"):
        with contextlib.suppress(OSError):
            folder = tempfile.mkdtemp(prefix="pymp-", dir=place)
            multiprocessing.util.Finalize(None, shutil.rmtree, args=(folder, True), exitpriority=-100)
            multiprocessing.current_process()._config["tempdir"] = folder  # type: ignore[attr-defined]  # workers inherit it
            return
    raise ConfigError(
        f"TMPDIR: expected a folder whose name has at most {longest - len('/pymp-01234567')} bytes, for the sockets of collectors in other "
        f"processes, received '{tempfile.gettempdir()}', and cannot write to /tmp or /var/tmp; set TMPDIR to a shorter one"
    )


def _end(collector: weakref.ref[BaseCollector]) -> None:
    """Ends what a collector has begun that nobody did shut down: its process would wait for the workers for ever."""
    if (alive := collector()) is not None:
        with contextlib.suppress(Exception):
            alive.shutdown()
        # Its queues tell the workers to stop, by a thread that each begins: once Python collects what is left, no thread can begin.
        for scheme in (getattr(alive, "_weight_sync_schemes", None) or {}).values():
            with contextlib.suppress(Exception):
                scheme.shutdown()


def _ray_collector(makers: list[Any], policy: TensorDictModuleBase, address: str, options: dict[str, Any]) -> BaseCollector:
    try:
        import ray  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(
            "collector.backend=ray: expected Ray, found none; run `pip install 'torchrl-sspl[ray]'`."
        ) from error
    cluster: dict[str, Any] = {"address": address} if address else {"num_cpus": len(makers), "include_dashboard": False}
    return Collector(
        makers, policy, backend="ray", sync=True,
        ray_init_config={**cluster, "log_to_driver": False, "ignore_reinit_error": True},
        remote_configs={"num_cpus": 1, "num_gpus": 0, "memory": 2 * 1024**3},
        **options,
    )  # fmt: skip


@contextlib.contextmanager
def _starting_in(env: Any, region: Region | None) -> Iterator[None]:
    """Let episodes of the environment, of which transforms may be made, start in a region meanwhile."""
    if region is None:
        yield
        return
    inner = env
    while isinstance(inner, TransformedEnv):
        inner = inner.base_env
    if not isinstance(inner, SafetyEnv):
        raise ConfigError(
            f"region: expected a SafetyEnv, with transforms or without, whose episodes start where they are asked to, received {type(inner).__name__}; "
            "leave region out, and start the environment there yourself"
        )
    before, inner.initial_set = inner.initial_set, region
    try:
        yield
    finally:
        inner.initial_set = before


__all__ = ["BACKENDS", "ExploringPolicy", "RandomActions", "collect_random", "collect_rollouts", "make_collector"]

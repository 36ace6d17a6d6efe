"""Where the phases get encoded transitions from: the joint training's store, and further collection through TorchRL."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import torch
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import EnvBase

from torchrl_sspl.data import Augmentation, Labels, TransitionStore, collect_random, collect_rollouts
from torchrl_sspl.data.collect import ExploringPolicy
from torchrl_sspl.data.store import continues
from torchrl_sspl.direction import direction_of
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.evaluation.simulation import Episodes
from torchrl_sspl.journal import Entry
from torchrl_sspl.modules import LatentObserver, Predict
from torchrl_sspl.modules.salad import make_rollout_policy
from torchrl_sspl.seeds import spawn
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE, Mixture, Region

_CHUNK = 4096  # transitions whose pictures are held at a time
_LONGER = 3  # times as long as random ones are the episodes of a policy with memory
_ENCODED = 1000  # and that are encoded at a time
_COUNTED = (
    "transitions", "labels of S", "labels of U", "resets", "transitions of rollouts", "held-out pictures with a label", "held-out steps with a label",
)  # fmt: skip
_ANSWERS = {SAFE: "chosen labels of S", UNSAFE: "chosen labels of U", UNLABELLED: "chosen labels of neither"}

Latents = dict[str, Tensor]


def starts_of(env: SafetyEnv, shares: Sequence[float], *, grouped: bool = True) -> Region:
    """Where episodes start: anywhere, outside U, in S and in U of an environment that knows them, in four given shares; rows that are
    reset together in this order, or in any.

    Source: paper Section IV (S, U and D are sampled apart).
    """
    return Mixture([env.state_space, env.state_space - env.unsafe_set, env.safe_set, env.unsafe_set], shares, grouped=grouped)


class TrainingStarts:
    """Environments for training: where the sets are known, episodes start in them as :func:`starts_of` says.

    ``grouped``: not where the first rows act otherwise than the others, else it would depend on the start who acts.
    """

    def __init__(self, make_env: Callable[..., EnvBase], batch_size: list[int], shares: Sequence[float], *, grouped: bool = True) -> None:
        self.make_env, self.batch_size, self.shares, self.grouped = make_env, batch_size, list(shares), grouped

    def __call__(self, seed: int | None = None) -> EnvBase:
        """An environment; others than those of this library start as they always do."""
        env = self.make_env(batch_size=self.batch_size, seed=seed)
        if isinstance(env, SafetyEnv):
            env.initial_set = starts_of(env, self.shares, grouped=self.grouped)
        return env


class Source:
    """Encoded transitions for the phases, from pictures, actions and labels; counts what it has taken.

    Args:
        make_env: ``(batch_size=[n], seed=...) -> environment`` with ``"pixels"`` and ``"region"``.
        encoder: pixels -> latent, where it is being trained.
        store: transitions of the joint training; ``None``: everything is collected anew.
        starts: shares of the episodes that start anywhere, outside U, in S, in U, where the environment knows its sets.
        steps: longest episode under random actions; ``None`` leaves that to the environment.
        envs: environments stepped together.
        seed: seed of all collections.
        augmentation: changes the pictures of what is collected anew; the store's are as they are.
        changes: of pictures, that should not matter to what comes out; by default ``augmentation``.
        labels: how many labels there are in all; what is collected anew gets those that the store has left.

    Source: paper Algorithm 1 (D grows by rollouts of the policy); deviation: labels of the rollouts are used too.
    """

    def __init__(
        self,
        make_env: Callable[..., EnvBase],
        encoder: nn.Module,
        *,
        store: TransitionStore | None = None,
        starts: Sequence[float] = (0.5, 0.0, 0.5, 0.0),
        steps: int | None = 4,
        envs: int = 256,
        seed: int = 0,
        augmentation: Augmentation | None = None,
        changes: Augmentation | None = None,
        labels: Labels | None = None,
    ) -> None:
        self.make_env, self.encoder, self.store, self.labels = make_env, getattr(encoder, "module", encoder), store, labels
        self.starts, self.steps, self.envs, self.seed, self.augmentation = list(starts), steps, envs, seed, augmentation
        changes = augmentation if changes is None else changes
        self.changes = changes if changes is not None and changes.share > 0.0 else None  # what changes nothing is not looked at twice
        self.budget = dict.fromkeys(_COUNTED, 0)
        self.tell: Callable[[int], None] = lambda transitions: None  # how many it has taken, whenever there are more

    @cached_property
    def env(self) -> Any:
        """One environment of the system; for what it knows, not for stepping."""
        return self.make_env(batch_size=[1], seed=self.seed)

    @property
    def known(self) -> bool:
        """Whether the environment knows its sets, so that episodes can start in them."""
        return isinstance(self.env, SafetyEnv)

    @property
    def outside_unsafe(self) -> Region:
        """The states that carry no label of U."""
        return self.env.state_space - self.env.unsafe_set

    def count(self, store: TransitionStore) -> None:
        """Adds what was recorded into a store to the budget."""
        self.budget["transitions"] += store.recorded
        self.budget["labels of S"] += store.given[SAFE]
        self.budget["labels of U"] += store.given[UNSAFE]
        self.budget["resets"] += (store.n_frames - len(store)) // 2  # an episode has two frames more than transitions
        self.tell(self.budget["transitions"])

    def count_stored(self) -> None:
        """Adds what the joint training has collected, unless anything was counted before."""
        if self.store is not None and not self.budget["transitions"]:
            self.count(self.store)

    def count_labels(self, answers: Tensor) -> None:
        """Adds labels ``(n,)`` that were asked for to the budget, with those that say that a picture is of neither set."""
        for code, name in _ANSWERS.items():
            self.budget[name] = self.budget.get(name, 0) + int((answers == code).sum())

    def count_held_out(self, pictures: int, *runs: Episodes) -> None:
        """Adds fresh pictures and the steps of episodes whose labels a check reads; no network learns from them."""
        self.budget["held-out pictures with a label"] += pictures
        self.budget["held-out steps with a label"] += sum(int(run.alive.sum()) for run in runs)

    def stored(self, most: int) -> Latents | None:
        """Latents of the joint training's transitions; of more than ``most``, those of S and U first, up to half, and
        others at random. ``None`` without a store."""
        if self.store is None or not len(self.store):
            return None
        self.count(self.store)
        n = len(self.store)
        index = torch.arange(n)
        if n > most:
            mixed = torch.randperm(n, generator=torch.Generator().manual_seed(self.seed))
            first = mixed[self.store.region[mixed] != UNLABELLED][: most // 2]
            index = torch.cat([first, mixed[~torch.isin(mixed, first)][: most - len(first)]]).sort().values
        return self._encode(self.store, index)

    def random(self, n: int, index: int, *, region: Region | None = None, steps: int | None = None) -> Latents:
        """Latents of n transitions under random actions.

        Args:
            index: number of this collection within its round's seeds.
            region: where episodes start; by default the shares ``starts``.
            steps: longest episode, in place of the source's.
        """

        def draw(env: EnvBase, store: TransitionStore, seed: int) -> None:
            where = region or (starts_of(env, self.starts) if isinstance(env, SafetyEnv) else None)
            collect_random(env, store.max_size, seed=seed, steps=steps or self.steps, region=where, store=store)

        return self._in_chunks(draw, n, index)

    def under(
        self,
        policy: nn.Module,
        n: int,
        index: int,
        *,
        exploration: float,
        region: Region | None = None,
        dynamics: nn.Module | None = None,
        gain: Tensor | None = None,
    ) -> Latents:
        """Latents of n transitions under a policy with noise on its actions; other arguments as for :meth:`random`.

        With ``dynamics`` and ``gain`` the policy acts behind the latent observer.
        """
        device = next(self.encoder.parameters()).device
        # A memory that drifts shows only after many times its own length.
        steps = self.steps if gain is None or self.steps is None else _LONGER * self.steps
        acting, predict = make_rollout_policy(self.encoder, policy.to(device)), None
        if gain is not None and dynamics is not None:
            observer, decide = LatentObserver(self.encoder, gain, len(gain), direction=direction_of(dynamics)).to(device), acting.module[-1]
            acting = TensorDictSequential(observer, decide, selected_out_keys=["latent", "action"])
            predict = Predict(copy.deepcopy(dynamics).to(device))
        space = self.env.action_spec_unbatched.space
        bounds = space.low.cpu().float(), space.high.cpu().float()
        exploring = ExploringPolicy(acting, *bounds, exploration, 0.0, predict).to(device)

        def draw(env: EnvBase, store: TransitionStore, seed: int) -> None:
            devices: dict[str, Any] = {}
            if device.type != "cpu":
                devices = {"policy_device": device, "env_device": "cpu", "storing_device": "cpu"}
            with torch.random.fork_rng():
                torch.manual_seed(seed)
                collect_rollouts(env, exploring, store.max_size, seed=seed, steps=steps, region=region, store=store, **devices)

        try:
            return self._in_chunks(draw, n, index, envs=max(1, _CHUNK // (steps or 1)), rollouts=True)
        finally:
            policy.cpu()

    def _in_chunks(
        self, draw: Callable[[EnvBase, TransitionStore, int], None], n: int, index: int, envs: int = _CHUNK, *, rollouts: bool = False
    ) -> Latents:
        env = self.make_env(batch_size=[min(self.envs, n, envs)], seed=self.seed)
        parts = list[Latents]()
        for k, size in enumerate(c.numel() for c in torch.arange(n).split(_CHUNK)):
            seed = spawn(self.seed, "rounds", 1000 * index + k)
            entry = Entry("transitions", seed, size)
            kept = entry.saved()
            if kept is not None:
                self.budget.update(kept["budget"])  # of an earlier version it may lack some
                self.tell(self.budget["transitions"])
                parts.append(kept["latents"])
                continue
            changes = None if self.augmentation is None else self.augmentation.with_seed(seed)
            labels = None
            if self.labels is not None:
                labels = self.labels.less(self.budget["labels of S"], self.budget["labels of U"], seed=seed)
            store = TransitionStore(size, pixel_views=not hasattr(self.encoder, "sequence"), augmentation=changes, labels=labels)
            draw(env, store, seed)
            self.count(store)
            if rollouts:
                self.budget["transitions of rollouts"] += len(store)
            parts.append(self._encode(store, torch.arange(len(store))))
            entry.save({"latents": parts[-1], "budget": self.budget}, complete=True)
        if not isinstance(env, SafetyEnv):
            env.close()
        return {k: torch.cat([p[k] for p in parts]) for k in parts[0]}

    @staticmethod
    def _check_recorded(store: TransitionStore, asked: Sequence[str]) -> None:
        if len(store) and (lacking := set(asked) - set(store.get(slice(0, 1)).keys())):
            raise ConfigError(
                f"expected a store that was recorded with these labels, received one without {', '.join(sorted(lacking))}; give the same labels to both, "
                "TransitionStore(capacity, labels=labels), and record it again"
            )

    @torch.no_grad()
    def _encode(self, store: TransitionStore, index: Tensor) -> Latents:
        """Encoded observations before and after, actions and regions of some transitions, on the CPU; which of them go on
        where the one before ends."""
        device = next(self.encoder.parameters()).device
        parts, asked = [], [] if self.labels is None else self.labels.kept
        self._check_recorded(store, asked)
        for rows in index.split(_ENCODED):
            batch = store.get(rows)
            if hasattr(self.encoder, "sequence"):
                latent, after = self.encoder.sequence(batch["frames"].to(device)).unbind(1)  # type: ignore[operator]
            else:
                latent, after = self.encoder(batch["pixels"].to(device)), self.encoder(batch["next", "pixels"].to(device))
            parts.append((latent.cpu(), after.cpu(), batch["action"], batch["region"], *(batch[k] for k in asked)))
        names = ("seen", "next_seen", "action", "region", *asked)
        found = {k: torch.cat(v) for k, v in zip(names, zip(*parts, strict=True), strict=True)}
        if self.labels is not None and self.labels.tells:  # what has a label is not what counts as if it had
            found["told"] = found["region"] != UNLABELLED
        neighbours = torch.cat([torch.zeros(1, dtype=torch.bool), index[1:] == index[:-1] + 1])
        return found | {"continues": continues(store, index) & neighbours}


__all__ = ["Source", "TrainingStarts", "starts_of"]

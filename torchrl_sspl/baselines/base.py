"""What every method of the comparison has in common: one interface, a ledger of what it was given, a one-step filter."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor

from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.evaluation.controllers import Camera, Decision

Nominal = Callable[[Tensor], Tensor]
T = TypeVar("T")
DYNAMICS = ("none", "control-affine", "exact")


@dataclass(frozen=True)
class Budget:
    """How many transitions a method may learn from; the same for all.

    Attributes:
        name: of the budget.
        transitions: under random actions, half from states anywhere, half from states outside U.
        safe, unsafe: more of them that start in S, and in U.
        rollouts: more of them under a policy of the method's own; random ones for a method without one.

    Source: none.

    Example:
        >>> BUDGETS["small"].total
        23000
    """

    name: str
    transitions: int
    safe: int
    unsafe: int
    rollouts: int = 0

    @property
    def total(self) -> int:
        """All transitions."""
        return self.transitions + self.safe + self.unsafe + self.rollouts


SCHEMA = 3  # one more where recordings, encoders or measures have changed: what was measured before is not taken
POOL = 32  # height and width to which pictures are averaged, unless a method has an option for it
EARLIER = "earlier_cpu_seconds"  # note of a method whose training goes on where another process stopped
#: Small: one recording. Full: more than the shipped agents took, with rollouts. Tiny: for tests.
BUDGETS = {
    "tiny": Budget("tiny", 96, 32, 32),
    "small": Budget("small", 16_000, 3_000, 4_000),
    "full": Budget("full", 56_000, 7_000, 24_000, 28_000),
}


@dataclass(frozen=True)
class Needs:
    """The information that a method was given, counted, and what its claim rests on.

    Attributes:
        transitions: pictures with the action that followed.
        safe_labels, unsafe_labels, neither_labels: pictures that were labelled as of S, as of U, or as of neither where that was asked.
        states: pictures that came with their true state (pose and speed).
        masks: pictures that came with the place of things in them (obstacle, robot).
        expert_actions: actions of an expert that knows state and dynamics.
        rollouts: transitions under a policy of its own.
        held_out_labels, held_out_steps: fresh pictures, and steps of fresh episodes, whose labels its own checks read.
            None: not counted, as in the trainings of the shipped agents; so are labels and transitions of an agent that does not say them.
        state_at_run_time: whether it reads the true state when it acts.
        dynamics: "none", "control-affine" (f and g are known) or "exact" (the simulator itself).
        proved, measured, claimed: what is proved of the safe set, what held-out episodes decided, and what is only claimed.

    Source: none.

    Example:
        >>> Needs(unsafe_labels=4_000).dynamics
        'none'
    """

    transitions: int | None = 0
    safe_labels: int | None = 0
    unsafe_labels: int | None = 0
    neither_labels: int | None = 0
    states: int = 0
    masks: int = 0
    expert_actions: int = 0
    rollouts: int | None = 0
    held_out_labels: int | None = 0
    held_out_steps: int | None = 0
    state_at_run_time: bool = False
    dynamics: str = "none"
    proved: str = "nothing"
    measured: str = "nothing"
    claimed: str = "nothing"

    def __post_init__(self) -> None:
        if self.dynamics not in DYNAMICS:
            raise ConfigError(f"needs.dynamics: expected one of {', '.join(DYNAMICS)}, received {self.dynamics!r}")


class SafetyMethod(ABC):
    """A method that claims states to be safe for ever under its actions, and changes the actions of a nominal policy.

    A subclass has a ``name``, says what it ``reads``, and gives ``fit``, ``barrier`` and ``act``.

    Attributes:
        name: of the row.
        reads: ``"pixels"``, two stacked frames uint8 ``(n, 6, H, W)``, or ``"state"``, true states ``(n, s)``.
        learns: whether budget and seed matter.
        records: whether ``fit`` takes a recording.
        pools: whether pictures are averaged for it, see :attr:`side`.
        needs: what it was given, complete after ``fit``.
        notes: figures of its own training.
        directory: where a training of its own may write; None: nowhere.
        env_name: name or file of the system's configuration, ``env=`` of a cell; "": not known.
        stages: what stages of ``fit`` have learnt, see :meth:`stage`; trials that fit on the same data share it.
        Config: dataclass of its options.
        space: what is tried where it is tuned, values by option.
        published: values of the paper by option, where the defaults are others; the second trial has them.

    Source: none.

    Example:
        >>> class Nowhere(SafetyMethod):
        ...     name, reads = "nowhere", "state"
        ...     def fit(self, data, env, budget, seed):
        ...         self.needs = Needs(state_at_run_time=True)
        ...     def barrier(self, seen):
        ...         return torch.ones(len(seen))
        ...     def act(self, seen, nominal):
        ...         return nominal, torch.zeros(len(seen), dtype=torch.bool)
        >>> Nowhere(None).claims(torch.zeros(2, 3))
        tensor([False, False])
    """

    name: ClassVar[str]
    reads: ClassVar[str] = "pixels"
    learns: ClassVar[bool] = True
    records: ClassVar[bool] = True
    pools: ClassVar[bool] = True
    Config: ClassVar[type | None] = None
    space: ClassVar[dict[str, tuple[Any, ...]]] = {}
    published: ClassVar[dict[str, Any]] = {}
    needs: Needs = Needs()

    def __init__(self, config: Any = None) -> None:
        self.config: Any = config if config is not None or self.Config is None else self.Config()
        self.notes: dict[str, float] = {}
        self.directory: Path | None = None
        self.env_name = ""
        self.stages: dict[tuple[str, ...], Any] = {}

    def stage(self, options: Sequence[str], learn: Callable[[], T]) -> T:
        """What a stage of ``fit`` learns, or has learnt with the same options; random numbers go on from its end.

        Args:
            options: names of all options that it reads.
            learn: returns what later stages read and do not change.
        """
        key = tuple(f"{name}={getattr(self.config, name)}" for name in options)
        if key not in self.stages:
            self.stages[key] = learn(), torch.get_rng_state()
        found, state = self.stages[key]
        torch.set_rng_state(state)
        return found

    @property
    def side(self) -> int | None:
        """Height and width to which pictures are averaged for it: its option ``pixels``, else what rivals share; None: it sees them as they are."""
        return getattr(self.config, "pixels", POOL) if self.pools else None

    @classmethod
    def idle(cls, env: SafetyEnv) -> tuple[str, ...]:
        """Options that do nothing on this system, which trials do not draw."""
        return ()

    @abstractmethod
    def fit(self, data: Any, env: SafetyEnv, budget: Budget, seed: int) -> None:
        """Learn from a :class:`~torchrl_sspl.baselines.data.Recording`, and fill the ledger ``needs``.

        Args:
            data: what was recorded of the environment; None for a method that does not learn.
            env: the system; only what ``needs`` says may be read from it.
            budget: what may be learnt from.
            seed: of initial weights, batches and whatever else is drawn.
        """

    @abstractmethod
    def barrier(self, seen: Tensor) -> Tensor | None:
        """Value ``(n,)`` of what it reads, at most zero where it claims safety; None for a method that claims nothing."""

    @abstractmethod
    def act(self, seen: Tensor, nominal: Tensor) -> tuple[Tensor, Tensor]:
        """Actions ``(n, m)`` near wanted ones ``(n, m)``, in physical units, and ``(n,)`` whether none met its condition."""

    def claims(self, seen: Tensor) -> Tensor | None:
        """Whether states are called safe for ever under its actions, ``(n,)`` bool; None if it claims nothing."""
        value = self.barrier(seen)
        return None if value is None else value <= 0

    def controller(self, nominal: Nominal) -> Guarded:
        """The method in a closed loop, see :class:`Guarded`."""
        return Guarded(self, nominal)

    def ledger(self, **known: Any) -> Needs:
        """``needs`` with some entries replaced."""
        return replace(self.needs, **known)


class Guarded:
    """A method that changes the actions of a nominal policy, as a controller of ``simulate``; counts what it does.

    Args:
        method: what acts.
        nominal: true states ``(n, s)`` -> wanted actions ``(n, m)``, which may be an adversary's.

    Attributes:
        steps, infeasible: actions asked for, and those of them for which the method's own condition could not be met.
        deviation: sum of the distances between action and wanted action, physical units.

    Source: none.

    Example:
        >>> from torchrl_sspl.baselines.ceilings import BoxMargin
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> from torchrl_sspl.evaluation import simulate
        >>> method, env = BoxMargin(), PendulumEnv()
        >>> method.fit(None, env, BUDGETS["tiny"], 0)
        >>> run = simulate(method.controller(lambda x: torch.zeros(len(x), 1)), env, start=torch.zeros(5, 2), horizon=3)
        >>> run.actions.shape
        torch.Size([3, 5, 1])
    """

    reads, streams = "pixels", True

    def __init__(self, method: SafetyMethod, nominal: Nominal) -> None:
        self.method, self.nominal = method, nominal
        self.steps = self.infeasible = 0
        self.deviation = 0.0

    def reset(self, rows: Tensor | None = None) -> None:
        """It has no memory."""

    def watch(self, camera: Camera, rows: Tensor | None = None) -> Decision:
        """Nothing is decided about the last observation."""
        return Decision()

    def step(self, camera: Camera, rows: Tensor | None = None) -> Decision:
        """Actions ``(k, m)``; see ``Controller``."""
        wanted = self.nominal(camera.state)
        action, infeasible = self.decide(camera, rows, wanted)
        self.steps += len(action)
        self.infeasible += int(infeasible.sum())
        self.deviation += float((action - wanted).norm(dim=-1).sum())
        return Decision(action)

    def decide(self, camera: Camera, rows: Tensor | None, wanted: Tensor) -> tuple[Tensor, Tensor]:
        """Actions of the method, and where its condition could not be met."""
        if self.method.reads == "state":
            return self.method.act(camera.state, wanted)
        seen, start, parts = camera.pixels(), 0, []
        for part in seen:
            parts.append(self.method.act(part, wanted[start : start + len(part)]))
            start += len(part)
        action, infeasible = zip(*parts, strict=True)
        return torch.cat(action), torch.cat(infeasible)


def nearest_admissible(candidates: Tensor, value: Tensor, limit: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor]:
    r"""Nearest of the candidates whose value is within the limit, else the one of the least value.

    .. math:: u = \arg\min_{v : h_v \le \ell} \lVert v - u_{wanted} \rVert, \qquad u = \arg\min_v h_v \text{ if there is none}

    Args:
        candidates: ``(n, k, m)`` actions.
        value: ``(n, k)`` what each leads to.
        limit: ``(n,)`` largest value that is admitted.
        wanted: ``(n, m)``.

    Returns the actions ``(n, m)`` and ``(n,)`` whether none was admitted. Raises ShapeError if the sizes do not agree.
    Source: the filter of all discrete-time control barrier functions; the published ones sample in place of a grid.

    Example:
        >>> tried = torch.tensor([[[-1.0], [0.0], [1.0]]])
        >>> nearest_admissible(tried, torch.tensor([[0.0, 1.0, 0.0]]), torch.zeros(1), torch.tensor([[0.4]]))
        (tensor([[1.]]), tensor([False]))
    """
    if candidates.shape[:2] != value.shape or wanted.shape != candidates[:, 0].shape or limit.shape != value.shape[:1]:
        shapes = [tuple(t.shape) for t in (candidates, value, limit, wanted)]
        raise ShapeError(f"filter: expected (n, k, m), (n, k), (n,) and (n, m), received {shapes}")
    admitted = value <= limit[:, None]
    none = ~admitted.any(1)
    cost = (candidates - wanted[:, None]).norm(dim=-1).masked_fill(~admitted, torch.inf)
    chosen = torch.where(none, value.argmin(1), cost.argmin(1))
    return candidates[torch.arange(len(value)), chosen], none


class OneStepFilter(SafetyMethod):
    r"""A function h of what is perceived, safe where :math:`h \le 0`, and the nearest action that keeps it.

    .. math:: u = \arg\min_v \lVert v - u_{wanted} \rVert \quad \text{with} \quad h(f(x, v)) \le \alpha\, h(x)

    over an equally spaced grid of actions and the wanted one itself; ``offset`` is added to h, in the claim and in the filter. A subclass
    gives ``perceive``, ``h`` and ``predict``. Source: discrete-time control barrier functions.
    """

    alpha: float = 0.5
    offset: float = 0.0
    grid: int = 21
    env: SafetyEnv

    @abstractmethod
    def perceive(self, seen: Tensor) -> Tensor:
        """State ``(n, p)``, as the method has it, of what it reads."""

    @abstractmethod
    def h(self, state: Tensor) -> Tensor:
        """Value ``(n,)`` of perceived states, at most zero where they are called safe."""

    @abstractmethod
    def predict(self, state: Tensor, action: Tensor) -> Tensor:
        """Perceived states one step later, ``(n, p)``."""

    def barrier(self, seen: Tensor) -> Tensor | None:
        """h of what is perceived."""
        return self.raised(self.perceive(seen))

    def raised(self, state: Tensor) -> Tensor:
        """h and the offset ``(n,)``."""
        return self.h(state) + self.offset

    def after(self, state: Tensor, candidates: Tensor) -> Tensor:
        """h ``(n, k)`` of the successors of states ``(n, p)`` under ``(n, k, m)`` actions."""
        n, k, m = candidates.shape
        repeated = state[:, None].expand(n, k, state.shape[-1]).reshape(n * k, -1)
        return self.raised(self.predict(repeated, candidates.reshape(n * k, m))).reshape(n, k)

    def candidates(self, wanted: Tensor) -> Tensor:
        """Actions that are tried, ``(n, k, m)``; the wanted one first."""
        bound = self.env.max_action
        axes = [torch.linspace(-bound, bound, self.grid)] * self.env.action_dim
        table = torch.cartesian_prod(*axes).reshape(-1, self.env.action_dim)
        return torch.cat([wanted[:, None].clamp(-bound, bound), table.expand(len(wanted), *table.shape)], 1)

    def limit(self, state: Tensor) -> Tensor:
        """Largest value ``(n,)`` that a successor may have."""
        return self.alpha * self.raised(state)

    @torch.no_grad()
    def act(self, seen: Tensor, nominal: Tensor) -> tuple[Tensor, Tensor]:
        """The nearest admissible actions; arguments as for :meth:`SafetyMethod.act`."""
        state, tried = self.perceive(seen), self.candidates(nominal)
        return nearest_admissible(tried, self.after(state, tried), self.limit(state), nominal)


__all__ = ["BUDGETS", "Budget", "Guarded", "Needs", "Nominal", "OneStepFilter", "SafetyMethod", "nearest_admissible"]

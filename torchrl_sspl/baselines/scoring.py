"""The measures of the comparison: what a method claims, against the true kernel, and what happens in its closed loop."""

from __future__ import annotations

import contextlib
import math
import time
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_sspl.baselines.base import Guarded, Nominal, SafetyMethod
from torchrl_sspl.baselines.data import pooled
from torchrl_sspl.baselines.pictures import Album, shifts
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.envs.dubins import DubinsEnv
from torchrl_sspl.envs.pendulum import PixelPendulumEnv
from torchrl_sspl.envs.quadruped.camera import RenderError
from torchrl_sspl.errors import ConfigError, MissingDependencyError
from torchrl_sspl.evaluation.known import states_where
from torchrl_sspl.evaluation.measurements import Draw, Evaluation, Measurement
from torchrl_sspl.evaluation.simulation import simulate
from torchrl_sspl.sets import UNSAFE
from torchrl_sspl.viability.grid import ViabilityKernel, viability_kernel

_RIM = 2  # cells of the kernel's grid that the common set keeps from its border
_ENTER = 0.001  # share of the check episodes that may enter U at a calibrated level
_EPISODES, _HORIZON = 500, 200  # of every method: columns of one table are alike
NOMINALS = ("harmless", "adversarial")
CLAIMS = ("claimed_over_kernel", "false_safe", "unsafe_called_safe")


@dataclass
class ScoreConfig:
    """Sizes of the measurements."""

    episodes: int = 0  # of each of the four blocks; 0: 500, of methods on states and on pictures alike
    horizon: int = 0  # steps of each; 0: 200, of trials 60
    grid: int = 0  # states along the finest coordinate of the grid of the sets; 0: the system's own
    kernel_grid: int = 0  # the same of the true kernel's grid
    check_episodes: int = 0  # that place a calibrated level; 0: as many as episodes
    frames: int = 200  # of which the latency is taken
    shifted: int = 1000  # uniform states that are shown on shifted pictures of each kind; 0: none
    seed: int = 20260104  # of the starts

    def check(self) -> None:
        """Raises ConfigError for a size with which nothing can be measured, or a seed that is none."""
        if not 0 <= self.seed < 2**62:
            raise ConfigError(f"score.seed: expected an integer in [0, 2^62), received {self.seed}")
        for name, value in vars(self).items():
            least = 1 if name == "frames" else 2 if name in ("grid", "kernel_grid") and value else 0
            if not value >= least:
                raise ConfigError(f"score.{name}: expected >= {least}{', or 0 for the default' if least == 2 else ''}, received {value}")


def harmless(env: SafetyEnv) -> Nominal:
    """A nominal policy that does nothing: states ``(n, s)`` -> zeros ``(n, m)``. Source: none.

    Example:
        >>> harmless(PixelPendulumEnv())(torch.ones(2, 2))
        tensor([[0.],
                [0.]])
    """
    return lambda state: torch.zeros(len(state), env.action_dim)


def adversarial(env: SafetyEnv) -> Nominal:
    r"""A nominal policy that wants harm: the pendulum is pushed over, the car steers at the obstacle.

    .. math:: u = u_{max} \operatorname{sign}(\theta + 0.3\, \dot\theta), \qquad u = \operatorname{sat}(3\,(\text{bearing of the obstacle}))

    Raises ConfigError for another system. Source: none.

    Example:
        >>> adversarial(PixelPendulumEnv())(torch.tensor([[0.1, 0.0]]))
        tensor([[10.]])
    """
    if isinstance(env, PixelPendulumEnv):
        return lambda x: env.max_action * torch.where(x[:, :1] + 0.3 * x[:, 1:] >= 0, 1.0, -1.0)
    if isinstance(env, DubinsEnv):
        centre, bound = torch.tensor(env.obstacle_centre), env.max_action

        def chase(state: Tensor) -> Tensor:
            to = centre - state[:, :2]
            off = torch.atan2(to[:, 1], to[:, 0]) - state[:, 2]
            return (3 * torch.remainder(off + math.pi, 2 * math.pi) - 3 * math.pi).clamp(-bound, bound)[:, None]

        return chase
    raise ConfigError(f"adversary: expected a pendulum or a Dubins car, received {type(env).__name__}; give a nominal policy of your own")


def nominals(env: SafetyEnv) -> dict[str, Nominal]:
    """The nominal policies of the score by name; without the adversarial one for a system whose harm nobody has written down. Source: none.

    Example:
        >>> from torchrl_sspl.envs import CMUTwoDiscsEnv
        >>> list(nominals(PixelPendulumEnv())), list(nominals(CMUTwoDiscsEnv()))
        (['harmless', 'adversarial'], ['harmless'])
    """
    found = {"harmless": harmless(env)}
    with contextlib.suppress(ConfigError):
        found["adversarial"] = adversarial(env)
    return found


def well_inside(kernel: ViabilityKernel, state: Tensor, cells: int = _RIM) -> Tensor:
    """Whether states ``(n, s)`` and their neighbours some cells away all belong to the kernel, bool ``(n,)``. Source: none.

    Example:
        >>> kernel = viability_kernel(lambda x, u: x + u, low=[-1.0], high=[1.0], resolution=21, margin=lambda x: 0.5 - x[:, 0].abs(),
        ...                           actions=torch.zeros(1, 1))
        >>> well_inside(kernel, torch.tensor([[0.2], [0.4]]))
        tensor([ True, False])
    """
    steps = torch.tensor(kernel.grid.step) * cells
    inside = kernel.contains(state)
    for shift in torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * len(steps)).reshape(-1, len(steps)):
        moved = state + shift * steps
        # What the shift takes out of the arena says nothing of the rim where leaving is safe; elsewhere it is outside.
        inside = inside & kernel.contains(moved)
    return inside


def barrier_on(method: SafetyMethod, env: SafetyEnv, state: Tensor, album: Album | None = None, shift: str = "") -> Tensor | None:
    """Barrier values ``(n,)`` of a method at true states ``(n, s)``, by its pictures if it reads those; None without. Source: none.

    Args:
        method: fitted.
        env: the system.
        state: ``(n, s)``.
        album: pictures that were drawn before; those of ``env`` if not given.
        shift: name of other pictures, see ``shifts``.

    Example:
        >>> from torchrl_sspl.baselines import make
        >>> barrier_on(make("imitation"), PixelPendulumEnv(), torch.zeros(2, 2)) is None
        True
    """
    values = []
    for seen in [state] if method.reads == "state" else (album or Album(env))(state, shift, size=method.side):
        value = method.barrier(seen)
        if value is None:
            return None
        values.append(value.detach())
    return torch.cat(values) if values else torch.zeros(0)


def paths(
    method: SafetyMethod, env: SafetyEnv, start: Tensor, nominal: Nominal, horizon: int, draw: Draw | None = None
) -> tuple[Guarded, Tensor, Tensor]:
    """What acted from states ``(n, s)``, ``(n,)`` which of the episodes enter U, and where they went, ``(horizon + 1, n, s)``.

    ``draw`` is another camera, ``(n, s)`` -> frames uint8 ``(n, 3, H, W)``; the system's own if not given. Source: none.

    Example:
        >>> from torchrl_sspl.baselines import BUDGETS, make
        >>> env, method = PixelPendulumEnv(), make("lqr")
        >>> method.fit(None, env, BUDGETS["tiny"], 0)
        >>> paths(method, env, torch.tensor([[0.1, 0.0], [1.5, 1.4]]), harmless(env), 9)[1]
        tensor([False,  True])
    """
    acts = method.controller(nominal)
    # Each frame is averaged once, not with every observation that holds it.
    frame = draw or env.draw
    run = simulate(acts, env, start=start, horizon=horizon, draw=frame if (side := method.side) is None else lambda state: pooled(frame(state), side))
    assert run.states is not None
    return acts, ((run.region == UNSAFE) & run.alive).any(0), run.states


@dataclass
class _Score:
    """What the parts of a score share."""

    method: SafetyMethod
    env: SafetyEnv
    kernel: ViabilityKernel
    config: ScoreConfig
    out: Evaluation
    album: Album
    nominals: dict[str, Nominal]

    def barrier(self, state: Tensor, shift: str = "") -> Tensor | None:
        return barrier_on(self.method, self.env, state, self.album, shift)

    def inside(self, state: Tensor) -> Tensor:
        value = self.barrier(state)
        return torch.zeros(len(state), dtype=torch.bool) if value is None else value <= 0

    def episodes(self, start: Tensor, nominal: str, draw: Draw | None = None) -> tuple[Guarded, Tensor, Tensor]:
        return paths(self.method, self.env, start, self.nominals[nominal], self.config.horizon, draw)

    def starts(self, keep, index: int, n: int) -> Tensor:
        generator = torch.Generator().manual_seed(self.config.seed + index)
        return states_where(keep, self.env.state_space, n, generator)


@torch.no_grad()
def score(
    method: SafetyMethod, env: SafetyEnv, config: ScoreConfig | None = None, *, kernel: ViabilityKernel | None = None, album: Album | None = None
) -> Evaluation:
    """Measures a method after ``fit``: its claims on a grid, its closed loop, its latency, its claims on shifted pictures.

    The names: ``claimed_over_kernel``, ``false_safe`` (of what is claimed), ``unsafe_called_safe``;
    ``claimed_<nominal>_enter`` and ``common_<nominal>_enter``, episodes into U from the claimed set and from the kernel without
    its rim of two cells; ``<...>_infeasible`` (of all steps) and ``<...>_deviation`` (mean distance from the nominal
    action); ``calibrated_...`` at the level at which at most one in a thousand other episodes enters U; ``latency_p50`` and
    ``latency_p99``; ``shifted_<name>_...``, the claims of one who reads pictures when these are other ones, see
    :func:`~torchrl_sspl.baselines.pictures.shifts`. A method that claims nothing is measured from the common set alone, on other
    pictures, too (``shifted_<name>_common_harmless_enter``). What a system has no adversary or no such picture for is left out.

    Args:
        method: fitted.
        env: the true system.
        config: sizes; see :class:`ScoreConfig`.
        kernel: true viability kernel; computed if not given.
        album: pictures that another score of the same system has drawn.

    Returns measurements with exact 95 % bounds. Source: none; the paper compares by ticks.

    Example:
        >>> from torchrl_sspl.baselines import BUDGETS, make
        >>> env, method = PixelPendulumEnv(), make("lqr")
        >>> method.fit(None, env, BUDGETS["tiny"], 0)
        >>> score(method, env, ScoreConfig(episodes=50, horizon=20, grid=41, kernel_grid=61, frames=5))["false_safe"]
        0.0
    """
    given = config or ScoreConfig()
    given.check()
    on_states = method.reads == "state"
    episodes = given.episodes or _EPISODES
    sizes = ScoreConfig(
        episodes, given.horizon or _HORIZON, given.grid, given.kernel_grid,
        given.check_episodes or episodes, given.frames, given.shifted, given.seed,
    )  # fmt: skip
    if kernel is None:
        kernel = viability_kernel(env, resolution=sizes_of(env.system.kernel_grid, given.kernel_grid))
    it = _Score(method, env, kernel, sizes, Evaluation(), album or Album(env), nominals(env))
    barrier = _sets(it)
    if barrier is not None:
        _calibrated(it, barrier, _loops(it, "claimed", it.inside, 0))
    _loops(it, "common", lambda x: well_inside(kernel, x), 1)
    _latency(it)
    if not on_states and sizes.shifted:
        _shifted(it) if barrier is not None else _shifted_loops(it)
    return it.out


def sizes_of(own: int | tuple[int, ...], n: int) -> int | tuple[int, ...]:
    """Nodes of a grid: the system's own, or n along its finest coordinate and the others in proportion. Source: none.

    Example:
        >>> sizes_of((61, 61, 37), 31)
        (31, 31, 19)
    """
    if isinstance(own, int) or not n:
        return n or own
    return tuple(max(2, round(k * n / max(own))) for k in own)


def middles(env: SafetyEnv, sizes: int | tuple[int, ...]) -> Tensor:
    """Middles of the cells of a grid over the state space, ``(prod(sizes), s)``.

    Nodes on the border of U, of which rounding decides whether they belong to it, would count as much as whole cells. Source: none.

    Example:
        >>> middles(PixelPendulumEnv(), (2, 7))[0]
        tensor([-1.5708, -3.0000])
    """
    low, high = env.state_space.low, env.state_space.high  # type: ignore[attr-defined]
    counts = [sizes] * len(low) if isinstance(sizes, int) else list(sizes)
    axes = [a + (b - a) * (torch.arange(n) + 0.5) / n for a, b, n in zip(low, high, counts, strict=True)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(axes))


def _sets(it: _Score) -> tuple[Tensor, Tensor, Tensor] | None:
    """The claimed set on a grid: barrier, kernel, U, one value for each node."""
    states = middles(it.env, sizes_of(it.env.system.state_grid, it.config.grid))
    viable, unsafe = it.kernel.contains(states), it.env.unsafe_set.contains(states)
    barrier = it.barrier(states)
    if barrier is None:
        it.out.missing(*CLAIMS, note="claims nothing")
        return None
    _count_sets(it.out, "", barrier <= 0, viable, unsafe)
    it.out.arrays.update(states=states, barrier=barrier, viable=viable)
    return barrier, viable, unsafe


def _count_sets(out: Evaluation, prefix: str, claimed: Tensor, viable: Tensor, unsafe: Tensor, *, independent: bool = False) -> None:
    for name, events, note, of in (
        ("claimed_over_kernel", claimed & viable, "cells of the true kernel that are claimed", viable),
        ("false_safe", claimed & ~viable, "claimed cells outside the true kernel", claimed),
        ("unsafe_called_safe", claimed & unsafe, "cells of U that are claimed", unsafe),
    ):
        out.count(f"{prefix}{name}", events, note, of, independent=independent)


def _loops(it: _Score, name: str, keep, index: int) -> list[tuple[Tensor, Tensor]]:
    """Episodes from a set, under both nominal policies; returns starts and which of them enter U."""
    start = it.starts(keep, index, it.config.episodes)
    found = []
    for label in NOMINALS:
        key, where = f"{name}_{label}", f"episodes of {it.config.horizon} steps from the {name} set, {label} nominal policy"
        if not len(start) or label not in it.nominals:
            reason = f"no {label} nominal policy is known for this system" if len(start) else f"the {name} set is empty"
            it.out.missing(f"{key}_enter", f"{key}_infeasible", note=reason)
            it.out.missing(f"{key}_deviation", unit="physical units", note=reason)
            continue
        acts, entered, states = it.episodes(start, label)
        it.out.count(f"{key}_enter", entered, where)
        if name == "claimed" and bool(entered.any()):  # for a film, of a start that could be kept safe if there is one
            telling = entered & it.kernel.contains(start)
            chosen = telling if bool(telling.any()) else entered
            it.out.arrays[f"failed_{label}"] = states[:, int(chosen.int().argmax())]
        steps = max(1, acts.steps)
        it.out.add(Measurement(f"{key}_infeasible", acts.infeasible / steps, "share", steps, note=f"steps of {where}, not independent"))
        it.out.add(Measurement(f"{key}_deviation", acts.deviation / steps, "physical units", steps, note=f"mean distance, steps of {where}"))
        found.append((start, entered))
    return found


def _calibrated(it: _Score, sets: tuple[Tensor, Tensor, Tensor], found: list[tuple[Tensor, Tensor]]) -> None:
    """The same sets and episodes at a level that other episodes have placed."""
    names = [f"calibrated_{n}_enter" for n in it.nominals]
    check = it.starts(it.inside, 2, it.config.check_episodes) if found else torch.zeros(0)
    if not len(check):  # a set of size zero, which counts in a mean over seeds; of a handful of states starts may be found once and not again
        _count_sets(it.out, "calibrated_", torch.zeros_like(sets[1]), *sets[1:])
        it.out.missing(*names, note="so little is claimed that no episode was found to place a level by" if found else "nothing is claimed")
        return
    shares = zip(check.tensor_split(len(it.nominals)), it.nominals, strict=True)
    each = [(x, it.episodes(x, label)[1]) for x, label in shares if len(x)]
    value = it.barrier(torch.cat([x for x, _ in each]))
    assert value is not None
    level = calibrated_level(value, torch.cat([e for _, e in each]))
    it.out.add(Measurement("calibrated_level", level if math.isfinite(level) else None, "barrier", len(value), note="of held-out episodes"))
    barrier, viable, unsafe = sets
    _count_sets(it.out, "calibrated_", barrier <= level, viable, unsafe)
    for name, (start, entered) in zip(names, found, strict=True):
        of = it.barrier(start)
        assert of is not None
        it.out.count(name, entered & (of <= level), "of the episodes from the claimed set, those that start below the level", of <= level)


def calibrated_level(barrier: Tensor, entered: Tensor, share: float = _ENTER) -> float:
    r"""Largest level :math:`c \le 0` below which at most a share of the episodes enters U, -inf if there is none.

    ``barrier (n,)`` at the starts of held-out episodes and ``entered (n,)`` bool, whether they enter U. Source: none.

    Example:
        >>> value = torch.tensor([-0.1, -0.2, -0.3])
        >>> round(calibrated_level(value, torch.tensor([True, False, False])), 6), calibrated_level(value, torch.zeros(3, dtype=torch.bool))
        (-0.2, 0.0)
        >>> calibrated_level(torch.tensor([-0.1, -0.1]), torch.tensor([False, True]))  # those at the level belong to it
        -inf
    """
    if not len(barrier) or not bool(entered.any()):
        return 0.0
    order = barrier.argsort()
    entered_before = entered[order].float().cumsum(0) / torch.arange(1, len(order) + 1)
    last_of_its_value = barrier[order].diff(append=torch.tensor([math.inf])) > 0
    good = ((entered_before <= share) & last_of_its_value).nonzero()
    if not len(good):
        return -math.inf
    last = int(good[-1])
    return 0.0 if last == len(order) - 1 else min(0.0, float(barrier[order[last]]))  # fresh noise at a start may say more than zero


def _latency(it: _Score) -> None:
    """Median and 99th percentile of the time from an observation to its action and claim, one after the other."""
    state = it.env.sample_states(20, torch.Generator().manual_seed(0))
    seen = state if it.method.reads == "state" else it.env.observe(state)
    wanted, seconds = torch.zeros(1, it.env.action_dim), []
    for k in range(it.config.frames + 5):
        start = time.perf_counter()
        it.method.act(seen[k % 20 : k % 20 + 1], wanted)
        it.method.barrier(seen[k % 20 : k % 20 + 1])
        seconds.append(1e3 * (time.perf_counter() - start))
    ordered = sorted(seconds[5:])
    for name, q in (("latency_p50", 0.5), ("latency_p99", 0.99)):
        value = ordered[math.ceil(q * len(ordered)) - 1]
        it.out.add(Measurement(name, value, "ms", len(ordered), note=f"{torch.get_num_threads()} thread(s), action and claim"))


def _shifted(it: _Score) -> None:
    """What is claimed on pictures of another kind, at states that are the same for all methods."""
    state = it.env.state_space.sample(it.config.shifted, torch.Generator().manual_seed(it.config.seed + 3))
    viable, unsafe = it.kernel.contains(state), it.env.unsafe_set.contains(state)
    for name in shifts(it.env):
        try:
            claimed = it.barrier(state, name)
        except (MissingDependencyError, RenderError) as error:
            it.out.missing(*(f"shifted_{name}_{n}" for n in CLAIMS), note=str(error))
            continue
        assert claimed is not None
        _count_sets(it.out, f"shifted_{name}_", claimed <= 0, viable, unsafe, independent=True)


def _shifted_loops(it: _Score) -> None:
    """Episodes from the common set that see other pictures, of a method that claims nothing."""
    start = it.starts(lambda x: well_inside(it.kernel, x), 1, it.config.episodes)
    for name, draw in shifts(it.env).items():
        key = f"shifted_{name}_common_harmless_enter"
        try:
            it.out.count(key, it.episodes(start, "harmless", draw)[1], f"episodes of {it.config.horizon} steps from the common set, other pictures")
        except (MissingDependencyError, RenderError) as error:
            it.out.missing(key, note=str(error))


__all__ = ["ScoreConfig", "adversarial", "barrier_on", "calibrated_level", "harmless", "middles", "nominals", "paths", "score", "sizes_of", "well_inside"]

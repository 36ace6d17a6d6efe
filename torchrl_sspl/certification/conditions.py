r"""The conditions of a barrier certificate, decided for frozen networks on the whole latent domain.

All are about the closed loop :math:`z^+ = d(z, \pi(z))` on a box that the encoder cannot leave. Each is proved, refuted
with a counterexample, or undecided with what remains. Of a policy that chooses, what it would do is bounded for each action
beside what it accepts (Theorem H in ``docs/theory.md``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchrl_sspl.certification.branch_and_bound import SLACK, Budget, Outcome, Problem, maximise
from torchrl_sspl.certification.floating import less_than, more_than
from torchrl_sspl.certification.graph import Apply
from torchrl_sspl.certification.loop import ClosedLoop
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.lipschitz.layers import Activation


def decide_invariance(
    system: ClosedLoop,
    *,
    condition: str = "R3",
    level: float = 0.0,
    margin: float = 0.0,
    decay: float = 0.0,
    decrement: float = 0.0,
    floor: float = 0.0,
    budget: Budget | None = None,
    confirm: Callable[[Tensor], bool] | None = None,
    progress: bool = False,
) -> Outcome:
    r"""Decides [V]: the set :math:`\{B \le s\}` is kept, with a margin.

    .. math:: B(z) \le s \;\Rightarrow\; \begin{cases}
        B(d(z, \pi(z))) + m \le s & \text{R3} \\
        B(d(z, \pi(z))) + m \le (1 - \alpha) B(z) & \text{R1} \\
        B(d(z, \pi(z))) + m \le \max(B(z) - \gamma, -c) & \text{R2} \end{cases}

    Args:
        system: the closed loop.
        condition: "R3", "R1" or "R2"; of a policy that chooses R3 alone.
        level: s, barrier units.
        margin: m, barrier units.
        decay: :math:`\alpha \in [0, 1]` of R1.
        decrement: :math:`\gamma \ge 0` of R2, barrier units.
        floor: c of R2, barrier units.
        budget: when to give up.
        confirm: whether a point ``(p,)`` is a counterexample for the deployed networks too.
        progress: show a progress bar.

    Returns:
        The outcome; ``upper`` bounds left side minus right side. Of a policy that accepts its own actions at more than
        :math:`s - m` it is undecided at best.

    Raises:
        ConfigError: if the condition is unknown or not one for this policy, or a parameter is out of range.

    Source: paper eq. (5); deviation: on the set instead of everywhere, on the whole latent domain instead of samples.

    Example:
        >>> from torch import nn
        >>> from torchrl_sspl.certification import closed_loop
        >>> plant = nn.Sequential(nn.Linear(2, 1, bias=False))  # z+ = z / 2, and B(z) = z
        >>> nn.utils.vector_to_parameters(torch.tensor([0.5, 0.0]), plant.parameters())
        >>> loop = closed_loop(nn.Identity(), plant, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=1.0)
        >>> [decide_invariance(loop, level=0.5, margin=m).status for m in (0.2, 0.3)]
        ['proved', 'refuted']
    """
    terms: dict[str, dict[str, Any]] = {
        "R3": dict(constant=(margin - level,)),
        "R1": dict(weight=(1.0 - decay,), constant=(margin,)),
        "R2": dict(weight=(1.0, 0.0), constant=(margin + decrement, margin + floor)),
    }
    if condition not in terms:
        raise ConfigError(f"expected condition to be one of {', '.join(terms)}, received {condition!r}")
    if not 0.0 <= decay <= 1.0 or decrement < 0.0 or not math.isfinite(level + margin + floor):
        raise ConfigError(
            f"expected 0 <= decay <= 1, decrement >= 0 and finite level, margin and floor, received decay={decay}, "
            f"decrement={decrement}, level={level}, margin={margin}, floor={floor}"
        )
    how: dict[str, Any] = {"threshold": 0.0, "budget": budget, "confirm": confirm, "progress": progress}
    if condition == "R3":
        return largest_next(system, level=level, constant=margin - level, **how)
    return maximise(system.problem(level=level, **terms[condition]), **how)


def largest_next(
    system: ClosedLoop, *, level: float, constant: float, error: float = 0.0, lost: float = 0.0, threshold: float | None = None, **how: Any
) -> Outcome:
    r"""Largest :math:`B(d(z, \pi(z)) + e) + c` where B is at most a level, or a decision about it (:func:`.branch_and_bound.maximise`).

    A policy that chooses accepts its own action wherever B is computed to be at most :math:`-m` after it; that counts, too, as
    :math:`-m + c + 2 \lambda + L_B \delta`.

    Args:
        system: the closed loop.
        level: s, barrier units.
        constant: c.
        error: :math:`\delta \ge \lVert e \rVert`, latent units.
        lost: :math:`\lambda`, what an evaluation of :math:`B(d(z, \pi(z)))` may be off, barrier units.
        threshold: value to prove.
        **how: of ``maximise``.

    Source: none.

    Example:
        >>> from torch import nn
        >>> from torchrl_sspl.certification import closed_loop
        >>> plant = nn.Sequential(nn.Linear(2, 1, bias=False))  # z+ = z / 2, and B(z) = z
        >>> nn.utils.vector_to_parameters(torch.tensor([0.5, 0.0]), plant.parameters())
        >>> loop = closed_loop(nn.Identity(), plant, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=1.0)
        >>> 0.25 <= largest_next(loop, level=0.5, constant=0.0).upper < 0.252
        True
    """
    own = math.fsum((system.accepted, constant, 2.0 * lost, system.lost_by(error)))
    found = maximise(system.problem(level=level, constant=(constant,), error=error, lost=lost), threshold=threshold, **how)
    kept = found.status != "proved" or threshold is None or own <= threshold
    return replace(found, status=found.status if kept else "undecided", upper=max(found.upper, own))


@dataclass(frozen=True)
class LargestError:
    """How large a latent error the invariance tolerates; errors in latent units."""

    delta: float  # proved: for errors up to this the set is kept; negative: it is not kept even without any
    refuted_above: float  # above this there is a counterexample, of the Lipschitz argument, not of the system
    outcome: Outcome  # the search behind it


def largest_error(
    system: ClosedLoop, *, level: float = 0.0, tolerance: float = 1e-3, budget: Budget | None = None, progress: bool = False
) -> LargestError:
    r"""Largest error of the latent dynamics for which :math:`\{B \le s\}` is kept, from both sides.

    .. math:: \delta^* = - \frac{1}{L_B} \max_{B(z) \le s} \left( B(d(z, \pi(z))) - s \right)

    Args:
        system: the closed loop, with a finite Lipschitz bound.
        level: s, barrier units.
        tolerance: distance of the two sides of the maximum at which the search ends, barrier units.
        budget: when to give up.
        progress: show a progress bar.

    Source: none (the paper estimates the error and asks for the margin; here the margin is computed).

    Example:
        >>> from torch import nn
        >>> from torchrl_sspl.certification import closed_loop
        >>> plant = nn.Sequential(nn.Linear(2, 1, bias=False))  # z+ = z / 2, and B(z) = z
        >>> nn.utils.vector_to_parameters(torch.tensor([0.5, 0.0]), plant.parameters())
        >>> loop = closed_loop(nn.Identity(), plant, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=1.0)
        >>> abs(largest_error(loop, level=0.5).delta - 0.25) < 2e-3
        True
    """
    if not math.isfinite(system.lipschitz_bound):
        raise ConfigError("expected a finite Lipschitz bound of the barrier, received infinity; prove one first")
    found = largest_next(system, level=level, constant=-level, tolerance=tolerance, budget=budget, progress=progress)
    # What decides, decides by more than the slack.
    proved = less_than(-(found.upper + SLACK) / system.lipschitz_bound)
    most = max(found.lower, system.accepted - level)  # errors count by the Lipschitz constant where an action is accepted, too
    return LargestError(proved, (SLACK - most) / system.lipschitz_bound, found)


def tolerates(
    system: ClosedLoop,
    error: float,
    *,
    level: float = 0.0,
    barrier_rounding: float = 0.0,
    step_rounding: float = 0.0,
    every_way: bool = True,
    budget: Budget | None = None,
) -> Outcome:
    r"""Decides whether :math:`\{B \le s\}` is kept whatever error of a size is added, by its own bounds in every direction.

    .. math:: B(z) \le s + \epsilon_B, \; \lVert e \rVert \le \delta \;\Rightarrow\;
        B(d(z, \pi(z)) + e) + L_B \epsilon_d + \epsilon_B \le s

    :func:`largest_error` asks the same through the Lipschitz constant, as if the barrier rose by it everywhere and in every
    direction at once. So does this of a policy that chooses, which does not know the error when it does; what is rounded off
    counts more often then (Theorem H in ``docs/theory.md``).

    Args:
        system: the closed loop, with a finite Lipschitz bound.
        error: :math:`\delta`, latent units.
        level: s, barrier units.
        barrier_rounding, step_rounding: :math:`\epsilon_B` and :math:`\epsilon_d` of the computed networks.
        every_way: whether errors count by bounds in every direction; False: by the Lipschitz constant.
        budget: when to give up.

    Source: none.

    Example:
        >>> from torch import nn
        >>> from torchrl_sspl.certification import closed_loop
        >>> plant = nn.Sequential(nn.Linear(2, 1, bias=False))  # z+ = z / 2, and B(z) = z
        >>> nn.utils.vector_to_parameters(torch.tensor([0.5, 0.0]), plant.parameters())
        >>> loop = closed_loop(nn.Identity(), plant, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=9.0)
        >>> [tolerates(loop, error, level=0.5).status for error in (0.24, 0.26)]
        ['proved', 'refuted']
    """
    lost = system.lipschitz_bound * step_rounding + barrier_rounding if step_rounding + barrier_rounding > 0 else 0.0
    inside = level + barrier_rounding + (SLACK if barrier_rounding else 0.0)
    constant = -level if every_way else system.lost_by(error) - level
    return largest_next(
        system, level=inside, constant=constant, error=error if every_way else 0.0, lost=lost, threshold=0.0, budget=budget
    )


@dataclass(frozen=True)
class ComputedError:
    """How large a latent error the numbers that are computed tolerate."""

    delta: float  # proved for the computed barrier and step, latent units; at most zero: not kept even without errors
    barrier_rounding: float  # what the computed barrier is off at most, anywhere, barrier units
    step_rounding: float  # the same of the computed d(z, pi(z)) where the computed barrier is at most s, Euclidean norm, latent units


def computed_error(
    system: ClosedLoop,
    known: LargestError,
    *,
    level: float = 0.0,
    unit: float = 2.0**-24,
    tolerance: float = 1e-3,
    budget: Budget | None = None,
    boxes: int = 16384,
) -> ComputedError:
    r"""Largest error for which :math:`\{\hat B \le s\}` is kept by the networks as they are computed.

    .. math:: \delta = - \frac{1}{L_B} \left( \max_{B(z) \le s + \epsilon_B} (B(d(z, \pi(z))) - s) + \epsilon_B \right)
        - \epsilon_d

    with :math:`\epsilon_B \ge |\hat B - B|` on the whole domain and :math:`\epsilon_d \ge \|\hat d(z, \hat\pi(z)) - d(z, \pi(z))\|`
    where :math:`B(z) \le s + \epsilon_B`, bounded on so many boxes for this unit roundoff; ``known`` is the error in real arithmetic.

    A policy that chooses does so by what is computed. With :math:`\lambda = \epsilon_B + L_B \epsilon_d` it is the largest
    :math:`\delta` for which

    .. math:: L_B \delta + 2 \lambda - m \le s, \qquad B(z) \le s + \epsilon_B, \; B(d(z, \pi(z))) > -m - \lambda \;\Rightarrow\;
        \min_k B(d(z, a_k)) + 3 \lambda + L_B \delta \le s

    as :math:`\lambda` is lost once where an action is accepted or not, twice where two of the table are compared, and once more
    after the step (Theorem H in ``docs/theory.md``).
    """
    lipschitz = system.lipschitz_bound
    of_barrier, of_step = system.rounding(unit, level=level, boxes=boxes)
    if not math.isfinite(of_barrier + of_step):
        return ComputedError(-math.inf, of_barrier, of_step)
    lost = of_step + of_barrier / lipschitz
    delta = known.delta - lost  # what it could be at most
    if delta > 0.0:
        how: dict[str, Any] = {"tolerance": tolerance, "budget": budget}
        if system.chooses:  # what is lost decides which action is taken
            how["lost"], lost = more_than(lost * lipschitz), 0.0
        found = largest_next(system, level=level + of_barrier + SLACK, constant=-level, **how)
        delta = -(found.upper + SLACK) / lipschitz - lost
    return ComputedError(less_than(less_than(delta)), of_barrier, of_step)


def decide_domain(system: ClosedLoop, *, budget: Budget | None = None) -> Outcome:
    r"""Decides whether :math:`d(z, \pi(z))` stays in the latent domain; a clamp to the domain proves it at once.

    Args:
        system: the closed loop.
        budget: when to give up.

    Source: none (the paper's latent space is unbounded).

    Example:
        >>> from torch import nn
        >>> from torchrl_sspl.certification import closed_loop
        >>> plant = nn.Sequential(nn.Linear(2, 1, bias=False))  # z+ = 3 z / 2
        >>> nn.utils.vector_to_parameters(torch.tensor([1.5, 0.0]), plant.parameters())
        >>> loop = closed_loop(nn.Identity(), plant, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=1.0)
        >>> decide_domain(loop).status
        'refuted'
    """
    last = system.step.steps[-1]
    if system.chooses or system.direction is not None or (isinstance(last, Apply) and _within(last.activation, system)):  # of those that choose it was demanded
        return Outcome("proved", 0.0, -math.inf, None, 0, 0.0, 0.0, 0)
    p = system.latent_dim
    eye, low, high = torch.eye(p, dtype=torch.float64), system.low, system.high
    rows, constant = torch.cat([eye, -eye]), torch.cat([-high, low])
    problem = Problem(low, high, system.step, rows, system.barrier, torch.zeros_like(constant), constant, combine="max")
    return maximise(problem, threshold=0.0, budget=budget)


def _within(activation: Activation, system: ClosedLoop) -> bool:
    ends = torch.tensor([-math.inf, math.inf], dtype=torch.float64)
    below, above = (float(v) for v in activation.value(ends))
    return bool((system.low <= below).all()) and bool((system.high >= above).all())


@dataclass(frozen=True)
class Vacuity:
    r"""Whether a statement about :math:`\{B \le s\}` says anything; points are ``(p,)``."""

    status: str  # "neither" (both points exist), "empty" (proved), "everything" (proved) or "undecided"
    inside: Tensor | None  # a point with B below s
    outside: Tensor | None  # a point with B above s


def decide_vacuity(system: ClosedLoop, *, level: float = 0.0, budget: Budget | None = None) -> Vacuity:
    r"""Decides whether :math:`\{B \le s\}` is empty, everything, or neither.

    Args:
        system: the closed loop.
        level: s, barrier units.
        budget: when to give up.

    Source: none; a barrier that is negative everywhere meets the paper's third condition without saying anything.

    Example:
        >>> from torch import nn
        >>> from torchrl_sspl.certification import closed_loop
        >>> plant, policy = nn.Sequential(nn.Linear(2, 1)), nn.Sequential(nn.Linear(1, 1))
        >>> loop = closed_loop(nn.Identity(), plant, policy, latent_dim=1, lipschitz_bound=1.0)
        >>> decide_vacuity(loop, level=-2.0).status
        'empty'
    """
    zero = torch.zeros(1, dtype=torch.float64)

    def side(sign: float) -> tuple[bool, Tensor | None]:
        """Whether sign (B - s) can be positive, with a point; None and True: not decided."""
        rows = torch.full((1, 1), sign, dtype=torch.float64)
        problem = Problem(system.low, system.high, system.barrier, rows, system.barrier, zero, zero - sign * level)
        found = maximise(problem, threshold=0.0, budget=budget)
        return found.status != "proved", found.witness if found.status == "refuted" else None

    may_lie_inside, inside = side(-1.0)
    may_lie_outside, outside = side(1.0)
    if not may_lie_inside:
        return Vacuity("empty", None, outside)
    if not may_lie_outside:
        return Vacuity("everything", inside, None)
    return Vacuity("neither" if inside is not None and outside is not None else "undecided", inside, outside)


def search_level(
    system: ClosedLoop, *, levels: Sequence[float], margin: float = 0.0, budget: Budget | None = None
) -> tuple[float, Outcome] | None:
    r"""The first of several levels for which :math:`\{B \le s\}` is kept (R3), with its outcome.

    Args:
        system: the closed loop.
        levels: s in the order in which they are tried, all at most zero (else ``ConfigError``); usually descending.
        margin: m, barrier units.
        budget: when to give up on one level.

    Returns:
        Level and outcome, or None if none is proved; an empty set is none.

    Source: none.

    Example:
        >>> from torch import nn
        >>> from torchrl_sspl.certification import closed_loop
        >>> plant = nn.Sequential(nn.Linear(2, 1, bias=False))  # z+ = 2 z, and B(z) = z
        >>> nn.utils.vector_to_parameters(torch.tensor([2.0, 0.0]), plant.parameters())
        >>> loop = closed_loop(nn.Identity(), plant, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=1.0)
        >>> search_level(loop, levels=[0.0, -0.1], margin=0.05)[0]
        -0.1
    """
    if any(level > 0 for level in levels):
        raise ConfigError(f"expected levels of at most zero, received {list(levels)}; above zero a set may touch U")
    for level in levels:
        outcome = decide_invariance(system, level=level, margin=margin, budget=budget)
        if outcome.status == "proved":
            # Nothing is easier to keep than nothing.
            return None if decide_vacuity(system, level=level, budget=budget).status == "empty" else (level, outcome)
    return None


def find_counterexamples(
    system: ClosedLoop,
    n: int,
    *,
    level: float = 0.0,
    margin: float = 0.0,
    samples: int = 50_000,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Points of the domain at which the invariance fails, for training on them.

    .. math:: B(z) \le s, \qquad B(d(z, \pi(z))) + m > s

    Args:
        system: the closed loop.
        n: largest number of points.
        level: s, barrier units.
        margin: m, barrier units.
        samples: uniform samples, of which the worst are improved by gradient steps.
        generator: source of randomness.

    Returns:
        ``(k, p)`` float32, the worst first, ``k <= n``; empty if none was found.

    Source: none (counterexample-guided training).

    Example:
        >>> from torch import nn
        >>> from torchrl_sspl.certification import closed_loop
        >>> plant = nn.Sequential(nn.Linear(2, 1, bias=False))  # z+ = 3 z / 2, and B(z) = z
        >>> nn.utils.vector_to_parameters(torch.tensor([1.5, 0.0]), plant.parameters())
        >>> loop = closed_loop(nn.Identity(), plant, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=1.0)
        >>> bool((find_counterexamples(loop, 10, level=0.5) > 0.33).all())
        True
    """
    problem = system.problem(level=level, constant=(margin - level,))
    span = system.high - system.low
    points = system.low + span * torch.rand(samples, len(span), generator=generator, dtype=torch.float64)
    with torch.no_grad():
        points = points[problem.feasible(system.barrier(points)[:, 0])]
        if not len(points):
            return system.latent(torch.zeros(0, system.latent_dim))
        value = problem.evaluate(points)[0]
        worst = points[value.topk(min(n, len(points))).indices]
        steps = 0.02 * span * torch.randn(4, *worst.shape, generator=generator, dtype=torch.float64)
        near = torch.minimum(torch.maximum(worst + steps, system.low), system.high).flatten(0, 1)
        points = torch.cat([worst, near])
        value, barrier = problem.evaluate(points)
        bad = points[problem.feasible(barrier) & (value > 0)]
        order = problem.evaluate(bad)[0].argsort(descending=True) if len(bad) else torch.zeros(0, dtype=torch.int64)
    return system.latent(bad[order][:n]).float()

r"""Branch and bound: the largest :math:`\min_k (R_k F(z) - b_k B(z) + c_k)` where :math:`c_- \le B(z) \le c_+`.

F is the closed loop :math:`z \mapsto B(d(z, \pi(z)))` (or :math:`d(z, \pi(z))` itself); all claims of the deterministic
layer are of this form. A box is discarded as soon as one of these, in the order of their cost, shows that it is of no
interest: the Lipschitz constant of B around its centre; linear bounds of B; the enclosure of :math:`d(z, \pi(z))` with
    the Lipschitz constant; linear bounds of F. The last two functions are used together: the linear programme
    "objective where B is at most :math:`c_+`" is solved exactly, and both half-spaces cut the box before it is split.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from torchrl_sspl.certification.graph import Graph
from torchrl_sspl.certification.half_spaces import clip, programme
from torchrl_sspl.certification.propagation import Enclosure, LinearBound
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.journal import Entry

#: What a bound or a witness must be better by before it decides; far above the rounding of float64.
SLACK = 1e-6
_BATCH = 1024  # boxes at a time
_PLAIN = ("lower", "witness", "count", "deepest", "close")  # of where a search stands


@dataclass(frozen=True)
class Budget:
    """When a search gives up; negative numbers raise ``ConfigError``.

    Attributes:
        boxes: number of boxes; when it runs out the result is the same on every machine.
        seconds: wall-clock time.

    Source: none.
    """

    boxes: int = 50_000_000
    seconds: float = 900.0

    def __post_init__(self) -> None:
        if self.boxes < 0 or not self.seconds >= 0:
            raise ConfigError(f"expected boxes >= 0 and seconds >= 0, received {self.boxes} and {self.seconds}")


@dataclass
class Problem:
    """What is maximised, and where; points are ``(n, p)`` float64."""

    low: Tensor  # corners of the domain, (p,)
    high: Tensor
    function: Graph  # F, (n, p) -> (n, q)
    rows: Tensor  # R, (K, q); nonnegative where there is ``inner``
    barrier: Graph  # B, (n, p) -> (n, 1)
    barrier_weight: Tensor  # b, (K,), nonnegative
    constant: Tensor  # c, (K,)
    level: float | None = None  # c_+
    floor: float | None = None  # c_-
    combine: str = "min"  # or "max", of the rows
    lipschitz: float | None = None  # proved Lipschitz constant of B
    inner: tuple[int, ...] = ()  # steps of F, one for each output, that hold d(z, u) where this output is B of it
    error: float = 0.0  # Euclidean norm up to which anything may be added to the only one of these, as long as it stays in the domain
    behind: Graph | None = None  # B of what these steps hold, where that is no point of the domain but a latent whose chart is one
    within: Callable[[Tensor], Tensor] | None = None  # the nearest of these

    @property
    def constrained(self) -> bool:
        """Whether there is a constraint."""
        return self.level is not None or self.floor is not None

    def evaluate(self, point: Tensor) -> tuple[Tensor, Tensor]:
        """Objective and barrier at points ``(n, p)``, each ``(n,)``."""
        barrier = self.barrier(point)
        if self.error and self.inner:
            after = self.function.values(point)[self.inner[0]]
            with torch.enable_grad():
                at = after.detach().requires_grad_()
                (slope,) = torch.autograd.grad(self.after(at).sum(), at)
            # A thousandth less: what goes back onto a circle may go a little farther.
            length = self.error if self.within is None else 0.999 * self.error
            moved = after + length * slope / slope.norm(dim=1, keepdim=True).clamp_min(1e-12)
            inside = torch.minimum(torch.maximum(moved, self.low), self.high) if self.within is None else self.within(moved)
            value = self.after(inside)
            return self.combined(value @ self.rows.mT - barrier * self.barrier_weight + self.constant), barrier[:, 0]
        return self.combined(self.function(point) @ self.rows.mT - barrier * self.barrier_weight + self.constant), barrier[:, 0]

    @property
    def after(self) -> Graph:
        """B of what a step leads to."""
        return self.barrier if self.behind is None else self.behind

    def combined(self, parts: Tensor) -> Tensor:
        """Objective from its rows ``(n, K)``."""
        return parts.amin(1) if self.combine == "min" else parts.amax(1)

    def feasible(self, barrier: Tensor) -> Tensor:
        """Whether points with these barrier values ``(n,)`` count, whatever float64 rounded off."""
        inside = torch.ones_like(barrier, dtype=torch.bool)
        if self.level is not None:
            inside &= barrier <= self.level - SLACK
        if self.floor is not None:
            inside &= barrier >= self.floor + SLACK
        return inside

    def about(self) -> list[Any]:
        """What tells it from other problems about the same networks."""
        numbers = [self.level, self.floor, self.combine, self.lipschitz, self.inner, self.error]
        return [self.low, self.high, self.rows, self.barrier_weight, self.constant, *numbers]


@dataclass
class Outcome:
    """Result of a search.

    Attributes:
        status: "proved" (it is at most ``upper``), "refuted" (by ``witness``) or "undecided" (budget too small).
        upper: the objective is at most this wherever the constraint holds, whatever the status.
        lower: largest value that was found.
        witness: where it was found, ``(p,)``, or None.
        boxes: boxes bounded.
        seconds: wall-clock time.
        remaining_volume: share of the domain that is not decided.
        depth: largest number of bisections of a box.
    """

    status: str
    upper: float
    lower: float
    witness: Tensor | None
    boxes: int
    seconds: float
    remaining_volume: float
    depth: int


def _attack(problem: Problem, samples: int = 32768, starts: int = 256) -> tuple[float, Tensor | None]:
    """Largest value that samples, and ascent from the best, find where the constraint holds, and its point ``(p,)``."""
    generator = torch.Generator().manual_seed(0)
    span = problem.high - problem.low
    points = problem.low + span * torch.rand(samples, len(span), generator=generator, dtype=span.dtype)
    with torch.no_grad():
        value, barrier = problem.evaluate(points)
        inside = problem.feasible(barrier)
        # The set may be small: where no sample lies in it, start from the deepest points.
        small = problem.level is not None and not inside.any()
        score = -barrier if small else torch.where(inside, value, -math.inf)
    return _ascend(problem, points[score.topk(starts).indices])


def _ascend(problem: Problem, start: Tensor, steps: int = 40) -> tuple[float, Tensor | None]:
    """Projected gradient ascent from ``(n, p)``, pulled back where the constraint fails; -inf, None if always."""
    best, where = -math.inf, None
    span = problem.high - problem.low
    point = start
    for k in range(steps + 1):
        with torch.enable_grad():
            x = point.detach().requires_grad_()
            value, barrier = problem.evaluate(x)
            outside = torch.zeros_like(barrier)
            if problem.level is not None:
                outside = outside + (barrier - problem.level).clamp_min(0.0)
            if problem.floor is not None:
                outside = outside + (problem.floor - barrier).clamp_min(0.0)
            (gradient,) = torch.autograd.grad((value - 20.0 * outside).sum(), x)
        score = torch.where(problem.feasible(barrier.detach()), value.detach(), -math.inf)
        top = int(score.argmax())
        if float(score[top]) > best:
            best, where = float(score[top]), point[top].clone()
        length = gradient.norm(dim=1, keepdim=True).clamp_min(1e-12)
        point = point + 0.05 * 0.85**k * span * gradient / length
        point = torch.minimum(torch.maximum(point, problem.low), problem.high)
    return best, where


class _Boxes:
    """The boxes that are left, with a bound of the objective on each."""

    def __init__(self, low: Tensor, high: Tensor) -> None:
        p, span = len(low), high - low
        per_axis = max(2, round(512 ** (1.0 / p)))
        # Every edge is computed once: neighbours share their faces to the last bit.
        edges = low[:, None] + span[:, None] * torch.linspace(0.0, 1.0, per_axis + 1, dtype=low.dtype)
        edges[:, -1] = high
        self.low = torch.cartesian_prod(*edges[:, :-1]).reshape(-1, p)
        self.high = torch.cartesian_prod(*edges[:, 1:]).reshape(-1, p)
        self.upper = torch.full((len(self.low),), math.inf, dtype=low.dtype)
        self.depth = torch.zeros(len(self.low), dtype=torch.int64)
        self.domain = float(span.prod())

    def __len__(self) -> int:
        return len(self.low)

    def take(self, n: int) -> tuple[Tensor, Tensor, Tensor]:
        """Removes the n boxes with the highest bounds."""
        keep = torch.zeros(len(self), dtype=torch.bool)
        if n < len(self):
            keep[:] = True
            keep[self.upper.topk(n).indices] = False
        taken = self.low[~keep], self.high[~keep], self.depth[~keep]
        self.low, self.high, self.upper, self.depth = (t[keep] for t in (self.low, self.high, self.upper, self.depth))
        return taken

    def split(self, low: Tensor, high: Tensor, upper: Tensor, depth: Tensor, sensitivity: Tensor) -> None:
        """Adds both halves of boxes, cut across the axis that matters most."""
        axis = (sensitivity * (high - low)).argmax(1, keepdim=True)
        middle = (0.5 * (low + high)).gather(1, axis)
        self.low = torch.cat([self.low, low, low.scatter(1, axis, middle)])
        self.high = torch.cat([self.high, high.scatter(1, axis, middle), high])
        self.upper = torch.cat([self.upper, upper, upper])
        self.depth = torch.cat([self.depth, depth + 1, depth + 1])

    def volume(self) -> float:
        """Share of the domain."""
        return float((self.high - self.low).prod(1).sum()) / self.domain


def _infeasible(problem: Problem, least: Tensor, most: Tensor) -> Tensor:
    """Whether no point of a box with B in ``[least, most]`` meets the constraint."""
    out = torch.zeros_like(least, dtype=torch.bool)
    if problem.level is not None:
        out |= least > problem.level + SLACK
    if problem.floor is not None:
        out |= most < problem.floor - SLACK
    return out


def _bound(
    q: Problem, low: Tensor, high: Tensor, threshold: float, tight: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """What is left of boxes: corners, upper bounds, sensitivity per axis, and which of the given boxes it was.

    A comparison with a bound that is not a number keeps the box.
    """
    limit = threshold - SLACK
    kept = torch.arange(len(low))
    constraints: list[LinearBound] = []  # functions that are at most zero wherever the constraint holds
    below = None  # above -B
    if q.constrained or bool(q.barrier_weight.any()):
        if q.lipschitz is not None and q.constrained:
            value = q.barrier(0.5 * (low + high))[:, 0]
            reach = q.lipschitz * (0.5 * (high - low)).norm(dim=1)
            keep = ~_infeasible(q, value - reach, value + reach)
            low, high, kept = low[keep], high[keep], kept[keep]
        box = Enclosure(q.barrier, low, high, tight=tight)
        both = box.upper(torch.tensor([[-1.0], [1.0]], dtype=torch.float64))
        ends = both.upper(box.radius)
        keep = ~_infeasible(q, -ends[:, 0], ends[:, 1])
        low, high, kept, both = low[keep], high[keep], kept[keep], both.select(keep)
        below, above_b = (LinearBound(both.slope[:, k : k + 1], both.value[:, k : k + 1], both.center) for k in (0, 1))
        if q.level is not None:
            constraints.append(LinearBound(-below.slope, -below.value - q.level - SLACK, below.center))
        if q.floor is not None:
            constraints.append(LinearBound(-above_b.slope, q.floor - SLACK - above_b.value, above_b.center))
        for c in constraints:
            low, high = clip(low, high, c)

    ball = (q.inner[0], q.error) if q.inner and q.error else None
    inner = Enclosure(q.function, low, high, until=max(q.inner, default=None), tight=tight, ball=ball)
    first = torch.full((len(low), len(q.rows)), math.inf, dtype=low.dtype)
    if q.inner and q.lipschitz is not None:
        least, most = (torch.stack(ends, 1) for ends in zip(*(inner.interval(k) for k in q.inner), strict=True))
        reach = q.lipschitz * ((0.5 * (most - least)).norm(dim=2) + q.error)
        middle = q.after(0.5 * (least + most).flatten(0, 1)).reshape(reach.shape)
        first = (middle + reach) @ q.rows.mT + q.constant
        if below is not None and bool(q.barrier_weight.any()):
            first = first + q.barrier_weight * below.at(inner.center).upper(inner.radius)
        keep = ~(q.combined(first) <= limit)
        low, high, kept, first, inner = low[keep], high[keep], kept[keep], first[keep], inner.select(keep)
        constraints = [c.select(keep) for c in constraints]
        below = None if below is None else below.select(keep)
    inner.extend()
    above = inner.upper(q.rows)
    slope, value = above.slope, above.value + q.constant
    if below is not None and bool(q.barrier_weight.any()):
        here = below.at(above.center)
        slope, value = slope + q.barrier_weight[:, None] * here.slope, value + q.barrier_weight * here.value
    above = LinearBound(slope, value, above.center)
    parts = torch.minimum(first, above.upper(inner.radius))
    for c in constraints:
        parts = torch.minimum(parts, programme(above, c.at(above.center), inner.radius))
    upper = q.combined(parts)
    keep = ~(upper <= limit)
    low, high, kept, upper, above = low[keep], high[keep], kept[keep], upper[keep], above.select(keep)
    if q.combine == "min" or len(q.rows) == 1:
        for k in range(len(q.rows)):
            row = LinearBound(-above.slope[:, k : k + 1], limit - above.value[:, k : k + 1], above.center)
            low, high = clip(low, high, row)
    last = q.inner[0] if q.inner else len(q.function.steps) - 1
    sensitivity = inner.slope(last)[keep].norm(dim=2) if last in q.function.interfaces else above.slope.abs().amax(1)
    sensitivity = sensitivity + 0.1 * sensitivity.amax(1, keepdim=True) + 1e-9
    return low, high, upper, sensitivity, kept


@torch.no_grad()
def maximise(
    problem: Problem,
    *,
    threshold: float | None = None,
    tolerance: float = 1e-3,
    budget: Budget | None = None,
    tight: bool = False,
    confirm: Callable[[Tensor], bool] | None = None,
    progress: bool = False,
    seek: bool = True,
) -> Outcome:
    """Largest objective where the constraint holds, or a proof that it does not exceed a threshold.

    With a threshold the search ends as soon as that is proved or refuted; a maximum within :data:`SLACK` of it is
    neither. Without one it closes in on the maximum from both sides until they are no more than the tolerance apart.
    The outcome is the same for the same arguments unless the time runs out.

    Args:
        problem: what is maximised.
        threshold: value to prove.
        tolerance: largest distance of the two sides in the end (without a threshold).
        budget: when to give up.
        tight: backward bounds for all undecided activations.
        confirm: whether a point ``(p,)`` is a counterexample of the deployed networks too; only then it refutes.
        progress: show a progress bar.
        seek: look for points with a large objective; without it nothing is refuted, and the bounds have to do it alone.

    Source: none (branch and bound).

    Example:
        >>> graph, zero = Graph(1), torch.zeros(1, dtype=torch.float64)
        >>> _ = graph.linear([0], [torch.tensor([[2.0]])])
        >>> one = torch.ones(1, 1, dtype=torch.float64)
        >>> problem = Problem(-one[0], one[0], graph, one, graph, zero, zero, level=0.5)  # 2 z where 2 z <= 0.5
        >>> maximise(problem).upper < 0.502
        True
    """
    budget = budget or Budget()
    search = _Search(problem, threshold, tolerance, confirm, seek)
    entry = Entry("maximise", problem.about(), threshold, tolerance, budget, tight, seek)
    kept = entry.saved()
    if kept is None:
        search.lower, search.witness = _attack(problem) if seek else (-math.inf, None)
    elif "status" in kept:
        return Outcome(**kept)
    else:
        search.load_state_dict(kept)

    def ended(status: str) -> Outcome:
        outcome = search.outcome(status)
        entry.save(vars(outcome), complete=True)
        return outcome

    bar = tqdm(total=1.0, disable=not progress, bar_format="{l_bar}{bar}| {n:.4f} of the domain [{elapsed}<{remaining}]")
    with bar:
        if search.refuted():
            return ended("refuted")
        while len(search.left):
            if search.count >= budget.boxes or search.seconds() >= budget.seconds:
                return ended("undecided")
            if search.advance(min(_BATCH, budget.boxes - search.count), tight):
                return ended("refuted")
            if entry.due:
                entry.save(search.state_dict())
            if progress:
                bar.n = max(0.0, 1.0 - search.left.volume())
                bar.refresh()
    return ended("undecided" if search.close else "proved")


@dataclass
class _Search:
    """Where a search stands; the arguments are those of :func:`maximise`."""

    problem: Problem
    threshold: float | None
    tolerance: float
    confirm: Callable[[Tensor], bool] | None
    seek: bool
    lower: float = -math.inf
    witness: Tensor | None = None
    count: int = 0
    deepest: int = 0

    def __post_init__(self) -> None:
        self.start = time.monotonic()
        self.left = _Boxes(self.problem.low, self.problem.high)
        self.close: list[float] = []  # volumes of the boxes on which the maximum lies within the slack of the threshold

    @property
    def goal(self) -> float:
        """What the objective is to be proved to be at most."""
        return self.lower + self.tolerance if self.threshold is None else self.threshold

    def seconds(self) -> float:
        return time.monotonic() - self.start

    def state_dict(self) -> dict[str, Any]:
        """Where it stands."""
        plain = {name: getattr(self, name) for name in _PLAIN}
        return {**plain, "seconds": self.seconds(), "boxes": {k: v for k, v in vars(self.left).items() if k != "domain"}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from what ``state_dict`` returned."""
        for name in _PLAIN:
            setattr(self, name, state[name])
        self.start = time.monotonic() - state["seconds"]
        vars(self.left).update(state["boxes"])

    def refuted(self) -> bool:
        if self.threshold is None or self.witness is None or not self.lower > self.threshold + SLACK:
            return False
        return self.confirm is None or self.confirm(self.witness)

    def outcome(self, status: str) -> Outcome:
        upper, volume = self.goal + (SLACK if self.close else 0.0), self.left.volume() + sum(self.close)
        if len(self.left):
            upper = max(upper, float(self.left.upper.max()) + SLACK)
        return Outcome(status, upper, self.lower, self.witness, self.count, self.seconds(), volume, self.deepest)

    def advance(self, n: int, tight: bool) -> bool:
        """Bounds the n boxes with the highest bounds and splits what is left of them; whether that refuted."""
        low, high, depth = self.left.take(n)
        self.count += len(low)
        low, high, upper, sensitivity, kept = _bound(self.problem, low, high, self.goal, tight)
        rest: tuple[Tensor, ...] = (low, high, upper, depth[kept], sensitivity)
        if len(low) and self.seek:
            value = self.look(0.5 * (low + high))
            if self.threshold is not None and not self.refuted():  # neither side can decide here, however often it is cut
                stuck = (upper <= self.threshold + SLACK) & (value > self.threshold - SLACK)
                self.close += ((high - low)[stuck].prod(1) / self.left.domain).tolist()
                rest = tuple(t[~stuck] for t in rest)
        if len(rest[0]):
            self.left.split(*rest)
            self.deepest = max(self.deepest, int(rest[3].max()) + 1)
        return self.refuted()

    def look(self, center: Tensor) -> Tensor:
        """Objective at points, -inf where the constraint fails; ascends from them if one is better than all before."""
        value, barrier = self.problem.evaluate(center)
        value = torch.where(self.problem.feasible(barrier), value, -math.inf)
        if float(value.max()) > self.lower:
            self.lower, self.witness = float(value.max()), center[int(value.argmax())].clone()
            better, place = _ascend(self.problem, center[value.topk(min(32, len(value))).indices], steps=20)
            if better > self.lower:
                self.lower, self.witness = better, place
        return value

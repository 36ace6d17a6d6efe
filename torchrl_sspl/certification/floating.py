r"""How far a floating-point evaluation of a graph is from its exact value, at any point of a box.

Every step k makes an error of its own, :math:`|\eta_k| \le \gamma_m (|W_k| |\hat x_k| + |b_k|)`, and hands on those of
the steps before. The errors at one step change the output by no more than the largest slope of what follows takes them
to, and the slopes of a ReLU network on a small box are nearly known: far less than the product of the absolute weights,
which forgets that most units are off and that the others cancel.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchrl_sspl.certification.graph import Affine, Apply, Graph
from torchrl_sspl.certification.propagation import Enclosure

#: Unit roundoff of the dtypes in which networks are deployed.
UNITS = {torch.float32: 2.0**-24, torch.float64: 2.0**-53}
_ARGUMENT = 1e-7  # by what the ends of intervals may be off themselves, being computed in float64
_UNDERFLOW = 1e-17  # of a term: what is lost below the smallest normal number, with action scales of 1e-10 and more
_OVERFLOW = 1e37  # a sum that may become larger is not bounded
_SAFETY = 1.0 + 1e-6  # for the float64 arithmetic in which the bounds are computed


def rounding_bound(
    graph: Graph, low: Tensor, high: Tensor, unit: float = 2.0**-24, *, refined: bool = False
) -> list[Tensor]:
    r"""Bounds ``(n, size)`` of how far an evaluation of each step can be from its exact value, anywhere on boxes.

    .. math::
        |\hat x_k - x_k| \le |W_k| e_{k-1} + \eta_k, \quad
        \eta_k = \gamma_m \left( |W_k| (|x_{k-1}| + e_{k-1}) + |b_k| \right), \quad \gamma_m = \frac{m u}{1 - m u}

    with m the number of terms of the longest sum and the roundings of the step besides, and u the unit roundoff, 2^-24
    for IEEE float32 (no TF32), 2^-53 for float64. Products may be summed in any order and with fused multiplication, so
    that no batch size, thread or library makes a difference. Activations hand an error on by their steepest slope on
    what the interval and the error allow.

    Refined, the errors of the interfaces and of the last step are :math:`\sum_k |J_k| \eta_k`, with :math:`J_k` the
    slopes of everything between, enclosed on the box and on whatever the errors themselves can reach. The corners are
    ``(n, p)`` float64; small boxes give tight bounds.

    Source: Higham 2002, section 3.1; the refinement is Lady Windermere's fan (Hairer, Norsett, Wanner 1993).
    """
    box = Enclosure(graph, low, high, tight=not refined)
    errors, local = [torch.zeros_like(low)], [torch.zeros_like(low)]
    sizes = [torch.maximum(low.abs(), high.abs())]
    slopes: dict[int, tuple[Tensor, Tensor]] = {}
    ends = {0}
    for number, step in enumerate(graph.steps[1:], start=1):
        if isinstance(step, Affine):
            error, size, own = _affine(step, errors, sizes, unit)
            if number in box._intervals:
                below, above = box._intervals[number]
                size = torch.minimum(size, torch.maximum(-below, above) + _ARGUMENT)
        else:
            assert isinstance(step, Apply)
            act, before = step.activation, errors[step.source]
            below, above = box._intervals[step.source]
            reach = before + _ARGUMENT
            slopes[number] = act.slopes(below - reach, above + reach)
            size = torch.stack([t.abs() for t in act.interval(below - reach, above + reach)]).amax(0)
            own = unit * (act.ulps * (size + sizes[step.source] + before) + act.units) + act.jump + _UNDERFLOW
            own = own if act.ulps or act.jump or act.units else torch.zeros_like(before)
            error = torch.stack([s.abs() for s in slopes[number]]).amax(0) * before + own
        errors.append(error * _SAFETY)
        local.append(own)
        sizes.append(size)
        if refined and (number in graph.interfaces or number == len(graph.steps) - 1):
            fan = _fan(graph, number, ends, errors, local, slopes)
            errors[number] = torch.minimum(errors[number], fan * _SAFETY)
            ends.add(number)
    return errors


def largest_rounding(
    graph: Graph,
    low: Tensor,
    high: Tensor,
    unit: float,
    *,
    boxes: int = 16384,
    vectors: int = 1,
    where: tuple[Graph, float] | None = None,
) -> float:
    """Bound of the Euclidean norm of the last step's rounding error anywhere on a domain; infinity where there is none.

    The domain from ``low`` to ``high``, ``(p,)`` float64, is cut into about so many boxes, the worst ones first. Of several vectors
    of one size, which the step holds side by side, it is the largest norm. With ``where``, a barrier and a level, it is that of the
    points at which the barrier is at most the level: boxes on which it is proved to be larger are left out.

    Example:
        >>> graph = Graph(2)
        >>> _ = graph.linear([0], [torch.eye(2)])
        >>> one = torch.ones(2, dtype=torch.float64)
        >>> 0.0 < largest_rounding(graph, -one, one, 2.0**-24) < 1e-6
        True
    """
    least, most = low[None], high[None]
    bound = torch.full((1,), torch.inf, dtype=torch.float64)
    count = 0
    while count < boxes and len(bound):
        worst = bound.topk(min(512, len(bound))).indices
        rest = torch.ones_like(bound, dtype=torch.bool)
        rest[worst] = False
        a, b = least[worst], most[worst]
        axis = (b - a).argmax(1, keepdim=True)
        middle = (0.5 * (a + b)).gather(1, axis)
        a, b = torch.cat([a, a.scatter(1, axis, middle)]), torch.cat([b.scatter(1, axis, middle), b])
        count += len(a)
        if where is not None:
            meets = ~(Enclosure(where[0], a, b).interval()[0][:, 0] > where[1])  # a bound that is no number proves nothing
            a, b = a[meets], b[meets]
        each = rounding_bound(graph, a, b, unit, refined=True)[-1].unflatten(1, (vectors, -1))
        error = each.norm(dim=2).nan_to_num(nan=torch.inf).amax(1)
        least, most, bound = torch.cat([least[rest], a]), torch.cat([most[rest], b]), torch.cat([bound[rest], error])
    return float(bound.max()) * _SAFETY if len(bound) else 0.0


def _affine(step: Affine, errors: list[Tensor], sizes: list[Tensor], unit: float) -> tuple[Tensor, Tensor, Tensor]:
    """Error handed on and made, size of the value, and error made by a sum of linear maps."""
    terms = int(sum((w != 0).sum(1) for w in step.weights).max()) + 1 + step.roundings  # type: ignore[union-attr]
    gamma = terms * unit / (1.0 - terms * unit)
    size = step.bias.abs()
    handed: Tensor | float = 0.0
    for source, weight in zip(step.sources, step.weights, strict=True):
        handed = handed + errors[source] @ weight.abs().mT
        size = size + (sizes[source] + errors[source]) @ weight.abs().mT
    own = gamma * size * _SAFETY + terms * _UNDERFLOW
    own = torch.where(size < _OVERFLOW, own, torch.inf)
    return handed + own, size, own


def _fan(
    graph: Graph,
    last: int,
    ends: set[int],
    errors: list[Tensor],
    local: list[Tensor],
    slopes: dict[int, tuple[Tensor, Tensor]],
) -> Tensor:
    """Error of a step from those made since the steps in ``ends``, each by the enclosed slopes of what follows it."""
    n, size = errors[last].shape
    eye = torch.eye(size, dtype=torch.float64).expand(n, size, size)
    pending: dict[int, tuple[Tensor, Tensor]] = {last: (eye, torch.zeros_like(eye))}  # middle and radius of the slopes
    total = torch.zeros_like(errors[last])
    for number in range(last, -1, -1):
        if number not in pending:
            continue
        middle, radius = pending.pop(number)
        made = errors[number] if number in ends else local[number]
        total = total + ((middle.abs() + radius) @ made[..., None])[..., 0]
        step = graph.steps[number]
        if number in ends:
            continue
        if isinstance(step, Apply):
            least, most = (s[:, None] for s in slopes[number])
            center, spread = 0.5 * (least + most), 0.5 * (most - least)
            _add(pending, step.source, middle * center, radius * (center.abs() + spread) + middle.abs() * spread)
        elif isinstance(step, Affine):
            for source, weight in zip(step.sources, step.weights, strict=True):
                _add(pending, source, middle @ weight, radius @ weight.abs())
    return total


def _add(pending: dict[int, tuple[Tensor, Tensor]], key: int, middle: Tensor, radius: Tensor) -> None:
    if key in pending:
        middle, radius = pending[key][0] + middle, pending[key][1] + radius
    pending[key] = middle, radius


def less_than(value: float) -> float:
    """Less than what the last operations, exactly carried out, would give."""
    return value - 4.0 * math.ulp(value)


def more_than(value: float) -> float:
    """More than what the last operations, exactly carried out, would give."""
    return value + 4.0 * math.ulp(value)

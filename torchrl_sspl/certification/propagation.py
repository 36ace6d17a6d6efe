r"""Linear bound propagation through composed networks, for many boxes at once.

On a box :math:`|z - c| \le r` every step x of a :class:`~torchrl_sspl.certification.graph.Graph` is enclosed

- forward, :math:`|x - (G (z - c) + a)| \le e`, which costs p + 2 rows per box and gives the interval of every
  activation;
- backward (CROWN), through the lines around the activations: one linear function above (or below) it on the whole box.

Forward bounds widen from layer to layer. At the interfaces of a graph (the action, the next latent) they are replaced
by backward bounds, where later backward passes end; where it is asked for, the intervals of all undecided activations
are replaced too. Skip connections carry z itself as a linear map, so that nothing is lost on them. What the float64
arithmetic may round off is bounded by :func:`~.floating.rounding_bound`, and a slack far above it is demanded wherever
a bound decides.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_sspl.certification.graph import Affine, Apply, Graph
from torchrl_sspl.errors import ShapeError


class LinearBound(NamedTuple):
    """Linear functions :math:`g (z - c) + h` above (or below) something on boxes."""

    slope: Tensor  # g, (n, rows, p)
    value: Tensor  # h, (n, rows)
    center: Tensor  # c, (n, p)

    def upper(self, radius: Tensor) -> Tensor:
        """Largest value within this radius ``(n, p)`` of the centre, ``(n, rows)``."""
        return self.value + (self.slope.abs() @ radius[..., None])[..., 0]

    def at(self, center: Tensor) -> LinearBound:
        """The same functions, written around other points ``(n, p)``."""
        return LinearBound(self.slope, self.value + (self.slope @ (center - self.center)[..., None])[..., 0], center)

    def select(self, index: Tensor) -> LinearBound:
        """The functions of some of the boxes."""
        return LinearBound(self.slope[index], self.value[index], self.center[index])


class _Form(NamedTuple):
    """``|x - (slope^T (z - c) + value)| <= error``; slope ``(n, p, size)``, value and error ``(n, size)``."""

    slope: Tensor
    value: Tensor
    error: Tensor | None

    def interval(self, radius: Tensor) -> tuple[Tensor, Tensor]:
        reach = (radius[:, None] @ self.slope.abs())[:, 0]
        if self.error is not None:
            reach += self.error
        return self.value - reach, self.value + reach

    def select(self, index: Tensor) -> _Form:
        return _Form(self.slope[index], self.value[index], None if self.error is None else self.error[index])


class Enclosure:
    """Bounds of the steps of a graph on boxes with corners ``(n, p)`` float64, up to the step ``until`` (the last one).

    Tight, the intervals of undecided activations are replaced by backward bounds: several times slower, much tighter on
    large boxes and deep networks. With ``ball``, a step and a radius, anything of at most this Euclidean norm may be added to
    that step, an interface: it costs no dimension, as its share of a linear function is the radius times the norm of the
    slope.

    Source: Zhang et al. 2018 (CROWN) for the backward bounds.

    Example:
        >>> graph = Graph(1)
        >>> a = graph.linear([0], [torch.tensor([[2.0]])])
        >>> _ = graph.linear([0, a], [torch.tensor([[-2.0]]), torch.eye(1)])  # 2 z - 2 z: exact
        >>> [end.item() for end in Enclosure(graph, -torch.ones(1, 1).double(), torch.ones(1, 1).double()).interval()]
        [0.0, 0.0]
    """

    def __init__(
        self,
        graph: Graph,
        low: Tensor,
        high: Tensor,
        *,
        until: int | None = None,
        tight: bool = False,
        ball: tuple[int, float] | None = None,
    ) -> None:
        _check_boxes(graph, low, high)
        self.graph, self.tight = graph, tight
        self.ball = (-1, 0.0) if ball is None else ball
        self.center, self.radius = 0.5 * (low + high), 0.5 * (high - low)
        n, p = low.shape
        # Forms at which backward passes end: the input and the interfaces.
        self._ends = {0: _Form(torch.eye(p, dtype=low.dtype).expand(n, p, p), self.center, None)}
        self._forms = dict(self._ends)
        self._intervals: dict[int, tuple[Tensor, Tensor]] = {0: (low, high)}
        self._done = 0
        self.extend(until)

    def extend(self, until: int | None = None) -> None:
        """Bounds further steps, up to this one or the last of the graph."""
        graph = self.graph
        last = len(graph.steps) - 1 if until is None else until
        for number in range(self._done + 1, last + 1):
            step = graph.steps[number]
            if isinstance(step, Affine):
                self._forms[number] = self._affine(step)
                if number in graph.activated:
                    self._intervals[number] = self._forms[number].interval(self.radius)
                    if self.tight:
                        self._tighten(number)
            elif isinstance(step, Apply):
                form, bounds = self._forms[step.source], self._intervals[step.source]
                slope, offset, gap = step.activation.parallel(*bounds)
                error = gap if form.error is None else gap.addcmul_(form.error, slope.abs())
                self._forms[number] = _Form(form.slope * slope[:, None], offset.addcmul_(form.value, slope), error)
                if number in graph.activated:
                    self._intervals[number] = step.activation.interval(*bounds)
            if number in graph.interfaces:
                self._forms[number] = self._ends[number] = self._collapse(number)
            for used in graph.last_use.get(number, ()):
                if used not in self._ends:
                    self._forms.pop(used, None)
            self._done = number

    def upper(self, rows: Tensor, step: int | None = None) -> LinearBound:
        """Linear functions above :math:`C x`, rows C ``(rows, size)`` and x a step (the last), by a backward pass.

        A bound below x is the negative of the bound above -x. Source: Zhang et al. 2018 (CROWN).
        """
        graph, n = self.graph, len(self.center)
        last = len(graph.steps) - 1 if step is None else step
        value = self.center.new_zeros(n, len(rows))
        slope = self.center.new_zeros(n, len(rows), self.center.shape[1])
        pending: dict[int, Tensor] = {last: rows.expand(n, *rows.shape)}
        for number in range(last, -1, -1):
            c = pending.pop(number, None)
            if c is None:
                continue
            part = graph.steps[number]
            if number in self._ends:
                form = self._ends[number]
                value += (c @ form.value[..., None])[..., 0]
                if form.error is not None:
                    value += (c.abs() @ form.error[..., None])[..., 0]
                if number == self.ball[0] and number < last:  # what is added belongs to the steps behind
                    value += self.ball[1] * c.norm(dim=-1)
                slope += c @ form.slope.mT
            elif isinstance(part, Affine):
                value += c @ part.bias
                for source, weight in zip(part.sources, part.weights, strict=True):
                    _add(pending, source, c @ weight)
            elif isinstance(part, Apply):
                lines = part.activation.relax(*self._intervals[part.source])
                above, below = c.clamp_min(0.0), c.clamp_max(0.0)
                value += (above @ lines.upper_offset[..., None] + below @ lines.lower_offset[..., None])[..., 0]
                c = above.mul_(lines.upper_slope[:, None]).addcmul_(below, lines.lower_slope[:, None])
                _add(pending, part.source, c)
        return LinearBound(slope, value, self.center)

    def interval(self, step: int | None = None) -> tuple[Tensor, Tensor]:
        """Interval of a step that was bounded last or is an interface, lower and upper ends ``(n, size)``."""
        number = len(self.graph.steps) - 1 if step is None else step
        low, high = self._forms[number].interval(self.radius)
        part = self.graph.steps[number]
        if isinstance(part, Apply):  # the values of a clamp lie within it, those of its lines need not
            least, most = part.activation.interval(*self._intervals[part.source])
            low, high = torch.maximum(low, least), torch.minimum(high, most)
        return low, high

    def slope(self, step: int) -> Tensor:
        """Linear part of an interface, ``(n, p, size)``."""
        return self._ends[step].slope

    def select(self, index: Tensor) -> Enclosure:
        """The same bounds for some of the boxes."""
        part = object.__new__(Enclosure)
        part.graph, part.tight, part.ball, part._done = self.graph, self.tight, self.ball, self._done
        part.center, part.radius = self.center[index], self.radius[index]
        part._forms = {k: f.select(index) for k, f in self._forms.items()}
        part._ends = {k: part._forms[k] for k in self._ends}
        part._intervals = {k: (a[index], b[index]) for k, (a, b) in self._intervals.items()}
        return part

    def _affine(self, step: Affine) -> _Form:
        slope = value = error = None
        for source, weight in zip(step.sources, step.weights, strict=True):
            form = self._forms[source]
            slope = form.slope @ weight.mT if slope is None else slope.add_(form.slope @ weight.mT)
            if value is None:
                value = torch.addmm(step.bias, form.value, weight.mT)
            else:
                value.addmm_(form.value, weight.mT)
            if form.error is not None:
                wide = form.error @ weight.abs().mT
                error = wide if error is None else error.add_(wide)
            if source == self.ball[0]:
                wide = (self.ball[1] * weight.norm(dim=1)).expand(len(form.value), -1)
                error = wide.clone() if error is None else error.add_(wide)
        assert slope is not None
        assert value is not None
        return _Form(slope, value, error)

    def _collapse(self, number: int) -> _Form:
        """Parallel linear bounds of a step from one backward pass for both sides."""
        size = self.graph.sizes[number]
        eye = torch.eye(size, dtype=self.center.dtype)
        both = self.upper(torch.cat([eye, -eye]), number)
        apart = both.slope[:, :size] + both.slope[:, size:]
        error = 0.5 * ((both.value[:, :size] + both.value[:, size:]) + (apart.abs() @ self.radius[..., None])[..., 0])
        slope = 0.5 * (both.slope[:, :size] - both.slope[:, size:]).mT
        return _Form(slope, 0.5 * (both.value[:, :size] - both.value[:, size:]), error.clamp_min(0.0))

    def _tighten(self, number: int) -> None:
        """Backward bounds for the neurons whose activation is not yet linear on every box."""
        if self._forms[number].error is None:
            return  # already exact
        low, high = self._intervals[number]
        open_ = self.graph.undecided(number, low, high).any(0).nonzero()[:, 0]
        if not len(open_):
            return
        eye = torch.eye(low.shape[1], dtype=low.dtype)[open_]
        above = self.upper(torch.cat([eye, -eye]), number).upper(self.radius)
        half = len(open_)
        high[:, open_] = torch.minimum(high[:, open_], above[:, :half])
        low[:, open_] = torch.maximum(low[:, open_], -above[:, half:])
        self._intervals[number] = low, high


def _add(pending: dict[int, Tensor], key: int, value: Tensor) -> None:
    pending[key] = pending[key] + value if key in pending else value


def _check_boxes(graph: Graph, low: Tensor, high: Tensor) -> None:
    """Refuses corners that are not ``(n, p)`` float64 both."""
    if low.shape != high.shape or low.ndim != 2 or low.shape[1] != graph.input_dim or low.dtype != torch.float64:
        raise ShapeError(
            f"expected corners of shape (n, {graph.input_dim}) and dtype float64, received {tuple(low.shape)} "
            f"{low.dtype} and {tuple(high.shape)}"
        )


def interval_bounds(graph: Graph, low: Tensor, high: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Lower and upper ends ``(n, size)`` of every step by interval arithmetic, to compare :class:`Enclosure` with.

    Example:
        >>> graph = Graph(1)
        >>> _ = graph.linear([0], [torch.tensor([[2.0]])])
        >>> interval_bounds(graph, -torch.ones(1, 1).double(), torch.ones(1, 1).double())[-1][1].item()
        2.0
    """
    _check_boxes(graph, low, high)
    bounds = [(low, high)]
    for step in graph.steps[1:]:
        if isinstance(step, Apply):
            bounds.append(step.activation.interval(*bounds[step.source]))
        elif isinstance(step, Affine):
            center, radius = step.bias, torch.zeros_like(step.bias)
            for source, weight in zip(step.sources, step.weights, strict=True):
                below, above = bounds[source]
                center = center + 0.5 * (above + below) @ weight.mT
                radius = radius + 0.5 * (above - below) @ weight.abs().mT
            bounds.append((center - radius, center + radius))
    return bounds

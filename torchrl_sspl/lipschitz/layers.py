"""The layers that proofs understand, in one list: values, slopes, linear relaxations and rounding of each.

:data:`LAYERS` is all that the Lipschitz proof, bound propagation, the comparison with what is deployed and the
statement about floating-point numbers know of a layer; to add one is to add one entry. Modules are known by their exact
type: a subclass may compute anything.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_sspl.errors import ConfigError, StructureError

_GRID = 17  # points per interval for smooth activations


class Relaxation(NamedTuple):
    """Lines below and above an activation on an interval, each part ``(*batch,)``."""

    lower_slope: Tensor
    lower_offset: Tensor
    upper_slope: Tensor
    upper_offset: Tensor


@dataclass(frozen=True)
class Activation:
    r"""Scalar function :math:`\sigma` that is applied to every entry; intervals and results are ``(*batch,)``.

    A relaxation is a pair of lines :math:`a_l x + b_l \le \sigma(x) \le a_u x + b_u` on an interval. Whatever slope is
    chosen, the offset is the extreme of :math:`\sigma(x) - a x`. A piecewise linear function takes it at an end of the
    interval or at a knot. For smooth ones it is evaluated on a grid, and what it may do between two grid points is
    bounded by the second
    derivative: no search, no tolerance.

    Attributes:
        name: for messages and certificates.
        value: the function.
        slope: smallest and largest slope, rounded outward.
        knots: where a piecewise linear function changes its slope; empty for smooth ones.
        curvature: bound of :math:`|\sigma''|` for smooth ones, 0 for piecewise linear ones.
        minimum: place and value of the only minimum of a function that is not monotone; the value is rounded down.
        ulps: how many units of rounding, relative to argument and value, a floating-point evaluation may be off.
        units: how many of them it may be off besides, relative to one.
        jump: what it may be off besides, for constants that are no float32 numbers and thresholds of PyTorch.
    """

    name: str
    value: Callable[[Tensor], Tensor]
    slope: tuple[float, float]
    knots: tuple[float, ...] = ()
    curvature: float = 0.0
    minimum: tuple[float, float] | None = None
    ulps: float = 0.0
    jump: float = 0.0
    units: float = 0.0

    def interval(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        """Range of the function on intervals, lower and upper ends."""
        first, last = self.value(lower), self.value(upper)
        low, high = torch.minimum(first, last), torch.maximum(first, last)
        if self.minimum is not None:
            place, value = self.minimum
            near = (lower < place + 1e-3) & (upper > place - 1e-3)
            low = torch.where(near, low.clamp_max(value), low)
        return low, high

    def parallel(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        r"""Slope a, offset b and gap g of parallel lines around the function, :math:`|\sigma(x) - (a x + b)| \le g`.

        Source: none; for ReLU the parallelogram of Singh et al. 2018.
        """
        slope = self._chord(lower, upper)
        low, high = self._offsets(slope, lower, upper)
        if self.curvature:  # on a wide interval the range alone may be the better bound
            flat_low, flat_high = self.interval(lower, upper)
            flat = flat_high - flat_low < high - low
            slope = torch.where(flat, 0.0, slope)
            low, high = torch.where(flat, flat_low, low), torch.where(flat, flat_high, high)
        return slope, 0.5 * (high + low), 0.5 * (high - low)

    def relax(self, lower: Tensor, upper: Tensor) -> Relaxation:
        """Lines below and above the function.

        Of a piecewise linear function these are the edges of its convex and its concave hull that leave the least
        area, of a smooth one two parallel lines.

        Source: Zhang et al. 2018 (CROWN) with adaptive slopes; a clamp is one function here, not two ReLUs.

        Example:
            >>> r = activation_of(nn.ReLU()).relax(torch.tensor([-1.0]), torch.tensor([3.0]))
            >>> r.lower_slope.item(), r.upper_slope.item(), r.upper_offset.item()
            (1.0, 0.75, 0.75)
        """
        if self.curvature:
            slope, offset, gap = self.parallel(lower, upper)
            return Relaxation(slope, offset - gap, slope, offset + gap)
        middle = 0.5 * (lower + upper)
        best: Relaxation | None = None
        for first, last in combinations(self._points(lower, upper), 2):
            slope = self._chord(first, last)
            low, high = self._offsets(slope, lower, upper)
            if best is None:
                best = Relaxation(slope, low, slope, high)
                continue
            above = slope * middle + low > best.lower_slope * middle + best.lower_offset
            below = slope * middle + high < best.upper_slope * middle + best.upper_offset
            best = Relaxation(
                torch.where(above, slope, best.lower_slope),
                torch.where(above, low, best.lower_offset),
                torch.where(below, slope, best.upper_slope),
                torch.where(below, high, best.upper_offset),
            )
        assert best is not None
        return best

    def slopes(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        """Smallest and largest slope of the function on intervals."""
        if self.curvature:  # a chord has the slope of some point between; it cannot change faster than the curvature
            wide = (upper - lower).clamp_min(1e-6)
            chord, change = self._chord(lower, lower + wide), self.curvature * wide * (1 + 1e-6) + 1e-9
            return (chord - change).clamp_min(self.slope[0]), (chord + change).clamp_max(self.slope[1])
        least, most = torch.full_like(lower, self.slope[1]), torch.full_like(lower, self.slope[0])
        for left, right in pairwise((-math.inf, *self.knots, math.inf)):
            ends = torch.tensor([max(left, min(right, 0.0) - 1.0), min(right, max(left, 0.0) + 1.0)], dtype=lower.dtype)
            first, last = self.value(ends).tolist()
            slope = min(max((last - first) / float(ends[1] - ends[0]), self.slope[0]), self.slope[1])
            here = (lower < right) & (upper > left)
            least, most = torch.where(here, least.clamp_max(slope), least), torch.where(here, most.clamp_min(slope), most)
        # On a knot, without width, any slope will do: the whole range.
        return torch.minimum(least, most), torch.maximum(least, most)

    def _points(self, lower: Tensor, upper: Tensor) -> list[Tensor]:
        """The ends and the knots between them; a knot outside becomes the nearer end."""
        return [lower, *(lower.clamp_min(knot).minimum(upper) for knot in self.knots), upper]

    def _chord(self, lower: Tensor, upper: Tensor) -> Tensor:
        """Slope between two points; any slope is sound, so a point in place of an interval may have any."""
        return ((self.value(upper) - self.value(lower)) / (upper - lower)).nan_to_num(0.0).clamp(*self.slope)

    def _offsets(self, slope: Tensor, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        r"""Smallest and largest value of :math:`\sigma(x) - a x` on the interval."""
        if self.curvature:
            steps = torch.linspace(0.0, 1.0, _GRID, dtype=lower.dtype, device=lower.device)
            points = torch.lerp(lower, upper, steps.reshape(-1, *[1] * lower.ndim))
            rest = self.value(points) - slope * points
            # Between two points of distance h a function differs from its chord by at most |f''| h^2 / 8.
            between = self.curvature * ((upper - lower) / (_GRID - 1)).square() / 8.0
            return rest.amin(0) - between, rest.amax(0) + between
        low = high = self.value(lower) - slope * lower
        for point in self._points(lower, upper)[1:]:
            rest = self.value(point) - slope * point
            low, high = torch.minimum(low, rest), torch.maximum(high, rest)
        return low, high


class Abs(nn.Module):
    """Absolute value as a module, for networks that certification should understand.

    Example:
        >>> Abs()(torch.tensor([-2.0]))
        tensor([2.])
    """

    def forward(self, value: Tensor) -> Tensor:
        """Absolute value, any shape."""
        return value.abs()


@dataclass(frozen=True)
class _Sine(Activation):
    """The sine, which rises and falls again and again."""

    def interval(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        first, last = self.value(lower), self.value(upper)
        low, high = torch.minimum(first, last), torch.maximum(first, last)
        quarter, turn = 0.5 * math.pi, 2.0 * math.pi
        for sign in (1.0, -1.0):  # is there a k with a peak (or a trough) at sign pi / 2 + 2 pi k between the two, or nearly?
            after = ((lower - 1e-6 - sign * quarter) / turn).ceil() * turn + sign * quarter
            there = after <= upper + 1e-6
            high = torch.where(there, 1.0, high) if sign > 0 else high
            low = torch.where(there, -1.0, low) if sign < 0 else low
        return low, high


def sine() -> Activation:
    """The sine of a direction's angle; no network has it as a layer.

    What a floating-point evaluation may be off counts what the two numbers of a direction are off their circle.

    Example:
        >>> [end.item() for end in sine().interval(torch.tensor([0.0]), torch.tensor([2.0]))]
        [0.0, 1.0]
    """
    return _Sine("Sine", torch.sin, (-1.0, 1.0), curvature=1.0, ulps=16.0, units=16.0)


def clamp(low: float = -1.0, high: float = 1.0) -> Activation:
    """The clamp to an interval, ``low < high``.

    Example:
        >>> clamp().value(torch.tensor([-3.0, 0.5]))
        tensor([-1.0000,  0.5000])
    """
    if not low < high:
        raise ConfigError(f"expected low < high, received {low} and {high}")
    name = f"Clamp({low:g}, {high:g})"
    return Activation(name, lambda x: x.clamp(low, high), (0.0, 1.0), (low, high), jump=_off(low, high))


def _off(*constants: float) -> float:
    """What float32 changes constants by, at most."""
    return max(abs(float(torch.tensor(c, dtype=torch.float32)) - c) for c in constants)


def _leaky_relu(module: Any) -> Activation:
    a = float(module.negative_slope)
    deployed = float(torch.tensor(a, dtype=torch.float32))  # a float32 network multiplies with this
    slope, bend = (min(a, deployed, 1.0), max(a, deployed, 1.0)), (0.0, 0.0) if a < 0 else None
    return Activation(f"LeakyReLU({a:g})", lambda x: F.leaky_relu(x, a), slope, (0.0,), minimum=bend, ulps=3.0)


def _softplus(module: Any) -> Activation:
    b, threshold = float(module.beta), float(module.threshold)
    # Beyond the threshold PyTorch goes over to the identity: a jump, which is rounding for large thresholds only.
    if not (b > 0 and 20.0 <= threshold < math.inf):
        raise StructureError(
            f"expected one of the activations that are known, received {module!r}; below threshold=20 it jumps by "
            "log(1 + exp(-threshold)) / beta"
        )
    smooth = lambda x: F.softplus(x, beta=b, threshold=700.0)  # noqa: E731
    jump = math.exp(-threshold) / b * (1 + 1e-9)
    return Activation(f"Softplus({b:g})", smooth, (0.0, 1.0), curvature=0.25 * b * (1 + 1e-9), ulps=8.0, jump=jump)


def _gelu(module: Any) -> Activation:
    if module.approximate != "none":
        raise StructureError(f"expected one of the activations that are known, received {module!r}; use approximate='none'")
    return Activation("GELU", F.gelu, (-0.13, 1.13), curvature=0.7979, minimum=(-0.7517916, -0.1699713), ulps=8.0)


#: What is known of layers, by exact type: None for a linear layer or none, else the activation. Bounds of second derivatives:
#: tanh 4 / (3 sqrt 3), sigmoid 1 / (6 sqrt 3), softplus beta / 4, SiLU 1 / 2, GELU sqrt(2 / pi), all rounded up.
LAYERS: dict[type[nn.Module], Callable[[Any], Activation | None]] = {
    nn.Linear: lambda m: None,
    nn.Identity: lambda m: None,
    nn.ReLU: lambda m: Activation("ReLU", torch.relu, (0.0, 1.0), (0.0,)),
    nn.LeakyReLU: _leaky_relu,
    nn.Hardtanh: lambda m: clamp(float(m.min_val), float(m.max_val)),
    nn.ReLU6: lambda m: clamp(float(m.min_val), float(m.max_val)),
    nn.Tanh: lambda m: Activation("Tanh", torch.tanh, (0.0, 1.0), curvature=0.7699, ulps=8.0),
    nn.Sigmoid: lambda m: Activation("Sigmoid", torch.sigmoid, (0.0, 0.25), curvature=0.0963, ulps=8.0),
    nn.Softplus: _softplus,
    nn.SiLU: lambda m: Activation("SiLU", F.silu, (-0.1, 1.1), curvature=0.501, minimum=(-1.278464, -0.2784646), ulps=8.0),
    nn.GELU: _gelu,
    Abs: lambda m: Activation("Abs", torch.abs, (-1.0, 1.0), (0.0,), minimum=(0.0, 0.0)),
}

#: Their forward methods as they were when they became known.
ORIGINAL: dict[type[nn.Module], Callable[..., Tensor]] = {k: k.forward for k in (*LAYERS, nn.Sequential)}  # type: ignore[attr-defined]
#: Modules that are more than layers in a row, by exact type, and the form of what they compute. "residual":
#: clamp(z + net(z, u / action_scale), -1, 1); "bounded": action_scale clamp(net(z), -1, 1); "choosing": modules.ChoosingPolicy.
FORMS: dict[type[nn.Module], str] = {}
#: Modules whose ``collapse()`` gives the plain network that is deployed in their place, by exact type.
COLLAPSIBLE: set[type[nn.Module]] = set()


def known_form(form: str) -> Callable[[type], type]:
    """Decorator of a module whose forward is of one of the :data:`FORMS`; values are compared nevertheless.

    Example:
        >>> FORMS.pop(known_form("bounded")(type("Mine", (nn.Module,), {})))
        'bounded'
    """
    if form not in ("residual", "bounded", "choosing"):
        raise ConfigError(f"expected the form 'residual', 'bounded' or 'choosing', received {form!r}")

    def register(kind: type) -> type:
        FORMS[kind], ORIGINAL[kind] = form, kind.forward  # type: ignore[attr-defined]
        return kind

    return register


def collapsible(kind: type) -> type:
    """Decorator of a module whose ``collapse()`` gives the plain network that is deployed."""
    COLLAPSIBLE.add(kind)
    ORIGINAL[kind] = kind.forward  # type: ignore[attr-defined]
    return kind


def activation_of(module: nn.Module) -> Activation:
    """What is known of an activation, one of :data:`LAYERS` that is not linear, else ``StructureError``.

    Example:
        >>> activation_of(nn.LeakyReLU(0.5)).slope
        (0.5, 1.0)
    """
    read = LAYERS.get(type(module))
    found = None if read is None else read(module)
    if found is None:
        known = ", ".join(sorted(kind.__name__ for kind in LAYERS))
        raise StructureError(f"expected layers of the kinds {known}, received {module!r}; deploy a network made of these")
    return found

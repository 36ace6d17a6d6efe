"""Ground truth for low-dimensional systems by dynamic programming: states that some control keeps safe."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_sspl.errors import ConfigError, DTypeError, EmptyRegionError, NonFiniteError, ShapeError
from torchrl_sspl.sets import UNSAFE, Box, Difference, Region, Union

Dynamics = Callable[[Tensor, Tensor], Tensor]


class Grid:
    """Regular grid over a box with multilinear interpolation; axes may be periodic.

    Args:
        low, high (sequence of float): corners of the box, length ``d``.
        resolution (int or sequence of int): number of nodes per axis. On a periodic axis ``high`` is the same
            place as ``low`` and carries no node of its own.
        period (sequence of float, optional): period per axis, 0 or None where there is none; where given it
            must be ``high - low``.

    Example:
        >>> grid = Grid([0.0, 0.0], [1.0, 2.0], resolution=3)
        >>> grid.axes[1]
        tensor([0., 1., 2.])
    """

    def __init__(
        self,
        low: Sequence[float],
        high: Sequence[float],
        resolution: int | Sequence[int] = 201,
        period: Sequence[float | None] | None = None,
        *,
        device: torch.device | str | None = None,
    ) -> None:
        low, high = [float(v) for v in low], [float(v) for v in high]
        dim = len(low)
        sizes = [resolution] * dim if isinstance(resolution, int) else list(resolution)
        periods = [float(p or 0.0) for p in period] if period is not None else [0.0] * dim
        if not (dim and len(high) == len(sizes) == len(periods) == dim):
            raise ShapeError(
                f"grid: expected low, high, resolution and period of one length >= 1, received "
                f"{len(low)}, {len(high)}, {len(sizes)}, {len(periods)}."
            )
        if any(n < 2 for n in sizes) or any(h <= l for l, h in zip(low, high, strict=True)):
            raise ConfigError(f"grid: expected low < high and >= 2 nodes per axis, received {low}, {high}, {sizes}.")
        for l, h, p in zip(low, high, periods, strict=True):
            if p and not math.isclose(p, h - l, rel_tol=1e-6):
                raise ConfigError(f"grid: expected a period equal to high - low = {h - l}, received {p}.")
        self.low, self.high, self.period, self.shape = low, high, periods, tuple(sizes)
        self.dim = dim
        cells = [n if p else n - 1 for n, p in zip(sizes, periods, strict=True)]
        self.step = [(h - l) / c for l, h, c in zip(low, high, cells, strict=True)]
        nodes = [torch.arange(n, dtype=torch.float64, device=device) for n in sizes]
        self.axes = [(l + s * i).float() for l, s, i in zip(low, self.step, nodes, strict=True)]
        self._cells = cells
        padded = [c + 1 for c in cells]  # a periodic axis repeats its first node at the end
        self._strides = [math.prod(padded[k + 1 :]) for k in range(dim)]

    def nodes(self) -> Tensor:
        """All nodes, ``(prod(shape), d)``, last axis fastest."""
        return torch.stack(torch.meshgrid(*self.axes, indexing="ij"), dim=-1).reshape(-1, self.dim)

    def locate(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cell, position in the cell, and whether the state lies outside the box.

        Args:
            state (Tensor): ``(*batch, d)``.

        Returns:
            tuple: int32 index ``(*batch,)`` of the lower corner, float ``(d, *batch)`` in [0, 1], bool
                ``(*batch,)``.
        """
        index = torch.zeros(state.shape[:-1], dtype=torch.int32, device=state.device)
        outside = torch.zeros(state.shape[:-1], dtype=torch.bool, device=state.device)
        inside_cell = []
        for k in range(self.dim):
            position = (state[..., k] - self.low[k]) / self.step[k]
            if self.period[k]:
                position = position.remainder(self._cells[k])
            else:
                slack = 1e-5  # float32 nodes on the border of the box are inside
                outside |= (position < -slack) | (position > self._cells[k] + slack) | position.isnan()
            cell = position.nan_to_num(0.0).floor().clamp_(0, self._cells[k] - 1)
            inside_cell.append((position - cell).clamp_(0, 1))
            index += cell.to(torch.int32) * self._strides[k]
        return index, torch.stack(inside_cell), outside

    def pad(self, value: Tensor) -> Tensor:
        """Values on the nodes, flat, with the first node repeated at the end of periodic axes."""
        value = value.reshape(self.shape)
        for k in range(self.dim):
            if self.period[k]:
                value = torch.cat([value, value.narrow(k, 0, 1)], dim=k)
        return value.reshape(-1)

    def gather(self, padded: Tensor, index: Tensor, inside_cell: Tensor) -> Tensor:
        """Multilinear interpolation of padded values at located states, ``(*batch,)``."""
        corners = [padded[index + offset] for offset in self._corner_offsets()]
        for k in reversed(range(self.dim)):  # the last axis varies fastest over the corners
            corners = [torch.lerp(corners[2 * i], corners[2 * i + 1], inside_cell[k]) for i in range(len(corners) // 2)]
        return corners[0]

    def _corner_offsets(self) -> list[int]:
        offsets = [0]
        for stride in self._strides:
            offsets = [o + s for o in offsets for s in (0, stride)]
        return offsets


@dataclasses.dataclass(frozen=True)
class ViabilityKernel:
    """Values on a grid whose positive part is a set of states: a viability kernel or a recoverable set.

    Attributes:
        value (Tensor): ``(n_1, ..., n_d)``; positive inside the set.
        margin (Tensor): same shape; positive where the constraint holds (outside the unsafe set).
        grid (Grid): axes, period and interpolation.
        outside (bool): whether states beyond the grid belong to the set.
        iterations (int), seconds (float), change (float): of the computation; ``change`` is the largest
            change of a value in the last iteration, as a share of the largest value.
    """

    value: Tensor
    margin: Tensor
    grid: Grid
    outside: bool
    iterations: int
    seconds: float
    change: float

    @property
    def axes(self) -> list[Tensor]:
        """Coordinates of the nodes, one tensor per axis."""
        return self.grid.axes

    @property
    def volume_fraction(self) -> float:
        """Share of the nodes where the constraint holds that belong to the set."""
        allowed = self.margin > 0
        return ((self.value > 0) & allowed).sum().item() / max(1, int(allowed.sum()))

    def interpolate(self, state: Tensor) -> Tensor:
        """Multilinear interpolation of the values at states ``(*batch, d)``, giving ``(*batch,)``.

        States outside the grid get ``+inf`` where leaving it is safe, else ``-inf``.

        Raises:
            ShapeError, DTypeError: the states are not a floating-point ``(*batch, d)`` tensor.
        """
        if not state.is_floating_point():
            raise DTypeError(f"state: expected a floating-point tensor, received {state.dtype}; call .float().")
        if state.ndim < 1 or state.shape[-1] != self.grid.dim:
            raise ShapeError(f"state: expected shape (*batch, {self.grid.dim}), received {tuple(state.shape)}.")
        index, inside_cell, outside = self.grid.locate(state)
        value = self.grid.gather(self.grid.pad(self.value).to(inside_cell.dtype), index, inside_cell)
        beyond = math.inf if self.outside else -math.inf
        return torch.where(outside, torch.full_like(value, beyond), value)

    def contains(self, state: Tensor) -> Tensor:
        """Whether states ``(*batch, d)`` belong to the set, bool ``(*batch,)``."""
        return self.interpolate(state) > 0


def viability_kernel(
    system: Any,
    *,
    low: Sequence[float] | None = None,
    high: Sequence[float] | None = None,
    resolution: int | Sequence[int] = 201,
    period: Sequence[float | None] | None = None,
    margin: Callable[[Tensor], Tensor] | None = None,
    actions: Tensor | None = None,
    exit_is_safe: bool | None = None,
    saturation: float = 0.05,
    tolerance: float = 1e-4,
    max_iterations: int = 1000,
) -> ViabilityKernel:
    """Largest set of states from which some control keeps the constraint for ever, on a grid.

    Iterates, without discount, until no value changes by more than ``tolerance``:

        V_0 = l,    V_{k+1}(x) = min(l(x), max_u V_k(f(x, u)))

    with ``l(x) > 0`` where the constraint holds and multilinear interpolation of ``V_k`` between the nodes.
    The kernel is ``{V > 0}``. Its border does not change when ``l`` is replaced by an increasing function of
    ``l`` with the same zero, so ``l`` is cut at a small share of its largest value: interpolation errors then
    do not add up over the distance that a slow trajectory travels, and the iteration stops early. The result
    is a numerical reference, not a proof: its border is exact to a fraction of a cell.

    Args:
        system: an environment with ``dynamics``, ``state_space``, ``unsafe_set``, ``max_action`` and
            ``action_dim`` (all other arguments then have defaults), or a function
            ``dynamics(state (n, d), action (n, m)) -> (n, d)``.
        low, high (sequence of float): box that the grid covers; required for a function.
        resolution (int or sequence of int): nodes per axis. Default 201.
        period (sequence): period per axis, None or 0 where there is none.
        margin (callable): ``l``, ``(n, d) -> (n,)``, positive where the constraint holds; required for a
            function. Best a distance to the border (a plus-minus-one indicator works, less exactly).
        actions (Tensor): ``(k, m)`` actions to choose from; required for a function. Default for an
            environment: 21 equally spaced values for one action component, a grid of 7 per component for
            several.
        exit_is_safe (bool): whether leaving the box counts as safe. Default False, or what the environment's
            ``exit_region`` says.
        saturation (float): share of the largest value of ``l`` at which it is cut, above and below. Default
            0.05.
        tolerance (float): stop when no value changes by more than this share of the cut. Default 1e-4.
        max_iterations (int): stop at the latest after so many iterations. Default 1000.

    Returns:
        ViabilityKernel: ``value``, ``axes``, ``contains(state)``, ``interpolate(state)``,
            ``volume_fraction``. The pendulum at the default resolution takes two seconds on one core.

    Raises:
        ConfigError: an argument that is needed is missing, or a value is not valid.
        ShapeError, NonFiniteError: the dynamics return a wrong shape or NaN.

    Source: discrete-time viability by value iteration; the paper has no ground truth. Deviation: none.

    Example:
        >>> import torch
        >>> # Inside |x| < 1, pushed outwards by 0.5 x, with |u| <= 0.1: controllable up to |x| = 0.2.
        >>> kernel = viability_kernel(
        ...     lambda x, u: 1.5 * x + u, low=[-1.2], high=[1.2], resolution=241,
        ...     margin=lambda x: 1 - x[:, 0].abs(), actions=torch.linspace(-0.1, 0.1, 5)[:, None])
        >>> kernel.contains(torch.tensor([[0.19], [0.21]]))
        tensor([ True, False])
    """
    problem = _Problem.collect(system, low, high, resolution, period, margin, actions, exit_is_safe)
    if not 0 < saturation <= 1:
        raise ConfigError(f"saturation: expected a share in (0, 1], received {saturation!r}.")
    if float(problem.margin.max()) <= 0:
        raise EmptyRegionError(
            f"margin: expected a positive value at some node, received at most {float(problem.margin.max()):.3g}; "
            "the constraint holds nowhere on the grid."
        )
    return _iterate(problem, float(problem.margin.max()) * saturation, tolerance, max_iterations)


def _iterate(problem: _Problem, cut: float, tolerance: float, max_iterations: int) -> ViabilityKernel:
    """The iteration of ``viability_kernel``, with l cut at a value."""
    start = time.perf_counter()
    limit = problem.margin.clamp(-cut, cut)
    value, iterations, change = limit, 0, math.inf
    while change > tolerance and iterations < max_iterations:
        new = torch.minimum(limit, problem.best_successor(value, cut))
        change = float((new - value).abs().max()) / cut
        value, iterations = new, iterations + 1
    shape = problem.grid.shape
    return ViabilityKernel(
        value=value.reshape(shape),
        margin=limit.reshape(shape),
        grid=problem.grid,
        outside=problem.exit_is_safe,
        iterations=iterations,
        seconds=time.perf_counter() - start,
        change=change,
    )


def recoverable_set(
    system: Any,
    target: ViabilityKernel,
    *,
    horizon: int | None = None,
    actions: Tensor | None = None,
    tolerance: float = 1e-4,
    max_iterations: int = 1000,
) -> ViabilityKernel:
    """States that some control steers into a set within a horizon, without leaving the grid's box.

        V_0 = target,    V_{k+1}(x) = max(V_k(x), max_u V_k(f(x, u)))

    The unsafe set may be crossed on the way: this is the set from which a return is possible at all.

    Args:
        system: as for ``viability_kernel``; the grid is the target's.
        target (ViabilityKernel): the set to reach.
        horizon (int, optional): number of steps allowed. Default None: any number.
        actions (Tensor): as for ``viability_kernel``.
        tolerance (float), max_iterations (int): stop rule when there is no horizon.

    Returns:
        ViabilityKernel: the set, on the target's grid, with the target's ``margin``.

    Raises:
        ConfigError: ``horizon`` is negative, or ``actions`` are missing.

    Source: backward reachability by value iteration; the paper claims recovery from everywhere, see the
    deviations page. Deviation: none.

    Example:
        >>> import torch
        >>> push = dict(actions=torch.tensor([[-0.1], [0.1]]))
        >>> f = lambda x, u: x + u
        >>> goal = viability_kernel(
        ...     f, low=[-1], high=[1], margin=lambda x: 0.2 - x[:, 0].abs(), **push)
        >>> recoverable_set(f, goal, horizon=2, **push).contains(torch.tensor([[0.35], [0.45]]))
        tensor([ True, False])
    """
    if horizon is not None and horizon < 0:
        raise ConfigError(f"horizon: expected an integer >= 0 or None, received {horizon!r}.")
    grid = target.grid
    flat = target.value.reshape(-1)
    problem = _Problem.collect(
        system,
        grid.low,
        grid.high,
        grid.shape,
        grid.period,
        lambda _: target.margin.reshape(-1),
        actions,
        False,
    )
    start = time.perf_counter()
    cut = float(flat.abs().max())
    value, iterations, change = flat, 0, math.inf
    limit = max_iterations if horizon is None else horizon
    while change > tolerance and iterations < limit:
        new = torch.maximum(value, problem.best_successor(value, cut))
        change = float((new - value).abs().max()) / cut
        value, iterations = new, iterations + 1
    return dataclasses.replace(
        target,
        value=value.reshape(grid.shape),
        outside=False,
        iterations=iterations,
        seconds=time.perf_counter() - start,
        change=change,
    )


@dataclasses.dataclass
class _Problem:
    """Located successors of every node under every action: the part of the iteration that never changes."""

    grid: Grid
    margin: Tensor  # (nodes,)
    exit_is_safe: bool
    successors: list[tuple[Tensor, Tensor, Tensor]]  # per action: cell, position in it, outside

    @classmethod
    def collect(
        cls,
        system: Any,
        low: Sequence[float] | None,
        high: Sequence[float] | None,
        resolution: int | Sequence[int],
        period: Sequence[float | None] | None,
        margin: Callable[[Tensor], Tensor] | None,
        actions: Tensor | None,
        exit_is_safe: bool | None,
    ) -> _Problem:
        dynamics: Dynamics = getattr(system, "dynamics", system)
        space = getattr(system, "state_space", None)
        if isinstance(space, Box):
            low = space.low.tolist() if low is None else low
            high = space.high.tolist() if high is None else high
            period = space.period.tolist() if period is None else period
        if margin is None:
            margin = _margin_of(system)
        if actions is None:
            actions = _actions_of(system)
        if exit_is_safe is None:
            exit_is_safe = getattr(system, "exit_region", UNSAFE) != UNSAFE
        given = dict(low=low, high=high, margin=margin, actions=actions)
        missing = [name for name, value in given.items() if value is None]
        if not callable(dynamics) or low is None or high is None or margin is None or actions is None:
            raise ConfigError(
                "viability kernel: expected an environment (dynamics, state_space, unsafe_set, max_action), "
                "or a function together with low, high, margin and actions; received "
                f"{type(system).__name__} without {missing}."
            )
        if actions.ndim != 2:
            raise ShapeError(f"actions: expected shape (k, action_dim), received {tuple(actions.shape)}.")
        grid = Grid(low, high, resolution, period)
        nodes = grid.nodes()
        limit = margin(nodes)
        if limit.shape != nodes.shape[:1]:
            raise ShapeError(f"margin: expected shape {(nodes.shape[0],)}, received {tuple(limit.shape)}.")
        successors = []
        for action in actions.to(nodes):
            after = dynamics(nodes, action.expand(nodes.shape[0], -1))
            if after.shape != nodes.shape:
                raise ShapeError(f"dynamics: expected shape {tuple(nodes.shape)}, received {tuple(after.shape)}.")
            if torch.isnan(after).any():
                raise NonFiniteError("dynamics: expected finite states, received NaN for a node of the grid.")
            successors.append(grid.locate(after))
        return cls(grid, limit, bool(exit_is_safe), successors)

    def best_successor(self, value: Tensor, cut: float) -> Tensor:
        """Largest value among the successors of each node, ``(nodes,)``; beyond the box it is +- ``cut``."""
        padded = self.grid.pad(value)
        beyond = value.new_tensor(cut if self.exit_is_safe else -cut)
        best = None
        for index, inside_cell, outside in self.successors:
            reached = torch.where(outside, beyond, self.grid.gather(padded, index, inside_cell))
            best = reached if best is None else torch.maximum(best, reached, out=best)
        assert best is not None
        return best


def _outside(region: Region, state: Tensor) -> Tensor:
    """How far states ``(n, d)`` are outside a region, largest-component norm; negative inside; ``(n,)``.

    A lower bound of the distance for boxes and what is cut out of or joined from them; what ``region.outside`` says
    for a region that has it; +-1 for other regions.
    """
    if isinstance(region, Box):
        low, high, period = region.low.to(state), region.high.to(state), region.period.to(state)
        offset = state - (low + high) / 2
        turn = torch.where(period > 0, period, torch.inf)
        offset = torch.where(period > 0, (offset + period / 2).remainder(turn) - period / 2, offset)
        beyond = offset.abs() - (high - low) / 2
        # An angle that may take every value never tells inside from outside.
        return torch.where((period > 0) & (high - low >= period * (1 - 1e-6)), -torch.inf, beyond).amax(-1)
    if isinstance(region, Difference):
        return torch.maximum(_outside(region.a, state), -_outside(region.b, state))
    if isinstance(region, Union):
        return torch.stack([_outside(part, state) for part in region.parts]).amin(0)
    if hasattr(region, "outside"):
        return region.outside(state)
    return 1.0 - 2.0 * region.contains(state).to(state.dtype)


def _margin_of(system: Any) -> Callable[[Tensor], Tensor] | None:
    unsafe = getattr(system, "unsafe_set", None)
    return None if unsafe is None else lambda state: _outside(unsafe, state)


def _actions_of(system: Any) -> Tensor | None:
    bound, dim = getattr(system, "max_action", None), getattr(system, "action_dim", None)
    if bound is None or dim is None:
        return None
    axis = torch.linspace(-1.0, 1.0, 21 if dim == 1 else 7)
    return torch.cartesian_prod(*[axis] * dim).reshape(-1, dim) * bound


__all__ = ["Grid", "ViabilityKernel", "recoverable_set", "viability_kernel"]

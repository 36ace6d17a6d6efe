"""Ground truth for low-dimensional systems by dynamic programming: states that some control keeps safe."""

from __future__ import annotations

import dataclasses
import functools
import math
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from torchrl_sspl.errors import ConfigError, DTypeError, EmptyRegionError, NonFiniteError, ShapeError
from torchrl_sspl.journal import Entry
from torchrl_sspl.sets import UNSAFE, Box, Difference, Region, Union

Dynamics = Callable[[Tensor, Tensor], Tensor]
_PATIENCE = 5.0  # s, after which a progress bar appears


class Grid:
    """Regular grid over a box with multilinear interpolation; axes may be periodic. Source: none.

    Args:
        low, high: corners of the box, length ``d``.
        resolution: number of nodes per axis. On a periodic axis ``high`` is the same place as ``low`` and carries no
            node of its own.
        period: period per axis, 0 or None where there is none; where given it must be ``high - low``.

    Example:
        >>> Grid([0.0, 0.0], [1.0, 2.0], resolution=3).axes[1]
        tensor([0., 1., 2.])
    """

    def __init__(
        self,
        low: Sequence[float],
        high: Sequence[float],
        resolution: int | Sequence[int] = 201,
        period: Sequence[float | None] | None = None,
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
        self.low, self.high, self.period, self.shape, self.dim = low, high, periods, tuple(sizes), dim
        cells = [n if p else n - 1 for n, p in zip(sizes, periods, strict=True)]
        self.step = [(h - l) / c for l, h, c in zip(low, high, cells, strict=True)]
        nodes = [torch.arange(n, dtype=torch.float64) for n in sizes]
        self.axes = [(l + s * i).float() for l, s, i in zip(low, self.step, nodes, strict=True)]
        self._cells = cells
        padded = [c + 1 for c in cells]  # a periodic axis repeats its first node at the end
        self._strides = [math.prod(padded[k + 1 :]) for k in range(dim)]
        self._corners = [0]  # offsets of the corners of a cell, the last axis fastest
        for stride in self._strides:
            self._corners = [o + s for o in self._corners for s in (0, stride)]

    def nodes(self) -> Tensor:
        """All nodes, ``(prod(shape), d)``, last axis fastest."""
        return torch.stack(torch.meshgrid(*self.axes, indexing="ij"), dim=-1).reshape(-1, self.dim)

    def locate(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Lower corner ``(*batch,)`` of cells, position ``(d, *batch)`` in them, in [0, 1], and who is outside."""
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
        corners = [padded[index + offset] for offset in self._corners]
        for k in reversed(range(self.dim)):
            corners = [torch.lerp(corners[2 * i], corners[2 * i + 1], inside_cell[k]) for i in range(len(corners) // 2)]
        return corners[0]


@dataclasses.dataclass(frozen=True)
class ViabilityKernel:
    """Values on a grid whose positive part is a set of states: a viability kernel or a recoverable set.

    Attributes:
        value: ``(n_1, ..., n_d)``; positive inside the set.
        margin: same shape; positive where the constraint holds (outside the unsafe set).
        grid: axes, period and interpolation.
        outside: whether states beyond the grid belong to the set.
        iterations, seconds: of the computation.
        change: largest change of a value in the last iteration, as a share of the largest value.
        converged: whether that is within the tolerance; if not, a kernel is too large.
    """

    value: Tensor
    margin: Tensor
    grid: Grid
    outside: bool
    iterations: int
    seconds: float
    change: float
    converged: bool = True

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
        """Multilinear interpolation ``(*batch,)`` of the values at states ``(*batch, d)``.

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
        return value.masked_fill(outside, math.inf if self.outside else -math.inf)

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
    errors: Tensor | None = None,
    saturation: float = 0.05,
    tolerance: float = 1e-4,
    max_iterations: int = 1000,
) -> ViabilityKernel:
    """Largest set of states from which some control keeps the constraint for ever, on a grid.

    Iterates, without discount, until no value changes by more than ``tolerance``:

        V_0 = l,    V_{k+1}(x) = min(l(x), max_u min_e V_k(f(x, u) + e))

    with ``l(x) > 0`` where the constraint holds and multilinear interpolation of ``V_k`` between the nodes.
    The kernel is ``{V > 0}``. Its border does not change when ``l`` is replaced by an increasing function of
    ``l`` with the same zero, so ``l`` is cut at a small share of its largest value: interpolation errors then
    do not add up over the distance that a slow trajectory travels, and the iteration stops early. The result
    is a numerical reference, not a proof: its border is exact to a fraction of a cell. Source: discrete-time viability
    by value iteration; the paper has no ground truth. Deviation: none.

    Args:
        system: an environment with ``dynamics``, ``state_space``, ``unsafe_set``, ``max_action`` and ``action_dim``, or
            a function ``dynamics(state (n, d), action (n, m)) -> (n, d)``, which needs box, margin and actions.
        low, high: box that the grid covers.
        resolution: nodes per axis.
        period: period per axis, None or 0 where there is none.
        margin: ``l``, ``(n, d) -> (n,)``, positive where the constraint holds. Best a distance to the border (a
            plus-minus-one indicator works, less exactly).
        actions: ``(k, m)`` to choose from. Default: 21 equally spaced values of one component, 7 of each of several.
        exit_is_safe: whether leaving the box counts as safe. Default: what ``exit_region`` says, else no.
        errors: ``(j, d)`` errors e, of which the worst is added to every successor, which stays in the box by that. Default: none.
        saturation: share of the largest value of ``l`` at which it is cut, above and below.
        tolerance: stop when no value changes by more than this share of the cut.
        max_iterations: stop at the latest after so many iterations, with a warning.

    Returns:
        The kernel. That of the pendulum at the default resolution takes two seconds on one core.

    Raises:
        ConfigError: an argument that is needed is missing, or a value is not valid.
        EmptyRegionError: the constraint holds nowhere on the grid.
        ShapeError, NonFiniteError: the dynamics return a wrong shape or NaN.

    Example:
        >>> # Inside |x| < 1, pushed outwards by 0.5 x, with |u| <= 0.1: controllable up to |x| = 0.2.
        >>> kernel = viability_kernel(
        ...     lambda x, u: 1.5 * x + u, low=[-1.2], high=[1.2], resolution=241,
        ...     margin=lambda x: 1 - x[:, 0].abs(), actions=torch.linspace(-0.1, 0.1, 5)[:, None])
        >>> kernel.contains(torch.tensor([[0.19], [0.21]]))
        tensor([ True, False])
    """
    problem = _Problem(system, low, high, resolution, period, margin, actions, exit_is_safe, errors)
    if not 0 < saturation <= 1:
        raise ConfigError(f"saturation: expected a share in (0, 1], received {saturation!r}.")
    if float(problem.margin.max()) <= 0:
        raise EmptyRegionError(
            f"margin: expected a positive value at some node, received at most {float(problem.margin.max()):.3g}; "
            "the constraint holds nowhere on the grid."
        )
    cut = float(problem.margin.max()) * saturation
    problem.margin = limit = problem.margin.clamp(-cut, cut)
    kernel = _iterate(problem, limit, lambda _, best: torch.minimum(limit, best), cut, tolerance, max_iterations)
    if not kernel.converged:
        warnings.warn(
            f"the kernel still changes by {kernel.change:.2g} of the cut after {kernel.iterations} iterations, more than the tolerance of {tolerance:g}: "
            "it is too large; raise max_iterations", stacklevel=2,
        )  # fmt: skip
    return kernel


def _iterate(
    problem: _Problem,
    value: Tensor,
    combine: Callable[[Tensor, Tensor], Tensor],
    cut: float,
    tolerance: float,
    limit: int,
) -> ViabilityKernel:
    """Combines the values with the best among their successors' until they stay as they are."""
    entry = Entry("sweeps", value, tolerance, limit)
    state = entry.saved() or {"value": value, "iterations": 0, "change": math.inf, "seconds": 0.0}
    value, iterations, change = state["value"], state["iterations"], state["change"]
    start = time.perf_counter() - state["seconds"]

    def save(complete: bool = False) -> None:
        state = {"value": value, "iterations": iterations, "change": change, "seconds": time.perf_counter() - start}
        entry.save(state, complete=complete)

    # Only what takes long shows itself: a fine grid of many coordinates.
    with tqdm(desc=f"kernel on {value.numel():,} nodes", unit="sweep", initial=iterations, delay=_PATIENCE, leave=False) as bar:
        while change > tolerance and iterations < limit:
            new = combine(value, problem.best_successor(value, cut))
            change = float((new - value).abs().max()) / cut
            value, iterations = new, iterations + 1
            bar.update()
            if entry.due:
                save()
    save(complete=True)
    grid, seconds = problem.grid, time.perf_counter() - start
    value, margin = value.reshape(grid.shape), problem.margin.reshape(grid.shape)
    return ViabilityKernel(value, margin, grid, problem.exit_is_safe, iterations, seconds, change, change <= tolerance)


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

    The unsafe set may be crossed on the way: this is the set from which a return is possible at all. Source: backward
    reachability by value iteration; the paper claims recovery from everywhere, see the deviations page. Deviation:
    none.

    Args:
        system, actions: as for :func:`viability_kernel`.
        target: the set to reach; its grid and margin are those of the result.
        horizon: number of steps allowed, a ConfigError if negative; None: any number.
        tolerance, max_iterations: stop rule when there is no horizon.

    Example:
        >>> push, f = dict(actions=torch.tensor([[-0.1], [0.1]])), lambda x, u: x + u
        >>> goal = viability_kernel(f, low=[-1], high=[1], margin=lambda x: 0.2 - x[:, 0].abs(), **push)
        >>> recoverable_set(f, goal, horizon=2, **push).contains(torch.tensor([[0.35], [0.45]]))
        tensor([ True, False])
    """
    if horizon is not None and horizon < 0:
        raise ConfigError(f"horizon: expected an integer >= 0 or None, received {horizon!r}.")
    grid, flat, margin = target.grid, target.value.reshape(-1), target.margin.reshape(-1)
    problem = _Problem(
        system, grid.low, grid.high, grid.shape, grid.period, lambda _: margin, actions, exit_is_safe=False
    )
    limit = max_iterations if horizon is None else horizon
    return _iterate(problem, flat, torch.maximum, float(flat.abs().max()), tolerance, limit)


class _Problem:
    """Located successors of every node under every action: the part of the iteration that never changes."""

    def __init__(
        self,
        system: Any,
        low: Sequence[float] | None,
        high: Sequence[float] | None,
        resolution: int | Sequence[int],
        period: Sequence[float | None] | None,
        margin: Callable[[Tensor], Tensor] | None,
        actions: Tensor | None,
        exit_is_safe: bool | None,
        errors: Tensor | None = None,
    ) -> None:
        dynamics: Dynamics = getattr(system, "dynamics", system)
        space = getattr(system, "state_space", None)
        if isinstance(space, Box):
            low = space.low.tolist() if low is None else low
            high = space.high.tolist() if high is None else high
            period = space.period.tolist() if period is None else period
        if margin is None:
            unsafe = getattr(system, "unsafe_set", None)
            margin = None if unsafe is None else functools.partial(_outside, unsafe)
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
        self.grid, self.exit_is_safe = Grid(low, high, resolution, period), bool(exit_is_safe)
        nodes = self.grid.nodes()
        self.margin = margin(nodes)  # (nodes,)
        if self.margin.shape != nodes.shape[:1]:
            raise ShapeError(f"margin: expected shape {(nodes.shape[0],)}, received {tuple(self.margin.shape)}.")
        if errors is not None and (errors.ndim != 2 or errors.shape[1] != nodes.shape[1] or not len(errors)):
            raise ShapeError(f"errors: expected shape (j, {nodes.shape[1]}), received {tuple(errors.shape)}.")
        self.successors = []  # per action, for every error: cell, position in it, outside
        placed = tqdm(actions.to(nodes), desc=f"successors of {len(nodes):,} nodes", unit="action", delay=_PATIENCE, leave=False)
        for action in placed:
            after = dynamics(nodes, action.expand(nodes.shape[0], -1))
            if after.shape != nodes.shape:
                raise ShapeError(f"dynamics: expected shape {tuple(nodes.shape)}, received {tuple(after.shape)}.")
            if torch.isnan(after).any():
                raise NonFiniteError("dynamics: expected finite states, received NaN for a node of the grid.")
            self.successors.append([self.grid.locate(a) for a in _moved(self.grid, after, errors)])

    def best_successor(self, value: Tensor, cut: float) -> Tensor:
        """Largest value among the successors of each node, ``(nodes,)``; beyond the box it is +- ``cut``."""
        padded = self.grid.pad(value)
        beyond = value.new_tensor(cut if self.exit_is_safe else -cut)
        best = None
        for moved in self.successors:
            reached = None
            for index, inside_cell, outside in moved:
                value_there = torch.where(outside, beyond, self.grid.gather(padded, index, inside_cell))
                reached = value_there if reached is None else torch.minimum(reached, value_there, out=reached)
            assert reached is not None
            best = reached if best is None else torch.maximum(best, reached, out=best)
        assert best is not None
        return best


def _moved(grid: Grid, after: Tensor, errors: Tensor | None) -> list[Tensor]:
    """Successors ``(n, d)`` with each of the errors ``(j, d)`` added, which do not leave the box by that."""
    if errors is None:
        return [after]
    around = torch.tensor([bool(p) for p in grid.period])
    low, high = (torch.tensor(v).masked_fill(around, s * math.inf) for s, v in ((-1.0, grid.low), (1.0, grid.high)))
    return [torch.minimum(torch.maximum(after + e, low), high) for e in errors.to(after)]


@torch.no_grad()
def one_step_value(
    kernel: ViabilityKernel, state: Tensor, dynamics: Dynamics, *, margin: Callable[[Tensor], Tensor], actions: Tensor, errors: Tensor | None = None
) -> Tensor:
    """Value ``(n,)`` of states ``(n, d)`` by one step of the iteration from them; exacter than interpolating where the grid is coarse.

        V(x) = min(l(x), max_u min_e V(f(x, u) + e))

    Args:
        kernel: what the iteration came to.
        state: anywhere in the box.
        dynamics, margin, actions, errors: those of :func:`viability_kernel`.

    Source: none.

    Example:
        >>> f, l, u = lambda x, u: 1.5 * x + u, lambda x: 1 - x[:, 0].abs(), torch.linspace(-0.1, 0.1, 5)[:, None]
        >>> coarse = viability_kernel(f, low=[-1.2], high=[1.2], resolution=25, margin=l, actions=u)
        >>> bool(one_step_value(coarse, torch.tensor([[0.15]]), f, margin=l, actions=u) > 0)
        True
    """
    best = torch.full((len(state),), -math.inf)
    for action in actions.to(state):
        after = dynamics(state, action.expand(len(state), -1))
        reached = torch.stack([kernel.interpolate(a) for a in _moved(kernel.grid, after, errors)]).amin(0)
        best = torch.maximum(best, reached)
    return torch.minimum(best, margin(state))


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


def _actions_of(system: Any) -> Tensor | None:
    bound, dim = getattr(system, "max_action", None), getattr(system, "action_dim", None)
    if bound is None or dim is None:
        return None
    axis = torch.linspace(-1.0, 1.0, 21 if dim == 1 else 7)
    return torch.cartesian_prod(*[axis] * dim).reshape(-1, dim) * bound

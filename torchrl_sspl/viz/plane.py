"""The plane of two state coordinates in which sets and trajectories are drawn, and the style of all figures."""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torchrl_sspl.errors import ConfigError, DTypeError, MissingDependencyError, NonFiniteError, ShapeError
from torchrl_sspl.sets import Box, Difference, Region

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Fill colours of the sets, as in the paper: light green for S, light red for U.
SAFE_FILL, UNSAFE_FILL, OUTSIDE_FILL = "#cdeccd", "#fadcd7", "#e3e5e8"
OBSTACLE_FILL = "#b3261e"
#: Colours and markers of points: they differ in shape too, for readers who do not tell red from green.
POINTS: dict[int, tuple[str, str, str]] = {
    0: ("#6b7280", "s", "buffer"),
    2: ("#c8372d", "^", "unsafe (U)"),
    1: ("#15803d", "o", "safe (S)"),
}
BARRIER_COLOUR, KERNEL_COLOUR = "#111111", "#1d4ed8"
#: Of paths; none of them is red, which is the colour of U and of what goes wrong.
PATH_COLOURS = ("#0072b2", "#b8860b", "#6b4c9a", "#00806b", "#3aa0d8", "#7a5230", "#4d6a00", "#5c5c5c")


def require(module: str) -> Any:
    """Import an optional module; MissingDependencyError says how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingDependencyError(
            f"expected the module '{module}', which is not installed; pip install 'torchrl-sspl[viz]'."
        ) from error


def new_figure(width: float, height: float, caption: str = "") -> Figure:
    """Empty figure of a size in inches, outside pyplot's global state; its label is the caption of a report."""
    agg = require("matplotlib.backends.backend_agg")
    figure = require("matplotlib.figure").Figure(figsize=(width, height), layout="constrained", facecolor="white")
    agg.FigureCanvasAgg(figure)
    figure.set_label(caption)
    return figure


def array(name: str, value: Any, shape: tuple[int | None, ...], *, finite: bool = True) -> np.ndarray:
    """Values (tensor, array or nested list) as a float64 or bool array of a given shape (None: any size).

    ShapeError, DTypeError and NonFiniteError call them ``name``; ``finite``: refuse NaN and infinity.
    """
    try:
        tensor = torch.as_tensor(value).detach().cpu()
    except (TypeError, ValueError, RuntimeError) as error:
        raise DTypeError(f"{name}: expected a tensor of numbers, received {type(value).__name__}.") from error
    fits = tensor.ndim == len(shape) and all(w is None or n == w for n, w in zip(tensor.shape, shape, strict=True))
    if not fits:
        wanted = "(" + ", ".join("n" if w is None else str(w) for w in shape) + ")"
        raise ShapeError(f"{name}: expected shape {wanted}, received {tuple(tensor.shape)}.")
    out = tensor.numpy() if tensor.dtype == torch.bool else tensor.double().numpy()
    if finite and not np.isfinite(out).all():
        raise NonFiniteError(f"{name}: expected finite values, received {int((~np.isfinite(out)).sum())} that are not.")
    return out


@dataclass
class Plane:
    """Two coordinates of the state, with the range in which they are shown and the labelled sets.

    Args:
        names: names and units of the two coordinates.
        low, high: corners of the state space, one number per state coordinate.
        period: period per state coordinate, 0 where there is none.
        safe_set, unsafe_set: S and U, filled light green and light red; None: not drawn.
        coords: which two coordinates of the state are shown.
        fixed: values of the other coordinates at which S and U are drawn; default: the middle of their range.
        obstacle: what stands there, a set of the two coordinates shown; None: nothing.

    Raises ConfigError for other coordinates or ranges. Source: paper Section V, figure "plot_real_pend"; deviation:
    none.

    Example:
        >>> Plane(("x [m]", "y [m]"), [-2.0, -2.0, -3.14], [2.0, 2.0, 3.14]).dim
        3
    """

    names: tuple[str, str]
    low: list[float]
    high: list[float]
    period: list[float] = field(default_factory=list)
    safe_set: Region | None = None
    unsafe_set: Region | None = None
    coords: tuple[int, int] = (0, 1)
    fixed: dict[int, float] = field(default_factory=dict)
    obstacle: Region | None = None

    def __post_init__(self) -> None:
        self.low, self.high = [float(v) for v in self.low], [float(v) for v in self.high]
        self.period = [float(p) for p in self.period] or [0.0] * self.dim
        i, j = self.coords
        if not (0 <= i < self.dim and 0 <= j < self.dim and i != j):
            raise ConfigError(f"coords: expected two different coordinates below {self.dim}, received {self.coords}.")
        if not len(self.low) == len(self.high) == len(self.period):
            raise ConfigError(
                f"plane: expected low, high and period of one length, received {len(self.low)}, {len(self.high)}, "
                f"{len(self.period)}."
            )
        if any(a >= b for a, b in zip(self.low, self.high, strict=True)):
            raise ConfigError(f"plane: expected low < high, received {self.low} and {self.high}.")

    @classmethod
    def of(
        cls, env: Any, names: tuple[str, str] = ("x0", "x1"), *, coords: tuple[int, int] = (0, 1),
        fixed: dict[int, float] | None = None,
    ) -> Plane:  # fmt: skip
        """Plane of an environment's ``state_space`` (a box, or a box with holes), ``safe_set``, ``unsafe_set`` and ``obstacle``.

        The other arguments are those of the class. Raises ConfigError if the state space is no box. Source: none.
        """
        space = env.state_space
        while isinstance(space, Difference):
            space = space.a
        if not isinstance(space, Box):
            raise ConfigError(
                f"plane: expected an environment whose state_space is a Box, received {type(space).__name__}; "
                "build the Plane from low and high."
            )
        corners = space.low.tolist(), space.high.tolist(), space.period.tolist()
        obstacle = getattr(env, "obstacle", None) if coords == (0, 1) else None
        return cls(names, *corners, env.safe_set, env.unsafe_set, coords, dict(fixed or {}), obstacle)

    @property
    def dim(self) -> int:
        """Size of the state."""
        return len(self.low)

    @property
    def hidden(self) -> list[int]:
        """The coordinates of the state that are not shown."""
        return [k for k in range(self.dim) if k not in self.coords]

    def draw(self, ax: Axes, *, cover: np.ndarray | None = None, resolution: int = 480) -> None:
        """Axes with names and limits, and the sets S and U as areas; what lies outside the state space is grey.

        Points ``cover`` ``(k, 2)`` are seen even outside the state space; areas have ``resolution`` pixels per
        coordinate.
        """
        i, j = self.coords
        corners = np.array([[self.low[i], self.low[j]], [self.high[i], self.high[j]]])
        lower, upper = corners
        if cover is not None:
            lower, upper = np.minimum(lower, cover.min(0)), np.maximum(upper, cover.max(0))
        # A little room beyond a point, none where the state space itself is the limit.
        lower, upper = (
            b + 0.03 * (b - c) / np.maximum(np.abs(b - c), 1e-9) * (upper - lower) * (np.abs(b - c) > 1e-5)
            for b, c in zip((lower, upper), corners, strict=True)
        )
        extent = (float(lower[0]), float(upper[0]), float(lower[1]), float(upper[1]))
        state = self._middle().repeat(resolution * resolution, 1)
        # Centres of the pixels, so that an area ends where its set ends.
        middle = (torch.arange(resolution) + 0.5) / resolution
        y, x = torch.meshgrid(middle, middle, indexing="ij")
        state[:, i] = (extent[0] + (extent[1] - extent[0]) * x).reshape(-1)
        state[:, j] = (extent[2] + (extent[3] - extent[2]) * y).reshape(-1)
        to_rgb = require("matplotlib.colors").to_rgb
        image = np.ones((resolution * resolution, 3))
        for region, colour in ((self.unsafe_set, UNSAFE_FILL), (self.safe_set, SAFE_FILL)):
            if region is not None:
                image[region.contains(state).numpy()] = to_rgb(colour)
        if self.obstacle is not None:
            image[self.obstacle.contains(state[:, [i, j]]).numpy()] = to_rgb(OBSTACLE_FILL)
        shown = state[:, [i, j]].numpy()
        image[((shown < corners[0]) | (shown > corners[1])).any(1)] = to_rgb(OUTSIDE_FILL)
        units = [name.partition("[")[2] for name in self.names[:2]]
        # A metre is as long to the right as it is upward.
        aspect: Any = "equal" if units[0] and units[0] == units[1] else "auto"
        square = image.reshape(resolution, resolution, 3)
        ax.imshow(square, extent=extent, origin="lower", aspect=aspect, interpolation="nearest", zorder=0)
        ax.set(xlim=extent[:2], ylim=extent[2:], xlabel=self.names[0], ylabel=self.names[1])
        for axis, k in ((ax.xaxis, i), (ax.yaxis, j)):
            if math.isclose(self.period[k], 2 * math.pi, rel_tol=1e-4):
                labels = ["\u2212\u03c0", "\u2212\u03c0/2", "0", "\u03c0/2", "\u03c0"]
                marks = {h * math.pi / 2: label for h, label in zip(range(-2, 3), labels, strict=True)}
                shown_marks = {t: s for t, s in marks.items() if self.low[k] - 1e-3 <= t <= self.high[k] + 1e-3}
                axis.set_ticks(list(shown_marks), list(shown_marks.values()))

    def set_handles(self, *, beyond: bool = False) -> list[Any]:
        """Legend entries of the areas and of the obstacle, ``beyond``: of what lies outside the state space too.

        Of a set that depends on coordinates which are neither shown nor fixed it is said that these are in the middle of their range.
        """
        patch = require("matplotlib.patches").Patch
        areas = [
            (name + (" (rest mid-range)" if self._varies(region) else ""), colour, region is not None)
            for name, colour, region in (("S", SAFE_FILL, self.safe_set), ("U", UNSAFE_FILL, self.unsafe_set))
        ]
        areas += [("obstacle", OBSTACLE_FILL, self.obstacle is not None), ("beyond the space", OUTSIDE_FILL, beyond)]
        return [patch(facecolor=c, edgecolor="#9a9a9a", linewidth=0.5, label=s) for s, c, drawn in areas if drawn]

    def _varies(self, region: Region | None) -> bool:
        """Whether a set is another one at other values of the coordinates that are neither shown nor fixed."""
        free = [k for k in self.hidden if k not in self.fixed]
        if region is None or not free:
            return False
        low, high, shown = torch.tensor(self.low), torch.tensor(self.high), list(self.coords)
        anywhere = low + (high - low) * torch.rand(4000, self.dim, generator=torch.Generator().manual_seed(0))
        drawn = self._middle().repeat(4000, 1)
        drawn[:, shown] = anywhere[:, shown]
        state = drawn.clone()
        state[:, free] = anywhere[:, free]
        return bool((region.contains(state) != region.contains(drawn)).any())

    def _middle(self) -> torch.Tensor:
        """The state ``(dim,)`` at whose coordinates sets are drawn where these are not shown."""
        return torch.tensor([self.fixed.get(k, (self.low[k] + self.high[k]) / 2) for k in range(self.dim)])

    def grid(
        self, states: Any, values: dict[str, Any], reduce: str = "max"
    ) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Values on a full grid of states as matrices over the two coordinates shown.

        Args:
            states: ``(n, dim)`` all nodes of a regular grid, in any order.
            values: by name, ``(n,)`` or ``(n, 1)``; positive means outside a set for floats, True inside for bools.
            reduce: over the coordinates not shown: ``"max"`` takes the largest value and "for all" of booleans,
                ``"min"`` the smallest and "for some"; a coordinate in ``fixed`` is taken at the nearest node instead.

        Returns the two axes, ``(a,)`` and ``(b,)``, and the matrices ``(b, a)``. Raises ShapeError if the states are no
        full grid, or a value does not fit them; ConfigError for another ``reduce``. Source: none.
        """
        if reduce not in ("max", "min"):
            raise ConfigError(f"reduce: expected 'max' or 'min', received {reduce!r}.")
        axes, tables = full_grid(states, values, self.dim)
        out = {}
        for name, table in tables.items():
            for k in reversed(self.hidden):
                if k in self.fixed:
                    table = table.take(int(np.abs(axes[k] - self.fixed[k]).argmin()), axis=k)
                else:
                    # For a bool, "in the set for all" is the smallest; for a barrier it is the largest value.
                    largest = (reduce == "max") != (table.dtype == bool)
                    table = table.max(axis=k) if largest else table.min(axis=k)
            out[name] = self.turned(table)
        return axes[self.coords[0]], axes[self.coords[1]], out

    def rest(self, reduce: str = "max") -> str:
        """Words of a caption: for which values of coordinates not shown the lines of ``grid`` are; empty if none is reduced."""
        if all(k in self.fixed for k in self.hidden):
            return ""
        values = "every value" if reduce == "max" else "some values"
        return f" Lines are borders of what is in a set at {values} of the coordinates that are not shown."

    def turned(self, table: np.ndarray) -> np.ndarray:
        """A table of values over the two coordinates shown, in the order of the state, as a matrix ``(b, a)``."""
        return table.T if self.coords[0] < self.coords[1] else table

    def unwrap_breaks(self, path: np.ndarray) -> np.ndarray:
        """Path ``(t, 2)`` in the plane with a row of NaN wherever a periodic coordinate jumps."""
        period = np.array([self.period[k] for k in self.coords])
        jump = ((np.abs(np.diff(path, axis=0)) > period / 2) & (period > 0)).any(1)
        return np.insert(path, np.nonzero(jump)[0] + 1, np.nan, axis=0)


def full_grid(states: Any, values: dict[str, Any], dim: int) -> tuple[list[np.ndarray], dict[str, np.ndarray]]:
    """The axes of a regular grid of states ``(n, dim)``, and values on it, ``(n,)`` or ``(n, 1)`` by name, as tables over all of them.

    Raises ShapeError if the states are no full grid, or a value does not fit them.
    """
    x = array("states", states, (None, dim))
    axes, index = zip(*(np.unique(x[:, k], return_inverse=True) for k in range(dim)), strict=True)
    sizes = tuple(len(a) for a in axes)
    flat = np.ravel_multi_index(index, sizes)
    if math.prod(sizes) != len(x) or len(np.unique(flat)) != len(x):
        raise ShapeError(
            f"states: expected all nodes of a regular grid, received {len(x)} states with "
            f"{' x '.join(map(str, sizes))} different coordinates; use state_space.grid(n)."
        )
    tables = {}
    for name, value in values.items():
        column = torch.as_tensor(value)
        v = array(name, column[:, 0] if column.ndim == 2 else column, (len(x),))
        table = np.empty(sizes, v.dtype)
        table.reshape(-1)[flat] = v
        tables[name] = table
    return list(axes), tables


def line_handle(colour: str, label: str, style: str = "-") -> Any:
    """Legend entry of a line."""
    return require("matplotlib.lines").Line2D([], [], color=colour, linestyle=style, linewidth=1.8, label=label)


def zero_level(ax: Axes, x: np.ndarray, y: np.ndarray, value: np.ndarray, **style: Any) -> Any | None:
    """Contour line of a matrix ``(b, a)`` at zero (of a bool: its border) over ``(a,)``, ``(b,)``; None without one."""
    level = 0.5 if value.dtype == bool else 0.0
    inside = value.astype(float) > level
    if not inside.any() or inside.all():
        return None
    return ax.contour(x, y, value.astype(float), levels=[level], **style)

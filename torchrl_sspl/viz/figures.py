"""Figures of the paper's case studies: latent space, state plane, trajectories, frames."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.viz.plane import (
    BARRIER_COLOUR,
    KERNEL_COLOUR,
    PATH_COLOURS,
    POINTS,
    Plane,
    array,
    line_handle,
    new_figure,
    require,
    zero_level,
)  # fmt: skip

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_POINT_SIZE = {0: 5, 1: 9, 2: 9}


def _codes(region: Any, n: int) -> np.ndarray:
    """Region codes as ``(n,)`` integers."""
    r = torch.as_tensor(region)
    codes = array("region", r[:, 0] if r.ndim == 2 and r.shape[1] == 1 else r, (n,)).astype(int)
    if not np.isin(codes, list(POINTS)).all():
        raise ConfigError(f"region: expected codes {sorted(POINTS)}, received {sorted(set(codes.tolist()))[:8]}.")
    return codes


def _thin(codes: np.ndarray, limit: int) -> np.ndarray:
    """Rows to draw: at most ``limit`` of each region, the same ones every time."""
    order = np.random.default_rng(0)
    rows = [np.nonzero(codes == code)[0] for code in POINTS]
    return np.sort(np.concatenate([r if len(r) <= limit else order.choice(r, limit, replace=False) for r in rows]))


def _scatter(ax: Any, points: np.ndarray, codes: np.ndarray, **style: Any) -> None:
    for code, (colour, marker, label) in POINTS.items():
        p = points[codes == code]
        if len(p):
            look = {"s": _POINT_SIZE[code], "c": colour, "marker": marker, "linewidths": 0, "alpha": 0.75, **style}
            ax.scatter(*p.T, label=label, **look)


def latent_space(
    latent: Any,
    region: Any,
    barrier: Callable[[Tensor], Tensor] | None = None,
    *,
    max_points: int = 1500,
    near: float = 0.02,
) -> Figure:
    r"""Latent points of S, U and the buffer, with the zero level of the barrier.

    A latent of two dimensions is shown as it is, with the line B(z) = 0; of three, from two sides; of more, in its
    first two principal components. Where no line can be drawn, points with \|B(z)\| <= ``near`` are marked black.

    Args:
        latent: ``(n, p)``, p >= 2, in [-1, 1].
        region: ``(n,)`` or ``(n, 1)`` codes: 0 buffer, 1 safe, 2 unsafe.
        barrier: ``(n, p) -> (n, 1)``; None: no level is drawn.
        max_points: points drawn of each region at most.
        near: barrier value up to which a point counts as on the border.

    The figure's label is a caption. Raises ShapeError, ConfigError or NonFiniteError for other latents or codes.
    Source: paper Section V, figure "plot_latent_pend"; deviation: none.

    Example:
        >>> z = torch.rand(100, 2) * 2 - 1
        >>> figure = latent_space(z, (z[:, :1] > 0).long() + 1, lambda z: z[:, :1])
        >>> [axes.get_ylabel() for axes in figure.axes]
        ['z₂', 'B(z)']
    """
    z = array("latent", latent, (None, None))
    n, p = z.shape
    if p < 2 or n < 1:
        raise ShapeError(f"latent: expected shape (n, p) with n >= 1 and p >= 2, received {z.shape}.")
    codes = _codes(region, n)
    value = None if barrier is None else _evaluate(barrier, z)
    rows = _thin(codes, max_points)
    border = np.zeros(0, int)
    if value is not None:
        border = np.nonzero(np.abs(value) <= near)[0]
        border = border[:: max(1, math.ceil(len(border) / max_points))]
    caption = "Latent points (numbers without a unit) of S, U and the unlabelled buffer"
    style = dict(s=11, c=BARRIER_COLOUR, marker="o", linewidths=0, zorder=5, label=f"|B| \u2264 {near:g}")
    if p == 3:
        figure = new_figure(9.2, 4.6, f"{caption}, seen from two sides; black: the border of the learned safe set.")
        _latent_3d(figure, z, codes, rows, border, style)
    elif p == 2:
        figure = new_figure(6, 5, f"{caption}; black line: B = 0.")
        _latent_2d(figure, z, codes, rows, barrier)
    else:
        figure = new_figure(6, 5, f"{caption} in the first two principal components; black: near the barrier's zero.")
        _latent_components(figure, z, codes, rows, border, style)
    handles = figure.axes[0].get_legend_handles_labels()[0]
    if p == 2 and barrier is not None:
        handles.append(line_handle(BARRIER_COLOUR, "B = 0"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, markerscale=1.8)
    return figure


def _latent_3d(
    figure: Figure, z: np.ndarray, codes: np.ndarray, rows: np.ndarray, border: np.ndarray, style: dict[str, Any]
) -> None:
    require("mpl_toolkits.mplot3d")
    for k, azimuth in enumerate((-60, 30)):
        ax = figure.add_subplot(1, 2, k + 1, projection="3d")
        ax.computed_zorder = False  # type: ignore[attr-defined]
        _scatter(ax, z[rows], codes[rows], depthshade=False)
        if len(border):
            ax.scatter(*z[border].T, depthshade=False, **style)  # type: ignore[misc]
        ax.set(xlabel="z\u2081", ylabel="z\u2082", zlabel="z\u2083")  # type: ignore[call-arg]
        ax.view_init(elev=22, azim=azimuth)  # type: ignore[attr-defined]
        ax.tick_params(labelsize=7, pad=-2)
        for axis in (ax.xaxis, ax.yaxis, ax.zaxis):  # type: ignore[attr-defined]
            axis.set_ticks([-1, 0, 1])
            axis.labelpad = -6
        ax.set_box_aspect(None, zoom=0.92)  # type: ignore[call-arg, arg-type]


def _latent_2d(
    figure: Figure, z: np.ndarray, codes: np.ndarray, rows: np.ndarray, barrier: Callable[[Tensor], Tensor] | None
) -> None:
    ax = figure.add_subplot()
    if barrier is not None:
        axis = np.linspace(-1, 1, 201)
        nodes = np.stack(np.meshgrid(axis, axis), -1)
        level = _evaluate(barrier, nodes.reshape(-1, 2)).reshape(201, 201)
        top = np.abs(level).max() or 1.0
        shade = ax.contourf(axis, axis, level, levels=np.linspace(-top, top, 13), cmap="PuOr_r", alpha=0.35, zorder=0)
        figure.colorbar(shade, ax=ax, label="B(z)")
        zero_level(ax, axis, axis, level, colors=BARRIER_COLOUR, linewidths=1.8)
    _scatter(ax, z[rows], codes[rows], zorder=2)
    ax.set(xlim=(-1.02, 1.02), ylim=(-1.02, 1.02), xlabel="z\u2081", ylabel="z\u2082", aspect="equal")


def _latent_components(
    figure: Figure, z: np.ndarray, codes: np.ndarray, rows: np.ndarray, border: np.ndarray, style: dict[str, Any]
) -> None:
    centred = z - z.mean(0)
    _, size, direction = np.linalg.svd(centred, full_matrices=False)
    share = size**2 / max(float((size**2).sum()), 1e-30)
    flat = centred @ direction[:2].T
    ax = figure.add_subplot()
    _scatter(ax, flat[rows], codes[rows])
    if len(border):
        ax.scatter(*flat[border].T, **style)
    ax.set(xlabel=f"component 1 ({share[0]:.0%} of variance)", ylabel=f"component 2 ({share[1]:.0%})")


def _evaluate(barrier: Callable[[Tensor], Tensor], latent: np.ndarray) -> np.ndarray:
    points = torch.as_tensor(latent, dtype=torch.float32)
    weight = next(barrier.parameters(), points) if isinstance(barrier, nn.Module) else points
    with torch.no_grad():
        value = barrier(points.to(weight.device)).cpu()
    if value.shape != (len(latent), 1):
        raise ShapeError(f"barrier: expected values of shape ({len(latent)}, 1), received {tuple(value.shape)}.")
    return value[:, 0].double().numpy()


def state_plane(
    plane: Plane,
    states: Any,
    barrier: Any,
    *,
    viable: Any | None = None,
    points: Any | None = None,
    region: Any | None = None,
    max_points: int = 400,
    reduce: str = "max",
) -> Figure:
    """Plane of two state coordinates: S and U as areas, the line B = 0, the true kernel's border, sampled points.

    Args:
        plane: the coordinates shown, their range, S and U.
        states: ``(n, dim)`` all nodes of a regular grid.
        barrier: ``(n,)`` or ``(n, 1)`` barrier value of the observation of each state.
        viable: ``(n,)`` whether each state is in the true viability kernel (bool), or its value (float, positive
            inside: a smoother line).
        points: ``(m, dim)`` sampled states to mark.
        region: ``(m,)`` or ``(m, 1)`` their codes: 0 buffer, 1 safe, 2 unsafe.
        max_points: points drawn of each region at most.
        reduce: over coordinates not shown, see ``Plane.grid``.

    The figure's label is a caption. Raises ShapeError, NonFiniteError or ConfigError for arguments that do not fit.
    Source: paper Section V, figures "sys_pend" and "plot_real_pend"; deviation: the true kernel is added.

    Example:
        >>> states = torch.cartesian_prod(torch.linspace(-1, 1, 21), torch.linspace(-1, 1, 21))
        >>> plane = Plane(("x", "y"), [-1, -1], [1, 1])
        >>> state_plane(plane, states, states.norm(dim=-1) - 0.5).axes[0].get_xlabel()
        'x'
    """
    values = {"barrier": barrier}
    if viable is not None:
        v = torch.as_tensor(viable)
        values["viable"] = v if v.dtype == torch.bool else -v  # negative inside, like a barrier
    x, y, table = plane.grid(states, values, reduce)
    caption = (
        "Learned safe set {B \u2264 0} (inside the black line) in the state plane, with the labelled sets S (green) "
        "and U (red)" + (", and the border of the true viability kernel (blue)." if viable is not None else ".")
    ) + plane.rest(reduce)
    figure = new_figure(6.6, 5.2, caption)
    ax = figure.add_subplot()
    plane.draw(ax)
    handles = plane.set_handles()
    inside = table["barrier"] <= 0
    if inside.any():
        ax.contourf(x, y, table["barrier"], levels=[-np.inf, 0], colors=["#22304a"], alpha=0.13, zorder=1)
    dashed = {"colors": KERNEL_COLOUR, "linewidths": 1.6, "linestyles": "--", "zorder": 3}
    if "viable" in table and zero_level(ax, x, y, table["viable"], **dashed):
        handles.append(line_handle(KERNEL_COLOUR, "true viability kernel", "--"))
    if zero_level(ax, x, y, table["barrier"], colors=BARRIER_COLOUR, linewidths=2.0, zorder=4):
        handles.append(line_handle(BARRIER_COLOUR, "B = 0"))
    else:
        ax.set_title("B \u2264 0 nowhere" if not inside.any() else "B \u2264 0 everywhere", fontsize=10)
    if points is not None:
        p = array("points", points, (None, plane.dim))
        codes = np.zeros(len(p), int) if region is None else _codes(region, len(p))
        rows = _thin(codes, max_points)
        _scatter(ax, p[rows][:, list(plane.coords)], codes[rows], zorder=2)
        handles += ax.get_legend_handles_labels()[0]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, markerscale=1.8)
    return figure


def trajectories(
    plane: Plane,
    states: Any,
    actions: Any,
    barrier: Any | None = None,
    *,
    background: tuple[Any, Any] | None = None,
    action_name: str = "action",
    action_direction: tuple[float, float] | None = None,
    action_scale: float | None = None,
    dt: float | None = None,
    episodes: int = 6,
    arrows: int = 14,
    lengths: Any | None = None,
    caption: str = "",
) -> Figure:
    """Closed-loop trajectories with their actions as arrows, and barrier and action over time.

    Args:
        plane: the coordinates shown, their range, S and U.
        states: ``(T + 1, n, dim)`` visited states.
        actions: ``(T, n, m)`` actions, in physical units; the first component is drawn.
        barrier: ``(T + 1, n)`` barrier values on the way; None: no panel of its own.
        background: grid states ``(k, dim)`` and their barrier values ``(k,)``, of which the zero level is drawn.
        action_name: name and unit of the action.
        action_direction: direction in the plane of a positive action (the pendulum's torque pushes the angular
            velocity: ``(0, 1)``); None: along the path.
        action_scale: action of an arrow of full length; default: the largest of those episodes.
        dt: time step in s; None: the time axis counts steps.
        episodes: trajectories drawn at most, with starts far apart.
        arrows: arrows per trajectory, at most.
        lengths: ``(n,)`` steps after which each episode was over; None: all steps are drawn.
        caption: what the figure shows.

    The figure's label is a caption. Raises ShapeError or NonFiniteError for arguments that do not fit. Source: paper
    Section V, figures "sspl_pend" and "traj_sspl_gr"; deviation: time series are added.

    Example:
        >>> plane = Plane(("x", "y"), [-1, -1], [1, 1])
        >>> figure = trajectories(plane, torch.zeros(5, 2, 2), torch.ones(4, 2, 1), torch.zeros(5, 2))
        >>> len(figure.axes)
        3
    """
    x = array("states", states, (None, None, plane.dim))
    steps, n = x.shape[0] - 1, x.shape[1]
    if steps < 1 or n < 1:
        raise ShapeError(f"states: expected shape (T + 1, n, {plane.dim}) with T, n >= 1, received {x.shape}.")
    u = array("actions", actions, (steps, n, None))[..., 0]
    values = None if barrier is None else array("barrier", barrier, (steps + 1, n))
    last = np.full(n, steps) if lengths is None else array("lengths", lengths, (n,)).astype(int).clip(1, steps)
    extent = np.array([plane.high[k] - plane.low[k] for k in plane.coords])
    chosen = _spread(x[0][:, list(plane.coords)] / extent, min(episodes, n))
    largest = action_scale or max(1e-12, *(float(np.abs(u[: last[k], k]).max()) for k in chosen))
    caption = (caption or f"{len(chosen)} trajectories of the learned policy").rstrip(".")
    drawn = "" if background is None else plane.rest()
    figure = new_figure(10.5, 5.0, f"{caption}; an arrow of full length is {largest:.3g} ({action_name}).{drawn}")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1))
    ax = figure.add_subplot(grid[:, 0])
    handles = _draw_sets(ax, plane, x[:, chosen][..., list(plane.coords)].reshape(-1, 2), background)
    colours = list(zip(np.resize(PATH_COLOURS, len(chosen)), chosen, strict=True))
    for colour, k in colours:
        path = x[: last[k] + 1, k][:, list(plane.coords)]
        _draw_path(ax, plane, path, u[: last[k], k] / largest, extent, colour, action_direction, arrows)
    marker = functools.partial(require("matplotlib.lines").Line2D, [], [], color="#555555")
    handles.append(marker(marker="o", linewidth=1.2, label="start and path"))
    arrow = "$\\uparrow$" if action_direction is not None else "$\\rightarrow$"
    handles.append(marker(marker=arrow, linestyle="", markersize=9, label=f"{action_name}, size"))
    figure.legend(handles=handles, loc="outside lower center", ncols=6, frameon=False)
    _draw_over_time(figure, grid, values, u, last, colours, dt, action_name)
    return figure


def _draw_sets(ax: Axes, plane: Plane, cover: np.ndarray, background: tuple[Any, Any] | None) -> list[Any]:
    """The plane with its sets, what lies beyond it and the line B = 0, as far as points reach; legend entries."""
    plane.draw(ax, cover=cover)
    limits = [(plane.low[k] - 1e-4, plane.high[k] + 1e-4) for k in plane.coords]
    beyond = any(cover[:, k].min() < low or cover[:, k].max() > high for k, (low, high) in enumerate(limits))
    handles = plane.set_handles(beyond=beyond)
    if background is not None:
        gx, gy, table = plane.grid(background[0], {"barrier": background[1]})
        if zero_level(ax, gx, gy, table["barrier"], colors=BARRIER_COLOUR, linewidths=1.8, zorder=2):
            handles.append(line_handle(BARRIER_COLOUR, "B = 0"))
    return handles


def _draw_path(
    ax: Axes, plane: Plane, path: np.ndarray, action: np.ndarray, extent: np.ndarray, colour: str,
    direction: tuple[float, float] | None, arrows: int,
) -> None:  # fmt: skip
    """One path with its start, and its actions (as shares of the largest) as arrows."""
    ax.plot(*plane.unwrap_breaks(path).T, color=colour, linewidth=1.2, zorder=3)
    ax.plot(*path[0], "o", color=colour, markersize=5, markeredgecolor="white", zorder=5)
    at = _spaced(path / extent, arrows)
    size = action if direction is not None else np.abs(action)
    length = 0.13 * extent * _directions(path / extent, direction) * size[:, None]
    ax.quiver(
        *path[at].T, *length[at].T, angles="xy", scale_units="xy", scale=1, width=0.005, headwidth=4, headlength=4.5,
        headaxislength=4, minlength=0.3, color=colour, zorder=4, alpha=0.9,
    )  # fmt: skip


def _draw_over_time(
    figure: Figure, grid: Any, values: np.ndarray | None, u: np.ndarray, last: np.ndarray,
    colours: list[tuple[str, int]], dt: float | None, action_name: str,
) -> None:  # fmt: skip
    """Barrier value, if there is one, and action of the chosen episodes over time."""
    time = np.arange(len(u) + 1) * (dt or 1.0)
    end = time[max(last[k] for _, k in colours)]
    if values is not None:
        upper = figure.add_subplot(grid[0, 1])
        for colour, k in colours:
            upper.plot(time[: last[k] + 1], values[: last[k] + 1, k], color=colour, linewidth=1.2)
        upper.axhline(0, color=BARRIER_COLOUR, linewidth=1.0, linestyle=":")
        upper.set(ylabel="barrier B [latent units]", xlim=(0, end))
        upper.tick_params(labelbottom=False)
    lower = figure.add_subplot(grid[1 if values is not None else slice(None), 1])
    for colour, k in colours:
        lower.step(time[: last[k]], u[: last[k], k], where="post", color=colour, linewidth=0.8, alpha=0.85)
    lower.axhline(0, color="#999999", linewidth=0.8)
    lower.set(ylabel=action_name, xlabel="time [s]" if dt else "time [steps]", xlim=(0, end))


def _spread(points: np.ndarray, count: int) -> np.ndarray:
    """Rows of ``count`` points that lie far apart, the first one first."""
    chosen = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.unique(chosen)


def _spaced(path: np.ndarray, limit: int) -> np.ndarray:
    """Steps at which an arrow is drawn: one per stretch of path, more often where the state moves fast."""
    moved = np.linalg.norm(np.diff(path, axis=0), axis=1)
    moved[moved > 0.5] = 0.0  # the step over the edge of a periodic coordinate
    stretch = np.floor(np.concatenate([[0.0], moved[:-1].cumsum()]) / max(0.05, moved.sum() / limit))
    return np.unique(stretch, return_index=True)[1]


def _directions(path: np.ndarray, fixed: tuple[float, float] | None) -> np.ndarray:
    """Unit vectors ``(T, 2)`` of the arrows, in shares of the plane."""
    if fixed is not None:
        d = np.tile(np.asarray(fixed, float), (len(path) - 1, 1))
    else:
        d = np.diff(path, axis=0)
        d[np.abs(d).max(1) > 0.5] = 0.0  # the step over the edge of a periodic coordinate
    return d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-12)


def frames(env: Any, states: Any, *, captions: Sequence[str] | None = None, both: bool = True) -> Figure:
    """Strip of the frames that the agent sees.

    Args:
        env: has ``observe(states) -> uint8 (n, 6, H, W)``.
        states: ``(n, state_dim)``, n <= 12.
        captions: one per state; default: its coordinates.
        both: show the frame of the step before as well, in a row of its own.

    The figure's label is a caption. Raises ShapeError for no state, too many, or another number of captions. Source:
    paper Section V, figures "sys_pend" and "sspl_gr"; deviation: none.

    Example:
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> len(frames(PendulumEnv(), torch.tensor([[0.0, 0.0], [1.0, 0.0]])).axes)
        4
    """
    x = array("states", states, (None, None))
    n = len(x)
    if not 1 <= n <= 12:
        raise ShapeError(f"states: expected 1 to 12 states, received {n}.")
    names = list(captions) if captions is not None else [", ".join(f"{v:+.2f}" for v in row) for row in x]
    if len(names) != n:
        raise ShapeError(f"captions: expected {n}, one per state, received {len(names)}.")
    pixels = env.observe(torch.as_tensor(states, dtype=torch.float32)).cpu()
    rows = 2 if both else 1
    lines = max(name.count("\n") for name in names) + 1
    figure = new_figure(1.6 * n + 0.4, 1.6 * rows + 0.2 + 0.15 * lines, "All that the agent sees of these states.")
    axes = figure.subplots(rows, n, squeeze=False)
    shown = [("step before", slice(0, 3)), ("now", slice(3, 6))][-rows:]
    for row, (time, channels) in zip(axes, shown, strict=True):
        for ax, picture in zip(row, pixels, strict=True):
            ax.imshow(picture[channels].permute(1, 2, 0).numpy(), interpolation="nearest")
            ax.set(xticks=[], yticks=[])
        row[0].set_ylabel(time, fontsize=9)
    for ax, name in zip(axes[0], names, strict=True):
        ax.set_title(name, fontsize=7.5)
    return figure

"""Systems of three coordinates: their plane for values of the third, and their paths in full physics."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.viz.plane import (
    BARRIER_COLOUR,
    KERNEL_COLOUR,
    PATH_COLOURS,
    Plane,
    array,
    line_handle,
    new_figure,
    zero_level,
)  # fmt: skip

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WRONG = "#c8372d"


def slices(
    plane: Plane,
    states: Any,
    barrier: Any,
    viability: Any | None = None,
    *,
    name: str = "heading [rad]",
    values: Sequence[float] | None = None,
    arrows: bool = True,
) -> Figure:
    """The plane for several values of a third, periodic coordinate: S, U, the line B = 0, the true kernel's border.

    Args:
        plane: the first two coordinates, with S and U.
        states: ``(n, 3)`` all nodes of a regular grid; the third coordinate in rad.
        barrier: ``(n,)`` barrier value of what is seen of each state.
        viability: ``(n,)`` value of the true kernel, positive inside; None: not drawn.
        name: name and unit of the third coordinate.
        values: of the third coordinate, in rad; the nearest of the grid is shown. Default: eight of them.
        arrows: the third coordinate is a direction in the plane: show it.

    Raises ShapeError or NonFiniteError if the states are no full grid, or a value does not fit them. Source: paper
    Section V, figure "traj_sspl_gr"; deviation: the level of B and the true kernel are added.

    Example:
        >>> plane = Plane(("x", "y"), [-2, -2, -3], [2, 2, 3])
        >>> states = torch.cartesian_prod(torch.arange(-2.0, 3), torch.arange(-2.0, 3), torch.arange(-3.0, 3))
        >>> len(slices(plane, states, 1.0 - states[:, :2].norm(dim=-1), values=[0.0, 1.0]).axes)
        2
    """
    values = [k * math.pi / 4 for k in range(8)] if values is None else values
    angles = [math.remainder(v, 2 * math.pi) for v in values]
    word = name.partition(" [")[0]
    columns = min(4, len(angles))
    rows = math.ceil(len(angles) / columns)
    caption = (
        f"What is called safe at a given {word}{' (arrow)' if arrows else ''}: the side of the black line, on which "
        "B = 0, where S lies. Green: S, red: U, white: the buffer without labels."
    )
    tables = {"barrier": barrier}
    if viability is not None:
        caption += " Blue, dashed: border of the true viability kernel."
        # Where leaving is safe the value is infinite; a contour needs numbers.
        tables["viability"] = -torch.as_tensor(viability).clamp(-10.0, 10.0)
    figure = new_figure(3.1 * columns, 3.2 * rows + 0.4, caption)
    for k, angle in enumerate(angles):
        ax = figure.add_subplot(rows, columns, k + 1)
        cut = dataclasses.replace(plane, coords=(0, 1), fixed={2: angle})
        cut.draw(ax, resolution=200)
        x, y, table = cut.grid(states, tables)
        zero_level(ax, x, y, table["barrier"], colors=BARRIER_COLOUR, linewidths=1.6)
        if viability is not None:
            zero_level(ax, x, y, table["viability"], colors=KERNEL_COLOUR, linewidths=1.3, linestyles="--")
        if arrows:
            _draw_direction(ax, plane, angle)
        ax.set(title=f"{word} {math.degrees(angle):.0f}\u00b0", aspect="equal" if arrows else "auto")
        ax.label_outer()
    handles = [*plane.set_handles(), line_handle(BARRIER_COLOUR, "B = 0")]
    if viability is not None:
        handles.append(line_handle(KERNEL_COLOUR, "true kernel", "--"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure


def _draw_direction(ax: Any, plane: Plane, angle: float) -> None:
    """An arrow in the middle of the plane."""
    span = plane.high[0] - plane.low[0]
    x, y = ((plane.low[k] + plane.high[k]) / 2 for k in (0, 1))
    dx, dy = 0.075 * span * math.cos(angle), 0.075 * span * math.sin(angle)
    style = {"width": 0.015 * span, "head_width": 0.055 * span, "color": "#444444", "length_includes_head": True}
    ax.arrow(x - dx, y - dy, 2 * dx, 2 * dy, **style)


def walks(plane: Plane, states: Any, alive: Any, wrong: Any, *, limit: int = 60, caption: str = "") -> Figure:
    """Paths of episodes in full physics, in the plane; those that went wrong are red.

    Args:
        plane: the coordinates shown.
        states: ``(T + 1, n, dim)`` true states.
        alive, wrong: ``(T + 1, n)`` whether a state belongs to its episode, ``(n,)`` whether an episode went wrong.
        limit: paths drawn at most; those that went wrong first.
        caption: what is shown; how many are is said before it.

    Raises ConfigError without any episode; ShapeError or NonFiniteError for arguments that do not fit. Source: paper
    Section V, figure "traj_sspl_gr"; deviation: the paths of all episodes, not of a few.

    Example:
        >>> plane = Plane(("x", "y"), [-2, -2, -3], [2, 2, 3])
        >>> walks(plane, torch.zeros(3, 1, 3), torch.ones(3, 1).bool(), [False]).axes[0].get_xlabel()
        'x'
    """
    held = array("alive", alive, (None, None)).astype(bool)
    steps, n = held.shape
    if not n:
        raise ConfigError("walks: expected at least one, received none; set the number of episodes above 0.")
    x = array("states", states, (steps, n, plane.dim), finite=False)[..., list(plane.coords)]
    bad = array("wrong", wrong, (n,)).astype(bool)
    worse, good = bad.nonzero()[0].tolist(), (~bad).nonzero()[0].tolist()
    # Evenly over all of them: where they come from groups, all groups are seen.
    spread = min(max(0, limit - len(worse)), len(good))
    drawn = worse[:limit] + [good[k * len(good) // spread] for k in range(spread)]
    paths = {k: array("states", x[held[:, k], k], (None, 2)) for k in drawn}
    told = f"{n}" if len(drawn) == n else f"{len(drawn)} of {n}" + (", those that went wrong first" if bad.any() else "")
    figure = new_figure(5.6, 5.6, f"{told}: {caption or 'walks in full physics; dots: where they start.'}")
    ax = figure.add_subplot()
    plane.draw(ax, cover=np.concatenate(list(paths.values())))
    for count, (k, path) in enumerate(paths.items()):
        colour = _WRONG if bad[k] else PATH_COLOURS[count % len(PATH_COLOURS)]
        ax.plot(*plane.unwrap_breaks(path).T, color=colour, linewidth=1.0)
        ax.plot(*path[0], "o", color=colour, markersize=4, markeredgecolor="white")
    ax.set_aspect("equal")
    handles = [*plane.set_handles(beyond=True), line_handle(_WRONG, f"went wrong ({len(worse)})")]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure

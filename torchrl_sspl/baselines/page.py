"""One page of the comparison: its tables, and for each system the claimed sets of all methods over the true kernel."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_sspl.baselines.cell import CLAIMS_FILE, ROW_FILE, Cell
from torchrl_sspl.baselines.table import Row, budget_of, markdown, name_of, table, tables
from torchrl_sspl.errors import MissingDependencyError
from torchrl_sspl.files import write
from torchrl_sspl.viz.pages import Table, render
from torchrl_sspl.viz.plane import new_figure
from torchrl_sspl.viz.report import figure_picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DIRECTORY = Path("runs/baselines")
_COLUMNS = 5
#: Outside the kernel, in it and not claimed, claimed in it, claimed outside of it.
_COLOURS = ("#ffffff", "#cfd6e4", "#4c9f70", "#c0392b")


def main(words: Sequence[str]) -> int:
    """Measure what is missing of a table, print it, and write it, the page and all rows that there are; 0. Source: none."""
    rows = table(words)
    text = markdown(rows)
    print(text)
    write(DIRECTORY / "table.md", text)
    every = [json.loads(path.read_text()) for path in sorted(DIRECTORY.rglob(ROW_FILE))]
    write(DIRECTORY / "rows.json", json.dumps(every, indent=1) + "\n")
    try:
        page(rows, DIRECTORY / "table.html")
    except MissingDependencyError as error:
        print(f"no page: {error}", file=sys.stderr)
    return 0


def page(rows: Sequence[tuple[Cell, Row]], path: str | Path) -> Path:
    """Writes a self-contained page with the tables of :mod:`~torchrl_sspl.baselines.table`, and a figure for each system.

    Returns the file. Raises MissingDependencyError without matplotlib. Source: none.
    """
    found = []
    for env, of_env in tables(rows).items():
        drawn = claims([cell for cell, _ in rows if cell.env == env])
        figure = None if drawn is None else figure_picture(f"Claimed sets, {env}", drawn)
        found.append((env, figure, [(title, Table(head, lines)) for title, (head, *lines) in of_env]))
    facts = "A share is the mean of the seeds, with the worst in parentheses. Docs: the page Comparison says what the columns mean."
    return write(path, render("methods.html", title="The comparison", facts=facts, systems=found))


def claims(cells: Sequence[Cell]) -> Figure | None:
    """What the methods of some cells claim of one system, side by side, of each the first seed that was measured; None without any.

    Of a system of three coordinates the figure shows the third at its middle. Source: none.
    """
    first: dict[str, Path] = {}
    for cell in cells:
        if (cell.directory / CLAIMS_FILE).is_file():
            first.setdefault(f"{name_of(cell)}\n{budget_of(cell)}, seed {cell.seed}", cell.directory / CLAIMS_FILE)
    if not first:
        return None
    rows = -(-len(first) // _COLUMNS)
    caption = (
        "Green: claimed, and in the true kernel; red: claimed outside of it; grey: the rest of the kernel. A third coordinate is at its "
        "middle; methods without a claimed set are left out."
    )
    figure = new_figure(2.2 * _COLUMNS, 2.3 * rows, caption)
    axes = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    for ax in axes[len(first) :]:
        ax.set_axis_off()
    for ax, (title, path) in zip(axes, first.items(), strict=False):
        kinds, extent = _slice(path)
        ax.imshow(kinds, extent=extent, origin="lower", aspect="auto", interpolation="nearest")
        ax.set_title(title, fontsize=7)
        ax.tick_params(labelsize=6)
    return figure


def _slice(path: Path) -> tuple[Any, tuple[float, ...]]:
    """Colours ``(y, x, 3)`` of a slice of the grid, and its borders."""
    with np.load(path) as body:
        states, claimed, viable = body["states"], body["claimed"], body["viable"]
    if states.shape[1] > 2:
        near = np.abs(states[:, 2]).min()
        chosen = np.abs(states[:, 2]) == near
        chosen &= states[:, 2] == states[chosen][0, 2]  # of two that are as near the first
        states, claimed, viable = states[chosen], claimed[chosen], viable[chosen]
    shape = [len(np.unique(states[:, k])) for k in (0, 1)]
    kinds = np.where(claimed, np.where(viable, 2, 3), np.where(viable, 1, 0)).reshape(shape).T
    palette = np.array([[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in _COLOURS], np.uint8)
    low, high = states.min(0), states.max(0)
    return palette[kinds], (float(low[0]), float(high[0]), float(low[1]), float(high[1]))


__all__ = ["claims", "main", "page"]

"""One page of the comparison: its tables, and for each system the claimed sets of all methods over the true kernel, and how they fail."""

from __future__ import annotations

import json
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torchrl_sspl.baselines.cell import CLAIMS_FILE, ROW_FILE, Cell, of_this_version
from torchrl_sspl.baselines.scoring import NOMINALS
from torchrl_sspl.baselines.table import Row, budget_of, markdown, name_of, table, tables, values
from torchrl_sspl.errors import MissingDependencyError, OutputError
from torchrl_sspl.files import write
from torchrl_sspl.viz.animation import Scene, Take, animate
from torchrl_sspl.viz.pages import Table, render
from torchrl_sspl.viz.plane import Plane, new_figure
from torchrl_sspl.viz.report import figure_picture, film_picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLUMNS, _LETTERS = 5, 30  # of the figure, and of a line above one of its pictures
_AFTER = 0.5  # s, for which what went wrong is still looked at
#: Outside the kernel, in it and not claimed, claimed in it, claimed outside of it.
_COLOURS = ("#ffffff", "#cfd6e4", "#4c9f70", "#c0392b")


def main(words: Sequence[str]) -> int:
    """Measure what is missing of a table, print it, and write it, the page and all rows that there are into ``out_dir``; 0. Source: none."""
    rows = table(words)
    text, directory = markdown(rows), Path(rows[0][0].root)
    print(text)
    write(directory / "table.md", text)
    every = []
    for path in sorted(directory.rglob(ROW_FILE)):
        try:
            every.append(of_this_version(json.loads(path.read_text()), path))
        except ValueError as error:
            print(f"left out: '{path}' cannot be read ({error}); remove it", file=sys.stderr)
        except OutputError as error:
            print(f"left out: {error}", file=sys.stderr)
    write(directory / "rows.json", json.dumps(every, indent=1) + "\n")
    write(directory / "rows.csv", values(every))
    try:
        page(rows, directory / "table.html")
    except MissingDependencyError as error:
        print(f"no page: {error}", file=sys.stderr)
    return 0


def page(rows: Sequence[tuple[Cell, Row]], path: str | Path) -> Path:
    """Writes a self-contained page with the tables of :mod:`~torchrl_sspl.baselines.table`, a figure and a film for each system.

    The films lie beside it. Returns the page. Raises MissingDependencyError without matplotlib. Source: none.
    """
    found, path = [], Path(path)
    for env, of_env in tables(rows).items():
        cells = [cell for cell, row in rows if cell.env == env and isinstance(row, dict)]  # what lies beside another row is another one's
        drawn, film = claims(cells), failures(cells, path.with_name(f"failures-{Path(env).stem}.mp4"))
        figures = [] if drawn is None else [figure_picture(f"Claimed sets, {env}", drawn)]
        if film is not None:
            figures.append(film_picture(film, "One failure of every method that has any: from its claimed set into U. Solid: what it claims; dashed: the true kernel."))
        found.append((env, figures, [(title, Table(head, lines)) for title, (head, *lines) in of_env]))
    facts = "A share is the mean of the seeds, with the worst in parentheses. Docs: the page Comparison says what the columns mean."
    return write(path, render("methods.html", title="The comparison", facts=facts, systems=found))


def claims(cells: Sequence[Cell]) -> Figure | None:
    """What the methods of some cells claim of one system, side by side, of each the first seed that was measured; None without any.

    Of a system of more than two coordinates the figure shows the others at their middle. Source: none.
    """
    first = _first(cells)
    if not first:
        return None
    rows = -(-len(first) // _COLUMNS)
    caption = (
        "Green: claimed, and in the true kernel; red: claimed outside of it; grey: the rest of the kernel. Coordinates after the second are at their "
        "middle; methods without a claimed set are left out."
    )
    figure = new_figure(2.2 * _COLUMNS, 2.3 * rows, caption)
    axes = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    for ax in axes[len(first) :]:
        ax.set_axis_off()
    for ax, (title, path) in zip(axes, first.items(), strict=False):
        kinds, extent = _slice(path)
        ax.imshow(kinds, extent=extent, origin="lower", aspect="auto", interpolation="nearest")
        ax.set_title("\n".join(textwrap.fill(line, _LETTERS) for line in title.splitlines()), fontsize=7)
        ax.tick_params(labelsize=6)
    return figure


def failures(cells: Sequence[Cell], path: Path) -> Path | None:
    """Film of one failure of every method that has any on one system: from where it claims safety into U; None without any.

    Shown is an episode from a start that could be kept safe, if there is one, up to half a second in U. Source: none.
    """
    failed = _first([cell for cell in cells if _failed_under(cell.directory / CLAIMS_FILE)])
    if not failed:
        return None
    env = cells[0].environment()
    scenes = (_failure(env, title.replace("\n", ", "), kept) for title, kept in failed.items())
    return animate(scenes, path, plane=Plane.of(env, env.system.state_names[:2]), fps=round(1 / env.dt))  # type: ignore[arg-type, attr-defined]


def _failed_under(path: Path) -> str:
    """The first nominal policy under which a method failed, "" for none."""
    if not path.is_file():
        return ""
    with np.load(path) as body:
        return next((n for n in NOMINALS if f"failed_{n}" in body), "")


def _failure(env: Any, title: str, path: Path) -> Scene:
    nominal = _failed_under(path)
    with np.load(path) as body:
        states, grid, viable = (torch.from_numpy(body[name]) for name in (f"failed_{nominal}", "states", "viable"))
        levels = grid.numpy(), {"B": body["claimed"], "kernel": body["viable"]}
    unsafe = env.unsafe_set.contains(states)
    end = int(unsafe.int().argmax()) + round(_AFTER / env.dt)
    states, unsafe = states[: end + 1], unsafe[: end + 1]
    kept = viable[(states[:, None] - grid).abs().div(grid.amax(0) - grid.amin(0)).amax(2).argmin(1)]
    said = [("in the unsafe set U", "bad") if u else ("could be kept safe", "good") if k else ("cannot be kept safe", "fair") for u, k in zip(unsafe, kept, strict=True)]
    pictures = (env.portrait(x[None])[0].permute(1, 2, 0).numpy() for x in states)
    return Scene(f"{title}: {nominal} nominal policy", [Take("what happens", pictures, said, states)], levels)


def _first(cells: Sequence[Cell]) -> dict[str, Path]:
    """Where the claims of the first measured seed of every method and budget lie, by their titles."""
    first: dict[tuple[str, str], Cell] = {}
    for cell in cells:
        if (cell.directory / CLAIMS_FILE).is_file():
            first.setdefault((name_of(cell), budget_of(cell)), cell)
    return {f"{name}\n{budget}, seed {cell.seed}": cell.directory / CLAIMS_FILE for (name, budget), cell in first.items()}


def _slice(path: Path) -> tuple[Any, tuple[float, ...]]:
    """Colours ``(y, x, 3)`` of a slice of the grid, and its borders."""
    with np.load(path) as body:
        states, claimed, viable = body["states"], body["claimed"], body["viable"]
    for k in range(2, states.shape[1]):
        nodes = np.unique(states[:, k])
        chosen = states[:, k] == nodes[np.abs(nodes).argmin()]  # of two that are as near the first
        states, claimed, viable = states[chosen], claimed[chosen], viable[chosen]
    shape = [len(np.unique(states[:, k])) for k in (0, 1)]
    kinds = np.where(claimed, np.where(viable, 2, 3), np.where(viable, 1, 0)).reshape(shape).T
    palette = np.array([[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in _COLOURS], np.uint8)
    low, high = states.min(0), states.max(0)
    return palette[kinds], (float(low[0]), float(high[0]), float(low[1]), float(high[1]))


__all__ = ["claims", "failures", "main", "page"]

"""Curves of a training, read from its log."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_sspl.errors import CheckpointError
from torchrl_sspl.viz.plane import PATH_COLOURS, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = 8  # of curves, in the style sheet


def read_log(path: str | Path) -> list[dict[str, Any]]:
    """Rows of a training's ``log.jsonl``, each with "phase", "round" and "step"; a last line cut short is left out.

    Raises CheckpointError if the file is missing, empty, or not a log. Source: none.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"expected the log of a training at '{path}', found no file; give a run's log.jsonl.")
    lines = path.read_text().splitlines()
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
            rows.append({**row, "phase": str(row["phase"]), "round": int(row["round"]), "step": int(row["step"])})
        except (ValueError, KeyError, TypeError) as error:
            if number == len(lines) and rows:
                break
            raise CheckpointError(
                f"expected JSON with phase, round and step in line {number} of '{path}', received {line[:60]!r}."
            ) from error
    if not rows:
        raise CheckpointError(f"expected at least one row in '{path}', received an empty log.")
    return rows


@dataclass(frozen=True)
class Panel:
    """Curves of one loss of one phase, as a page draws them: 250 x 110 pixels from (40, 20) on."""

    title: str
    lines: list[tuple[int, str]]  # number of a colour of the style sheet, points
    bottom: str  # value below ...
    top: str  # ... and above
    end: str  # last step


def panels(logs: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[Panel]:
    """Every loss of every phase over its steps, a line for every log; rounds follow each other.

    ``logs``: rows by the name of their run, see :func:`read_log`. Source: none.

    Example:
        >>> found = panels({"run": [{"phase": "fit", "round": 0, "step": s, "loss_safe": 1 / s} for s in (100, 200)]})
        >>> [(p.title, p.bottom, p.top, p.end, p.lines) for p in found]
        [('fit: safe', '0.005', '0.01', '200', [(0, '40.0,20.0 290.0,130.0')])]
    """
    found: dict[str, dict[int, list[tuple[float, float]]]] = {}
    for k, log in enumerate(logs.values()):
        for title, point in _points(log):
            found.setdefault(title, {}).setdefault(k, []).append(point)
    return [_panel(title, lines) for title, lines in found.items()]


def _points(log: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, tuple[float, float]]]:
    longest: dict[str, int] = {}
    for row in log:
        longest[row["phase"]] = max(longest.get(row["phase"], 1), row["step"])
    for row in log:
        x = row["round"] * longest[row["phase"]] + row["step"]
        for name, value in row.items():
            if name.startswith("loss") and isinstance(value, (int, float)) and math.isfinite(value):
                yield f"{row['phase']}: {name.removeprefix('loss_').replace('_', ' ')}", (float(x), float(value))


def _panel(title: str, lines: Mapping[int, list[tuple[float, float]]]) -> Panel:
    points = [p for line in lines.values() for p in line]
    log = min(y for _, y in points) > 0

    def height(y: float) -> float:
        return math.log10(y) if log else y

    left, right = min(x for x, _ in points), max(x for x, _ in points)
    low, high = height(min(y for _, y in points)), height(max(y for _, y in points))

    def place(x: float, y: float) -> str:
        across = 40 + 250 * (x - left) / ((right - left) or 1)
        return f"{across:.1f},{130 - 110 * (height(y) - low) / ((high - low) or 1):.1f}"

    drawn = [(k % COLOURS, " ".join(place(*p) for p in line[:: len(line) // 400 + 1])) for k, line in lines.items()]
    bottom, top = (f"{10**v if log else v:.3g}" for v in (low, high))
    return Panel(title, drawn, bottom, top, f"{right:g}")


def training_curves(path: str | Path) -> Figure:
    """Losses of every phase of a training over its optimiser steps, and the held-out checks of every round.

    One panel per phase of a run's ``log.jsonl`` (one JSON object per line with ``phase``, ``round``, ``step``,
    ``loss_*``); the figure's label is a caption. Raises CheckpointError if the file is missing, empty, or not a log.
    Source: paper Algorithm 1 (phases); the paper shows no curves.

    Example:
        >>> from pathlib import Path
        >>> _ = Path("log.jsonl").write_text('{"phase": "fit", "round": 0, "step": 100, "loss_safe": 0.1}')
        >>> len(training_curves("log.jsonl").axes)
        1
    """
    log = read_log(path)
    phases: dict[str, list[dict[str, Any]]] = {}
    for row in log:
        if any(k.startswith("loss") for k in row) or row["phase"] == "check":
            phases.setdefault(row["phase"], []).append(row)
    if not phases:
        raise CheckpointError(f"expected losses or checks in '{path}', received {len(log)} rows without either.")
    columns = min(3, len(phases))
    lines = math.ceil(len(phases) / columns)
    caption = "Losses of every phase (rounds follow one another, dotted lines between them)."
    figure = new_figure(4.0 * columns, 3.1 * lines, caption)
    for k, (phase, rows) in enumerate(phases.items()):
        ax = figure.add_subplot(lines, columns, k + 1)
        ax.set_title(phase, fontsize=10)
        (_draw_checks if phase == "check" else _draw_losses)(ax, rows)
        ax.tick_params(labelsize=8)
    return figure


def _draw_losses(ax: Axes, rows: list[dict[str, Any]]) -> None:
    at, offset, last = [], 0, 0
    previous = rows[0]["round"]
    for row in rows:
        if row["round"] != previous:
            offset, previous = offset + last, row["round"]
            ax.axvline(offset, color="#aaaaaa", linewidth=0.8, linestyle=":")
        last = row["step"]
        at.append(offset + last)
    names = list(dict.fromkeys(k for row in rows for k in row if k.startswith("loss")))
    for colour, name in zip(np.resize(PATH_COLOURS, len(names)), names, strict=True):
        value = np.array([float(row.get(name) or 0.0) for row in rows])
        label = name.removeprefix("loss_").removeprefix("loss") or "total"
        if (value > 0).any():
            shown = np.where(value > 0, value, np.nan)
            ax.plot(at, shown, ".-", color=colour, linewidth=1.0, markersize=3, label=label)
            ax.set_yscale("log")
        else:
            ax.plot([], [], color=colour, label=f"{label} (0)")
    ax.set_xlabel("optimiser step", fontsize=8)
    ax.set_ylabel("loss", fontsize=8)
    _legend_below(ax)


def _legend_below(ax: Axes) -> None:
    place: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.2), "ncols": 3}
    ax.legend(fontsize=7, frameon=False, labelspacing=0.25, columnspacing=1.0, handlelength=1.4, **place)


def _draw_checks(ax: Axes, rows: list[dict[str, Any]]) -> None:
    def draw(name: str, shown: list[dict[str, Any]], style: str, **look: Any) -> None:
        ax.plot([row["round"] for row in shown], [float(row.get(name) or 0.0) for row in shown], style, **look)

    draw("size", rows, "o-", color=PATH_COLOURS[0], linewidth=1.1, label="size of the set")
    draw("returned", rows, "o-", color=PATH_COLOURS[1], linewidth=1.1, label="returned")
    failed = [row for row in rows if not row.get("passed")]
    draw("size", failed, "x", color="#c8372d", markersize=10, label="check failed")
    ax.set(ylim=(-0.03, 1.03), xticks=sorted({row["round"] for row in rows}))
    ax.set_xlabel("round", fontsize=8)
    ax.set_ylabel("share", fontsize=8)
    _legend_below(ax)

"""Curves of a training, read from its log."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_sspl.errors import CheckpointError
from torchrl_sspl.viz.plane import PATH_COLOURS, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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

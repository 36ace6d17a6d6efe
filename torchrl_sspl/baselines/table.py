"""The table of the comparison: runs the cells that are missing, one after the other, and writes it in Markdown."""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchrl_sspl.baselines.cell import Cell, run_cell, stored
from torchrl_sspl.baselines.registry import kind_of
from torchrl_sspl.configs.reader import parse
from torchrl_sspl.errors import ConfigError, SSPLError
from torchrl_sspl.files import write

#: The paper's Table I: requires a model, general dynamics, expert demonstrations, computationally expensive, safety and completeness guarantees.
TICKS = {
    "imitation": "-++---",
    "nerf_cbf": "+--++-",
    "vision_cbf": "---++-",
    "neural_cbf": "+---+-",
    "latent_cbf": "----+-",
    "sspl": "-+--++",
}
_TICK_NAMES = ("model", "general", "expert", "expensive", "safety", "completeness")
#: What stands in the table if nothing else is asked for; options of a method follow a colon.
DEFAULTS = {
    "pendulum": (
        "kernel", "lqr", "depth", "depth:beta=0.5:alpha=0.9", "hocbf", "box_margin", "depth:noise=[0.007,0.016]", "imitation", "nerf_cbf",
        "nerf_cbf:pose=estimated", "vision_cbf", "neural_cbf", "latent_cbf", "latent_safe", "smooth_latent", "sspl", "sspl:agent=pendulum",
    ),
    "dubins": (
        "kernel", "turning_circle", "cone", "box_margin", "turning_circle:noise=[0.02,0.02,0.04]", "imitation", "nerf_cbf",
        "nerf_cbf:form=closing", "nerf_cbf:form=closing:pose=estimated", "vision_cbf", "neural_cbf", "latent_cbf", "latent_safe",
        "smooth_latent", "sspl", "sspl:agent=quadruped",
    ),
}  # fmt: skip
#: Column, measurement, whether it is a share; of two seeds and more the mean stands, with the worst one.
_MEASURED = (
    ("claimed / kernel", "claimed_over_kernel", True, min),
    ("false-safe", "false_safe", True, max),
    ("U called safe", "unsafe_called_safe", True, max),
    ("claimed, harmless", "claimed_harmless_enter", True, max),
    ("claimed, adversarial", "claimed_adversarial_enter", True, max),
    ("common, harmless", "common_harmless_enter", True, max),
    ("common, adversarial", "common_adversarial_enter", True, max),
    ("infeasible", "common_harmless_infeasible", True, max),
    ("deviation", "common_harmless_deviation", False, max),
    ("calibrated / kernel", "calibrated_claimed_over_kernel", True, min),
)
_SHIFTS = ("renderer", "dark", "bright", "background", "object")
_NEEDED = (
    ("transitions", "transitions"), ("S", "safe_labels"), ("U", "unsafe_labels"), ("states", "states"), ("masks", "masks"),
    ("expert actions", "expert_actions"), ("state at run time", "state_at_run_time"), ("dynamics", "dynamics"),
)  # fmt: skip


def cells(words: Sequence[str]) -> list[Cell]:
    """The cells that words ask for: ``methods=a,b:key=value env=pendulum,dubins budget=small seed=0,1 out_dir=... score.*``.

    Raises ConfigError for a word that is not valid. Source: none.

    Example:
        >>> [c.directory.as_posix() for c in cells(["methods=lqr,hocbf:k=2.0", "env=pendulum"])]
        ['runs/baselines/pendulum/none/lqr/0', 'runs/baselines/pendulum/none/hocbf-k-2.0/0']
    """
    given = parse(list(words))
    scores = [f"{k}={v}" for k, v in given.items() if k.startswith("score.")]
    unknown = [k for k in given if k not in ("methods", "env", "budget", "seed", "trials") and not k.startswith("score.")]
    if unknown:
        raise ConfigError(f"table: expected methods=, env=, budget=, seed=, trials= and score.*=, received {', '.join(unknown)}")
    found: dict[Path, Cell] = {}
    for env in given.get("env", "pendulum,dubins").split(","):
        if env not in DEFAULTS and "methods" not in given:
            raise ConfigError(f"table: expected env among {', '.join(DEFAULTS)}, or methods= with it, received '{env}'")
        names = _names(given["methods"]) if "methods" in given else DEFAULTS[env]
        # Those of one recording one after the other: it is made once.
        for budget, seed, name in itertools.product(given.get("budget", "small").split(","), given.get("seed", "0").split(","), names):
            method, *options = name.split(":")
            if not kind_of(method).learns or any(o.startswith("agent=") for o in options):
                seed = "0"
            cell = Cell.of(method, [f"env={env}", f"budget={budget}", f"seed={seed}", f"trials={given.get('trials', '0')}", *options, *scores])
            found[cell.directory] = cell
    return list(found.values())


def _names(text: str) -> list[str]:
    """Names that are separated by commas, of which some stand within brackets."""
    names, depth = [""], 0
    for letter in text:
        depth += (letter == "[") - (letter == "]")
        if letter == "," and not depth:
            names.append("")
        else:
            names[-1] += letter
    return names


def table(words: Sequence[str]) -> str:
    """Runs the cells that are missing and returns the table; ``run=false`` only reads what is there, whatever its sizes.

    A cell that fails is named in its row; the others go on. Source: none.
    """
    run = "run=false" not in words
    asked = cells([w for w in words if w not in ("run=false", "run=true")])
    rows: dict[Path, dict[str, Any] | str] = {}
    for k, cell in enumerate(asked):
        try:
            row = run_cell(cell) if run else stored(cell, any_score=True)
            rows[cell.directory] = row if row is not None else "not measured"
        except SSPLError as error:
            rows[cell.directory] = f"{type(error).__name__}: {error}"
        print(f"{k + 1} of {len(asked)}: {cell.directory}", file=sys.stderr, flush=True)
    return markdown([(cell, rows[cell.directory]) for cell in asked])


def markdown(rows: Sequence[tuple[Cell, dict[str, Any] | str]]) -> str:
    """Three tables for each system: what was measured, on shifted pictures too, and what each method was given. Source: none."""
    text = []
    for env, group in itertools.groupby(sorted(rows, key=lambda r: r[0].env), key=lambda r: r[0].env):
        several: dict[tuple[str, str], list[dict[str, Any] | str]] = {}
        for cell, row in group:
            label = " ".join([cell.method, *cell.options, *([f"trials={cell.trials}"] if cell.trials else [])])
            trained = any(option.startswith("agent=") for option in cell.options)
            several.setdefault((label, "its own" if trained else cell.budget), []).append(row)
        head = ["method", "budget", *(c[0] for c in _MEASURED), "latency p50 / p99", "episodes"]
        lines = [_line(head), _line(["---"] * len(head))]
        needs = ["method", "budget", *(c[0] for c in _NEEDED), "training, CPU min", "proved", "paper: " + ", ".join(_TICK_NAMES)]
        given = [_line(needs), _line(["---"] * len(needs))]
        moved = ["method", "budget", *_SHIFTS]
        shifted = [_line(moved), _line(["---"] * len(moved))]
        for (label, budget), found in several.items():
            good = [row for row in found if isinstance(row, dict)]
            if not good:
                lines.append(_line([label, budget, str(found[0]), *[""] * (len(head) - 3)]))
                continue
            first = good[0]
            if len(good) < len(found):
                reason = next(str(row) for row in found if not isinstance(row, dict))
                label = f"{label} ({len(good)} of {len(found)} seeds; {reason})"
            episodes = str(first["measurements"].get("common_harmless_enter", {}).get("n"))
            lines.append(_line([label, budget, *(_value(good, c) for c in _MEASURED), _latency(good), episodes]))
            if any(name.startswith("shifted_") for row in good for name in row["measurements"]):
                shifted.append(_line([label, budget, *(" / ".join(_value(good, _moved(c, shift)) for c in _MEASURED[:3]) for shift in _SHIFTS)]))
            facts = [str(first["needs"][key]) for _, key in _NEEDED]
            minutes = sum(row["minutes"]["fit_cpu"] for row in good) / len(good)
            ticks = TICKS.get(first["cell"]["method"], "")
            given.append(_line([label, budget, *facts, f"{minutes:.1f}", first["needs"]["proved"], " ".join("✓" if t == "+" else "✗" for t in ticks) or "-"]))
        text += [f"### {env}", "", *lines, "", *given, ""]
        if len(shifted) > 2:
            text += ["Shifted pictures: claimed / kernel, false-safe, U called safe", "", *shifted, ""]
    return "\n".join(text)


def _moved(column: tuple[str, str, bool, Any], shift: str) -> tuple[str, str, bool, Any]:
    """The column of a measurement on shifted pictures."""
    head, name, share, worst = column
    return head, f"shifted_{shift}_{name}", share, worst


def _line(cells_of_row: Sequence[str]) -> str:
    return f"| {' | '.join(cells_of_row)} |"


def _value(rows: list[dict[str, Any]], column: tuple[str, str, bool, Any]) -> str:
    _, name, share, worst = column
    values = [row["measurements"][name]["value"] for row in rows if name in row["measurements"]]
    values = [v for v in values if v is not None]
    if not values:
        return "-"

    def show(value: float) -> str:
        return f"{100 * value:.1f} %" if share else f"{value:.2f}"

    mean = show(sum(values) / len(values))
    shown = mean if len(values) == 1 else f"{mean} ({show(worst(values))})"
    return shown if len(values) == len(rows) else f"{shown}, {len(values)} of {len(rows)} seeds"


def _latency(rows: list[dict[str, Any]]) -> str:
    p50, p99 = (max(row["measurements"][f"latency_{p}"]["value"] for row in rows) for p in ("p50", "p99"))
    return f"{p50:.1f} / {p99:.1f} ms"


def main(words: Sequence[str]) -> int:
    """Print the table and write it, with all rows, beside the runs; 0. Source: none."""
    text = table(words)
    print(text)
    write("runs/baselines/table.md", text)
    found = sorted(Path("runs/baselines").rglob("row.json"))
    write("runs/baselines/rows.json", json.dumps([json.loads(p.read_text()) for p in found], indent=1) + "\n")
    return 0


__all__ = ["DEFAULTS", "TICKS", "cells", "markdown", "table"]

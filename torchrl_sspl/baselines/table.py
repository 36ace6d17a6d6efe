"""The table of the comparison: the cells that are missing are measured, and all of them are lines of Markdown."""

from __future__ import annotations

import csv
import io
import itertools
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import fields, replace
from functools import partial
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from typing import Any

from torchrl_sspl.baselines.cell import STAYS, Cell, run_cell, stored, trained_before
from torchrl_sspl.baselines.registry import kind_of
from torchrl_sspl.configs.reader import parse
from torchrl_sspl.errors import ConfigError, SSPLError
from torchrl_sspl.interrupts import Interrupted, interruptible

Row = dict[str, Any] | str  # what was measured, or why nothing was

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
    ("transitions", "transitions"), ("of rollouts", "rollouts"), ("S", "safe_labels"), ("U", "unsafe_labels"), ("neither", "neither_labels"),
    ("held-out labels", "held_out_labels"), ("held-out steps", "held_out_steps"), ("states", "states"), ("masks", "masks"),
    ("expert actions", "expert_actions"), ("state at run time", "state_at_run_time"), ("dynamics", "dynamics"),
)  # fmt: skip


def cells(words: Sequence[str]) -> list[Cell]:
    """The cells that words ask for: ``methods=a,b:key=value env=pendulum,dubins budget=small seed=0,1 trials=8 out_dir=runs/baselines score.*``.

    Raises ConfigError for a word that is not valid. Source: none.

    Example:
        >>> [c.directory.as_posix() for c in cells(["methods=lqr,hocbf:k=2.0", "env=pendulum"])]
        ['runs/baselines/pendulum/none/lqr/0', 'runs/baselines/pendulum/none/hocbf-k-2.0/0']
    """
    given = parse(list(words))
    scores = [f"{k}={v}" for k, v in given.items() if k.startswith("score.")]
    unknown = [k for k in given if k not in ("methods", "env", "budget", "seed", "trials", "out_dir") and not k.startswith("score.")]
    if unknown:
        raise ConfigError(f"table: expected methods=, env=, budget=, seed=, trials=, out_dir= and score.*=, received {', '.join(unknown)}")
    found: dict[Path, Cell] = {}
    for env in given.get("env", "pendulum,dubins").split(","):
        if env not in DEFAULTS and "methods" not in given:
            raise ConfigError(f"table: expected env among {', '.join(DEFAULTS)}, or methods= with it, received '{env}'")
        names = _names(given["methods"]) if "methods" in given else DEFAULTS[env]
        # Those of one recording one after the other: it is made once.
        for budget, seed, name in itertools.product(given.get("budget", "small").split(","), given.get("seed", "0").split(","), names):
            method, *options = name.split(":")
            if not kind_of(method).learns or trained_before(options):
                seed = "0"
            if trained_before(options):
                budget = "small"  # a name alone: nothing is learnt with it
            cell = Cell.of(method, [f"env={env}", f"budget={budget}", f"seed={seed}", f"trials={given.get('trials', '0')}", *options, *scores])
            cell = replace(cell, root=given.get("out_dir") or cell.root)
            if found.setdefault(cell.directory, cell) != cell:
                raise ConfigError(f"table: expected cells of folders of their own, received two for '{cell.directory}': {found[cell.directory].describe()} and {cell.describe()}; ask for one after the other, with another out_dir")
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


def table(words: Sequence[str]) -> list[tuple[Cell, Row]]:
    """Measures the cells that are missing and returns all rows; ``run=false`` only reads what is there, whatever its sizes.

    With ``jobs=2`` two processes measure side by side. A cell that fails is named in its row; the others go on. Source: none.
    """
    given = parse(list(words))
    run, jobs = given.pop("run", "true"), given.pop("jobs", "1")
    if run not in ("true", "false") or not jobs.isdecimal() or not int(jobs):
        raise ConfigError(f"table: expected run=true or false and jobs >= 1, received run={run} and jobs={jobs}")
    asked, measure, found = cells([f"{k}={v}" for k, v in given.items()]), partial(_row, run=run == "true"), list[tuple[Cell, Row]]()
    rows = _side_by_side(measure, asked, int(jobs)) if run == "true" and int(jobs) > 1 else map(measure, asked)
    for cell, row in zip(asked, rows, strict=True):
        found.append((cell, row))
        print(f"{len(found)} of {len(asked)}: {cell.directory}", file=sys.stderr, flush=True)
    return found


def _side_by_side(measure: Callable[[Cell], Row], asked: Sequence[Cell], jobs: int) -> Iterator[Row]:
    """The rows in order, measured by as many processes; whatever ends this one ends them, too."""
    pool = ProcessPoolExecutor(jobs, get_context("spawn"))
    try:
        for row in [pool.submit(measure, cell) for cell in asked]:
            try:
                yield row.result()
            except BrokenProcessPool as error:
                yield f"BrokenProcessPool: {error} It may have wanted more memory: the same command goes on, with jobs=1 each cell has all of it"
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in active_children():
            child.terminate()
        raise
    pool.shutdown()


def _row(cell: Cell, *, run: bool) -> Row:
    """What was measured, or why nothing was."""
    try:
        with interruptible(lambda: STAYS):  # here, too: it may be another process
            return run_cell(cell) if run else stored(cell, any_score=True) or "not measured"
    except Interrupted as error:
        if parent_process() is not None:
            os._exit(128 + error.number)  # else this process would begin the next cell
        raise
    except Exception as error:  # whatever becomes of one method, the others are measured
        if not isinstance(error, SSPLError):
            traceback.print_exc()
        return f"{type(error).__name__}: {error}"


def tables(rows: Sequence[tuple[Cell, Row]]) -> dict[str, list[tuple[str, list[list[str]]]]]:
    """Tables by system: what was measured, what each method was given, and what is claimed on shifted pictures; each has a title
    and lines, of which the first is its head. Source: none."""
    every = {}
    for env, group in itertools.groupby(sorted(rows, key=lambda r: r[0].env), key=lambda r: r[0].env):
        several: dict[tuple[str, str], list[Row]] = {}
        for cell, row in group:
            several.setdefault((name_of(cell), budget_of(cell)), []).append(row)
        lines = [["method", "budget", *(c[0] for c in _MEASURED), "latency p50 / p99", "episodes"]]
        given = [["method", "budget", *(c[0] for c in _NEEDED), "training, CPU min", "proved", "measured", "only claimed", "paper: " + ", ".join(_TICK_NAMES), "trials chose"]]
        shifted = [["method", "budget", *_SHIFTS]]
        for (label, budget), found in several.items():
            good = [row for row in found if isinstance(row, dict)]
            if not good:
                lines.append([label, budget, str(found[0]), *[""] * (len(lines[0]) - 3)])
                continue
            first = good[0]
            if len(good) < len(found):
                reason = next(str(row) for row in found if not isinstance(row, dict))
                label = f"{label} ({len(good)} of {len(found)} seeds; {reason})"
            lines.append([label, budget, *(_value(good, c) for c in _MEASURED), _latency(good), _episodes(good)])
            if any(name.startswith("shifted_") for row in good for name in row["measurements"]):
                shifted.append([label, budget, *(_on_shift(good, shift) for shift in _SHIFTS)])
            facts = ["not counted" if (n := first["needs"].get(key)) is None else str(n) for _, key in _NEEDED]
            if more := first.get("tuning", {}).get("needs"):
                facts[0] += f", and {more['transitions']} of trials"
            minutes = f"{sum(row['minutes']['fit_cpu'] for row in good) / len(good):.1f}"
            if "trials_cpu" in first["minutes"]:
                minutes += f", and {first['minutes']['trials_cpu']:.1f} of trials"
            ticks = TICKS.get(first["cell"]["method"], "")
            rests = [" or ".join(dict.fromkeys(row["needs"][name] for row in good)) for name in ("proved", "measured", "claimed")]
            given.append([label, budget, *facts, minutes, *rests, " ".join("✓" if t == "+" else "✗" for t in ticks) or "-", _chosen(first)])
        every[env] = [("Measured", lines), ("Given", given)]
        if len(shifted) > 1:
            every[env].append(("Shifted pictures: claimed / kernel, false-safe, U called safe; without a claim: common, harmless", shifted))
    return every


def name_of(cell: Cell) -> str:
    """The method of a cell with its options. Source: none."""
    return " ".join([cell.method, *cell.options, *([f"trials={cell.trials}"] if cell.trials else [])])


def budget_of(cell: Cell) -> str:
    """The budget of a cell; an agent that was trained before has one of its own. Source: none."""
    return "its own" if trained_before(cell.options) else cell.budget


def markdown(rows: Sequence[tuple[Cell, Row]]) -> str:
    """The tables in Markdown. Source: none."""
    text = []
    for env, found in tables(rows).items():
        text += [f"### {env}", ""]
        for title, (head, *lines) in found:
            text += [f"{title}:", "", _line(head), _line(["---"] * len(head)), *map(_line, lines), ""]
    return "\n".join(text)


def values(rows: Sequence[dict[str, Any]]) -> str:
    """What the tables show of each row, one line each, as comma-separated values. Source: none."""
    shown = [name for _, name, *_ in _MEASURED]
    shown += [f"shifted_{shift}_{name}" for shift in _SHIFTS for name in (*shown[:3], "common_harmless_enter")]
    lines = [["env", "method", "budget", "seed", *shown]]
    for row in rows:
        of = row["cell"]
        cell = Cell(of["method"], of["env"], of["budget"], of["seed"], tuple(of["options"]), trials=of.get("trials", 0))
        found = [row["measurements"].get(name, {}).get("value") for name in shown]
        lines.append([cell.env, name_of(cell), budget_of(cell), str(cell.seed), *("" if v is None else f"{v:.6g}" for v in found)])
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()


def _on_shift(rows: list[dict[str, Any]], shift: str) -> str:
    """What a method claims on shifted pictures, or what its episodes come to if it claims nothing anywhere."""
    lost = f"shifted_{shift}_common_harmless_enter"
    if any(lost in row["measurements"] for row in rows):
        return f"{_value(rows, ('', lost, True, max))} enter U"
    return " / ".join(_value(rows, (head, f"shifted_{shift}_{name}", share, worst)) for head, name, share, worst in _MEASURED[:3])


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


def _episodes(rows: list[dict[str, Any]]) -> str:
    """From how many starts episodes began, the fewest of the seeds; apart those from the claimed set where fewer were found in it, and those
    that placed a calibrated level where they were others."""
    names = ("common_harmless_enter", "claimed_harmless_enter", "calibrated_level")
    common, claimed, held = ([n for row in rows if (n := row["measurements"].get(name, {}).get("n"))] for name in names)
    most = min(common or claimed, default=0)
    shown = [str(most or "-"), *([f"{min(claimed)} claimed"] if claimed and min(claimed) < most else [])]
    return ", ".join([*shown, *([f"calibrated by {min(held)}"] if held and min(held) != most else [])])


def _chosen(row: dict[str, Any]) -> str:
    """Options that trials have chosen, the same for all seeds; those that are written out as they are by default are left out."""
    if "tuning" not in row:
        return "-"
    config = kind_of(row["cell"]["method"]).Config
    usual = {f"{f.name}={f.default}" for f in fields(config)} if config else set()
    return " ".join(option for option in row["tuning"]["chosen"] if option not in usual) or "the defaults"


def _latency(rows: list[dict[str, Any]]) -> str:
    p50, p99 = (max(row["measurements"][f"latency_{p}"]["value"] for row in rows) for p in ("p50", "p99"))
    return f"{p50:.1f} / {p99:.1f} ms"


__all__ = ["DEFAULTS", "TICKS", "Row", "budget_of", "cells", "markdown", "name_of", "table", "tables", "values"]

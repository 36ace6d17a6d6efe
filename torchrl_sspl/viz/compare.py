"""Runs beside each other: one table over their measurements, and one page with settings, figures and curves."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from torchrl_sspl.configs.reader import EnvFactory
from torchrl_sspl.envs.system import Requirement, bounded
from torchrl_sspl.errors import CheckpointError
from torchrl_sspl.files import write
from torchrl_sspl.viz.curves import COLOURS, panels, read_log
from torchrl_sspl.viz.pages import Badge, Cell, Picture, Table, render
from torchrl_sspl.viz.report import MARKS, SEEN, badge, file_uri, format_value, verdict_in, verdict_kind

_OWN = ("out_dir", "seed", "trainer.progress", "logger.kind", "logger.project")  # no settings of what is compared

@dataclass(frozen=True)
class Run:
    """A run on disk."""

    name: str  # what tells it from the others
    directory: Path
    #: What its ``metrics.json`` says; of a run that has not come to an end, its configuration alone.
    metrics: Mapping[str, Any] = field(default_factory=dict)

    @property
    def finished(self) -> bool:
        """Whether it was evaluated."""
        return "measurements" in self.metrics

    @property
    def settings(self) -> dict[str, Any]:
        """Values by key."""
        config = self.metrics.get("config", {})
        sections = {name: section for name, section in config.items() if isinstance(section, Mapping)}
        inner = {f"{name}.{k}": v for name, section in sections.items() for k, v in section.items()}
        return {k: v for k, v in config.items() if k not in sections} | inner


@dataclass(frozen=True)
class Row:
    """One measurement over the runs of one setting, which differ in their seeds."""

    setting: str  # what tells it from others, such as "synthesis.margin=0.05"
    evaluation: str  # where it was measured
    name: str
    label: str  # what it is, for people
    unit: str
    must: str  # limit of the requirement such as "<= 0.01", or ""
    mean: float | None  # over the runs that measured it
    worst: float | None  # of these, by the sense of the requirement; None without one
    values: dict[str, float | None]  # by run
    verdict: str  # of the worst run, "not measured" if a run is missing, or "" without a requirement


def read_runs(directories: Sequence[str | Path]) -> list[Run]:
    """Runs of these directories, named by what their paths do not share; without ``metrics.json`` one is not finished.

    Raises CheckpointError for no such directory, or a ``metrics.json`` that cannot be read. Source: none.
    """
    paths = [Path(d) for d in directories]
    shared = os.path.commonpath([p.resolve().parent for p in paths]) if paths else ""
    return [Run(os.path.relpath(path.resolve(), shared), path, read_metrics(path)) for path in paths]


def read_metrics(directory: Path) -> dict[str, Any]:
    """What a run's directory says about it; errors as for :func:`read_runs`."""
    if not directory.is_dir():
        raise CheckpointError(f"expected the directory of a run, received '{directory}'; train one with `sspl train`")
    for name, key in (("metrics.json", None), ("config.json", "config")):
        if (file := directory / name).is_file():
            try:
                body = dict(json.loads(file.read_text()))
            except (ValueError, TypeError) as error:
                message = f"expected readable numbers in '{file}', received {error}; run it again"
                raise CheckpointError(message) from error
            return {key: body} if key else body
    return {}


def differing(runs: Sequence[Run]) -> list[str]:
    """Keys in which the settings of runs differ, apart from seed and directory."""
    settings = [run.settings for run in runs if run.metrics]
    keys = dict.fromkeys(k for s in settings for k in s)
    return [k for k in keys if k not in _OWN and any(s.get(k) != settings[0].get(k) for s in settings)]


def rows_of(runs: Sequence[Run]) -> list[Row]:
    """The table over runs, a row for every setting, evaluation and measurement: what is required comes first."""
    keys = differing(runs)
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(", ".join(f"{k}={_show(run.settings.get(k))}" for k in keys), []).append(run)
    rows = []
    for setting, members in groups.items():
        if len(keys) > 4:  # the page has a table of what differs
            setting = f"{members[0].name} ({len(keys)} settings differ)"
        required = {r.name: r for r in _requirements(next((m for m in members if m.finished), members[0]))}
        pairs = list(dict.fromkeys((n, e) for run in members for e, found in _measured(run).items() for n in found))
        pairs += [(n, "") for n in required if all(n != name for name, _ in pairs)]
        order = [*required, *(n for n, _ in pairs)]
        for name, evaluation in sorted(pairs, key=lambda pair: order.index(pair[0])):
            shown = f" ({evaluation})" if sum(n == name for n, _ in pairs) > 1 else ""
            rows.append(_row(setting, evaluation, name, shown, members, required.get(name)))
    return rows


def _row(
    setting: str, evaluation: str, name: str, shown: str, runs: Sequence[Run], required: Requirement | None
) -> Row:
    found = [_measured(run).get(evaluation, {}).get(name, {}) for run in runs]
    values = {run.name: _number(m.get("value")) for run, m in zip(runs, found, strict=True)}
    known = [v for v in values.values() if v is not None]
    mean = sum(known) / len(known) if known else None
    default = "share" if required and max(required.must, required.aim) <= 1 else ""
    unit = next((m["unit"] for m in found if m.get("unit")), default)
    if required is None:
        return Row(setting, evaluation, name, name + shown, unit, "", mean, None, values, "")
    worst = (max if required.sense == "<=" else min)(known, default=None)
    asked = worst if len(known) == len(values) else None
    verdict = required.verdict(SimpleNamespace(measurements={name: SimpleNamespace(value=asked)}))
    for m in found:  # of equal values the least certain counts
        verdict = bounded(required, verdict, SimpleNamespace(**{k: m.get(k) for k in ("lower", "upper", "unit")}))
    must, label = f"{required.sense} {format_value(required.must, unit)}", required.label + shown
    return Row(setting, evaluation, name, label, unit, must, mean, worst, values, verdict_in(unit, verdict))


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, (int, float)) and not math.isnan(value) else None


def _measured(run: Run) -> Mapping[str, Any]:
    return run.metrics.get("measurements", {})


def _requirements(run: Run) -> Sequence[Requirement]:
    """Requirements of the system of a run: as its metrics say, or its environment."""
    if "requirements" in run.metrics:
        return [Requirement(**r) for r in run.metrics["requirements"]]
    try:
        env = EnvFactory(run.metrics["config"]["env"])(batch_size=[1], seed=0)
    except Exception:  # given in code, or not to be had here
        return ()
    requirements = getattr(getattr(env, "system", None), "requirements", ())
    env.close()
    return requirements


def _show(value: Any) -> str:
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def text_table(rows: Sequence[Row]) -> str:
    """Rows with a requirement (all rows if none has one) as text, a block for every setting."""
    rows = [r for r in rows if r.must] or list(rows)
    lines: list[str] = []
    for setting, block, names in _blocks(rows):
        text = [["", "must", "mean", "worst", "verdict", *names]]
        for r in block:
            values = [r.values.get(n) for n in names]
            text.append([*_cells(r), *("-" if v is None else format_value(v, r.unit) for v in values)])
        widths = [max(map(len, column)) for column in zip(*text, strict=True)]
        lines += [setting] if setting else []
        lines += ["  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in text]
        lines.append("")
    return "\n".join(lines).rstrip()


def _blocks(rows: Sequence[Row]) -> Iterator[tuple[str, list[Row], list[str]]]:
    """Settings with their rows and the names of their runs."""
    for setting in dict.fromkeys(r.setting for r in rows):
        block = [r for r in rows if r.setting == setting]
        yield setting, block, list(dict.fromkeys(n for r in block for n in r.values))


def _cells(row: Row) -> list[str]:
    worst = "" if row.worst is None else format_value(row.worst, row.unit)
    return [row.label, row.must, format_value(row.mean, row.unit), worst, row.verdict]


def compare(runs: Sequence[str | Path] | Sequence[Run], path: str | Path, *, title: str = "") -> Path:
    """Write a page that shows runs (directories, or runs that were read) beside each other; self-contained, no scripts.

    Returns the file; its folder is created. Raises CheckpointError if no run is finished, or one cannot be read.
    Source: none.
    """
    found = [r for r in runs if isinstance(r, Run)] or read_runs([r for r in runs if not isinstance(r, Run)])
    if not any(run.finished for run in found):
        raise CheckpointError(f"expected at least one run with metrics.json, received {len(found)} directories without")
    rows, keys = rows_of(found), differing(found)
    required, names = [r for r in rows if r.must], list(dict.fromkeys(k for run in found for k in run.settings))
    page = render(
        "comparison.html", title=title or f"{len(found)} runs", facts=f"{len(keys)} settings differ, apart from the seed",
        runs=_overview(found), differing=_settings(found, keys), settings=_settings(found, names), side=_side(required),
        required=_tables(required), rows=_tables(rows), figures=_figures(found), curves=panels({run.name: _log(run) for run in found}),
        key=[(k % COLOURS, run.name) for k, run in enumerate(found)],
    )  # fmt: skip
    return write(path, page)


def _overview(runs: Sequence[Run]) -> Table:
    cells: list[list[str | Cell]] = []
    for run in runs:
        m, seconds = run.metrics, run.metrics.get("training_seconds")
        cells.append([
            Cell(run.name, "code"), _show(run.settings.get("seed")), "" if seconds is None else f"{seconds / 60:.1f} min",
            str(m.get("stop_reason", "") if run.finished else "not finished"), Cell(badge=_standing(run)),
        ])  # fmt: skip
    return Table(["Run", "Seed", "Training", "Why it ended", "Requirements"], cells)


def _standing(run: Run) -> Badge:
    """How many requirements a run misses, or leaves open; green only where every bound reaches its must."""
    verdicts = [r.verdict for r in rows_of([run]) if r.must]
    kinds = [verdict_kind(v) for v in verdicts if v not in SEEN]
    words = {"bad": "missed", "fair": "with too few episodes", "none": "not measured"}
    left = {kind: f"{kinds.count(kind)} {text}" for kind, text in words.items() if kind in kinds}
    if not left:
        return badge("must" if verdicts else "not measured")
    worst = next(iter(left))
    return Badge(worst, MARKS[worst], f"of {len(verdicts)}: {', '.join(left.values())}")


def _tables(rows: Sequence[Row]) -> list[tuple[str, Table]]:
    """Every setting with its rows."""
    out = []
    for setting, block, names in _blocks(rows):
        cells: list[list[str | Cell]] = []
        for r in block:
            label, must, mean, worst, verdict = _cells(r)
            each = [format_value(r.values[n], r.unit) if n in r.values else "" for n in names]
            cells.append([label, must, mean, Cell(worst, "b"), Cell(badge=badge(verdict)) if r.must else "", *each])
        out.append((setting, Table(["Measurement", "Must", "Mean", "Worst", "Verdict of the worst", *names], cells)))
    return out


def _side(rows: Sequence[Row]) -> Table | None:
    """The settings beside each other: worst with its verdict, and mean."""
    settings = list(dict.fromkeys(r.setting for r in rows))
    if len(settings) < 2:
        return None
    places: dict[str, dict[str, Row]] = {}
    for r in rows:
        places.setdefault(r.label, {})[r.setting] = r
    cells: list[list[str | Cell]] = []
    for label, found in places.items():
        each: dict[str, Cell] = {}
        for setting, r in found.items():
            _, _, mean, worst, verdict = _cells(r)
            each[setting] = Cell(worst, "b", badge(verdict), f"mean {mean}")
        must = next((r.must for r in found.values() if r.mean is not None), next(iter(found.values())).must)
        cells.append([label, must, *(each.get(s, "") for s in settings)])
    return Table(["Worst, verdict and mean", "Must", *settings], cells)


def _settings(runs: Sequence[Run], keys: Sequence[str]) -> Table | None:
    cells: list[list[str | Cell]] = [[Cell(k, "code"), *(_show(run.settings.get(k)) for run in runs)] for k in keys]
    return Table(["Key", *(run.name for run in runs)], cells) if keys else None


def _figures(runs: Sequence[Run]) -> list[tuple[str, list[Picture]]]:
    files = {run.name: {p.name: p for p in sorted((run.directory / "figures").glob("*.png"))} for run in runs}
    return [
        (Path(name).stem.replace("_", " "), [Picture(file_uri(found[name]), name, run) for run, found in files.items() if name in found])
        for name in dict.fromkeys(n for found in files.values() for n in found)
    ]


def _log(run: Run) -> list[dict[str, Any]]:
    try:
        return read_log(run.directory / "log.jsonl")
    except CheckpointError:
        return []

"""One self-contained web page per run: the verdict first, then everything it rests on."""

from __future__ import annotations

import base64
import io
import math
import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, is_dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from torchrl_sspl.certification.rounding import down, up
from torchrl_sspl.envs.system import bounded
from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.files import write
from torchrl_sspl.viz.pages import Badge, Cell, Picture, Table, render

_NOT_MEASURED = "not measured"
_MIME = {
    ".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".gif": "image/gif", ".webp": "image/webp",
    ".svg": "image/svg+xml", ".mp4": "video/mp4", ".webm": "video/webm",
}  # fmt: skip
_ASSUMED = (
    "Camera, physics and starts stay as they were during the measurements; starts are drawn uniformly from the set that is named, "
    "and a grid counts as such a sample.",
    "The labels of S and U are right.",
    "Nothing is said about other cameras, other physics or states outside the state space.",
)


def format_value(value: Any, unit: str = "") -> str:
    """A number, bool, text or None for people, not escaped: four digits, "not measured" for None and NaN.

    ``unit``: "share" prints per cent, others are appended. Source: none.

    Example:
        >>> format_value(0.0012, "share"), format_value(float("nan")), format_value(1.98765, "m")
        ('0.12 %', 'not measured', '1.988 m')
    """
    if value is None:
        return _NOT_MEASURED
    if hasattr(value, "item") and getattr(value, "shape", None) in ((), None):
        value = value.item()
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, (int, float)):
        return str(value)
    if math.isnan(value):
        return _NOT_MEASURED
    if math.isinf(value):
        return "\u221e" if value > 0 else "\u2212\u221e"
    if unit == "share":
        return _number(100 * value) + " %"
    return _number(value) + (f" {unit}" if unit and unit not in ("ratio", "count") else "")


def _number(value: float) -> str:
    if isinstance(value, int):
        return f"{value:,}"
    if value and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.3g}"
    text = f"{value:.4g}"
    return f"{value:,.0f}" if "e" in text else text


def _plain(name: str, value: Any) -> dict[str, Any]:
    """A mapping or dataclass as a dictionary."""
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, Mapping):
        return dict(value)
    if hasattr(value, "__dict__"):
        return dict(vars(value))
    raise ConfigError(f"{name}: expected a mapping or a dataclass, received {type(value).__name__}.")


def _bound(m: Mapping[str, Any]) -> str:
    """The 95 % bound of a share, rounded outward: one-sided where nothing (or everything) happened, else the interval."""
    lower, upper, events, n = (m.get(k) for k in ("lower", "upper", "events", "n"))
    if lower is None or upper is None or any(isinstance(v, float) and math.isnan(v) for v in (lower, upper)):
        return "\u2013"
    low, high = down(100 * lower, 3), up(100 * upper, 3)
    if events == 0:
        return f"\u2264 {high} %"
    return f"\u2265 {low} %" if events is not None and events == n else f"{low} to {high} %"


def _count(value: Any) -> str:
    return "\u2013" if value is None else format_value(value)


def verdict_kind(verdict: str) -> str:
    """Class of a verdict: "good", "fair" (seen, not certain), "bad" or "none"."""
    text = str(verdict).strip().lower()
    if text.startswith(("aim", "must", "proved", "yes", "pass")):
        return "good"
    if text in _UNCERTAIN:
        return "fair"
    return "none" if not text or text.startswith("not measured") else "bad"


#: Verdicts on what no sample can prove, as nothing lies beyond the must.
SEEN = ("none seen", "all seen")
_UNCERTAIN = (*SEEN, "too few episodes")
#: Marks of the kinds of a verdict.
MARKS = {"good": "\u2713", "fair": "\u2248", "bad": "\u2717", "none": "?"}
_WORDS = {"aim": "aim reached", "must": "must reached"}


def badge(verdict: str) -> Badge:
    """A verdict ("aim", "must", "proved", "yes", "pass": good; see ``bounded``: fair; "not measured"; else bad) as a mark."""
    kind = verdict_kind(verdict)
    return Badge(kind, MARKS[kind], _WORDS.get(str(verdict).strip().lower(), str(verdict).strip() or _NOT_MEASURED))


def requirement_rows(requirements: Sequence[Any], evaluation: Any) -> list[tuple[str, Any, str, str, str]]:
    """Rows (label, measurement or None, must, aim, verdict) of the summary of ``write_report``.

    Requirements are such as :class:`~torchrl_sspl.envs.Requirement`; the evaluation has ``measurements`` by name.
    Source: none.

    Example:
        >>> from types import SimpleNamespace
        >>> from torchrl_sspl.envs import Requirement
        >>> requirement_rows([Requirement("a", "what", "<=", 0.1, 0.0)], SimpleNamespace(measurements={}))
        [('what', None, '≤ 10 %', '0 %', 'not measured')]
    """
    rows = []
    for r in requirements:
        m = evaluation.measurements.get(r.name)
        unit = getattr(m, "unit", "share" if r.must <= 1 and r.aim <= 1 else "")
        sign = {"<=": "\u2264", ">=": "\u2265"}[r.sense]
        # Nothing lies below no event at all, nothing above all of them.
        end = {"<=": 0.0, ">=": 1.0 if unit == "share" else math.inf}[r.sense]
        limits = [f"{'' if v == end else sign + ' '}{format_value(v, unit)}" for v in (r.must, r.aim)]
        rows.append((r.label, m, *limits, verdict_in(unit, bounded(r, r.verdict(evaluation), m))))
    return rows


def verdict_in(unit: str, verdict: str) -> str:
    """A verdict "missed by x", in per cent where its unit is "share"."""
    if unit != "share" or not verdict.startswith("missed by "):
        return verdict
    return f"missed by {format_value(float(verdict.removeprefix('missed by ')), unit)}"


def _summary(rows: Sequence[Sequence[Any]], measurements: Mapping[str, dict[str, Any]]) -> tuple[str, str, Table | None]:
    """Headline, its class, and the table with must and aim."""
    kinds: list[str] = []
    out: list[list[str | Cell]] = []
    for row in rows:
        if len(row) != 5:
            raise ShapeError(f"summary: expected rows (label, value, must, aim, verdict), received {len(row)} entries.")
        label, value, must, aim, verdict = row
        value, m = _resolve(label, value, measurements)
        shown = format_value(value, m.get("unit", ""))
        if shown == _NOT_MEASURED:
            verdict = _NOT_MEASURED
        kinds.append(verdict_kind(verdict))
        numbers = (_bound(m), _count(m.get("n")), format_value(must), format_value(aim))
        out.append([str(label), Cell(shown, "b"), *numbers, Cell(badge=badge(verdict))])
    aims, missed, unknown = (kinds.count(kind) for kind in ("good", "bad", "none"))
    fair = kinds.count("fair")
    reached, aims = aims, sum(str(row[4]).startswith("aim") for row, kind in zip(rows, kinds, strict=True) if kind == "good")
    if not rows:
        headline, kind = "No requirements were given", "none"
    elif missed:
        headline, kind = f"{missed} of {len(rows)} requirements missed", "bad"
    elif unknown:
        headline, kind = f"{reached} of {len(rows)} requirements reached, {unknown} not measured", "none"
    elif fair:
        headline, kind = f"{reached} of {len(rows)} requirements reached, {fair} seen but not certain", "fair"
    else:
        headline, kind = f"All requirements reached ({len(rows)} of {len(rows)})", "good"
    if reached:
        headline += f", {aims} at the aim" if not missed else f", {reached} reached"
    head = ("Requirement", "Measured", "95 % bound", "n", "Must", "Aim", "Verdict")
    return headline, kind, Table(head, out, "summary") if rows else None


def _data_uri(data: bytes, mime: str) -> str:
    return f"data:{mime};base64,{base64.b64encode(data).decode()}"


def file_uri(path: str | Path) -> str:
    """A picture or film as an address that holds it."""
    path = Path(path)
    mime = _MIME.get(path.suffix.lower())
    if mime is None or not path.is_file():
        raise ConfigError(
            f"figure or video: expected an existing file of type {', '.join(_MIME)}, received '{path}'; draw it first."
        )
    return _data_uri(path.read_bytes(), mime)


def film_picture(path: Path, caption: str) -> Picture:
    """A film; a picture beside it of the same name, ending in .jpg, is shown before it begins."""
    poster = path.with_suffix(".jpg")
    return Picture(file_uri(path), caption, caption, poster=file_uri(poster) if poster.is_file() else "")


def figure_picture(name: str, value: Any) -> Picture:
    """One figure: a matplotlib Figure (its label is the caption), a path, or a pair (either, caption)."""
    caption = ""
    if isinstance(value, tuple) and len(value) == 2:
        value, caption = value
    if hasattr(value, "savefig"):
        buffer = io.BytesIO()
        value.savefig(buffer, format="png", dpi=160)
        uri = _data_uri(buffer.getvalue(), "image/png")
        caption = caption or str(value.get_label() or "")
    elif isinstance(value, (str, Path)):
        uri = file_uri(value)
    else:
        raise ConfigError(
            f"figures[{name!r}]: expected a matplotlib Figure or a path, received {type(value).__name__}."
        )
    return Picture(uri, caption or name, caption, name)


def _flatten(config: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for key, value in config.items():
        name = f"{prefix}{key}"
        if is_dataclass(value) and not isinstance(value, type):
            value = asdict(value)
        rows += _flatten(value, f"{name}.") if isinstance(value, Mapping) and value else [(name, value)]
    return rows


def _measured_lines(rows: Sequence[Sequence[Any]], measurements: Mapping[str, dict[str, Any]]) -> list[tuple[str, str]]:
    """The measured side of the verdict: shares of the summary with n and bound, what was missed first."""
    order, lines = ("bad", "fair", "good", "none"), []
    for label, value, _, _, verdict in rows:
        _, m = _resolve(label, value, measurements)
        if m.get("n") and m.get("unit") == "share" and m.get("value") is not None:
            shown, bound = format_value(m["value"], "share"), _bound(m)
            lines.append((verdict_kind(verdict), f"{label}: {shown} of {m['n']:,}" + (f" (95 %: {bound})" if bound != "\u2013" else "")))
    return sorted(lines, key=lambda item: order.index(item[0]))


def _resolve(label: str, value: Any, measurements: Mapping[str, dict[str, Any]]) -> tuple[Any, Mapping[str, Any]]:
    """Value of a row of the summary, and the measurement behind it where there is one."""
    if value is None or isinstance(value, (int, float, str)) or hasattr(value, "item"):
        return value, measurements.get(label, {})
    m = _plain("summary", value)
    return m.get("value"), m


def _sizes(checks: Sequence[Any]) -> Table:
    rows = [_plain("checks", c) for c in checks]
    names = list(dict.fromkeys(k for row in rows for k in row))
    share = ("size", "returned")
    cells = [[format_value(r.get(k), "share" if k in share else "") for k in names] for r in rows]
    return Table([n.replace("_", " ") for n in names], cells)


def write_report(
    path: str | Path,
    *,
    title: str,
    summary: Sequence[Sequence[Any]] = (),
    measurements: Mapping[str, Any] | None = None,
    figures: Mapping[str, Any] | None = None,
    config: Mapping[str, Any] | None = None,
    checks: Sequence[Any] = (),
    certificate: str | None = None,
    video: str | Path | None = None,
    video_caption: str = "One episode: what the agent sees, the true state, and the barrier value.",
    notes: str = "",
    headline: tuple[str, str, str] | None = None,
    measured: Sequence[str | tuple[str, str]] = (),
    proved: Sequence[str | tuple[str, str]] = (),
    assumed: Sequence[str] | None = None,
    kernel: bool = False,
) -> Path:
    """Write a run's report: one HTML file without scripts or outside resources, for desk and phone, light and dark.

    The page begins with the verdict: what is proved, what is measured (with n and a 95 % bound), what is assumed.

    Args:
        path: file to write; its folder is created.
        title: what was trained.
        summary: rows (label, value, must, aim, verdict), see ``requirement_rows``. A value is a number, or a
            measurement with ``value``, ``unit``, ``n``, ``events``, ``lower`` and ``upper``; a verdict starts with
            "aim", "must", "missed" or "not measured", or is "none seen", "all seen" or "too few episodes".
        measurements: every measurement by name: mapping or dataclass as above, and with ``note``.
        figures: by name: a matplotlib Figure (its label is the caption), the path of a picture, or (either, caption).
        config: everything that determined the run, nested; its ``seed`` is named at the top.
        checks: held-out checks, one mapping or dataclass per round.
        certificate: section made by :func:`~torchrl_sspl.viz.certificate.certificate_section`.
        video, video_caption: mp4, webm or gif file, and what it shows; a picture beside it, of the same name with the ending .jpg, is
            shown before it begins.
        notes: text, in paragraphs separated by empty lines.
        headline: verdict, its kind ("good", "fair", "bad" or "none") and what has to be added; default: how many rows of the
            summary are reached.
        measured: what was measured, as sentences or (kind, sentence); default: the shares of the summary.
        proved: statements that are proved, likewise; those that are refuted too, as ("bad", sentence). Never derived from
            the measurements: pass what a proof has returned.
        assumed: what both rest on; default: what holds for every sampled figure.
        kernel: whether the true kernel is known, and explained beside S, U and B.

    Returns the file. Raises ShapeError if a row of the summary has not five entries; ConfigError for a figure, video,
    measurement or check that is not what was expected. Source: none.

    Example:
        >>> page = write_report("report.html", title="Demo", summary=[("a", 0.0, "0", "0", "aim")])
        >>> "All requirements reached (1 of 1)" in page.read_text()
        True
    """
    data = {name: _plain(f"measurements[{name!r}]", m) for name, m in (measurements or {}).items()}
    config = dict(config or {})
    first, kind, requirements = _summary(summary, data)
    more = ""
    if headline is not None:
        first, kind, more = headline
    lists = (proved, measured or _measured_lines(summary, data), _ASSUMED if assumed is None else assumed)
    page = render(
        "report.html", title=title, facts=" / ".join(_facts(config)), headline=first, kind=kind, mark=MARKS[kind], more=more,
        columns=_columns(lists), kernel=kernel, film=None if video is None else film_picture(Path(video), video_caption),
        requirements=requirements, certificate=certificate or "", notes=_paragraphs(notes),
        figures=[figure_picture(n, f) for n, f in (figures or {}).items()], checks=_sizes(checks) if checks else None,
        measurements=_measurements(data) if data else None, configuration=_configuration(config) if config else None,
    )  # fmt: skip
    return write(path, page)


def _columns(lists: Sequence[Sequence[str | tuple[str, str]]]) -> list[tuple[str, list[Badge]]]:
    """What is proved, measured and assumed."""
    empty = ("Nothing is claimed as proved.", "No share with a confidence bound.", "Nothing stated.")
    columns = zip(("Proved", "Measured", "Assumed"), lists, empty, strict=True)
    return [(name, [item(i) for i in items or [none]]) for name, items, none in columns]


def item(given: str | tuple[str, str]) -> Badge:
    """A sentence, with the mark of its kind where it has one."""
    kind, text = ("none", given) if isinstance(given, str) else given
    return Badge(kind, "" if kind == "none" else MARKS[kind], str(text))


def _facts(config: Mapping[str, Any]) -> list[str]:
    """What the run was made with, for the line under the title."""
    chosen = [f"{key} {config[key]}" for key in ("seed", "preset") if key in config]
    versions = [f"torchrl_sspl {_version('torchrl-sspl')}", f"torch {_version('torch')}"]
    return [*chosen, *versions, f"Python {platform.python_version()}"]


def _paragraphs(notes: str) -> list[str]:
    return [p.strip() for p in re.split(r"\n\s*\n", notes) if p.strip()]


def _measurements(data: Mapping[str, dict[str, Any]]) -> Table:
    """Every measurement with its bound, size and how it was made."""
    rows: list[list[str | Cell]] = [
        [Cell(name, "code"), format_value(m.get("value"), m.get("unit", "")), _bound(m), _count(m.get("n")), str(m.get("note", ""))]
        for name, m in data.items()
    ]
    return Table(("Measurement", "Value", "95 % bound", "n", "How"), rows)


def _configuration(config: Mapping[str, Any]) -> Table:
    return Table(("Key", "Value"), [[Cell(k, "code"), str(v)] for k, v in _flatten(config)])


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"

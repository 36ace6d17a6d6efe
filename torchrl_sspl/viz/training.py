"""A training on a page while it runs: phase, time left, losses, volume kept so far, and the checks of every round."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from torchrl_sspl.configs.schema import SynthesisConfig
from torchrl_sspl.errors import CheckpointError
from torchrl_sspl.modules.agent import agent_directory
from torchrl_sspl.runtime.monitor import FILE as CALIBRATION_FILE
from torchrl_sspl.trainers.phases import LOG_FILE
from torchrl_sspl.trainers.progress import PROGRESS_FILE, WORDS, round_line, spoken
from torchrl_sspl.viz.curves import panels, read_log
from torchrl_sspl.viz.pages import Badge, render
from torchrl_sspl.viz.report import format_value, item
from torchrl_sspl.viz.server import Feed, served

_EVERY = 1.0  # seconds between looks at the directory
_SILENT = 60.0  # seconds without a sign after which that is said
_FILES = (LOG_FILE, PROGRESS_FILE, "metrics.json")


def training_directory(name: str | Path) -> Path | None:
    """The directory of a run, where it is its training that is to be seen: it goes on, or no agent in it is calibrated.

    None for anything else. Raises CheckpointError for a directory with neither an agent nor a log. Source: none.
    """
    path = Path(name)
    begun, logged = (path / PROGRESS_FILE).is_file(), (path / LOG_FILE).is_file()
    if begun:
        return path
    try:
        calibrated = (agent_directory(name) / CALIBRATION_FILE).is_file()
    except CheckpointError:
        if path.is_dir() and not logged:
            raise CheckpointError(
                f"expected a run directory with an agent to see at work, or with a {LOG_FILE} of its training, received '{name}', which "
                "has neither; train one with `sspl train`"
            ) from None
        if not logged:
            raise
        return path
    return path if logged and not calibrated else None


def watch_training(
    directory: Path, *, host: str = "127.0.0.1", port: int = 8000, changes: int | None = None, ready: Callable[[str], Any] = print
) -> dict[str, int]:
    """Serves a page on a training, which shows what is new within a second, until so many changes were shown or it is interrupted.

    Args:
        directory: of the run.
        host, port: where the page is served; port 0: any that is free.
        changes: after so many it ends; None: it goes on.
        ready: called with the page's address.

    Returns how many ``changes`` were shown, and how many ``rounds`` have been checked. Raises ConfigError for a port that is taken;
    CheckpointError for a log that cannot be read. Source: none.
    """
    feed, seen, count = Feed(kept=1), None, 0
    found = read_training(directory)

    def page() -> str:
        return render("training.html", title=directory.resolve().name, facts=f"training, {directory}", **read_training(directory))

    with suppress(KeyboardInterrupt), served(host, port, feed, page) as address:
        ready(address)
        while changes is None or count < changes:
            stamp = _stamp(directory)
            if stamp != seen:
                seen, found, count = stamp, read_training(directory), count + 1
                feed.publish({"html": render("training_now.html", **found)})
            time.sleep(_EVERY)
    return {"changes": count, "rounds": len(found["checks"])}


def _stamp(directory: Path) -> list[Any]:
    """What is different when there is something new to show."""
    stamp: list[Any] = []
    for name in _FILES:
        with suppress(OSError):
            found = (directory / name).stat()
            stamp += [name, found.st_mtime_ns, found.st_size, (time.time() - found.st_mtime) // _SILENT]
    return stamp


def read_training(directory: Path) -> dict[str, Any]:
    """What the files of a training say, for its page. Source: none.

    Example:
        >>> from torchrl_sspl.files import append
        >>> append("runs/a/log.jsonl", '{"phase": "fit", "round": 0, "step": 100, "loss_safe": 0.25}')
        >>> found = read_training(Path("runs/a"))
        >>> found["headline"], found["numbers"]
        ('Not running', [('Last step', '100'), ('Loss', '0.25'), ('Safe set kept so far', 'none yet')])
    """
    log = read_log(directory / LOG_FILE) if (directory / LOG_FILE).is_file() else []
    now, metrics, config = (_json(directory / name) for name in (PROGRESS_FILE, "metrics.json", "config.json"))
    checks = [row for row in log if row["phase"] == "check"]
    losses = [row for row in log if any(k.startswith("loss") for k in row)]
    kept = [row["size"] for row in checks if row.get("passed")]
    numbers = [("Steps", f"{now['done']:,} of {now['total']:,}")] if now else []
    if losses:
        loss = sum(v for k, v in losses[-1].items() if k.startswith("loss"))
        numbers += [] if now else [("Last step", f"{losses[-1]['step']:,}")]
        numbers.append(("Loss", f"{loss:.3g}"))
    numbers.append(("Safe set kept so far", f"{format_value(max(kept), 'share')} of the space outside U" if kept else "none yet"))
    numbers += [("Time left", now["left"] or "not known yet")] if now else []
    headline, kind, more = _state(directory, now, metrics, log)
    episodes = config.get("synthesis", {}).get("check_episodes", SynthesisConfig().check_episodes)
    return {
        "headline": headline, "kind": kind, "more": more, "numbers": numbers,
        "checks": [_check(row, episodes) for row in reversed(checks)],
        "phases": [(_words(phase), panels({"": rows})) for phase, rows in _phases(losses)],
    }  # fmt: skip


def _state(directory: Path, now: dict[str, Any], metrics: dict[str, Any], log: list[dict[str, Any]]) -> tuple[str, str, str]:
    """Headline, its kind, and what has to be added."""
    if now:
        phase = now["phase"][:1].upper() + now["phase"][1:]
        with suppress(OSError):
            silent = time.time() - (directory / PROGRESS_FILE).stat().st_mtime
            if silent >= _SILENT:
                return phase, "fair", f"No update for {spoken(silent)}: a phase without steps is running, or it was killed."
        return phase, "none", ""
    if "measurements" in metrics:
        return "Trained and evaluated", "good", f"{metrics.get('stop_reason') or 'All phases are done'}. The result is in report.html."
    if (directory / "agent").is_dir():
        return "Trained", "none", "The evaluation is not finished yet."
    last = f"The last line of its log is of {_words(log[-1]['phase'])}, round {log[-1]['round'] + 1}. " if log else ""
    return "Not running", "fair", last + "Run the same command again to resume from the last checkpoint."


def _check(row: dict[str, Any], episodes: int) -> Badge:
    """Held-out checks of a round as a sentence, with its mark."""
    default = {"left": 0, "touched": 0, "returned": 0.0, "size": 0.0, "covered": 0.0, "passed": False, "reason": "the log does not say"}
    return item(("good" if row.get("passed") else "bad", round_line(SimpleNamespace(**default | row), episodes)))


def _phases(losses: list[dict[str, Any]]) -> list[tuple[str, list[dict[str, Any]]]]:
    """Rows by phase, the phase of the newest row first."""
    newest = dict.fromkeys(row["phase"] for row in reversed(losses))
    return [(phase, [row for row in losses if row["phase"] == phase]) for phase in newest]


def _words(phase: str) -> str:
    return {"joint": "joint training", **WORDS}.get(phase, phase)


def _json(path: Path) -> dict[str, Any]:
    """What a file holds; nothing where there is none, or it cannot be read."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


__all__ = ["read_training", "training_directory", "watch_training"]

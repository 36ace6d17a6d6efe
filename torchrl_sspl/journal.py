"""Results that take long, kept in files until what they belong to is done: an interruption costs seconds of them."""

from __future__ import annotations

import hashlib
import io
import pickle
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_sspl.files import write
from torchrl_sspl.interrupts import end_if_pending, pending

FOLDER = "unfinished"
_EVERY = 20.0  # seconds between two writings of what is not complete
_SHORT = 1.0  # seconds up to which nothing is worth a file


@dataclass
class _Journal:
    folder: Path
    beat: Callable[[], None]
    entries: int = 0  # that were asked for: their order is the same when it is done again


_journal: ContextVar[_Journal | None] = ContextVar("journal", default=None)


@contextmanager
def journal(directory: Path | None, name: str, *about: Any, beat: Callable[[], None] | None = None) -> Iterator[None]:
    """Inside, an :class:`Entry` keeps what was computed; after an interruption the same computation takes it from there.

    Args:
        directory: of the run, of which the folder ``unfinished`` is used, and removed when the outermost journal ends in good order;
            None: nothing is kept, unless in a journal around this one, whose directory counts.
        name: of the part of the run.
        about: what the results depend on (tensors, and what prints the same in every process), beside what the journal around depends
            on; of anything else they are not taken.
        beat: called with every piece of what is computed, so that somebody sees that it goes on; that of the journal around if not given.

    Source: none.

    Example:
        >>> with journal(Path("runs/try"), "sums", 3):
        ...     Entry("first").save(torch.ones(2), complete=True)
        ...     Entry("second").saved()
        >>> Path("runs/try/unfinished").exists()
        False
    """
    around = _journal.get()
    # Inside of the folder around it: what that depends on counts here, too.
    root = around.folder if around is not None else None if directory is None else directory / FOLDER
    if root is None:
        yield
        return
    folder = root / f"{name}-{_digest(about)}"
    for old in root.glob(f"{name}-*"):  # of other weights, or other settings
        if old != folder:
            shutil.rmtree(old, ignore_errors=True)
    token = _journal.set(_Journal(folder, beat or (around.beat if around is not None else _silent)))
    try:
        yield
    finally:
        _journal.reset(token)
    if around is None:
        shutil.rmtree(root, ignore_errors=True)


def _silent() -> None:
    """Nobody listens."""


class Entry:
    """The next result of the open journal; without one it keeps nothing.

    Args:
        about: what tells this result from others, as in :func:`journal`.

    Source: none.

    Example:
        >>> entry = Entry("sum", 3)
        >>> entry.saved() is None
        True
    """

    def __init__(self, *about: Any) -> None:
        self._began = self._written = time.monotonic()
        self._path: Path | None = None
        self._beat = _silent
        opened = _journal.get()
        if opened is not None:
            self._beat = opened.beat
            self._beat()
            opened.entries += 1
            self._path = opened.folder / f"{opened.entries:05d}-{_digest(about)}.pt"

    def saved(self) -> Any:
        """What was saved last, complete or not; None where there is nothing that can be read."""
        if self._path is None or not self._path.is_file():
            return None
        with suppress(OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError):  # of a machine that went down
            return torch.load(self._path, weights_only=True)
        return None

    @property
    def open(self) -> bool:
        """Whether there is a journal that keeps what is saved."""
        return self._path is not None

    @property
    def due(self) -> bool:
        """Whether it is time to save what is not complete, or somebody waits for that; asked with every piece of it."""
        self._beat()
        return self._path is not None and (pending() or time.monotonic() - self._written >= _EVERY)

    def save(self, value: Any, *, complete: bool = False) -> None:
        """Keeps tensors, numbers, texts, and lists and dictionaries of these, unless they are complete and took no time."""
        if self._path is None or (complete and time.monotonic() - self._began < _SHORT):
            return
        content = io.BytesIO()
        torch.save(value, content)
        write(self._path, content.getvalue())
        self._written = time.monotonic()
        end_if_pending()


def kept(compute: Callable[[], Any], *about: Any) -> Any:
    """What is computed; from the open journal where that has it.

    Args:
        compute: gives tensors, numbers, texts, or lists and dictionaries of these.
        about: as in :class:`Entry`.

    Source: none.

    Example:
        >>> kept(lambda: torch.ones(2), "ones")
        tensor([1., 1.])
    """
    entry = Entry(*about)
    found = entry.saved()
    if found is None:
        found = compute()
        entry.save(found, complete=True)
    return found


def kept_parts(compute: Callable[[Any], Any], parts: Iterable[Any], *about: Any) -> list[Any]:
    """What is computed of parts, one after the other; as many as the open journal has from there.

    Args:
        compute: of a part, as in :func:`kept`.
        parts: in an order that stays the same.
        about: as in :class:`Entry`.

    Source: none.

    Example:
        >>> kept_parts(lambda k: 2 * k, range(3), "doubled")
        [0, 2, 4]
    """
    entry = Entry(*about)
    found = entry.saved() or []
    for part in islice(parts, len(found), None):
        found.append(compute(part))
        if entry.due:
            entry.save(found)
    entry.save(found, complete=True)
    return found


def _digest(about: Any) -> str:
    """Digits that are the same for the same values."""
    found = hashlib.sha256()

    def add(value: Any) -> None:
        if isinstance(value, Tensor):
            plain = value.detach().cpu().contiguous()
            found.update(f"{plain.dtype}{tuple(plain.shape)}".encode() + plain.reshape(-1).view(torch.uint8).numpy().tobytes())
        elif isinstance(value, (list, tuple)):
            found.update(f"[{len(value)}".encode())
            for part in value:
                add(part)
        else:
            found.update(f"{value!r};".encode())

    add(about)
    return found.hexdigest()[:16]


__all__ = ["FOLDER", "Entry", "journal", "kept", "kept_parts"]

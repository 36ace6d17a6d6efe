"""What a run writes: each file in one step, in a directory that no other run writes to."""

from __future__ import annotations

import json
import os
import shutil
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from torchrl_sspl.errors import OutputError

LOCK_FILE = ".lock"
OWNER_FILE = ".owner.json"


def write(path: str | Path, content: str | bytes) -> Path:
    """Write a file, or replace it in one step: whoever reads it sees all of the old or all of the new one.

    The directory is made if there is none. Raises OutputError if that cannot be done; the old file is still there then.
    Source: none.

    Example:
        >>> write("a.txt", "new").read_text()
        'new'
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(content.encode() if isinstance(content, str) else content)
        return part.replace(path)
    except OSError as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise OutputError(f"expected to write '{path}', received {_reason(error)}; {path.name} is as it was before") from error


def append(path: str | Path, line: str) -> None:
    """Add a line to a file, which is made if there is none; raises OutputError if that cannot be done. Source: none.

    Example:
        >>> append("log.txt", "begun")
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as file:
            file.write(line + "\n")
    except OSError as error:
        raise OutputError(f"expected to add to '{path}', received {_reason(error)}; make room or repair it") from error


class RunDirectory:
    """The directory of a run: made, tried, and held by one process at a time.

    A lock of the operating system is held, which ends with the process however that ends. Source: none.

    Args:
        path: the directory.
        needs: bytes that the run is going to write there.

    Raises OutputError if it cannot be made or written to, has too little room, or another process holds it.

    Example:
        >>> with RunDirectory("runs/try").held() as path:
        ...     path.is_dir()
        True
    """

    def __init__(self, path: str | Path, needs: int = 0) -> None:
        self.path = Path(path)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            probe = self.path / f".probe.{os.getpid()}"
            probe.write_bytes(b"0")
            probe.unlink()
            free = shutil.disk_usage(self.path).free
        except OSError as error:
            raise OutputError(
                f"expected a directory to write to, received out_dir='{path}': {_reason(error)}; choose another out_dir"
            ) from error
        if free < needs:
            raise OutputError(
                f"expected {needs / 1e9:.1f} GB of free disk for the checkpoints in '{path}', found {free / 1e9:.1f} GB; make room, "
                "choose another out_dir, or lower trainer.keep_checkpoints"
            )
        self._lock = FileLock(self.path / LOCK_FILE)
        with self.held():
            pass

    @contextmanager
    def held(self) -> Iterator[Path]:
        """Holds the directory meanwhile; inside of itself it does nothing more."""
        owner = self.path / OWNER_FILE
        try:
            self._lock.acquire(timeout=0)
        except Timeout:
            raise OutputError(
                f"expected a directory that no other run writes to, received out_dir='{self.path}', where {_owner(owner)}; wait for "
                "its end, or choose another out_dir"
            ) from None
        try:
            now = time.strftime("%Y-%m-%d %H:%M:%S")
            write(owner, json.dumps({"process": os.getpid(), "machine": socket.gethostname(), "since": now}) + "\n")
            yield self.path
        finally:
            if self._lock.lock_counter == 1:
                owner.unlink(missing_ok=True)
            self._lock.release()


def _owner(path: Path) -> str:
    try:
        who = json.loads(path.read_text())
        return f"process {who['process']} on {who['machine']} has been writing since {who['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process is writing"


def _reason(error: OSError) -> str:
    return error.strerror or type(error).__name__


__all__ = ["RunDirectory", "append", "write"]

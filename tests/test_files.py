"""What a run writes: each file in one step, in a directory that is its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from torchrl_sspl import files
from torchrl_sspl.errors import OutputError
from torchrl_sspl.files import RunDirectory, append, write


def test_a_file_that_cannot_be_written_to_the_end_leaves_the_old_one(tmp_path, monkeypatch):
    path = write(tmp_path / "a.json", "old")

    def full(self, data):
        with self.open("wb") as file:
            file.write(data[:1])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OutputError, match="No space left on device"):
        write(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_lines_are_added_and_a_file_that_takes_none_is_named(tmp_path):
    for line in ("one", "two"):
        append(tmp_path / "new" / "log.jsonl", line)
    assert (tmp_path / "new" / "log.jsonl").read_text() == "one\ntwo\n"
    with pytest.raises(OutputError, match=r"expected to add to '.*new', received"):
        append(tmp_path / "new", "three")


def test_a_directory_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "runs").write_text("a file")
    with pytest.raises(OutputError, match=r"expected to write '.*runs/one/a.json'"):
        write(tmp_path / "runs" / "one" / "a.json", "")
    with pytest.raises(OutputError, match=r"out_dir=.*runs/one.*choose another out_dir"):
        RunDirectory(tmp_path / "runs" / "one")


def test_too_little_room_is_said_before_anything_is_computed(tmp_path, monkeypatch):
    class Usage:
        free = 10**9

    monkeypatch.setattr(files.shutil, "disk_usage", lambda path: Usage)
    RunDirectory(tmp_path, needs=10**9)
    with pytest.raises(OutputError, match=r"expected 2\.0 GB of free disk.*found 1\.0 GB"):
        RunDirectory(tmp_path, needs=2 * 10**9)


HOLDER = """
import sys, time
from torchrl_sspl.files import RunDirectory
with RunDirectory(sys.argv[1]).held():
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_second_process_is_refused_with_the_first_ones_and_a_killed_one_leaves_no_lock(tmp_path):
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path)], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(OutputError, match=rf"process {holder.pid} on .* since \d{{4}}-"):
            RunDirectory(tmp_path)
        assert json.loads((tmp_path / files.OWNER_FILE).read_text())["process"] == holder.pid
        holder.kill()
        holder.wait()
    with RunDirectory(tmp_path).held():
        assert json.loads((tmp_path / files.OWNER_FILE).read_text())["process"] == os.getpid()
    assert not (tmp_path / files.OWNER_FILE).exists()


def test_held_inside_of_itself_it_is_held_until_the_outer_one_ends(tmp_path):
    directory = RunDirectory(tmp_path)
    with directory.held():
        with directory.held():
            pass
        code = f"from torchrl_sspl.files import RunDirectory; RunDirectory({str(tmp_path)!r})"
        out = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=60)
        assert "OutputError" in out.stderr

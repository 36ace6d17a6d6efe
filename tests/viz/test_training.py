"""A training on a page while it runs: what is served, what a new line of the log changes, and what the folder decides."""

from __future__ import annotations

import json
import os
import re
import shutil
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.request import urlopen

import pytest

from torchrl_sspl import cli
from torchrl_sspl.errors import CheckpointError, ConfigError
from torchrl_sspl.files import append, write
from torchrl_sspl.modules.agent import agent_directory, load
from torchrl_sspl.runtime.monitor import FILE as CALIBRATION_FILE
from torchrl_sspl.viz import training
from torchrl_sspl.viz.live import watch
from torchrl_sspl.viz.training import read_training, training_directory

FIT = {"phase": "fit", "round": 0, "step": 100, "loss_safe": 0.25, "loss_unsafe": 0.5}
CHECK = {
    "phase": "check", "round": 0, "step": 0, "level": 0.0, "unsafe_inside": 0, "safe_outside": 0, "left": 2, "touched": 0, "returned": 0.98,
    "size": 0.62, "passed": True, "reason": "", "tolerated": 0.0, "covered": 0.0,
}  # fmt: skip
SENTENCE = "round 1: the safe set covers 62 % of the space outside U; of up to 10 held-out episodes 2 left it, 0 entered U"


def begun(folder: Path, *rows: dict[str, Any], left: str = "4 min left in this phase, then 3 more") -> Path:
    """The folder of a training that goes on."""
    write(folder / "config.json", json.dumps({"synthesis": {"check_episodes": 10}}))
    write(folder / "progress.json", json.dumps({"phase": "round 1 of 2: fitting", "done": 4200, "total": 9100, "left": left}))
    for row in rows:
        append(folder / "log.jsonl", json.dumps(row))
    return folder


def text_of(html: str) -> str:
    return " ".join(re.sub(r"<[^>]*>", " ", html).split())


def test_what_is_shown_changes_when_the_log_grows(tmp_path, monkeypatch):
    looks = iter(range(400))

    def sleep(seconds: float) -> None:
        if next(looks, None) is None:
            raise KeyboardInterrupt  # nothing new is ever seen
        time.sleep(0.05)

    monkeypatch.setattr(training, "time", SimpleNamespace(time=time.time, sleep=sleep))
    folder = begun(tmp_path / "run", FIT)
    pages: list[str] = []
    told: list[dict[str, str]] = []
    readers: list[threading.Thread] = []

    def read(stream: Any) -> None:
        for line in stream:
            if line.startswith(b"data: "):
                told.append(json.loads(line[6:]))
                if len(told) == 1:  # only after the first was seen
                    append(folder / "log.jsonl", json.dumps(CHECK))

    def ready(address: str) -> None:
        with urlopen(address) as answer:
            assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
            pages.append(answer.read().decode())
        readers.append(threading.Thread(target=read, args=(urlopen(f"{address}events"),)))
        readers[0].start()

    counts = watch(str(folder), port=0, steps=2, ready=ready)
    readers[0].join(20)
    assert counts == {"changes": 2, "rounds": 1}
    assert told.pop() == {}  # the end is told
    page = text_of(pages[0])
    assert "<title>sspl watch: run</title>" in pages[0]
    assert not re.search(r"(src|href)=\"(?!data:)|https?://|@import", pages[0])  # nothing from elsewhere
    for words in ("Round 1 of 2: fitting", "4,200 of 9,100", "Loss 0.75", "none yet", "4 min left in this phase, then 3 more", "fit: unsafe"):
        assert words in page, words
    first, second = (text_of(event["html"]) for event in told)
    assert "None yet" in first
    assert SENTENCE not in first
    assert SENTENCE in second
    assert "62 % of the space outside U" in second.split("Held-out")[0]


def test_every_check_is_a_sentence_the_newest_first_and_only_what_passed_is_kept(tmp_path):
    failed = CHECK | {"round": 1, "size": 0.9, "passed": False, "reason": "left 7"}
    old = {k: v for k, v in failed.items() if k != "reason"} | {"round": 2}
    found = read_training(begun(tmp_path, FIT, CHECK, failed, old))
    assert [c.kind for c in found["checks"]] == ["bad", "bad", "good"]
    assert found["checks"][0].text.endswith("not kept, because of: the log does not say")
    assert found["checks"][1].text.endswith("not kept, because of: left 7")
    assert found["checks"][2].text.startswith(SENTENCE)
    assert dict(found["numbers"])["Safe set kept so far"] == "62 % of the space outside U"


def test_the_newest_phase_comes_first_with_its_losses(tmp_path):
    tune = {"phase": "tune", "round": 0, "step": 100, "loss_target": 0.1}
    found = read_training(begun(tmp_path, FIT, tune, FIT | {"step": 200}))
    assert [name for name, _ in found["phases"]] == ["fitting safe set and policy", "tuning both on the condition"]
    assert [p.title for p in found["phases"][0][1]] == ["fit: safe", "fit: unsafe"]
    assert found["phases"][0][1][0].end == "200"


def test_a_training_that_gives_no_sign_has_stopped_or_has_ended_says_so(tmp_path):
    folder = begun(tmp_path, FIT)
    assert read_training(folder)["kind"] == "none"
    then = time.time() - 200
    os.utime(folder / "progress.json", (then, then))
    assert read_training(folder)["more"].startswith("No update for 4 min")
    (folder / "progress.json").unlink()
    stopped = read_training(folder)
    assert (stopped["headline"], stopped["kind"]) == ("Not running", "fair")
    assert "of fitting safe set and policy, round 1" in stopped["more"]
    (folder / "agent").mkdir()
    assert read_training(folder)["headline"] == "Trained"
    write(folder / "metrics.json", json.dumps({"measurements": {}, "stop_reason": "round 0 is best"}))
    assert read_training(folder)["more"] == "round 0 is best. The result is in report.html."


def test_nothing_in_a_log_becomes_markup(tmp_path):
    folder = begun(tmp_path, FIT | {"phase": "<script>", "loss_<b>": 1.0}, left="<i>")
    page = training.render("training_now.html", **read_training(folder))
    assert "&lt;script&gt;" in page
    assert not re.search("<(script|b|i)>", page)


def test_the_folder_decides_what_is_watched(tmp_path):
    assert training_directory("pendulum") is None  # shipped, with a calibration
    folder = begun(tmp_path, FIT)
    assert training_directory(folder) == folder
    load("pendulum").save(folder / "agent")
    (folder / "progress.json").unlink()
    assert training_directory(folder) == folder  # the agent is not calibrated
    shutil.copy(agent_directory("pendulum") / CALIBRATION_FILE, folder / "agent")
    assert training_directory(folder) is None
    assert training_directory(begun(folder)) == folder  # trained again


def test_a_folder_without_a_log_is_refused(tmp_path, capsys):
    with pytest.raises(CheckpointError, match=r"with a log\.jsonl of its training"):
        watch(str(tmp_path), port=0, steps=1)
    with pytest.raises(CheckpointError, match="name of a shipped agent"):
        watch(str(tmp_path / "nowhere"), port=0, steps=1)
    assert cli.main(["watch", str(tmp_path)]) == 2
    assert "CheckpointError" in capsys.readouterr().err


def test_what_a_training_cannot_do_is_refused(tmp_path):
    folder = str(begun(tmp_path, FIT))
    for options in ({"protect": True}, {"policy": "random"}, {"env": "pendulum"}):
        with pytest.raises(ConfigError, match="with a training"):
            watch(folder, port=0, steps=1, **options)
    append(tmp_path / "log.jsonl", "no JSON")
    append(tmp_path / "log.jsonl", "{}")
    with pytest.raises(CheckpointError, match="line 2"):
        watch(folder, port=0, steps=1)


def test_the_command_shows_a_training(tmp_path, capsys):
    assert cli.main(["watch", str(begun(tmp_path, FIT, CHECK)), "--port", "0", "--steps", "1"]) == 0
    shown = capsys.readouterr().out
    assert re.match(r"http://127\.0\.0\.1:\d+/", shown)
    assert "changes 1  rounds 1" in shown

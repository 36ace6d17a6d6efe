"""The live view: what is served, what is told at every step, the film of it, and how it ends."""

from __future__ import annotations

import json
import math
import re
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
import torch

from torchrl_sspl import cli
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import CheckpointError, ConfigError
from torchrl_sspl.modules.agent import load
from torchrl_sspl.runtime import Monitor
from torchrl_sspl.viz import live
from torchrl_sspl.viz.live import watch
from torchrl_sspl.viz.server import Feed

ffmpeg = pytest.importorskip("imageio_ffmpeg")


def seen(name: str = "pendulum", **options: Any) -> tuple[str, list[dict], dict[str, int]]:
    """The page, the events that a browser receives, and what is counted."""
    page: list[str] = []
    events: list[dict] = []
    readers: list[threading.Thread] = []

    def read(stream: Any) -> None:
        for line in stream:
            if line.startswith(b"data: "):
                events.append(json.loads(line[6:]))

    def ready(address: str) -> None:
        with urlopen(address) as answer:
            assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
            page.append(answer.read().decode())
        readers.append(threading.Thread(target=read, args=(urlopen(f"{address}events"),)))
        readers[0].start()

    counts = watch(name, **{"port": 0, "steps": 20, "fps": math.inf, "ready": ready} | options)
    readers[0].join(20)
    assert not readers[0].is_alive()
    assert events.pop() == {}  # the end is told
    return page[0], events, counts


def film(path: Path, frames: list[np.ndarray]) -> Path:
    """Frames ``(H, W, 3)`` uint8 as an MP4."""
    writer = ffmpeg.write_frames(str(path), (frames[0].shape[1], frames[0].shape[0]), fps=10, macro_block_size=2)
    writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(frame))
    writer.close()
    return path


def test_a_page_is_served_and_every_step_arrives_with_its_number():
    page, events, counts = seen()
    assert "<title>sspl watch: pendulum</title>" in page
    assert not re.search(r"(src|href)=\"(?!data:)|https?://|@import", page)  # nothing from elsewhere
    assert [e["step"] for e in events] == list(range(1, 21))
    assert counts == {"steps": 20, "interventions": 0, "alarms": 0, "entered": 0}
    for event in events:
        assert event["verdict"] == "PROOF_APPLIES"
        found = re.match(r"B = ([+-]\d\.\d{3}) <= 0; ", event["why"])
        assert float(found[1]) == pytest.approx(event["barrier"], abs=5.1e-4)  # both are rounded, to three digits and to five
        assert event["taken"] == event["wanted"]
    assert events[-1]["picture"].startswith("data:image/png;base64,")


@pytest.mark.slow
def test_random_actions_enter_u_and_behind_the_filter_they_do_not():
    _, bare, counts = seen(policy="random", steps=80)
    assert counts["entered"] > 0
    assert not any(e["intervened"] or e["protected"] for e in bare)
    _, kept, counts = seen(policy="random", steps=80, protect=True)
    assert counts["entered"] == 0
    assert counts["interventions"] == sum(e["intervened"] for e in kept) > 0
    assert all((e["taken"] != e["wanted"]) == e["intervened"] for e in kept)
    assert {e["verdict"] for e in bare} >= {"OUTSIDE"}


def test_episodes_end_and_begin_again():
    _, events, _ = seen(steps=205)
    assert [e["step"] for e in events if e["begins"]] == [1, 201]
    assert events[-1]["episode"] == 2


def test_a_film_is_written_with_one_picture_per_step(tmp_path):
    seen(record=tmp_path / "new" / "a.mp4", steps=7, protect=True)
    assert ffmpeg.count_frames_and_secs(str(tmp_path / "new" / "a.mp4"))[0] == 7


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # imageio-ffmpeg leaves its pipes to the collector
def test_a_film_is_watched_and_a_black_one_is_an_alarm_with_its_number(tmp_path):
    frame = PendulumEnv(batch_size=[1], seed=0).draw(torch.tensor([[0.05, 0.0]]))[0].permute(1, 2, 0).numpy()
    wide = np.pad(np.kron(frame, np.ones((2, 2, 1), np.uint8)), ((0, 0), (32, 32), (0, 0)), constant_values=255)
    _, events, counts = seen(video=film(tmp_path / "still.mp4", [wide] * 6), steps=None)
    assert counts["steps"] == 5  # pairs of frames
    assert events[0]["verdict"] in ("INSIDE", "UNKNOWN_PICTURE")  # a codec changes textures; nobody knows what acts
    assert events[0]["barrier"] < 0
    assert events[0]["unsafe"] is None
    _, events, counts = seen(video=film(tmp_path / "black.mp4", [0 * wide] * 6), steps=None)
    assert counts["alarms"] == 5
    assert events[0]["label"] == "Unknown picture"
    assert re.search(r"place [\d.]+ > [\d.]+", events[0]["why"])


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"env": "boat"}, "env to be one of"),
        ({"env": "quadruped"}, "pictures of"),
        ({"env": "physics"}, "full physics"),
        ({"video": "nowhere.mp4"}, "film file"),
        ({"video": __file__}, "film that can be read"),
        ({"video": __file__, "policy": "random"}, "video alone"),
        ({"video": __file__, "protect": True}, "video alone"),
        ({"policy": "mine"}, "policy in"),
        ({"port": 70000}, "port in"),
        ({"steps": 0}, "steps >= 1"),
        ({"fps": 0.0}, "fps > 0"),
        ({"noise": -1.0}, "noise >= 0"),
        ({"record": "film.avi"}, r"\.mp4"),
    ],
)
def test_what_cannot_be_watched_is_refused(options, words):
    with pytest.raises(ConfigError, match=words):
        watch("pendulum", **{"port": 0, "steps": 1} | options)


def test_a_port_that_is_taken_is_refused():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(ConfigError, match="which is taken"):
            watch("pendulum", port=taken.getsockname()[1], steps=1)


def test_an_agent_without_a_calibration_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match="calibration"):
        watch(str(load("pendulum").save(tmp_path)), port=0, steps=1)


def test_whoever_is_slow_receives_the_newest_steps_only():
    feed = Feed()
    for k in range(1000):
        feed.publish({"step": k}, f"picture {k}")
    feed.close()
    found = list(feed.events())
    assert [e["step"] for e in found] == list(range(700, 1000))
    assert [e.get("picture") for e in found] == [None] * 299 + ["picture 999"]


@pytest.mark.slow
def test_an_interrupt_ends_it_and_the_film_can_be_seen(tmp_path):
    words = ["watch", "pendulum", "--port", "0", "--record", str(tmp_path / "a.mp4")]
    process = subprocess.Popen(
        [sys.executable, "-m", "torchrl_sspl", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # in the background of a shell it is ignored
    )  # fmt: skip
    assert process.stdout is not None
    address = process.stdout.readline().split()[0]
    with urlopen(f"{address}events") as stream:
        for _ in range(6):
            stream.readline()
    process.send_signal(signal.SIGINT)
    try:
        told, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert (process.returncode, errors) == (0, "")
    found = re.search(r"steps (\d+)", told)
    assert found is not None
    # The step that was interrupted may be missing.
    assert 0 <= int(found[1]) - ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4"))[0] <= 1


def test_the_command_says_where_to_look_and_what_is_wrong(capsys):
    assert cli.main(["watch", "pendulum", "--port", "0", "--steps", "2", "--fps", "1000"]) == 0
    shown = capsys.readouterr().out
    assert re.match(r"http://127\.0\.0\.1:\d+/", shown)
    assert "steps 2  interventions 0" in shown
    assert cli.main(["watch", "pendulum", "--env", "boat"]) == 2
    assert "ConfigError" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.pybullet
def test_the_quadruped_is_watched_in_full_physics():
    pytest.importorskip("pybullet")
    _, events, counts = seen("quadruped", env="physics", steps=3, protect=True)
    assert counts["steps"] == 3
    _, again, _ = seen("quadruped", env="physics", steps=3, protect=True)
    assert [(e["barrier"], e["taken"]) for e in again] == [(e["barrier"], e["taken"]) for e in events]  # the seed is the world's, too
    assert {e["verdict"] for e in events} == {"PROOF_APPLIES"}
    assert not any(e["unsafe"] for e in events)


def test_every_episode_of_a_world_has_a_seed_of_its_own(monkeypatch):
    seeds = []

    def simulated(view, world, *, seed, **options):
        seeds.append(seed)
        if len(seeds) % 3 == 0:
            raise live._Over

    monkeypatch.setattr(live, "simulate", simulated)
    for seed in (0, 0, 1):
        live.watch("pendulum", port=0, seed=seed, ready=lambda address: None)
    assert seeds[:3] == seeds[3:6]
    assert len(set(seeds)) == 6


def test_an_agent_without_a_proof_is_said_to_have_none(monkeypatch):
    load = Monitor.load

    def unproved(name: str) -> Monitor:
        known = load(name)
        known.agent.description["tolerated_error"] = 0.0
        return Monitor(known.agent, known.calibration)  # what is proved is read when a monitor is made

    monkeypatch.setattr(Monitor, "load", unproved)
    _, events, _ = seen(steps=3)
    assert {e["verdict"] for e in events} == {"INSIDE"}
    assert all("nothing is proved of this agent" in e["why"] for e in events)


def test_under_random_actions_no_proof_applies_but_behind_the_filter():
    _, bare, _ = seen(policy="random", steps=4)
    assert {e["verdict"] for e in bare} <= {"INSIDE", "OUTSIDE"}
    assert "nothing is proved of what acts here" in bare[0]["why"]
    _, kept, _ = seen(policy="random", steps=4, protect=True)
    assert {e["verdict"] for e in kept} == {"PROOF_APPLIES"}


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_in_a_film_no_proof_applies(monkeypatch, tmp_path):
    load = Monitor.load

    def patient(name: str) -> Monitor:
        known = load(name)
        known.calibration.limits = {name: (-math.inf, math.inf) for name in known.calibration.limits}  # a codec changes textures
        return known

    monkeypatch.setattr(Monitor, "load", patient)
    frame = PendulumEnv(batch_size=[1], seed=0).draw(torch.tensor([[0.05, 0.0]]))[0].permute(1, 2, 0).numpy()
    _, events, _ = seen(video=film(tmp_path / "still.mp4", [frame] * 4), steps=None)
    assert {e["verdict"] for e in events} == {"INSIDE"}
    assert all("nothing is proved of what acts here" in e["why"] for e in events)

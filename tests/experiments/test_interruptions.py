"""Runs that are interrupted at random moments end with the agent of a run that never was."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tiny import TINY, TINY_PHASES

QUADRUPED = [
    "env=quadruped", "preset=smoke", *TINY_PHASES, "env.image_size=64", "network.pool_to=32", "collector.envs=8",
    "collector.frames_per_batch=64", "collector.init_random_frames=64", "trainer.total_frames=192",
    "trainer.optim_steps_per_batch=3", "buffer.batch=24", "synthesis.transitions=240", "synthesis.rollout_transitions=24",
    "synthesis.rim_transitions=16", "synthesis.rim_draws=2", "synthesis.check_episodes=8", "synthesis.check_horizon=2",
    "evaluation.walks=0",
]  # fmt: skip
SYSTEMS = {"pendulum": TINY, "quadruped": QUADRUPED}
TIMES = 10  # interruptions of each kind and system
CODES = {signal.SIGKILL: -9, signal.SIGTERM: 143, signal.SIGINT: 130}


def start(system: str, out: Path) -> subprocess.Popen[str]:
    words = [*SYSTEMS[system], "trainer.checkpoint_seconds=0.5", f"out_dir={out}"]
    command = [sys.executable, "-W", "ignore", "-m", "torchrl_sspl", "train", *words]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # in the background of a shell it is ignored
    )  # fmt: skip


@pytest.fixture(scope="module", params=SYSTEMS)
def whole(request, tmp_path_factory):
    """A run that nobody interrupts: system, weights, seconds."""
    out, begun = tmp_path_factory.mktemp("whole"), time.monotonic()
    with start(request.param, out) as process:
        error = process.communicate()[1]
    assert process.returncode == 0, error
    return request.param, (out / "agent" / "agent.safetensors").read_bytes(), time.monotonic() - begun


@pytest.mark.slow
@pytest.mark.parametrize("number", CODES, ids=lambda number: number.name)
def test_interrupted_at_random_moments_a_run_ends_with_the_same_agent(tmp_path, whole, number):
    system, expected, seconds = whole
    moments, hit, runs = random.Random(f"{system} {number}"), 0, 0
    while hit < TIMES:
        out, runs = tmp_path / str(runs), runs + 1
        for _ in range(3):  # interruptions of one run, at most
            with start(system, out) as process:
                try:
                    process.wait(moments.uniform(0.0, 1.1 * seconds))
                except subprocess.TimeoutExpired:
                    process.send_signal(number)
                    hit += 1
                error = process.communicate()[1]
            if process.returncode == 0:
                break
            assert "Traceback" not in error
            # Before Python has begun, nothing of ours can answer.
            assert process.returncode in (CODES[number], -number), error
        else:
            with start(system, out) as process:
                error = process.communicate()[1]
            assert process.returncode == 0, error
        assert (out / "agent" / "agent.safetensors").read_bytes() == expected
        assert not list((out / "checkpoints").glob(".*"))

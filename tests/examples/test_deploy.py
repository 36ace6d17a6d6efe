"""An exported agent on a film."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.modules.agent import load

DEPLOY = Path(__file__).resolve().parents[2] / "examples" / "deploy"


@pytest.mark.slow
def test_a_process_without_torch_runs_a_film(tmp_path):
    onnx_file = load("pendulum").export(tmp_path / "pendulum.onnx", check=16)
    iio = pytest.importorskip("imageio.v3")
    env = PendulumEnv(batch_size=[1], seed=1)
    data, shown = env.reset(), []
    for _ in range(6):
        shown.append(data["pixels"][0, 3:].permute(1, 2, 0).numpy())
        data = env.step(data.set("action", env.action_spec.zero()))["next"].exclude("reward")
    iio.imwrite(tmp_path / "film.gif", np.stack(shown), duration=50, loop=0)
    run = f"import sys; sys.modules['torch'] = None; sys.argv = ['x', r'{onnx_file}', r'{tmp_path / 'film.gif'}']; " \
        f"import runpy; runpy.run_path(r'{DEPLOY / 'run_onnx.py'}', run_name='__main__')"  # fmt: skip
    done = subprocess.run([sys.executable, "-c", run], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert "waiting" in lines[0]
    assert all("B = " in line and ("proof applies" in line or "premise" in line or "outside" in line) for line in lines[1:])


class _Session:
    """Meets the premise, and tells what it was given."""

    def __init__(self) -> None:
        self.given: list[dict] = []

    def run(self, _names, given):
        self.given.append(given)
        one = np.zeros(1, np.float32)
        return np.full((1, 1), 0.5, np.float32), one - 1, one - 1, one, np.array([True]), np.zeros((1, 3), np.float32)


def test_a_lost_frame_ends_the_proof():
    pytest.importorskip("onnxruntime")
    kind = runpy.run_path(str(DEPLOY / "run_onnx.py"))["OnnxAgent"]
    agent, frame = object.__new__(kind), np.zeros((8, 8, 3), np.uint8)
    agent.session, agent.shape, agent.period = _Session(), (6, 8, 8), 0.05
    agent.action, agent.latent = np.zeros((1, 1), np.float32), np.zeros((1, 3), np.float32)

    def told(*steps):
        agent.reset()
        return [agent.step(given, taken, time)[1] for given, taken, time in steps]

    first = ((frame, None, 0.0), (frame, None, 0.05))
    assert told(*first, (frame, None, 0.1)) == ["waiting for a second frame", "proof applies", "proof applies"]
    assert told(*first, (None, None, None), (frame, None, 0.15), (frame, None, 0.2))[2:] == [
        "no picture", "waiting for a second frame", "inside, premise not met"
    ]  # fmt: skip
    assert told(*first, (frame, None, 0.15), (frame, None, 0.2))[2:] == ["waiting for a second frame", "inside, premise not met"]
    assert agent.session.given[-1]["begins"]  # what was expected is too old
    assert told(*first, (frame, np.float32([0.5]), 0.1))[-1] == "proof applies"  # what was told
    assert told(*first, (frame, np.float32([0.7]), 0.1))[-1] == "inside, premise not met"

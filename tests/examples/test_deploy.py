"""An exported agent on a film."""

from __future__ import annotations

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

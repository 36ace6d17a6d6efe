"""The command: what it prints, what it refuses, and that a tiny run goes from words to report."""

from __future__ import annotations

import json
import subprocess
import sys
import types

import pytest
from tiny import TINY, TINY_EXPERIMENT

import torchrl_sspl
from torchrl_sspl import cli

SMALL = [
    "trainer.total_frames=64", "trainer.optim_steps_per_batch=2", "trainer.warm_start_steps=1", "trainer.progress=false",
    "trainer.checkpoint_every=-1", "collector.frames_per_batch=32", "collector.envs=16", "collector.init_random_frames=32",
    "env.image_size=16", "network.pool_to=8", "network.barrier_hidden=[8]", "network.policy_hidden=[8]",
    "network.dynamics_hidden=[8]", "buffer.batch=16", "evaluation.episodes=4", "evaluation.envs=4", "evaluation.horizon=3",
    *TINY_EXPERIMENT,
]  # fmt: skip
pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")


def test_usage_version_and_unknown_commands(capsys):
    assert cli.main(["--version"]) == 0
    assert torchrl_sspl.__version__ in capsys.readouterr().out
    assert cli.main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(word in shown for word in ("train", "evaluate", "verify"))
    assert cli.main([]) == 2
    assert cli.main(["trian"]) == 2
    assert "one of train, evaluate, verify, received 'trian'" in capsys.readouterr().err


def test_python_m_is_the_same_command():
    done = subprocess.run([sys.executable, "-m", "torchrl_sspl", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"torchrl_sspl {torchrl_sspl.__version__}\n"


def test_help_of_train_lists_fields_even_without_hydra(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "hydra", None)
    assert cli.main(["train", "--help"]) == 0
    shown = capsys.readouterr().out
    assert all(key in shown for key in ("trainer.total_frames", "collector.backend", "env=pendulum", "trainer=rounds"))


def test_without_hydra_train_names_the_extra(capsys, monkeypatch):
    for name in ("hydra", "hydra.core", "hydra.core.config_store"):
        monkeypatch.setitem(sys.modules, name, None)
    assert cli.main(["train", "seed=1"]) == 2
    assert "torchrl-sspl[hydra]" in capsys.readouterr().err


def test_a_wrong_key_lists_the_valid_ones(capsys):
    pytest.importorskip("hydra")
    assert cli.main(["train", "trainer.frames=1"]) == 2
    assert "valid keys: env.image_size" in capsys.readouterr().err


def test_from_words_to_report_and_evaluated_again(tmp_path, capsys):
    pytest.importorskip("hydra")
    assert cli.main(["train", "env=pendulum", *SMALL, f"out_dir={tmp_path}/run"]) == 0
    shown = capsys.readouterr().out
    assert "episodes from B <= 0 that touch U" in shown
    for name in ("metrics.json", "report.html", "agent/agent.json", "config.json", "csv/scalars/loss_safe.csv"):
        assert (tmp_path / "run" / name).stat().st_size > 0
    again = tmp_path / "again.json"
    assert cli.main(["evaluate", str(tmp_path / "run"), "episodes=3", "seed=5", "--json", str(again)]) == 0
    assert json.loads(again.read_text())["starts_inside"]["n"] == 3
    assert cli.main(["evaluate", str(tmp_path / "run"), "epsodes=3"]) == 2
    assert "did you mean episodes" in capsys.readouterr().err


def test_gymnasium_by_import_paths(tmp_path, capsys, monkeypatch):
    pytest.importorskip("hydra")
    (tmp_path / "my_cart.py").write_text(
        "from torch import nn\n"
        "def safe(state, info):\n    return abs(state[2]) < 0.05\n"
        "def unsafe(state, info):\n    return abs(state[2]) > 0.1\n"
        "class Encoder(nn.Sequential):\n"
        "    def __init__(self, latent_dim):\n"
        "        super().__init__(nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Linear(96, latent_dim), nn.Tanh())\n"
        "    def forward(self, pixels):\n"
        "        return super().forward(pixels.reshape(-1, *pixels.shape[-3:]) / 255.0).reshape(*pixels.shape[:-3], -1)\n"
    )
    monkeypatch.chdir(tmp_path)
    env = ["env=gymnasium", "env.make=CartPole-v1", "env.safe=my_cart:safe", "env.unsafe=my_cart:unsafe"]
    small = [w for w in SMALL if w.split("=")[0] not in ("network.pool_to", "collector.envs", "collector.frames_per_batch")]
    more = ["network.encoder=my_cart:Encoder", "collector.envs=4", "collector.frames_per_batch=64", "trainer.total_frames=192"]
    more += ["collector.init_random_frames=128"]
    assert cli.main(["train", *env, *small, *more, "out_dir=run"]) == 0, capsys.readouterr().err
    assert cli.main(["evaluate", "run", "episodes=2"]) == 0
    assert cli.main(["train", "env=gymnasium", *small, "out_dir=other"]) == 2
    assert "expected env.safe to name a predicate" in capsys.readouterr().err
    assert cli.main(["train", *env[:-1], "env.unsafe=my_cart:unsfe", *small, "out_dir=other"]) == 2
    assert "received 'my_cart:unsfe'" in capsys.readouterr().err


@pytest.mark.slow
def test_rounds_through_the_command(tmp_path, capsys):
    pytest.importorskip("hydra")
    words = [f"trainer.{w}" for w in TINY if not w.startswith("preset")]
    sizes = ["grid=9", "kernel_grid=61", "rollouts=4", "horizon=3", "gymnasium_rollouts=0", "certificate_episodes=20"]
    words += [f"trainer.evaluation.{w}" for w in sizes]
    assert cli.main(["train", "trainer=rounds_smoke", *words, f"out_dir={tmp_path}"]) == 0, capsys.readouterr().err
    assert (tmp_path / "report.html").stat().st_size > 0
    steps = [line.split(",")[0] for line in (tmp_path / "csv/scalars/loss_consistency.csv").read_text().splitlines()]
    assert steps == sorted(steps, key=float)
    assert (tmp_path / "csv/scalars/inside_of_allowed.csv").is_file()
    assert json.loads((tmp_path / "metrics.json").read_text())["measurements"]["volume_over_kernel"]["n"] > 0
    assert cli.main(["evaluate", str(tmp_path), "rollouts=2"]) == 0
    assert "volume_over_kernel" in capsys.readouterr().out


def test_rounds_need_known_dynamics(capsys, tmp_path):
    pytest.importorskip("hydra")
    words = ["env=gymnasium", "env.safe=builtins:callable", "env.unsafe=builtins:callable", f"out_dir={tmp_path}"]
    assert cli.main(["train", "trainer=rounds", *words]) == 2
    assert "dynamics are known" in capsys.readouterr().err


def test_agents_that_cannot_be_evaluated_are_named(tmp_path, capsys):
    assert cli.main(["evaluate", "nobody"]) == 2
    assert "pendulum" in capsys.readouterr().err
    (tmp_path / "agent.json").write_text("{")
    assert cli.main(["evaluate", str(tmp_path)]) == 2
    assert "agent.json" in capsys.readouterr().err


@pytest.mark.parametrize("code", [0, 1])
def test_verify_returns_the_verdict(code, monkeypatch):
    module = types.ModuleType("torchrl_sspl.trainers.certify")
    asked = []
    module.verify_run = lambda agent: asked.append(agent) or code
    monkeypatch.setitem(sys.modules, "torchrl_sspl.trainers.certify", module)
    assert cli.main(["verify", "pendulum"]) == code
    assert asked == ["pendulum"]

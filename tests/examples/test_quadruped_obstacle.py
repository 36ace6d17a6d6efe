"""The quadruped's example at tiny size: it trains, judges itself, writes what it promises, and evaluates what is given."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest
from tiny import TINY

from torchrl_sspl.cli import evaluate_agent

EXAMPLE = Path(__file__).parents[2] / "examples" / "quadruped_obstacle.py"
SMALL = ["evaluation.grid=7", "evaluation.rollouts=4", "evaluation.horizon=2", "network.pool_to=32", "walks=0"]


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("quadruped_obstacle", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def trained(example, tmp_path_factory):
    directory = tmp_path_factory.mktemp("quadruped")
    with pytest.MonkeyPatch.context() as patch:
        # A coarse kernel: what is tested is the way to the report.
        patch.setattr("torchrl_sspl.trainers.quadruped.KERNEL_GRID", (31, 31, 24))
        patch.setattr("torchrl_sspl.trainers.quadruped.STATE_GRID", (7, 7, 8))
        code = example.main([*TINY, *SMALL, f"out_dir={directory}"])
    return code, directory


def test_a_run_writes_numbers_figures_report_and_agent(trained):
    code, directory = trained
    assert code == 0
    metrics = json.loads((directory / "metrics.json").read_text())
    assert metrics["config"]["network"]["lipschitz_bound"] == 1.5
    assert metrics["measurements"]["unsafe_called_safe"]["n"] == 7 * 7 * 7
    assert metrics["measurements"]["latency_p99"]["value"] > 0
    # An agent of a few steps is no good, and the run says so; nobody claims walks that were not walked.
    assert any(verdict.startswith("missed") for verdict in metrics["verdicts"].values())
    assert metrics["verdicts"]["walks from S that fall"] == "not measured"
    for name in (
        "report.html", "agent/agent.safetensors", "agent/evaluation.json", "agent/certificate.json",
        "figures/plane_by_heading.png",
    ):  # fmt: skip
        assert (directory / name).stat().st_size > 0
    assert "Certificate" in (directory / "report.html").read_text()
    # It is trained on the car that turns late, and says so.
    assert json.loads((directory / "agent" / "agent.json").read_text())["environment"] == "DubinsEnv"


def test_the_command_measures_it_on_the_car(trained, monkeypatch):
    _, directory = trained
    monkeypatch.setattr("torchrl_sspl.trainers.quadruped.KERNEL_GRID", (31, 31, 24))
    monkeypatch.setattr("torchrl_sspl.trainers.quadruped.STATE_GRID", (5, 5, 8))
    found = evaluate_agent(str(directory), ["grid=5", "rollouts=4", "horizon=2"])
    assert found.measurements["unsafe_called_safe"].n == 5 * 5 * 5


def test_a_trained_agent_is_evaluated_without_training(example, trained, tmp_path):
    _, directory = trained
    before = (directory / "agent" / "agent.safetensors").read_bytes()
    arguments = ["mode=evaluate", f"agent={directory}", "dubins=false", "walks=0", "preset=smoke", f"out_dir={tmp_path}"]
    assert example.main(arguments) == 0
    assert (directory / "agent" / "agent.safetensors").read_bytes() == before
    assert not (tmp_path / "agent").exists()
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert "training_minutes" in metrics["measurements"]
    assert (tmp_path / "report.html").stat().st_size > 0


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("sed=1", "did you mean seed"),
        ("mode=fly", "train or evaluate"),
        ("walks=-1", "walks"),
        ("preset=quick", "sound, paper, smoke"),
        ("dubins=maybe", "true or false"),
    ],
)
def test_a_wrong_argument_is_named(example, capsys, argument, said):
    assert example.main([argument]) == 2
    assert said in capsys.readouterr().err


def test_an_agent_that_is_not_there_is_named(example, capsys, tmp_path):
    assert example.main(["mode=evaluate", "agent=nobody", f"out_dir={tmp_path}"]) == 2
    assert "nobody" in capsys.readouterr().err


@pytest.mark.parametrize("preset", ["sound", "paper", "smoke"])
def test_every_preset_of_the_file_is_valid_and_can_be_overridden(example, preset):
    config, task = example.configure([f"preset={preset}", "network.latent_dim=5", "walks=7"])
    assert config.network.lipschitz_bound == 1.5
    assert config.network.latent_dim == 5
    assert task.agent is None
    assert task.walks.episodes == 7

"""The quadruped's example at tiny size: it trains, judges itself, writes what it promises, and evaluates what is given."""

from __future__ import annotations

import json

import pytest
from tiny import TINY

from torchrl_sspl.cli import evaluate_agent
from torchrl_sspl.configs import compose

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning", "ignore:init_random_frames")
EXAMPLE = "quadruped_obstacle.py"
LEFT_OUT = ("env=pendulum", "env.image_size=32", "network.pool_to=16")
PICTURES = ["env.image_size=64", "network.pool_to=32"]
# A coarse kernel: what is tested is the way to the report.
SMALL = ["synthesis.grid=9", "evaluation.grid=7", "evaluation.kernel_grid=31", "evaluation.episodes=4", "evaluation.horizon=2", "synthesis.rounds=1"]


@pytest.fixture(scope="module")
def trained(program, tmp_path_factory):
    directory = tmp_path_factory.mktemp("quadruped")
    words = [*(w for w in TINY if w not in LEFT_OUT), *PICTURES, *SMALL, "evaluation.walks=0", f"out_dir={directory}"]
    return program(EXAMPLE, *words), directory


def test_a_run_writes_numbers_figures_report_and_agent(trained):
    code, directory = trained
    assert code == 0
    metrics = json.loads((directory / "metrics.json").read_text())
    assert metrics["config"]["network"]["lipschitz_bound"] == 1.5
    measured = metrics["measurements"]["own"]
    assert measured["unsafe_called_safe"]["n"] == 7 * 7 * 4
    assert measured["latency_p99"]["value"] > 0
    assert measured["training_minutes"]["value"] > 0
    # An agent of a few steps is no good, and the run says so; nobody claims walks that were not walked.
    assert any(verdict.startswith("missed") for verdict in metrics["verdicts"].values())
    assert metrics["verdicts"]["walks from S that fall"] == "not measured"
    for name in (
        "report.html", "agent/agent.safetensors", "agent/evaluation.json", "agent/certificate.json",
        "figures/state_plane.png", "figures/latent_space.png",
    ):  # fmt: skip
        assert (directory / name).stat().st_size > 0
    page = (directory / "report.html").read_text()
    assert "Certificate" in page
    # It is trained on the car that turns late, and says so.
    assert json.loads((directory / "agent" / "agent.json").read_text())["config"]["env"]["yaw_lag"] == [0.048, 0.063]
    assert "turns with the delay of the walking robot" in page


def test_every_phase_was_run(trained):
    rows = [json.loads(line) for line in (trained[1] / "log.jsonl").read_text().splitlines()]
    assert {"dynamics", "teach", "fit", "tighten", "check"} <= {row["phase"] for row in rows}


def test_the_command_measures_it_on_the_car_that_turns_at_once(trained):
    _, directory = trained
    found = evaluate_agent(str(directory), ["grid=5", "kernel_grid=31", "episodes=4", "horizon=2"])
    assert found.measurements["unsafe_called_safe"].n == 5 * 5 * 3


@pytest.mark.slow  # walks and films of the shipped agent have tests of their own
def test_a_trained_agent_walks_and_none_is_trained(program, trained, tmp_path):
    pytest.importorskip("pybullet", reason="needs the extra quadruped")
    _, directory = trained
    before = (directory / "agent" / "agent.safetensors").read_bytes()
    words = [f"agent={directory}", "preset=smoke", *PICTURES, "trainer.progress=false", f"out_dir={tmp_path}"]
    walks = ["evaluation.episodes=0", "evaluation.walks=1", "evaluation.walk_seconds=0.3"]  # as `make demo` has it
    assert program(EXAMPLE, *words, *walks) == 0
    assert (directory / "agent" / "agent.safetensors").read_bytes() == before
    assert not (tmp_path / "agent").exists()
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["measurements"]["own"]["walks_from_safe_hit"]["n"] == 1
    assert metrics["measurements"]["own"]["walks_from_safe_fall"]["value"] == 0.0
    assert "unsafe_called_safe" not in metrics["measurements"]["own"]
    assert (tmp_path / "report.html").stat().st_size > 0
    assert list((tmp_path / "figures").iterdir())


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("sed=1", "the nearest are seed"),
        ("mode=fly", "expected a valid key, received 'mode'"),
        ("walks=1", "the nearest are evaluation.walks"),
        ("preset=fast", "sound, paper, quick, smoke"),
        ("env.yaw_lag=maybe", "a list of numbers"),
        ("agent=nobody", "nobody"),
    ],
)
def test_a_wrong_word_is_named(program, capsys, word, said, tmp_path):
    assert program(EXAMPLE, word, f"out_dir={tmp_path}") == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.glob("**/*.json"))


@pytest.mark.parametrize("preset", ["sound", "paper", "quick", "smoke"])
def test_every_preset_is_valid_and_can_be_overridden(preset):
    config = compose(["env=quadruped", f"preset={preset}", "network.latent_dim=5", "evaluation.walks=7"]).check()
    assert config.network.lipschitz_bound == 1.5
    assert config.network.latent_dim == 5
    assert config.agent == ""
    assert config.evaluation.walks == 7
    assert config.network.encoder == ("FrameEncoder" if preset == "paper" else "TurnedBearingEncoder")

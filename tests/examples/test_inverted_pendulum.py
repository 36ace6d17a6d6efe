"""The example at tiny size: it trains, judges itself, and writes everything that it promises."""

from __future__ import annotations

import json
import shutil

import pytest
from tiny import SAVED, TINY

from torchrl_sspl.envs import PendulumRenderer

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning", "ignore:init_random_frames")
EXAMPLE = "inverted_pendulum.py"
WORDS = [w for w in TINY if w != "env=pendulum"]
SMALL = ["evaluation.grid=9", "evaluation.kernel_grid=61", "evaluation.episodes=6", "evaluation.horizon=3", "evaluation.renderer_episodes=4"]


@pytest.fixture(scope="module")
def trained(program, tmp_path_factory):
    directory = tmp_path_factory.mktemp("pendulum")
    with pytest.MonkeyPatch.context() as quick:
        # The same pictures in closed form: gymnasium takes 3 ms for each, test_rendering.py holds them to each other.
        quick.setattr("torchrl_sspl.envs.pendulum._gymnasium_renderer", PendulumRenderer)
        return program(EXAMPLE, *WORDS, SAVED, *SMALL, f"out_dir={directory}"), directory


def test_a_run_writes_numbers_figures_report_and_agent(trained):
    code, directory = trained
    assert code == 0
    metrics = json.loads((directory / "metrics.json").read_text())
    assert metrics["schema"] == 1
    assert metrics["seed"] == 0
    assert metrics["measurements"]["own"]["unsafe_called_safe"]["n"] > 0
    assert metrics["measurements"]["gymnasium"]["volume_over_kernel"]["n"] > 0
    # An agent of a few steps is no good, and the run says so.
    assert any(verdict.startswith("missed") for verdict in metrics["verdicts"].values())
    assert len(metrics["checks"]) == 2
    assert metrics["budget"]["transitions"] > 192  # those of the joint training, and those of the rounds
    assert 0 < metrics["budget"]["labels of U"] < metrics["budget"]["transitions"]
    for name in (
        "report.html", "agent/agent.safetensors", "agent/certificate.json", "agent/evaluation.json",
        "figures/state_plane.png", "figures/latent_space.png",
    ):  # fmt: skip
        assert (directory / name).stat().st_size > 0
    page = (directory / "report.html").read_text()
    assert "missed" in page
    assert str(directory) not in page + (directory / "metrics.json").read_text()


def test_every_phase_of_both_rounds_was_run(trained):
    rows = [json.loads(line) for line in (trained[1] / "log.jsonl").read_text().splitlines()]
    joint = [row for row in rows if row["phase"] == "joint"]
    assert [row["step"] for row in joint] == [3, 6, 9]
    assert all(row["loss_consistency"] > 0 for row in joint)
    for k in range(2):
        assert {"dynamics", "fit", "steer", "tune", "check"} <= {row["phase"] for row in rows if row["round"] == k}


@pytest.mark.slow  # as of every finished run
def test_started_again_it_is_not_trained_again(program, trained, tmp_path, capsys):
    directory = shutil.copytree(trained[1], tmp_path / "again")
    weights, log = (directory / "agent" / "agent.safetensors").read_bytes(), (directory / "log.jsonl").read_bytes()
    assert program(EXAMPLE, *WORDS, SAVED, *SMALL, "evaluation.renderer_episodes=0", f"out_dir={directory}") == 0
    assert (directory / "agent" / "agent.safetensors").read_bytes() == weights
    assert (directory / "log.jsonl").read_bytes() == log
    assert "missed" in capsys.readouterr().out


@pytest.mark.slow
def test_a_shipped_agent_is_evaluated_and_none_is_trained(program, tmp_path):
    words = ["preset=smoke", "agent=pendulum", "trainer.progress=false", "evaluation.kernel_grid=61", f"out_dir={tmp_path}"]
    assert program(EXAMPLE, *words) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["measurements"]["own"]["unsafe_called_safe"]["value"] == 0.0
    assert metrics["measurements"]["own"]["safe_rollouts_touch_unsafe"]["events"] == 0
    assert metrics["measurements"]["own"]["volume_over_kernel"]["value"] > 0.5
    assert metrics["training_seconds"] is None
    assert not (tmp_path / "agent").exists()
    assert not (tmp_path / "log.jsonl").exists()


@pytest.mark.slow
def test_the_paper_preset_reports_its_margins(program, tmp_path):
    words = [w for w in WORDS if w not in ("preset=smoke", "logger=none")]
    options = ["preset=paper", "logger=csv", "evaluation.renderer_episodes=0", "collector.envs=16", "collector.max_frames_per_traj=4"]
    assert program(EXAMPLE, *words, *options, *SMALL[:-1], f"out_dir={tmp_path}") == 0

    def column(name: str) -> list[float]:
        return [float(line.split(",")[1]) for line in (tmp_path / "csv" / "scalars" / f"{name}.csv").read_text().splitlines()]

    margins, errors = column("dynamics_margin"), column("dynamics_error_sample")
    assert len(margins) == 3
    assert margins == pytest.approx([2.0 * error for error in errors])  # L_B = 2
    assert column("safety_margin") == pytest.approx([2.0 * radius for radius in column("covering_radius")])
    assert column("loss_lipschitz")  # the barrier's own step
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["preset"] == "paper"
    assert metrics["checks"] == []
    assert "total loss of zero" in metrics["stop_reason"]


@pytest.mark.parametrize(
    ("word", "said"),
    [("sed=1", "the nearest are seed"), ("preset=fast", "sound, paper, quick, smoke"), ("network.latent_dim=two", "an integer")],
)
def test_a_wrong_word_names_the_right_one(program, capsys, word, said):
    assert program(EXAMPLE, word) == 2
    assert said in capsys.readouterr().err

"""The example at tiny size: it trains, judges itself, and writes everything that it promises."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest
from tiny import TINY

EXAMPLE = Path(__file__).parents[2] / "examples" / "inverted_pendulum.py"
SMALL = ["evaluation.grid=9", "evaluation.kernel_grid=61", "evaluation.rollouts=6", "evaluation.horizon=3", "evaluation.gymnasium_rollouts=4"]


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("inverted_pendulum", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_run_writes_numbers_figures_report_and_agent(example, tmp_path):
    assert example.main([*TINY, *SMALL, f"out_dir={tmp_path}"]) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["seed"] == 0
    assert metrics["measurements"]["unsafe_called_safe"]["n"] > 0
    assert metrics["foreign_measurements"]["volume_over_kernel"]["n"] > 0
    # An agent of a few steps is no good, and the run says so.
    assert any(verdict.startswith("missed") for verdict in metrics["verdicts"].values())
    for name in ("report.html", "agent/agent.safetensors", "figures/state_plane.png", "figures/latent_space.png"):
        assert (tmp_path / name).stat().st_size > 0
    assert "missed" in (tmp_path / "report.html").read_text()


def test_the_paper_preset_reports_its_margins(example, tmp_path):
    overrides = [item for item in TINY if not item.startswith("preset")]
    assert example.main(["preset=paper", *overrides, *SMALL, "evaluation.gymnasium_rollouts=0", f"out_dir={tmp_path}"]) == 0
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    margins = [row for row in rows if "dynamics_margin" in row]
    assert len(margins) == 2
    assert all(row["dynamics_margin"] == pytest.approx(2.0 * row["dynamics_error"]) for row in margins)


def test_a_wrong_key_names_the_right_one(example, capsys):
    assert example.main(["sed=1"]) == 2
    assert "did you mean seed" in capsys.readouterr().err

"""The benchmark of few labels, at a size of seconds."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "few_labels.py"
SIZES = ["score.episodes=4", "score.horizon=3", "score.grid=11", "score.kernel_grid=31", "score.frames=1", "score.shifted=0"]
SHORT = [
    "trainer.optim_steps_per_batch=4", "synthesis.dynamics_steps=4", "synthesis.fit_steps=4", "synthesis.steer_steps=2", "synthesis.tune_steps=4",
    "synthesis.tighten_steps=0", "synthesis.check_episodes=20", "synthesis.check_horizon=3", "synthesis.batch=32",
    "trainer.checkpoint_seconds=-1", "evaluation.certificate_seconds=0.1",
]  # fmt: skip


def test_every_point_is_measured_once_and_says_how_many_labels_it_had(tmp_path, monkeypatch, capsys):
    words = ["labels=20,all", "transitions=1280", "wrong=0.05", "seed=0", f"out={tmp_path}", *SIZES, *SHORT]

    def run(*more: str) -> str:
        monkeypatch.setattr(sys, "argv", ["few_labels.py", *words, *more])
        runpy.run_path(str(BENCHMARK), run_name="__main__")
        return capsys.readouterr().out

    assert "| 20 | 20 |" not in run("run=false")
    printed = run()
    assert "| pendulum | 20 | 20 | 0 | 1280 | 0.05 | 0 |" in printed
    found = json.loads((tmp_path / "points.json").read_text())
    assert [row["labels"] for row in found] == ["20", "all"]
    assert found[1]["needs"]["safe_labels"] > 100
    before = [path.stat().st_mtime_ns for path in sorted(tmp_path.rglob("point.json"))]
    assert run() == printed
    assert run("run=false") == printed
    assert [path.stat().st_mtime_ns for path in sorted(tmp_path.rglob("point.json"))] == before

"""The benchmark of CMU's car: rows of the comparison beside what is published."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import numpy as np
import pytest

from torchrl_sspl.baselines.cell import Cell, run_cell

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "cmu_dubins.py"
SIZES = ["score.episodes=2", "score.horizon=2", "score.grid=7", "score.kernel_grid=21", "score.frames=1", "score.shifted=0"]


def test_a_row_is_scored_on_the_cells_of_its_grid(tmp_path):
    of_row = runpy.run_path(str(BENCHMARK))["of_row"]
    run_cell(Cell.of("box_margin", ["env=cmu", "actions=5", "seed=2", f"out_dir={tmp_path}", *SIZES]))
    with np.load(tmp_path / "claims.npz") as body:
        claimed, viable = body["claimed"], body["viable"]
    name, found = of_row(tmp_path)
    assert name == "box_margin actions=5, budget none, seed 2"
    assert found["recall"] == pytest.approx((claimed & viable).sum() / viable.sum())
    assert found["unsafe_called_safe"] == pytest.approx((claimed & ~viable).sum() / (~viable).sum())
    assert 0 < found["unsafe_called_safe"] < 1  # what cannot turn away is claimed as well


def test_a_row_of_another_system_is_refused(tmp_path):
    (tmp_path / "row.json").write_text(json.dumps({"cell": {"env": "dubins"}}))
    with pytest.raises(SystemExit, match="expected a row of env=cmu, received one of env=dubins"):
        runpy.run_path(str(BENCHMARK))["of_row"](tmp_path)

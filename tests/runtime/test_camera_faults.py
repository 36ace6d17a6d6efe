"""The benchmark of faults in the loop, at its smallest."""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from torchrl_sspl.evaluation.simulation import Episodes
from torchrl_sspl.sets import UNLABELLED, UNSAFE


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    return importlib.import_module("camera_faults")


def test_entries_are_counted_from_alarms_premise_and_regions(benchmark):
    steps = 6

    def at(*first: float) -> torch.Tensor:
        """True from these steps on."""
        return torch.arange(steps)[:, None] >= torch.tensor(first)

    region = torch.where(at(4, 4, 4, math.inf), UNSAFE, UNLABELLED)
    run = Episodes(torch.zeros(steps - 1, 4, 1), region, torch.ones(steps, 4, dtype=torch.bool), events={"hit": torch.tensor([1, 0, 0, 0]) > 0})
    watching = SimpleNamespace(alarms=lambda: at(3, 4, math.inf, 5), applies=lambda: ~at(3, 4, 5, 5))
    # Noticed at step 3 of 4; in the same step; never; and one that does not enter U.
    assert benchmark.told(run, watching, 3) == "3 | 1 | 1 / 1 / 1 | 3 of 4 | 1 | 1 | -"


@pytest.mark.slow
@pytest.mark.pybullet
def test_walks_have_rows_for_the_faults_of_camera_and_world(benchmark, monkeypatch, capsys):
    pytest.importorskip("pybullet")
    monkeypatch.setattr(benchmark, "WORLD_FAULTS", {"pushed": (12.0,), "slippery": (0.3,)})
    monkeypatch.setattr(benchmark, "ONSET", 1)
    benchmark.main(["quadruped", "1", "2", "none", "frozen", "pushed", "slippery", "--physics"])
    printed = capsys.readouterr().out
    rows = [line.split(" | ") for line in printed.splitlines() if line.startswith("| ") and "Fault" not in line]
    assert [row[0] for row in rows] == [
        "| none", *["| frozen"] * 3, "| pushed, from S", "| slippery, from S", "| pushed, from {B <= 0}", "| slippery, from {B <= 0}",
    ]  # fmt: skip
    assert all(len(row) == 9 for row in rows)
    assert "with an alarm: 0 of 1, at most 95 %" in printed
    assert all(row[5] == "1 of 1" for row in rows[1:4])

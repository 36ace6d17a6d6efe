"""The benchmark of the filter, at a size of seconds."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from torchrl_sspl.evaluation import simulation


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    return importlib.import_module("filter")


def test_an_agents_own_actions_are_counted_where_its_episodes_run_in_parts(benchmark, monkeypatch, capsys):
    assert benchmark.AT_ONCE <= simulation._PART  # more would run in several parts, one after the other
    for module, name in ((benchmark, "AT_ONCE"), (simulation, "_PART")):
        monkeypatch.setattr(module, name, 2)
    monkeypatch.setattr(benchmark, "STEPS", 3)
    benchmark.main(["pendulum", "5", "-0.12", "--only", "own"])
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines() if line.startswith("| own")]
    assert [row[1:3] for row in rows] == [["none", "0 of 5"], ["level -0.12", "0 of 5"]]
    changed, moved = (float(cell.strip("% |")) for cell in rows[1][-2:])
    assert 0.0 <= changed <= 100.0
    assert 0.0 <= moved < 2.0


def test_actions_that_somebody_else_draws_are_counted_over_all_episodes(benchmark, monkeypatch, capsys):
    monkeypatch.setattr(benchmark, "AT_ONCE", 2)
    monkeypatch.setattr(benchmark, "STEPS", 3)
    benchmark.main(["pendulum", "5", "-0.12", "--only", "random"])
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines() if line.startswith("| random")]
    assert rows[0][-2:] == ["-", "- |"]
    assert float(rows[1][-2].strip("% ")) > 50.0

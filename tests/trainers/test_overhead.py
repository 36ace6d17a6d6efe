"""The trainer against bare loops: the same mathematics in every phase, at little cost."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
PHASES = ["world-model", "whole-loss", "dynamics", "teach", "fit", "steer", "tune", "tighten"]


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    return importlib.import_module("trainer_overhead")


@pytest.mark.slow
def test_bare_loops_have_the_trainers_gradients(benchmark):
    table = benchmark.main(batch=24, image_size=32, latents=96, rows=1000, repeats=0)  # nothing is timed
    assert list(table) == PHASES
    for phase, row in table.items():
        # Machines round differently, and a row may be among the worst ones on one side alone; a wrong term shows tenths.
        assert row["difference"] < 1e-2, phase


@pytest.mark.slow
def test_an_update_costs_at_most_a_tenth_more(benchmark):
    for phase, row in benchmark.main().items():
        assert row["ratio"] <= 1.10, (phase, row)

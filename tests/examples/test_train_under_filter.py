"""PPO behind the filter, a few steps of it."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "train_under_filter.py"


def test_the_example_learns_behind_the_filter_without_entering_u(tmp_path):
    example = runpy.run_path(str(EXAMPLE))
    example["main"].__globals__.update(ENVS=4, STEPS=30)
    example["main"](seeds=(0,), batches=2, out_dir=str(tmp_path))
    told = json.loads((tmp_path / "under_filter.json").read_text())
    with_filter, without = told["with the filter"][0], told["without"][0]
    assert [row["entered"] for row in with_filter] == [0.0, 0.0]
    assert sum(row["entered"] for row in without) > 0
    assert (tmp_path / "under_filter.png").stat().st_size > 5000

"""PPO behind the filter, a few steps of it."""

from __future__ import annotations

import json
import math
import runpy
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictModule

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "train_under_filter.py"


@pytest.fixture
def example():
    """The example, at a small size."""
    made = runpy.run_path(str(EXAMPLE))
    made["main"].__globals__.update(STEPS=120, MINIBATCH=60, EPOCHS=2)
    for task in made["TASKS"].values():
        task.envs, task.longest = 4, 30
    return made


@pytest.mark.parametrize(("env", "suffix"), [pytest.param("pendulum", "", marks=pytest.mark.slow), pytest.param("car", "_car", marks=pytest.mark.slow)])
def test_the_example_learns_behind_the_filter_without_entering_u(tmp_path, capsys, example, env, suffix):
    example["main"](env=env, seeds=(0,), batches=2, episodes=6, out_dir=str(tmp_path))
    told = json.loads((tmp_path / f"under_filter{suffix}.json").read_text())
    with_filter, without = told["learning"]["with the filter"][0], told["learning"]["without"][0]
    assert [row["entered"] for row in with_filter] == [0, 0]
    assert sum(row["episodes"] for row in with_filter) >= 8
    assert sum(row["entered"] for row in without) > 0
    for learnt in ("with the filter", "without"):
        assert told["afterwards"][f"learnt {learnt}, run with the filter"]["entered"] == 0
        assert told["afterwards"][f"learnt {learnt}, run without"]["episodes"] == 8  # of every system as many
    assert (tmp_path / f"under_filter{suffix}.png").stat().st_size > 5000
    assert "| without | with the filter |" in capsys.readouterr().out


@pytest.mark.slow
def test_who_heads_straight_for_the_goal_arrives_behind_the_filter_and_drives_into_the_obstacle_without_it(example):
    task = example["TASKS"]["car"]
    task.longest = 70

    def straight(state):
        away = torch.tensor(task.goal) - state[..., :2]
        off = (torch.atan2(away[..., 1:], away[..., :1]) - state[..., 2:3] + math.pi).remainder(2 * math.pi) - math.pi
        return (3.0 * off).clamp(-2.0, 2.0)

    driver = TensorDictModule(straight, ["state"], ["wanted"])
    behind, alone = (example["run"](task(), driver, 0, filtered=filtered, episodes=4) for filtered in (True, False))
    assert (behind["episodes"], behind["entered"], behind["arrived"]) == (4, 0, 4)
    assert (alone["episodes"], alone["entered"], alone["arrived"]) == (4, 4, 0)
    assert behind["return"] / 4 > 4.0 > 0.0 > alone["return"] / 4


def test_to_leave_the_arena_costs_as_much_as_to_enter_u_and_to_arrive_pays(example):
    task = example["TASKS"]["car"]()
    before, lost = torch.tensor([[-1.9, 0.0, 0.0, 0.0]]), torch.ones(1, 1, dtype=torch.bool)
    assert float(task.reward(before, before, lost)) == -2.0
    assert float(task.reward(before, before, ~lost)) == 0.0
    assert float(task.reward(torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.tensor([[1.2, 0.0, 0.0, 0.0]]), ~lost)) == pytest.approx(2.2)

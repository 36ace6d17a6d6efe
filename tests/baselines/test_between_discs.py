"""The benchmark between two discs: who heads for the goal gets there, who does not see the discs hits them, and what is counted."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import pytest
import torch

from torchrl_sspl.baselines import BUDGETS, make
from torchrl_sspl.envs import CMUTwoDiscsEnv

PATH = Path(__file__).parents[2] / "benchmarks" / "two_discs.py"
pytestmark = pytest.mark.skipif(not PATH.is_file(), reason="the benchmarks are not here")


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("two_discs_benchmark", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_nominal_policy_reaches_goals_and_hits_what_it_does_not_know(benchmark):
    env = CMUTwoDiscsEnv([1], image_size=32)
    start = torch.tensor([[-1.2, 0.0, 0.0, 0.0], [-1.2, 0.6, 0.0, 0.5], [-1.2, -0.6, 0.0, -0.5]])
    seeing, blind = (benchmark.episodes(benchmark.Through(), env, start, benchmark.Planner(env, blind=b)) for b in (False, True))
    assert seeing["reached without a collision"] >= 1
    assert not seeing["hit"][0]  # straight through the gap
    assert blind["hit"] == [False, True, True]
    assert blind["deviation"] == 0.0
    assert blind["changed"] == 0.0
    assert blind["episodes"] == 3


@pytest.mark.slow
def test_an_episode_ends_at_the_goal_and_where_the_car_leaves(benchmark):
    env = CMUTwoDiscsEnv([1], image_size=32)
    start = torch.tensor([[1.05, 0.0, 0.0, 0.0], [1.4, 1.2, 0.0, 0.0]])
    found = benchmark.episodes(benchmark.Through(), env, start, lambda x, rows: torch.full((len(x), 1), 2.0))
    assert found["reached without a collision"] == 1
    assert found["left"] == 1
    assert found["collisions"] == 0
    assert found["jerk"] == 0.0


@pytest.mark.slow
def test_it_counts_what_a_filter_changes(benchmark):
    env = CMUTwoDiscsEnv([1], image_size=32)
    perfect = make("kernel")
    perfect.kernel = benchmark.viability_kernel(env, resolution=(41, 41, 24, 2), actions=torch.tensor([[-2.0], [0.0], [2.0]]))
    perfect.fit(None, env, BUDGETS["tiny"], 0)
    start = torch.tensor([[-1.2, 0.6, 0.0, 0.5], [-1.2, -0.6, 0.0, -0.5]])
    found = benchmark.episodes(perfect, env, start, benchmark.Planner(env, blind=True))
    assert found["collisions"] == 0
    assert found["deviation"] > 0.1
    assert 0.0 < found["changed"] < 1.0


def test_a_wanted_action_that_is_admitted_is_no_change(benchmark, monkeypatch):
    env, passing = CMUTwoDiscsEnv([1], image_size=32), make("smooth_latent")
    passing.env, passing.tried = env, torch.linspace(-2.0, 2.0, 25)
    start = torch.tensor([[-1.2, 0.6, 0.0, 0.5], [-1.2, -0.6, 0.0, -0.5]])
    for bad, changed in ((0, 0.0), (24, 1.0)):  # all actions are as good; one is
        q = torch.ones(25).index_fill(0, torch.arange(bad), 0.1)  # the last one alone is good
        monkeypatch.setattr(passing, "_q", lambda seen, q=q: q.expand(len(seen), -1))
        found = benchmark.episodes(passing, env, start, lambda x, rows: torch.full((len(x), 1), 0.07))
        assert found["changed"] == changed
        assert (found["deviation"] > 0.0) is (changed > 0.0)


def test_the_command_prints_a_table_and_writes_all_of_it(benchmark, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(benchmark, "HORIZON", 4)
    monkeypatch.setattr(benchmark, "truth", lambda env: benchmark.viability_kernel(env, resolution=(21, 21, 12, 2), actions=torch.tensor([[-2.0], [2.0]])))
    monkeypatch.setattr(sys, "argv", ["two_discs.py", "--episodes", "3", "--budget", "none", "--out", str(tmp_path / "found.json")])
    benchmark.main()
    rows = capsys.readouterr().out.splitlines()
    assert len(rows) == 2 + 4
    body = json.loads((tmp_path / "found.json").read_text())
    assert set(body) == {"none", "true kernel, true state"}
    assert set(body["none"]) == {"MPPI", "blind MPPI"}
    assert body["none"]["MPPI"]["claimed"] is None
    assert body["true kernel, true state"]["blind MPPI"]["claimed"] == 3

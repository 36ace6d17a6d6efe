"""The benchmark of the filter, at a size of seconds."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
import torch

import torchrl_sspl as sspl
from torchrl_sspl.envs import CMUTwoDiscsEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.evaluation import simulation
from torchrl_sspl.evaluation.simulation import Episodes


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


@pytest.mark.parametrize(("agent", "name"), [("pendulum", "away_from_upright"), ("quadruped", "towards_obstacle")])
def test_the_adversary_of_a_saved_agent_is_that_of_its_system(benchmark, monkeypatch, tmp_path, agent, name):
    sspl.load(agent).save(tmp_path / "own")
    asked: list[str] = []
    nothing = Episodes(torch.zeros(0, 0, 1), torch.zeros(1, 0, dtype=torch.long), torch.zeros(1, 0, dtype=torch.bool))
    monkeypatch.setattr(benchmark, "reachable", lambda env, start: 0)
    monkeypatch.setattr(benchmark, "starts", lambda agent, env, *of: torch.zeros(0, env.state_dim))
    monkeypatch.setattr(benchmark, "on_known_dynamics", lambda *of: (asked.append(of[4].__name__), (nothing, "- | -"))[1])
    benchmark.main([str(tmp_path / "own"), "1", "--only", "adversarial"])
    assert set(asked) == {name}


def test_a_system_without_an_adversary_is_named(benchmark, monkeypatch):
    monkeypatch.setattr(benchmark, "described_system", lambda description: lambda size, seed: CMUTwoDiscsEnv(size, seed=seed))
    monkeypatch.setattr(benchmark, "starts", lambda agent, env, *of: torch.zeros(0, env.state_dim))
    with pytest.raises(ConfigError, match="expected an agent of a pendulum or a Dubins car, received one of CMUTwoDiscsEnv; give --only random"):
        benchmark.main(["pendulum", "1"])
    monkeypatch.setattr(benchmark, "described_system", lambda description: None)
    with pytest.raises(ConfigError, match="expected one whose description names a system of this library, received 'pendulum'"):
        benchmark.main(["pendulum", "1"])

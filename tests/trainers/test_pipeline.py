"""Training: it resumes exactly, refuses what does not belong to it, and keeps only what passed."""

from __future__ import annotations

import json

import pytest
import torch
from tiny import TINY

from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import CheckpointError, ConfigError
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.trainers.config import make_config
from torchrl_sspl.trainers.evaluation import evaluate
from torchrl_sspl.trainers.latents import CHECKPOINT_FILE, _action_grid
from torchrl_sspl.trainers.pipeline import Check, SafePolicyTraining


def make_env(batch_size: list[int], seed: int) -> PendulumEnv:
    return PendulumEnv(batch_size=batch_size, seed=seed)


def training(path, *overrides: str, kind=SafePolicyTraining) -> SafePolicyTraining:
    return kind(make_config([*TINY, *overrides, f"out_dir={path}"]), make_env)


class Killed(Exception):
    pass


class Interrupted(SafePolicyTraining):
    """Dies right after its n-th checkpoint, as a killed process would."""

    after = 0

    def _checkpoint(self) -> None:
        super()._checkpoint()
        type(self).after -= 1
        if type(self).after == 0:
            raise Killed


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole")
    return path, training(path).run()


@pytest.mark.parametrize("checkpoints", [1, 4, 9, 13])
def test_a_killed_training_continues_bit_for_bit(tmp_path, uninterrupted, checkpoints):
    Interrupted.after = checkpoints
    with pytest.raises(Killed):
        training(tmp_path, kind=Interrupted).run()
    resumed = training(tmp_path).run()
    expected = uninterrupted[1].agent.state_dict()
    for name, value in resumed.agent.state_dict().items():
        assert torch.equal(value, expected[name]), name
    assert resumed.checks == uninterrupted[1].checks


@pytest.mark.parametrize("checkpoints", [6, 11])
def test_a_training_whose_policy_is_taught_first_continues_bit_for_bit_too(tmp_path, checkpoints):
    taught = ("synthesis.teacher=value", "synthesis.teach_steps=4", "synthesis.counterexamples=0")
    whole = training(tmp_path / "whole", *taught)
    expected = whole.run()
    assert [name for name, _ in whole.phases()].count("teach") == 2
    Interrupted.after = checkpoints
    with pytest.raises(Killed):
        training(tmp_path / "part", *taught, kind=Interrupted).run()
    resumed = training(tmp_path / "part", *taught).run()
    for name, value in resumed.agent.state_dict().items():
        assert torch.equal(value, expected.agent.state_dict()[name]), name


def test_an_unknown_teacher_is_named(tmp_path):
    with pytest.raises(ConfigError, match="clearance, value"):
        training(tmp_path, "synthesis.teacher=mother").run()


def test_another_seed_gives_another_agent(tmp_path, uninterrupted):
    other = training(tmp_path, "seed=1").run().agent.state_dict()
    assert any(not torch.equal(v, other[k]) for k, v in uninterrupted[1].agent.state_dict().items())


def test_a_checkpoint_of_another_configuration_is_refused(uninterrupted):
    with pytest.raises(ConfigError, match="another out_dir"):
        training(uninterrupted[0], "synthesis.margin=0.5")


def test_an_unreadable_checkpoint_is_named(tmp_path):
    (tmp_path / CHECKPOINT_FILE).write_bytes(b"not a checkpoint")
    with pytest.raises(CheckpointError, match=r"checkpoint\.pt"):
        training(tmp_path)


def test_the_written_agent_is_the_returned_one(uninterrupted):
    path, result = uninterrupted
    loaded = Agent.load(path / "agent")
    pixels = make_env([4], 3).observe(torch.zeros(4, 2))
    assert torch.equal(loaded.encode(pixels), result.agent.encode(pixels))
    assert torch.equal(loaded.barrier(loaded.encode(pixels)), result.agent.barrier(result.agent.encode(pixels)))
    assert loaded.description["lipschitz"]["proved"] is True


def test_every_line_of_the_log_names_its_phase(uninterrupted):
    rows = [json.loads(line) for line in (uninterrupted[0] / "log.jsonl").read_text().splitlines()]
    assert {"represent", "dynamics", "fit", "steer", "tune", "check"} <= {row["phase"] for row in rows}


def check(number: int, size: float, passed: bool) -> Check:
    return Check(number, 0.0, 0, 0, 0, 0, 1.0, size, passed, "" if passed else "left 1")


def test_growth_is_never_paid_for_with_invariance(tmp_path):
    run = training(tmp_path)
    agent = run._agent(0.0)
    run._record(0, agent, check(0, 0.4, True))
    run._record(1, agent, check(1, 0.9, False))
    assert run.best is not None
    assert run.best["round"] == 0
    run._record(2, agent, check(2, 0.5, True))
    assert run.best["round"] == 2


def test_the_level_moves_the_last_bias(tmp_path):
    run = training(tmp_path)
    latent = torch.rand(5, 3) * 2 - 1
    torch.testing.assert_close(run._agent(0.25).barrier(latent), run._agent(0.0).barrier(latent) - 0.25)


def test_evaluation_measures_an_untrained_agent_without_flattering_it(uninterrupted):
    config = make_config(["evaluation.grid=15", "evaluation.kernel_grid=61", "evaluation.rollouts=10", "evaluation.horizon=4"])
    found = evaluate(uninterrupted[1].agent, make_env([1], 0), config.evaluation)
    names = {"unsafe_called_safe", "volume_over_kernel", "false_safe", "unsafe_rollouts_return", "lipschitz_ratio"}
    assert names <= set(found.measurements)
    for measurement in found.measurements.values():
        if measurement.unit == "share" and measurement.n:
            assert 0.0 <= measurement.lower <= measurement.value <= measurement.upper <= 1.0


def test_counterexamples_of_the_whole_domain_are_found_and_trained_on(uninterrupted):
    trained = training(uninterrupted[0])
    found = trained.counterexamples
    assert 0 < len(found) <= 8
    assert bool((found.abs() <= 1).all())


@pytest.mark.parametrize(("dimensions", "per_dimension"), [(1, 7), (2, 7), (3, 7), (4, 5), (6, 3), (12, 2)])
def test_the_grid_of_actions_gets_coarser_with_their_dimension(dimensions, per_dimension):
    grid = _action_grid([2.0] * dimensions, 7)
    assert grid.shape == (per_dimension**dimensions, dimensions)
    assert grid.min(0).values.tolist() == [-2.0] * dimensions
    assert grid.max(0).values.tolist() == [2.0] * dimensions


def test_too_many_dimensions_of_the_action_are_named():
    with pytest.raises(ConfigError, match="at most 12 action dimensions, received 13"):
        _action_grid([1.0] * 13, 7)

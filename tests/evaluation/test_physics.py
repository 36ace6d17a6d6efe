"""Walks in full physics: what is counted, where they start, and how the world is made and closed."""

from __future__ import annotations

import pytest
import torch
from evaluation.systems import World, straight_ahead

from torchrl_sspl.configs.schema import EvaluationConfig
from torchrl_sspl.envs import DubinsEnv, PendulumEnv
from torchrl_sspl.envs.dubins import YAW_LAG
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.evaluation.physics import evaluate_physics


class Car(DubinsEnv):
    """The Dubins car whose full physics are a stand-in, with faults that a test asks for."""

    def __init__(self, faults=None, **options):
        super().__init__(batch_size=[1], image_size=64, seed=0, **options)
        self.worlds, self.faults = [], faults or {}

    def physics(self):
        def make():
            self.worlds.append(World(**self.faults))
            return self.worlds[-1]

        return make


def sizes(walks: int, seconds: float) -> EvaluationConfig:
    return EvaluationConfig(walks=walks, walk_seconds=seconds)


def test_shares_have_their_events_and_the_world_is_closed():
    env = Car({"contact": 1})
    found, groups = evaluate_physics(straight_ahead(), env, sizes(3, 0.2))
    assert found["walks_from_safe_hit"] == found["walks_from_set_hit"] == 1.0
    assert found["walks_from_safe_fall"] == found["walks_from_set_fall"] == found["walks_from_set_enter"] == 0.0
    assert found.measurements["walks_from_set_enter"].n == 3
    assert [len(g) for g in groups] == [3, 3]
    assert [w.closed for w in env.worlds] == [1]
    assert bool(env.safe_set.contains(groups[0].states[0]).all())
    assert not bool(env.unsafe_set.contains(groups[1].states[0]).any())
    seeds = env.worlds[0].seeds
    assert seeds[:6] == [20260102, 20260103, 20260104] * 2


def test_entering_counts_as_a_hit_from_the_safe_set_only():
    found, _ = evaluate_physics(straight_ahead(), Car({"unsafe": 1}), sizes(2, 0.2))
    assert found["walks_from_safe_hit"] == found["walks_from_set_enter"] == 1.0
    assert found["walks_from_set_hit"] == 0.0


def test_falls_are_counted_and_the_world_is_closed_after_a_mistake():
    found, _ = evaluate_physics(straight_ahead(), Car({"fallen": 1}), sizes(2, 0.3))
    assert found["walks_from_safe_fall"] == found["walks_from_set_fall"] == 1.0
    env = Car()
    with pytest.raises(ZeroDivisionError):
        evaluate_physics(lambda pixels: torch.zeros(len(pixels)) if len(pixels) > 1 else 1 / 0, env, sizes(1, 0.1))
    assert [w.closed for w in env.worlds] == [1]


def test_an_empty_set_is_not_measured_rather_than_perfect():
    found, groups = evaluate_physics(straight_ahead(1.0), Car(), sizes(1, 0.1))
    assert found["walks_from_set_enter"] is None
    assert found["walks_from_safe_hit"] is not None
    assert len(groups) == 1


def test_a_bare_policy_walks_from_the_safe_set():
    found, groups = evaluate_physics(lambda pixels: torch.zeros(len(pixels)), Car(), sizes(2, 0.1))
    assert found["walks_from_safe_hit"] is not None
    assert found["walks_from_set_enter"] is None
    assert groups[0].barrier is None
    assert found.arrays["walks"].frames.shape[1] == 1


def test_without_walks_no_world_is_made():
    env = Car()
    found, groups = evaluate_physics(straight_ahead(), env, sizes(0, 1.0))
    assert groups == env.worlds == []
    assert found["walks_from_safe_hit"] is None


def test_the_closest_call_is_filmed():
    agent = straight_ahead()
    found, groups = evaluate_physics(agent, Car(), sizes(2, 0.3))
    walks = found.arrays["walks"]
    assert len(walks) == 4
    assert walks.frames.shape[:2] == (4, 1)
    starts = torch.cat([g.states[0] for g in groups])
    assert sorted(walks.states[0].tolist()) == sorted(starts.tolist())


def test_a_lagging_car_starts_walks_in_the_states_of_its_twin():
    _, groups = evaluate_physics(straight_ahead(), Car(yaw_lag=YAW_LAG), sizes(1, 0.1))
    assert groups[0].states.shape[-1] == 3


def test_systems_without_full_physics_are_named():
    with pytest.raises(ConfigError, match="physics"):
        evaluate_physics(lambda pixels: torch.zeros(len(pixels)), PendulumEnv(seed=0, image_size=16), sizes(1, 0.1))

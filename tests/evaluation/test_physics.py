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
from torchrl_sspl.evaluation.simulation import simulate


class Car(DubinsEnv):
    """The Dubins car whose full physics are a stand-in, with faults that a test asks for."""

    def __init__(self, faults=None, world=World, **options):
        super().__init__(batch_size=[1], image_size=64, seed=0, **options)
        self.worlds, self.faults, self.world = [], faults or {}, world

    def physics(self):
        def make():
            self.worlds.append(self.world(**self.faults))
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


class Moving(World):
    """As the robot in full physics: a reset takes a step of its own, and how it goes depends on the seed."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed, options=options)
        observation, _, _, _, info = self.step(torch.tensor([0.1 * (seed % 7)]))
        return observation, info


class Circling:
    """Turns all the time; its barrier is one of the distance from the middle."""

    reads = "state"

    def __init__(self, barrier):
        self.barrier = barrier

    def act(self, state):
        return torch.full((len(state), 1), 0.7), self.barrier(state[:, :2].abs().amax(-1))


@pytest.mark.parametrize(("barrier", "from_safe"), [(lambda far: 1.2 - far, False), (lambda far: far - 3.0, True)])
def test_the_film_shows_the_very_walk_that_was_measured(barrier, from_safe):
    env, policy = Car(world=Moving), Circling(barrier)
    found, groups = evaluate_physics(policy, env, sizes(4, 0.5))
    walks, every = found.arrays["walks"], groups[0].joined(groups[1])
    chosen = int(torch.where(every.alive, every.barrier, -torch.inf).amax(0).argmax())
    assert (chosen < 4) == from_safe
    order = [chosen, *(k for k in range(len(every)) if k != chosen)]
    assert torch.equal(walks.states, every.states[:, order])
    assert torch.equal(walks.alive, every.alive[:, order])
    assert all(torch.equal(happened, every.events[name][order]) for name, happened in walks.events.items())
    steps = int(walks.alive[:, 0].sum())
    assert torch.equal(walks.frames[:steps, 0], env.draw(walks.states[:steps, 0]))
    start, seed = found.arrays["closest"]
    again = simulate(policy, Moving(), start=torch.tensor([start]), horizon=5, seed=seed)
    assert torch.equal(again.states[:, 0], every.states[:, chosen])


@pytest.mark.pybullet
def test_in_full_physics_a_walk_is_repeated_bit_for_bit():
    pytest.importorskip("pybullet")
    env, policy = DubinsEnv(image_size=64), Circling(lambda far: 1.2 - far)
    found, groups = evaluate_physics(policy, env, sizes(2, 0.5))
    start, seed = found.arrays["closest"]
    world = env.physics()()
    again = simulate(policy, world, start=torch.tensor([start]), horizon=5, seed=seed, film=1)
    world.close()
    walks = found.arrays["walks"]
    assert torch.equal(again.states[:, 0], walks.states[:, 0])
    assert torch.equal(again.frames, walks.frames)
    assert any(torch.equal(again.states[:, 0], group.states[:, k]) for group in groups for k in range(len(group)))


def test_a_lagging_car_starts_walks_in_the_states_of_its_twin():
    _, groups = evaluate_physics(straight_ahead(), Car(yaw_lag=YAW_LAG), sizes(1, 0.1))
    assert groups[0].states.shape[-1] == 3


def test_systems_without_full_physics_are_named():
    with pytest.raises(ConfigError, match="physics"):
        evaluate_physics(lambda pixels: torch.zeros(len(pixels)), PendulumEnv(seed=0, image_size=16), sizes(1, 0.1))

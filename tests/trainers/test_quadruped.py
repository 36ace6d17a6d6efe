"""Walks in full physics: what is counted, when a walk ends, and how the robot's world is made and closed."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from torchrl_sspl.envs.dubins import YAW_LAG, DubinsEnv
from torchrl_sspl.errors import ConfigError, MissingDependencyError
from torchrl_sspl.modules import LatentDynamics, MomentEncoder, Policy
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.trainers import quadruped_run
from torchrl_sspl.trainers.quadruped import WalkConfig, evaluate_walks, kernel_of, latency, walk


class World:
    """Stands in for the simulator: the Dubins car, with faults that a test asks for."""

    def __init__(self, **faults: int) -> None:
        self.model, self.faults, self.closed = DubinsEnv(batch_size=[1], image_size=64), faults, 0

    def _info(self):
        now = {name: self.steps >= step for name, step in self.faults.items()}
        state = self.state[0]
        left = not bool(self.model.state_space.contains(state))
        info = {"pose": state.numpy(), "unsafe": bool(self.model.unsafe_set.contains(state)), "contact": False,
                "fallen": False, "left": left}  # fmt: skip
        return {**info, **now}

    def reset(self, *, seed=None, options=None):
        self.steps, self.state = 0, torch.tensor([options["pose"]])
        self.pixels = self.model.observe(self.state)[0].numpy()
        return self.pixels, self._info()

    def step(self, action):
        assert action.shape == (1,)
        before, self.steps = self.state, self.steps + 1
        self.state = self.model.wrap(self.model.dynamics(before, torch.as_tensor(action)[None]))
        pixels = self.model.observe(self.state, before)[0].numpy()
        info = self._info()
        return pixels, 0.0, info["fallen"] or info["left"], False, info

    def close(self):
        self.closed += 1


def straight_ahead(barrier: float = -1.0) -> Agent:
    """An agent that never turns and calls everything safe (or nothing)."""
    policy, constant = Policy(4, 1, (4,), 2.0), nn.Sequential(nn.Linear(4, 1))
    for layer in (policy.net[-1], constant[0]):
        nn.init.zeros_(layer.weight)
        nn.init.zeros_(layer.bias)
    nn.init.constant_(constant[0].bias, barrier)
    return Agent(MomentEncoder(4, 64), LatentDynamics(4, 1, (4,), 2.0), constant, policy, 1.5)


def test_a_walk_ends_where_the_arena_does():
    found = walk(straight_ahead(), World(), (1.75, 0.0, 0.0), 20, keep_frames=True)
    assert found.left
    assert not (found.entered)
    assert not (found.hit)
    assert not (found.fallen)
    assert len(found.poses) == len(found.barrier) == len(found.frames) == len(found.actions) + 1 == 4
    assert found.frames.dtype == torch.uint8


def test_a_walk_through_the_middle_enters_and_goes_on():
    found = walk(straight_ahead(), World(), (-1.5, 0.0, 0.0), 12)
    assert found.entered
    assert not found.left
    assert len(found.actions) == 12


@pytest.mark.parametrize(("fault", "field"), [("contact", "hit"), ("fallen", "fallen")])
def test_contacts_and_falls_are_kept(fault, field):
    found = walk(straight_ahead(), World(**{fault: 2}), (-1.5, 1.8, 0.0), 6)
    assert getattr(found, field)
    assert len(found.actions) == (2 if fault == "fallen" else 6)


def test_shares_have_their_events_and_the_world_is_closed():
    worlds = []

    def make():
        worlds.append(World(contact=1))
        return worlds[-1]

    model = DubinsEnv(batch_size=[1], image_size=64)
    found, walks = evaluate_walks(straight_ahead(), model, make, WalkConfig(episodes=3, seconds=0.2))
    assert found["walks_from_safe_hit"] == 1.0
    assert found["walks_from_safe_fall"] == 0.0
    assert found.measurements["walks_from_set_enter"].n == 3
    assert len(walks) == 6
    assert [w.closed for w in worlds] == [1]
    starts = torch.stack([w.poses[0] for w in walks])
    assert bool(model.safe_set.contains(starts[:3]).all())
    assert not bool(model.unsafe_set.contains(starts[3:]).any())


def test_an_empty_set_is_not_measured_rather_than_perfect():
    model = DubinsEnv(batch_size=[1], image_size=64)
    found, walks = evaluate_walks(straight_ahead(1.0), model, World, WalkConfig(episodes=1, seconds=0.1))
    assert found["walks_from_set_enter"] is None
    assert len(walks) == 1


def test_without_walks_no_world_is_made():
    model = DubinsEnv(batch_size=[1], image_size=64)
    found, walks = evaluate_walks(straight_ahead(), model, pytest.fail, WalkConfig(episodes=0))
    assert walks == []
    assert found["walks_from_safe_hit"] is None


def test_a_lagging_car_has_no_kernel_of_three_dimensions():
    with pytest.raises(ConfigError, match="yaw lag"):
        kernel_of(DubinsEnv(image_size=32, yaw_lag=YAW_LAG))


def test_latency_is_a_percentile_in_milliseconds():
    found = latency(straight_ahead(), DubinsEnv(batch_size=[1], image_size=64), frames=20)
    assert found.unit == "ms"
    assert found.n == 20
    assert 0.0 < found.value < 1000.0


def test_a_missing_simulator_is_named(monkeypatch):
    monkeypatch.setattr(quadruped_run, "_PHYSICS", "torchrl_sspl.no_such_module")
    with pytest.raises(MissingDependencyError, match="quadruped"):
        quadruped_run.make_physics(DubinsEnv(batch_size=[1], image_size=32))


def test_poses_are_floats():
    found = walk(straight_ahead(), World(), np.array([1.0, 1.5, 0.3]), 1)
    assert found.poses.dtype == torch.float32

"""Closed-loop episodes of the Dubins car: whoever has left the arena is asked for nothing any more."""

from __future__ import annotations

import math

import torch
from torch import nn

from torchrl_sspl.envs.dubins import DubinsEnv
from torchrl_sspl.evaluation import simulate
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.modules.networks import FrameEncoder, LatentDynamics, Policy


def straight_ahead() -> Agent:
    """An agent that never turns and whose barrier calls every frame unsafe."""
    torch.manual_seed(0)
    policy = Policy(4, 1, (8,), 2.0)
    nn.init.zeros_(policy.net[-1].weight)
    nn.init.zeros_(policy.net[-1].bias)
    barrier = nn.Sequential(nn.Linear(4, 1))
    nn.init.zeros_(barrier[0].weight)
    nn.init.constant_(barrier[0].bias, 0.5)
    return Agent(FrameEncoder(4, 128), LatentDynamics(4, 1, (8,), 2.0), barrier, policy, 1.5)


def test_after_leaving_the_arena_a_robot_stands_still_inside_the_set_and_without_error():
    env = DubinsEnv(batch_size=[2])
    start = torch.tensor([[1.85, 0.0, 0.0], [-1.9, 1.0, 0.0]])  # leaves after two steps; stays for long
    episodes = simulate(straight_ahead(), env, start=start, horizon=5)
    torch.testing.assert_close(episodes.states[2:, 0, 0], torch.full((4,), 2.05))
    torch.testing.assert_close(episodes.states[:, 1, 0], -1.9 + 0.1 * torch.arange(6.0))
    assert episodes.barrier[:, 0].tolist() == [0.5, 0.5, -1.0, -1.0, -1.0, -1.0]
    assert bool((episodes.barrier[:, 1] == 0.5).all())
    assert float(episodes.prediction_error[1:, 0].max()) == 0.0
    assert float(episodes.prediction_error[:, 1].min()) > 0.0
    assert episodes.events["left"].tolist() == [True, False]
    assert episodes.alive[:, 0].tolist() == [True] * 3 + [False] * 3
    assert bool(episodes.alive[:, 1].all())


def test_a_robot_that_leaves_cannot_come_back_into_the_unsafe_set():
    env = DubinsEnv(batch_size=[1])
    episodes = simulate(straight_ahead(), env, start=torch.tensor([[2.0, 0.0, -math.pi / 2], [1.99, 0.0, 0.0]]), horizon=40)
    assert not bool(env.unsafe_set.contains(episodes.states).any())
    assert not bool(env.state_space.contains(episodes.states[-1]).any())

"""The Dubins car with its top view: dynamics, regions, exits, frames, lag, ground truth."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_sspl.envs.dubins import YAW_LAG, Disc, DubinsEnv
from torchrl_sspl.errors import ConfigError, DTypeError, NonFiniteError, ShapeError
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE
from torchrl_sspl.viability.grid import viability_kernel


@pytest.mark.parametrize("batch_size", [[], [3]])
@pytest.mark.parametrize("yaw_lag", [None, YAW_LAG])
def test_specs_hold(batch_size, yaw_lag):
    check_env_specs(DubinsEnv(batch_size=batch_size, image_size=32, yaw_lag=yaw_lag, seed=0), seed=0)


def test_dynamics_are_the_papers_formula():
    state, action = torch.tensor([[0.3, -0.7, 0.9]]), torch.tensor([[1.3]])
    found = DubinsEnv(speed=0.8, dt=0.05, image_size=32).dynamics(state, action)
    torch.testing.assert_close(
        found, torch.tensor([[0.3 + 0.04 * math.cos(0.9), -0.7 + 0.04 * math.sin(0.9), 0.9 + 0.065]])
    )


def test_commands_beyond_the_bound_are_clamped():
    env, state = DubinsEnv(max_yaw_rate=1.5, image_size=32), torch.zeros(1, 3)
    assert torch.equal(env.dynamics(state, torch.tensor([[9.0]])), env.dynamics(state, torch.tensor([[1.5]])))


def test_with_the_yaw_lag_the_last_command_is_part_of_the_state():
    env = DubinsEnv(yaw_lag=(0.05, 0.06), image_size=32)
    first = env.dynamics(torch.tensor([[0.0, 0.0, 0.0, -1.0]]), torch.tensor([[2.0]]))
    torch.testing.assert_close(first[0, 2:], torch.tensor([0.05 * 2.0 - 0.06, 2.0]))
    second = env.dynamics(first, torch.tensor([[0.0]]))
    torch.testing.assert_close(second[0, 2:], first[0, 2:3].repeat(2) * torch.tensor([1.0, 0.0]) + torch.tensor([0.12, 0.0]))
    assert env.observe(first).shape == (1, 6, 32, 32)


def test_robots_that_turn_late_start_walking_straight_ahead():
    env = DubinsEnv(batch_size=[8], yaw_lag=(0.05, 0.06), image_size=32, seed=0)
    assert env.sample_states(100)[:, 3].abs().sum() == 0
    assert env.reset()["state"][:, 3].abs().sum() == 0


def test_regions_and_exit():
    env = DubinsEnv(image_size=32)
    states = torch.tensor([[0.69, 0.0, 1.0], [0.71, 0.0, 1.0], [1.51, 0.0, 9.0], [0.0, -1.9, 0.0], [2.1, 0.0, 0.0]])
    assert env.region(states).flatten().tolist() == [UNSAFE, UNLABELLED, SAFE, SAFE, SAFE]


def test_an_episode_ends_when_the_robot_leaves_and_that_is_safe():
    env = DubinsEnv(batch_size=[2], image_size=32, seed=0)
    start = TensorDict({"state": torch.tensor([[1.95, 0.0, 0.0], [1.95, 0.0, math.pi / 2]])}, [2])
    env.reset(start, set_state=True)
    out = env.step(TensorDict({"action": torch.zeros(2, 1)}, [2]))["next"]
    assert out["terminated"].flatten().tolist() == [True, False]
    assert out["region"].flatten().tolist() == [SAFE, SAFE]
    assert out["reward"].abs().sum() == 0


@pytest.mark.parametrize("shape", ["square", "disc"])
def test_obstacle_of_another_shape_and_place(shape):
    env = DubinsEnv(
        image_size=64, obstacle_shape=shape, obstacle_centre=(0.4, -0.3), unsafe_half_size=0.5, safe_half_size=1.2
    )
    corner, side = torch.tensor([[0.85, 0.15, 0.0]]), torch.tensor([[0.85, -0.3, 0.0]])
    assert bool(env.unsafe_set.contains(corner)) == (shape == "square")
    assert bool(env.unsafe_set.contains(side))
    drawn = env.unsafe_set.sample(500, torch.Generator().manual_seed(0))
    assert bool(env.unsafe_set.contains(drawn).all())
    torch.testing.assert_close(drawn[:, :2].mean(0), torch.tensor([0.4, -0.3]), atol=0.06, rtol=0)
    frame = env.draw(torch.tensor([[-1.5, 1.5, 0.0]]))[0]
    red = (frame[0] > 150) & (frame[1] < 100)
    rows, columns = red.nonzero().float().mean(0)
    metres = 4.8 / 64
    assert abs((columns - 31.5) * metres - 0.4) < metres
    assert abs((31.5 - rows) * metres + 0.3) < metres


def test_a_state_always_gives_the_same_frame_and_the_gait_varies_between_states():
    env = DubinsEnv(image_size=64)
    states = env.sample_states(2000, torch.Generator().manual_seed(0))
    assert torch.equal(env.observe(states[:4]), env.observe(states[:4]))
    share = torch.histc(env.gait_phase(states), 10, 0.0, 1.0) / len(states)
    assert share.min() > 0.07
    assert share.max() < 0.13


def test_frames_show_the_robot_where_it_is_even_just_outside_the_arena():
    env = DubinsEnv()
    states = torch.tensor([[1.2, -0.9, 0.5], [2.1, 2.1, 0.8], [-2.1, 0.0, 3.1]])
    frames = env.draw(states).float()
    blue = (frames[:, 2] > frames[:, 0] + 60).float()
    grid = (torch.arange(128) - 63.5) * (4.8 / 128)
    x, y = (blue * grid).sum((1, 2)) / blue.sum((1, 2)), (blue * -grid[:, None]).sum((1, 2)) / blue.sum((1, 2))
    torch.testing.assert_close(torch.stack([x, y], -1), states[:, :2], atol=0.12, rtol=0)


def test_observe_takes_the_previous_state():
    env = DubinsEnv(image_size=64)
    now, before = torch.tensor([[1.0, 1.0, 0.3]]), torch.tensor([[0.9, 1.0, 0.1]])
    pixels = env.observe(now, before)
    assert torch.equal(pixels[:, :3], env.draw(before))
    assert torch.equal(pixels[:, 3:], env.draw(now))
    straight = env.previous_state(now)
    torch.testing.assert_close(env.dynamics(straight, torch.zeros(1, 1)), now)


def test_faults_are_named():
    env = DubinsEnv(image_size=32)
    with pytest.raises(ShapeError, match="state"):
        env.observe(torch.zeros(2, 4))
    with pytest.raises(NonFiniteError, match="action"):
        env.dynamics(torch.zeros(1, 3), torch.full((1, 1), math.nan))
    with pytest.raises(DTypeError, match="state"):
        env.observe(torch.zeros(2, 3, dtype=torch.int64))
    for wrong in (
        dict(max_yaw_rate=0.0),
        dict(obstacle_shape="star"),
        dict(unsafe_half_size=1.6),
        dict(obstacle_half_size=0.8),
        dict(obstacle_centre=(3.0, 0.0)),
        dict(yaw_lag=(0.1,)),
        dict(image_size=8),
    ):
        with pytest.raises(ConfigError):
            DubinsEnv(**wrong)
    with pytest.raises(ConfigError, match="radius"):
        Disc([0.0, 0.0], -1.0)


@pytest.mark.parametrize(("max_yaw_rate", "shell"), [pytest.param(1.0, 0.064, marks=pytest.mark.slow), pytest.param(1.25, 0.054, marks=pytest.mark.slow), pytest.param(2.0, 0.0375, marks=pytest.mark.slow)])
def test_doomed_share_of_free_space(max_yaw_rate, shell):
    env = DubinsEnv(max_yaw_rate=max_yaw_rate, image_size=32)
    kernel = viability_kernel(env, resolution=[61, 61, 36])
    assert abs((1 - kernel.volume_fraction) - shell) < 0.01
    heading_in = torch.tensor([[0.75, 0.0, math.pi], [0.75, 0.0, 0.0], [1.99, 0.0, 0.0]])
    assert kernel.contains(heading_in).tolist() == [False, True, True]
    safe = env.safe_set.sample(20000, torch.Generator().manual_seed(0))
    doomed = int((~kernel.contains(safe)).sum())
    assert (doomed == 0) == (max_yaw_rate > 1.2)

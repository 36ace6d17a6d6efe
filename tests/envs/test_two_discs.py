"""CMU's car between two discs: dynamics, labels, a picture held to Pillow's, and a kernel that does not ask for the goal."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from torchrl_sspl.configs import compose
from torchrl_sspl.configs.schema import EvaluationConfig
from torchrl_sspl.envs import CMUTwoDiscsEnv
from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.evaluation import evaluate
from torchrl_sspl.experiments import Experiment
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE
from torchrl_sspl.viability import viability_kernel


def pillow_frame(state, size=128):
    """What Pillow draws of one state, ``(3, size, size)``: discs, goal and comet at four times the size, reduced by its Lanczos kernel."""
    from PIL import Image, ImageDraw

    x, y, heading, goal = (float(v) for v in state)
    side = 4 * size
    image = Image.new("RGB", (side, side), "white")
    draw = ImageDraw.Draw(image)

    def at(place):
        return int((place[0] + 1.5) / 3 * side), int((1.5 - place[1]) / 3 * side)

    for place, radius, colour in (((0.25, 0.65), 0.5, "red"), ((0.25, -0.65), 0.5, "red"), ((1.3, goal), 0.05, "green")):
        (column, row), reach = at(place), radius / 3 * side
        draw.ellipse([(column - reach, row - reach), (column + reach, row + reach)], fill=colour)
    (column, row), tip, half = at((x, y)), 10 / 128 * side, 3 / 128 * side
    along, across = (math.cos(heading), -math.sin(heading)), (math.sin(heading), math.cos(heading))
    corners = [(column + tip * along[0], row + tip * along[1])]
    corners += [(column + s * half * across[0], row + s * half * across[1]) for s in (1, -1)]
    draw.polygon(corners, fill="blue")
    box = [(column - half, row - half), (column + half, row + half)]
    draw.pieslice(box, math.degrees(-heading) + 90, math.degrees(-heading) - 90, fill="blue")
    return torch.from_numpy(np.array(image.resize((size, size), Image.Resampling.LANCZOS))).permute(2, 0, 1)


@pytest.fixture(scope="module")
def states():
    env = CMUTwoDiscsEnv(seed=0)
    at = [[1.3, 0.1, 0.3, 0.1], [0.25, 0.65, 1.0, 0.2], [-1.5, 1.5, 2.5, 0.0], [1.5, -1.5, 0.0, -0.6]]  # on goal, disc and corners
    return torch.cat([torch.tensor(at), env.sample_states(40)])


@pytest.mark.parametrize("batch_size", [[], [3]])
def test_specs_hold(batch_size):
    check_env_specs(CMUTwoDiscsEnv(batch_size=batch_size, image_size=32, seed=0), seed=0)


def test_pictures_are_pillows(states):
    theirs = torch.stack([pillow_frame(s) for s in states]).int()
    off = (CMUTwoDiscsEnv().draw(states).int() - theirs).abs().float()
    changed = (theirs - theirs.median(0).values).abs() > 5
    # Which pixels of the large picture an edge of the comet takes is a matter of taste: one of them is a sixteenth.
    assert off.mean() < 0.05
    assert off[changed].mean() < 4.0
    assert off.max() <= 90


def test_a_car_of_another_heading_or_another_goal_does_not_pass_for_the_picture(states):
    theirs = torch.stack([pillow_frame(s) for s in states[4:]]).int()
    changed = (theirs - theirs.median(0).values).abs() > 5
    for shift in ([0.0, 0.0, 0.15, 0.0], [0.0, 0.0, 0.0, 0.05]):
        assert (CMUTwoDiscsEnv().draw(states[4:] + torch.tensor(shift)).int() - theirs).abs().float()[changed].mean() > 8.0


def test_pictures_come_in_any_batch_shape(states):
    env = CMUTwoDiscsEnv()
    frames = env.draw(states[:6])
    assert torch.equal(env.draw(states[:6].reshape(2, 3, 4)), frames.reshape(2, 3, 3, 128, 128))
    assert torch.equal(torch.stack([env.draw(s) for s in states[:6]]), frames)
    assert env.draw(states[:0]).shape == (0, 3, 128, 128)


def test_dynamics_are_those_of_fine_steps_and_leave_the_goal_where_it_is():
    env = CMUTwoDiscsEnv()
    state, fine = torch.tensor([[0.2, -0.4, 0.9, 0.3]]), torch.tensor([0.2, -0.4, 0.9], dtype=torch.float64)
    for _ in range(1000):
        turn = 2.0 * 0.05 / 1000
        heading = fine[2] + turn / 2
        fine = fine + torch.stack([heading.cos() * 5e-5, heading.sin() * 5e-5, torch.tensor(turn, dtype=torch.float64)])
    found = env.dynamics(state, torch.tensor([[5.0]]))  # beyond the bound of 2
    torch.testing.assert_close(found[0, :3], fine.float(), atol=1e-6, rtol=0.0)
    assert found[0, 3].item() == pytest.approx(0.3)


def test_collisions_are_theirs():
    env = CMUTwoDiscsEnv()
    border = torch.tensor([[0.25, 0.151, 0.0, 0.0], [0.25, 0.149, 0.0, 0.6], [0.25, -1.14, 1.0, 0.0], [0.25, -1.16, 1.0, 0.0]])
    assert env.region(border).flatten().tolist() == [UNSAFE, UNLABELLED, UNSAFE, UNLABELLED]
    assert env.region(torch.tensor([[1.6, 0.0, 0.0, 0.0]])).item() == SAFE  # it has left


def test_safe_is_the_last_frame_before_the_car_leaves_whatever_it_does():
    env = CMUTwoDiscsEnv(seed=0)
    drawn = env.sample_states(500, region=env.safe_set)
    for rate in (-2.0, 0.0, 2.0):
        assert not env.state_space.contains(env.dynamics(drawn, torch.full((500, 1), rate))).any()
    assert (env.region(drawn) == SAFE).all()


def test_a_goal_is_reached_within_a_fifth_of_a_metre():
    at = torch.tensor([[1.11, 0.3, 0.0, 0.3], [1.09, 0.3, 0.0, 0.3], [1.3, 0.3, 0.0, 0.0]])
    assert CMUTwoDiscsEnv.reached(at).tolist() == [True, False, False]
    with pytest.raises(ShapeError, match="state"):
        CMUTwoDiscsEnv.reached(at[:, :3])


@pytest.mark.slow
def test_the_true_kernel_has_a_way_through_the_gap_and_does_not_ask_for_the_goal():
    env = CMUTwoDiscsEnv()
    kernel = viability_kernel(env, resolution=(61, 61, 36, 2), actions=torch.tensor([[-2.0], [0.0], [2.0]]))
    ways = torch.tensor([[0.25, 0.0, 0.0, 0.0], [-0.6, 0.0, 0.0, 0.5], [-0.3, 0.65, 0.0, 0.0], [-1.2, 0.65, 0.0, 0.0]])
    assert kernel.contains(ways).tolist() == [True, True, False, True]
    drawn = env.sample_states(2000, torch.Generator().manual_seed(0))
    moved = drawn.clone()
    moved[:, 3] = -drawn[:, 3]
    assert torch.equal(kernel.contains(drawn), kernel.contains(moved))


def test_a_size_that_is_none_is_refused():
    with pytest.raises(ConfigError, match="image_size"):
        CMUTwoDiscsEnv(image_size=0)


@pytest.mark.slow
def test_the_recommended_settings_begin_a_training_and_its_agents_are_measured(tmp_path):
    config = compose(["env=two_discs", "env.image_size=32", "network.pool_to=32", "preset=smoke", "logger=none", f"out_dir={tmp_path}"])
    experiment = Experiment(config)
    assert isinstance(experiment.env, CMUTwoDiscsEnv)
    assert experiment.dynamics.direction is not None  # the last two entries of the latent are one
    experiment.encoder.fit(experiment.env.draw(experiment.env.sample_states(20)))
    found = evaluate(Agent.from_loss(experiment.loss), experiment.env, EvaluationConfig(grid=7, kernel_grid=9, episodes=4, horizon=3))
    assert found["volume_over_kernel"] is not None
    assert found.measurements["unsafe_called_safe"].n > 20  # a grid over both discs

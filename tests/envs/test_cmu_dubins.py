"""CMU's Dubins car: dynamics, labels, a picture held to matplotlib's, ground truth, and what their scores mean."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
import torch
from tiny import SINGLE
from torchrl.envs.utils import check_env_specs

from torchrl_sspl.configs import compose
from torchrl_sspl.envs import CMUDubinsEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.experiments import Experiment
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE
from torchrl_sspl.viability import viability_kernel


def matplotlib_frame(state, *, size=128, scale=0.18, width=0.1, dot=20.0, background=(1, 1, 1), obstacle=(1, 0, 0)):
    """What matplotlib draws of one state: outline, arrow and dot on a figure of one inch, ``(3, size, size)``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle
    from PIL import Image

    x, y, heading = (float(v) for v in state)
    figure = Figure(figsize=(1, 1), facecolor=background)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(-1.1, 1.1), ylim=(-1.1, 1.1))
    axes.axis("off")
    axes.add_patch(Circle((0, 0), 0.5, edgecolor=obstacle, facecolor="none"))
    step = (0.05 * math.cos(heading), 0.05 * math.sin(heading))
    how = {"angles": "xy", "scale_units": "xy", "minlength": 0, "scale": scale, "width": width, "zorder": 3}
    axes.quiver(x, y, *step, color=(0, 0, 1), **how)
    if dot:
        axes.scatter(x, y, s=dot, c=[(0, 0, 1)], zorder=3)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=size)
    return torch.from_numpy(np.array(Image.open(file).convert("RGB"))).permute(2, 0, 1)


@pytest.fixture(scope="module")
def states():
    env = CMUDubinsEnv(seed=0)
    at = [[0.5, 0.0, -2.6], [-1.1, 1.1, 2.0], [1.1, 0.3, 0.0], [0.1, -1.09, 3.0], [0.0, 0.0, 0.0]]  # on outline and border
    return torch.cat([torch.tensor(at), env.sample_states(20)])


@pytest.mark.parametrize("batch_size", [[], [3]])
def test_specs_hold(batch_size):
    check_env_specs(CMUDubinsEnv(batch_size=batch_size, image_size=32, seed=0), seed=0)


@pytest.mark.parametrize(
    ("options", "same"),
    [
        ({}, {}),
        ({"arrow_scale": 0.1}, {"scale": 0.1}),
        ({"arrow_scale": 0.2, "arrow_width": 0.05, "dot_area": 0.0}, {"scale": 0.2, "width": 0.05, "dot": 0.0}),
        ({"arrow_scale": 0.1, "arrow_width": 0.02}, {"scale": 0.1, "width": 0.02}),  # long enough to have a shaft
        ({"background": (0, 1, 1), "obstacle_colour": (1, 0, 1)}, {"background": (0, 1, 1), "obstacle": (1, 0, 1)}),
        ({"image_size": 64}, {"size": 64}),
    ],
)
def test_pictures_are_matplotlibs(states, options, same):
    drawn = CMUDubinsEnv(**options).draw(states).int()
    off = (drawn - torch.stack([matplotlib_frame(s, **same) for s in states]).int()).abs()
    # The most is on the outline, which matplotlib draws as a polygon: 0.04 pixels smaller than a circle.
    assert off.max() <= 40
    assert off.float().mean() < 0.4


def test_a_car_of_another_heading_does_not_pass_for_the_picture(states):
    turned = states + torch.tensor([0.0, 0.0, math.radians(4)])
    off = (CMUDubinsEnv().draw(turned).int() - torch.stack([matplotlib_frame(s) for s in states]).int()).abs()
    assert off.max() > 60


def test_pictures_come_in_any_batch_shape(states):
    env = CMUDubinsEnv()
    frames = env.draw(states[:6])
    assert torch.equal(env.draw(states[:6].reshape(2, 3, 3)), frames.reshape(2, 3, 3, 128, 128))
    assert env.draw(states[:0]).shape == (0, 3, 128, 128)


def test_dynamics_and_failures_are_theirs():
    env = CMUDubinsEnv()
    found = env.dynamics(torch.tensor([[0.2, -0.4, 0.9]]), torch.tensor([[5.0]]))
    after = [0.2 + 0.05 * math.cos(0.9), -0.4 + 0.05 * math.sin(0.9), 0.9 + 0.05 * 1.25]
    torch.testing.assert_close(found, torch.tensor([after]))
    border = torch.tensor([[0.35, 0.35, 0.0], [0.36, 0.36, 0.0]])  # inside and outside of the disc of 0.5
    assert env.region(border).flatten().tolist() == [UNSAFE, UNLABELLED]


def test_safe_is_the_last_frame_before_the_car_leaves_whatever_it_does():
    env = CMUDubinsEnv(seed=0)
    drawn = env.sample_states(500, region=env.safe_set)
    for rate in (-1.25, 0.0, 1.25):
        assert not env.state_space.contains(env.dynamics(drawn, torch.full((500, 1), rate))).any()
    assert (env.region(drawn) == SAFE).all()
    inwards = drawn - torch.tensor([0.0, 0.0, math.pi])
    assert (env.region(inwards[drawn[:, :2].abs().amin(-1) < 1.0]) == UNLABELLED).all()
    assert env.region(torch.tensor([[1.2, 0.0, 0.0]])).item() == SAFE  # it has left


def test_an_episode_ends_where_the_car_leaves():
    env = CMUDubinsEnv(batch_size=[1], image_size=32, seed=0)
    run = env.rollout(60, break_when_all_done=True)
    last = run["next", "state"][0, -1]
    assert run["next", "terminated"][0, -1].item()
    assert last[:2].abs().max() > 1.1
    assert run["next", "region"][0, -1].item() == SAFE


@pytest.mark.slow
def test_the_true_kernel_has_the_share_that_they_report():
    env = CMUDubinsEnv()
    kernel = viability_kernel(env, resolution=(51, 51, 50))
    unsafe = ~kernel.contains(env.state_space.grid((51, 51, 51)))
    # Their own grid, from a solver of the Hamilton-Jacobi equation, has 22.0 %.
    assert abs(float(unsafe.float().mean()) - 0.220) < 0.01
    # Straight ahead a car can still turn away from 1.03 m: its circle of 0.8 m then passes the disc.
    assert kernel.contains(torch.tensor([[-1.08, 0.0, 0.0], [-0.9, 0.0, 0.0], [-0.9, 0.0, math.pi]])).tolist() == [True, False, True]


def test_values_that_are_none_are_refused():
    with pytest.raises(ConfigError, match="background"):
        CMUDubinsEnv(background=(0, 0, 300))
    with pytest.raises(ConfigError, match="arrow_scale"):
        CMUDubinsEnv(arrow_scale=0.0)
    with pytest.raises(ConfigError, match="dot_area"):
        CMUDubinsEnv(dot_area=-1.0)


@pytest.mark.slow
def test_the_settings_train_this_car_from_its_pictures_alone(tmp_path):
    config = compose(["env=cmu", *(word for word in SINGLE if not word.startswith("env")), "env.image_size=64", "network.pool_to=32", f"out_dir={tmp_path}"])
    experiment = Experiment(config)
    assert isinstance(experiment.env, CMUDubinsEnv)
    agent = experiment.train()
    assert agent.encode(experiment.env.observe(experiment.env.sample_states(3))).shape == (3, 2)

"""Frames drawn in batches are those of PyBullet's renderer."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_sspl.envs import DubinsEnv
from torchrl_sspl.envs.quadruped.compositor import TopViewCompositor
from torchrl_sspl.errors import ConfigError, DTypeError, NonFiniteError, ShapeError
from torchrl_sspl.sets import Box


def poses(n: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    pose = (torch.rand(n, 3, generator=g) * 2 - 1) * torch.tensor([2.0, 2.0, math.pi])
    return pose, torch.rand(n, generator=g)


@pytest.mark.pybullet
def test_frames_agree_with_the_renderer():
    pytest.importorskip("pybullet")
    from torchrl_sspl.envs.quadruped.sprites import BulletRenderer

    pose, phase = poses(150, seed=7)
    reference = BulletRenderer()(pose, phase)
    compositor = TopViewCompositor(obstacle=Box([-0.3, -0.3], [0.3, 0.3]))
    gap = (compositor(pose, phase).int() - reference.int()).abs()
    assert float(gap.float().mean()) <= 1.0
    assert float((gap.amax(1) > 16).float().mean()) <= 0.005
    # The same check notices a robot that is drawn 5 cm or 0.1 rad beside its place.
    for moved in (torch.tensor([0.05, 0.0, 0.0]), torch.tensor([0.0, 0.0, 0.1])):
        wrong = (compositor(pose + moved, phase).int() - reference.int()).abs()
        assert float((wrong.amax(1) > 16).float().mean()) > 1.5 * float((gap.amax(1) > 16).float().mean())


def test_frames_are_independent_of_the_batch_they_are_drawn_in():
    pose, phase = poses(12)
    compositor = TopViewCompositor()
    together = compositor(pose, phase)
    torch.testing.assert_close(compositor(pose.reshape(3, 4, 3), phase.reshape(3, 4)).flatten(0, 1), together)
    torch.testing.assert_close(torch.cat([compositor(p[None], f[None]) for p, f in zip(pose, phase, strict=True)]), together)


def test_a_robot_outside_the_view_leaves_the_arena_empty():
    compositor = TopViewCompositor()
    away = compositor(torch.tensor([[9.0, 0.0, 0.0], [0.0, -9.0, 1.0]]))
    assert bool((away[0] == away[1]).all())
    assert bool((compositor(torch.zeros(1, 3)) != away[:1]).any())


def test_environment_shows_the_step_before_and_now():
    env = DubinsEnv(batch_size=[1], seed=0)
    state = torch.tensor([[-1.6, 0.4, 0.2]])
    pixels = env.observe(state, previous_state=state)
    assert bool((pixels[:, :3] == pixels[:, 3:]).all())
    moving = env.observe(state)
    assert bool((moving[:, 3:] == pixels[:, 3:]).all())
    assert bool((moving[:, :3] != pixels[:, 3:]).any())


@pytest.mark.parametrize(
    ("pose", "error"),
    [
        (torch.zeros(2, 2), ShapeError),
        (torch.zeros(2, 3, dtype=torch.int64), DTypeError),
        (torch.full((1, 3), math.nan), NonFiniteError),
    ],
)
def test_bad_poses_are_refused(pose, error):
    with pytest.raises(error):
        TopViewCompositor()(pose)


def test_bad_sizes_are_refused():
    with pytest.raises(ConfigError):
        TopViewCompositor(image_size=8)
    with pytest.raises(ShapeError):
        TopViewCompositor(obstacle=Box([0.0], [1.0]))

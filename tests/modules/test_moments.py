"""The encoder on the centres of colours: it sees place and heading, whatever the gait, and survives a round trip."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import nn

from torchrl_sspl.envs.cmu_dubins import CMUDubinsEnv
from torchrl_sspl.envs.dubins import DubinsEnv
from torchrl_sspl.errors import ConfigError, DTypeError, EmptyRegionError
from torchrl_sspl.modules import LatentDynamics, MomentEncoder, Policy, ShapeEncoder
from torchrl_sspl.modules.agent import Agent, mlp_barrier


@pytest.fixture(scope="module")
def seen():
    """Encoder fitted to 500 frames, and 300 fresh states outside U with their frames."""
    env = DubinsEnv(image_size=64)
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    encoder = MomentEncoder(4, 64)
    encoder.fit(env.draw(env.sample_states(500, generator)))
    states = env.sample_states(300, generator, region=env.state_space - env.unsafe_set)
    return encoder, states, env.observe(states)


def test_place_and_heading_can_be_read_linearly_from_the_centres(seen):
    encoder, states, pixels = seen
    with torch.no_grad():
        centres = torch.cat([encoder.frames(pixels[:, 3:]), torch.ones(300, 1)], -1)
    goal = torch.cat([states[:, :2], states[:, 2:].cos(), states[:, 2:].sin()], -1)
    solution = torch.linalg.lstsq(centres[:200], goal[:200]).solution
    found = centres[200:] @ solution
    assert (found[:, :2] - goal[200:, :2]).norm(dim=-1).max() < 0.06  # m; a pixel has 0.075 m
    angle = torch.atan2(found[:, 3], found[:, 2]) - states[200:, 2]
    assert angle.sin().abs().quantile(0.95) < 0.15


def test_without_a_fit_the_heading_is_drowned(seen):
    _, states, pixels = seen
    raw = MomentEncoder(4, 64).frames(pixels[:, 3:]).detach()
    spread = torch.cat([raw, torch.ones(300, 1)], -1)
    goal = torch.cat([states[:, 2:].cos(), states[:, 2:].sin()], -1)
    residual = goal - spread @ torch.linalg.lstsq(spread, goal).solution
    assert residual.square().mean().sqrt() > 0.3


def test_with_no_velocity_gain_the_previous_frame_does_not_matter(seen):
    encoder, _, pixels = seen
    other = torch.cat([pixels[:, :3].flip(0), pixels[:, 3:]], 1)
    assert torch.equal(encoder(pixels), encoder(other))
    moving = MomentEncoder(4, 64, velocity_gain=4.0)
    assert not torch.equal(moving(pixels), moving(other))


def test_an_agent_with_it_survives_disk(seen, tmp_path):
    encoder, _, pixels = seen
    sizes = {"latent_dim": 4, "action_dim": 1, "hidden": [8], "action_scale": 2.0}
    networks = {
        "encoder": {"class": "MomentEncoder", "arguments": {"latent_dim": 4, "image_size": 64}},
        "dynamics": {"class": "LatentDynamics", "arguments": sizes},
        "policy": {"class": "Policy", "arguments": sizes},
        "barrier": {"latent_dim": 4, "hidden": [8]},
    }
    agent = Agent(
        encoder, LatentDynamics(**sizes), mlp_barrier(4, [8]), Policy(**sizes), 1.5, {"networks": networks}
    )
    loaded = Agent.load(agent.save(tmp_path))
    assert torch.equal(loaded.encode(pixels[:5]), agent.encode(pixels[:5]))


def test_wrong_frames_are_named(seen):
    encoder, _, pixels = seen
    with pytest.raises(EmptyRegionError, match="10 frames"):
        MomentEncoder(4, 64).fit(pixels[:5, 3:])
    with pytest.raises(DTypeError, match="uint8"):
        encoder.fit(pixels[:, 3:].float())


def test_an_empty_frame_is_finite(seen):
    encoder, _, _ = seen
    assert torch.isfinite(encoder(torch.full((1, 6, 64, 64), 255, dtype=torch.uint8))).all()


@pytest.fixture(scope="module")
def arrows():
    """Encoder of shapes fitted to 300 frames of arrows, and 200 fresh states away from the border with their frames."""
    env = CMUDubinsEnv()
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    encoder = ShapeEncoder(4, 128)
    encoder.fit(env.draw(env.sample_states(300, generator)))
    states = env.sample_states(200, generator) * torch.tensor([0.8, 0.8, 1.0])
    return encoder, states, env.observe(states)


def test_an_arrow_of_one_colour_tells_place_and_heading_to_two_degrees(arrows):
    encoder, states, pixels = arrows
    with torch.no_grad():
        moments = encoder.frames(pixels.unflatten(1, (2, 3)))
    found = moments[:, :, 2:4].sum(1)
    angle = torch.remainder(torch.atan2(-found[:, 1], found[:, 0]) - states[:, 2] + math.pi, 2 * math.pi) - math.pi
    assert angle.square().mean().sqrt() < math.radians(2.5)
    ahead = torch.stack([states[:, 2].cos(), states[:, 2].sin()], -1)
    centre = moments[:, 1, :2] * encoder.trunk[0].scale[:2] * 1.1 * torch.tensor([1.0, -1.0])
    assert (centre - states[:, :2] - 0.05 * ahead).norm(dim=-1).mean() < 0.01  # m; a pixel has 0.017 m


def test_the_shape_is_the_same_before_every_background(arrows):
    encoder, states, pixels = arrows
    frames, moments = pixels[:, 3:].float() / 127.5 - 1.0, encoder.trunk[0]
    plain = copy.deepcopy(moments)
    plain.background.fill_(1.0)  # the picture is white but for the disc's outline
    bare = CMUDubinsEnv(obstacle_colour=(1.0, 1.0, 1.0)).draw(states).float() / 127.5 - 1.0
    half = nn.functional.avg_pool2d
    assert (moments.moments(half(frames, 2)) - plain.moments(half(bare, 2)))[:, :2].abs().max() < 0.01


def test_noise_of_a_camera_moves_the_shape_little(arrows):
    encoder, _, pixels = arrows
    noisy = (pixels.float() + torch.randn(pixels.shape, generator=torch.Generator().manual_seed(1))).round().clamp(0, 255).byte()
    with torch.no_grad():
        assert (encoder(noisy) - encoder(pixels)).abs().max() < 0.02


def test_an_encoder_of_shapes_needs_four_latents_and_survives_disk(arrows, tmp_path):
    with pytest.raises(ConfigError, match="latent_dim >= 4"):
        ShapeEncoder(3)
    encoder, _, pixels = arrows
    twin = ShapeEncoder(**encoder.arguments)
    twin.load_state_dict(encoder.state_dict())
    assert torch.equal(twin(pixels[:9]), encoder(pixels[:9]))

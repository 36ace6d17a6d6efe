"""The encoder on the centres of colours: it sees place and heading, whatever the gait, and survives a round trip."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from torchrl_sspl.envs.cmu_dubins import CMUDubinsEnv
from torchrl_sspl.envs.dubins import DubinsEnv
from torchrl_sspl.envs.two_discs import CMUTwoDiscsEnv
from torchrl_sspl.errors import ConfigError, DTypeError, EmptyRegionError
from torchrl_sspl.modules import (
    BearingEncoder,
    LatentDynamics,
    MomentEncoder,
    Policy,
    ShapeBearingEncoder,
    ShapeEncoder,
    ShapePlaceEncoder,
)
from torchrl_sspl.modules.agent import Agent, mlp_barrier
from torchrl_sspl.modules.moments import Bearing


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


def test_an_arrow_of_one_colour_tells_place_and_heading_to_one_and_a_half_degrees(arrows):
    encoder, states, pixels = arrows
    with torch.no_grad():
        moments = encoder.frames(pixels.unflatten(1, (2, 3)))
    found = moments[:, 1, 2:4]
    angle = torch.remainder(torch.atan2(-found[:, 1], found[:, 0]) - states[:, 2] + math.pi, 2 * math.pi) - math.pi
    assert angle.square().mean().sqrt() < math.radians(1.5)
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


@pytest.fixture(scope="module")
def disc_ahead():
    """Encoder of bearings fitted to arrows of one colour, fresh states, and where the disc lies for each: ahead, aside [m]."""
    env, generator = CMUDubinsEnv(), torch.Generator().manual_seed(0)
    encoder = ShapeBearingEncoder(3, 128, pool_to=128)
    encoder.fit(env.draw(env.sample_states(500, generator)))
    states = env.sample_states(300, generator) * torch.tensor([0.8, 0.8, 1.0])
    (x, y), c, s = -states[:, :2].T, states[:, 2].cos(), states[:, 2].sin()
    return env, encoder, states, torch.stack([c * x + s * y, s * x - c * y], -1)  # aside is to the right in a picture


def test_a_disc_lies_where_it_does_seen_from_an_arrow_of_one_colour(disc_ahead):
    env, encoder, states, truth = disc_ahead
    seen = 1.1 * torch.atanh(encoder(env.observe(states))[:, :2])  # m
    off = seen - truth + torch.tensor([0.05, 0.0])  # the middle of the arrow is ahead of the car
    assert off.norm(dim=-1).mean() < 0.01
    assert off.norm(dim=-1).quantile(0.99) < 0.03


def test_where_the_border_cuts_an_arrow_the_frame_before_and_the_motion_tell_its_direction(disc_ahead):
    env, encoder, _, _ = disc_ahead
    leaving = torch.tensor([[0.95, 0.95, math.pi / 4], [1.0, 0.2, 0.0], [-0.3, 1.0, math.pi / 2], [0.2, -0.8, -math.pi / 2]])
    moments = encoder.frames(env.observe(leaving).unflatten(1, (2, 3)))
    assert (moments[:3, 1, 4] < 0.2).all()  # these are cut
    assert moments[3, 1, 4] == 1.0
    ahead = encoder.ahead(moments[:, 0], moments[:, 1])
    angle = torch.remainder(torch.atan2(-ahead[:, 1], ahead[:, 0]) - leaving[:, 2] + math.pi, 2 * math.pi) - math.pi
    assert angle.abs().max() < math.radians(15)


def test_an_arrow_that_turns_with_its_place_around_the_disc_sees_the_same(disc_ahead):
    env, encoder, states, _ = disc_ahead
    quarter = torch.stack([-states[:, 1], states[:, 0], states[:, 2] + math.pi / 2], -1)
    moved = encoder(env.observe(quarter)) - encoder(env.observe(states))
    assert moved.abs().mean() < 0.005


def test_an_encoder_of_the_disc_leaves_entries_to_the_memory_and_survives_disk(disc_ahead):
    env, encoder, states, _ = disc_ahead
    latent = encoder(env.observe(states[:9]))
    assert torch.equal(latent[:, 2:], torch.zeros(9, 1))
    assert not any(p.requires_grad for p in encoder.parameters() if p is encoder.gain)
    twin = ShapeBearingEncoder(**encoder.arguments)
    twin.load_state_dict(encoder.state_dict())
    assert torch.equal(twin(env.observe(states[:9])), latent)
    assert encoder(torch.full((1, 6, 128, 128), 255, dtype=torch.uint8)).isfinite().all()
    for wrong in ({"latent_dim": 1}, {"latent_dim": 2, "reach": 0.0}):
        with pytest.raises(ConfigError, match="latent_dim >= 2 and reach > 0"):
            ShapeBearingEncoder(**wrong)


@pytest.fixture(scope="module")
def comet():
    """Encoder of places fitted to 500 frames of comets and goals, and fresh states away from the border."""
    env, generator = CMUTwoDiscsEnv(), torch.Generator().manual_seed(0)
    encoder = ShapePlaceEncoder(5, 128, pool_to=128)
    encoder.fit(env.draw(env.sample_states(500, generator)))
    return env, encoder, env.sample_states(200, generator) * torch.tensor([0.8, 0.8, 1.0, 1.0])


def test_a_thing_of_one_colour_is_where_it_is_and_heads_where_it_does(comet):
    env, encoder, states = comet
    latent = encoder(env.observe(states)).detach()
    assert latent.shape == (200, 5)
    assert not latent[:, 4].any()
    assert torch.allclose(latent[:, 2:4].norm(dim=1), torch.tensor(0.3))
    off = torch.remainder(torch.atan2(-latent[:, 3], latent[:, 2]) - states[:, 2] + math.pi, 2 * math.pi) - math.pi
    assert off.square().mean().sqrt() < math.radians(1.5)
    ahead = torch.stack([states[:, 2].cos(), states[:, 2].sin()], -1)
    place = torch.atanh(latent[:, :2]) * 1.5 * torch.tensor([1.0, -1.0])  # m; its middle lies ahead of its tail
    assert (place - states[:, :2] - 0.044 * ahead).norm(dim=1).mean() < 0.006  # a pixel has 0.023 m


def test_a_thing_of_another_colour_is_nothing(comet):
    env, encoder, states = comet
    moved = states.clone()
    moved[:, 3] = -states[:, 3]
    far = ((states[:, :2] - torch.tensor([1.3, 0.0])).abs() > torch.tensor([0.3, 0.0])).all(1)  # neither goal lies under the car
    seen, other = encoder(env.observe(states[far])), encoder(env.observe(moved[far]))
    assert (seen - other).abs().max() < 1e-4
    plain = ShapeBearingEncoder(2, 128, pool_to=128)  # all that differs from the background counts
    plain.fit(env.draw(states))
    assert (plain(env.observe(states[far])) - plain(env.observe(moved[far]))).abs().max() > 0.05


def test_an_encoder_of_places_survives_disk_and_refuses_sizes_that_are_none(comet):
    env, encoder, states = comet
    twin = ShapePlaceEncoder(**encoder.arguments)
    twin.load_state_dict(encoder.state_dict())
    assert torch.equal(twin(env.observe(states[:9])), encoder(env.observe(states[:9])))
    assert encoder(torch.full((1, 6, 128, 128), 255, dtype=torch.uint8)).isfinite().all()
    for wrong, message in (({"latent_dim": 3}, "latent_dim >= 4"), ({"latent_dim": 4, "turn_radius": 0.0}, "turn_radius"), ({"latent_dim": 4, "reach": 0.0}, "reach > 0")):
        with pytest.raises(ConfigError, match=message):
            ShapePlaceEncoder(**wrong)


@pytest.fixture(scope="module")
def bearings():
    """Encoder of bearings fitted to 500 frames of a robot past an obstacle that is not in the middle, and fresh states outside U."""
    env = DubinsEnv(obstacle_centre=(0.4, -0.3), image_size=128)
    generator = torch.Generator().manual_seed(0)
    encoder = BearingEncoder(3, 128)
    encoder.fit(env.draw(env.sample_states(500, generator)))
    states = env.sample_states(400, generator, region=env.state_space - env.unsafe_set)
    states = states[states[:, :2].abs().amax(1) < 1.9]
    return env, encoder, states


def test_a_bearing_is_the_obstacle_in_the_robots_frame_to_a_few_centimetres(bearings):
    env, encoder, states = bearings
    seen = torch.atanh(encoder(env.observe(states))[:, :2]) * 0.625 * 1.2 * env.arena_half_size  # m
    away = torch.tensor(env.obstacle_centre) - states[:, :2]
    c, s = states[:, 2].cos(), states[:, 2].sin()
    truth = torch.stack([c * away[:, 0] + s * away[:, 1], -(c * away[:, 1] - s * away[:, 0])], -1)  # aside is to the right in a picture
    forward = (seen * truth).sum() > 0  # which end is which, the colours do not say
    off = seen - (truth if forward else -truth)
    assert float(off.mean(0)[0].abs()) < 0.15  # seen from the middle between the coloured ends, 0.1 m ahead of the base
    assert (off - off.mean(0)).norm(dim=-1).square().mean().sqrt() < 0.05  # m; a pixel has 0.038 m
    assert ((off - off.mean(0)).norm(dim=-1) / truth.norm(dim=-1)).max() < 0.1


def test_a_bearing_does_not_change_when_robot_and_obstacle_turn_together(bearings):
    _, encoder, _ = bearings
    bearing = encoder.trunk[0]
    centres, turn = torch.randn(20, 2, 2), torch.linalg.qr(torch.randn(2, 2)).Q
    turn = turn * torch.stack([turn.det(), torch.tensor(1.0)])  # a rotation
    moved = copy.deepcopy(bearing)
    moved.anchor.copy_(turn @ bearing.anchor)
    bearing.centres, moved.centres = (lambda c: c), (lambda c: turn @ c)
    bearing.in_place = moved.in_place = lambda c: c
    try:
        assert torch.allclose(moved(centres)[:, :2], bearing(centres)[:, :2], atol=1e-5)
    finally:
        del bearing.centres, bearing.in_place


@pytest.mark.parametrize("by", [(1, -1), (-1, 0), (1, 1)])
def test_a_camera_that_is_out_of_place_by_a_few_pixels_is_put_back(bearings, by):
    env, encoder, states = bearings
    bearing, frames = encoder.trunk[0], F.avg_pool2d(env.draw(states).float(), 2) / 127.5 - 1.0
    shifted = frames.roll(by, (2, 3))
    assert torch.equal(bearing.in_place(shifted)[..., 1:-1, 1:-1], frames[..., 1:-1, 1:-1])
    twin = BearingEncoder(**encoder.arguments)
    twin.load_state_dict(encoder.state_dict())
    assert torch.equal(twin.trunk[0].in_place(shifted), bearing.in_place(shifted))


def test_a_robot_on_the_obstacle_does_not_move_a_frame(bearings):
    env, encoder, _ = bearings
    states = env.sample_states(1000, torch.Generator().manual_seed(1), region=env.unsafe_set)
    frames = F.avg_pool2d(env.draw(states).float(), 2) / 127.5 - 1.0
    assert torch.equal(encoder.trunk[0].in_place(frames), frames)


def test_noise_and_brightness_do_not_move_a_frame(bearings):
    env, encoder, states = bearings
    bearing, frames = encoder.trunk[0], F.avg_pool2d(env.draw(states).float(), 2) / 127.5 - 1.0
    noisy = frames + 12.0 / 255.0 * torch.randn(frames.shape, generator=torch.Generator().manual_seed(0))
    for changed in (noisy, 0.85 * (frames + 1.0) - 1.0, (1.15 * (frames + 1.0) - 1.0).clamp_max(1.0)):
        assert torch.equal(bearing.in_place(changed), changed)


def test_where_nothing_stands_still_no_frame_is_moved():
    frames = torch.rand(8, 3, 64, 64, generator=torch.Generator().manual_seed(0)) * 2.0 - 1.0
    assert torch.equal(Bearing(64).in_place(frames), frames)


def test_entries_that_no_picture_shows_are_zero_and_the_encoder_survives_disk(bearings):
    env, encoder, states = bearings
    pixels = env.observe(states[:9])
    assert encoder(pixels)[:, 2].eq(0.0).all()
    twin = BearingEncoder(**encoder.arguments)
    twin.load_state_dict(encoder.state_dict())
    assert torch.equal(twin(pixels), encoder(pixels))
    assert not [p for p in encoder.parameters() if p.requires_grad]
    with pytest.raises(ConfigError, match="latent_dim >= 2"):
        BearingEncoder(1)


def test_an_empty_frame_has_a_finite_bearing(bearings):
    _, encoder, _ = bearings
    assert torch.isfinite(encoder(torch.full((1, 6, 128, 128), 255, dtype=torch.uint8))).all()


def _noise(pixels):
    drawn = torch.randn(pixels.shape, generator=torch.Generator().manual_seed(1))
    return (pixels.float() + 12.0 * drawn).round().clamp(0, 255).byte()


@pytest.mark.parametrize(
    ("change", "most"),
    [
        (_noise, 0.05),
        (lambda p: (0.85 * p.float()).round().byte(), 0.05),
        (lambda p: (1.15 * p.float()).round().clamp(0, 255).byte(), 0.05),
        (lambda p: p.roll(1, -1), 0.07),
        (lambda p: p.roll(-1, -2), 0.07),
    ],
    ids=["noise of 12/255", "darker", "brighter", "camera a pixel aside", "camera a pixel higher"],
)
def test_harmless_changes_of_the_picture_move_a_bearing_by_centimetres(bearings, change, most):
    env, encoder, states = bearings
    near = (states[:, :2] - torch.tensor(env.obstacle_centre)).norm(dim=-1) < 1.6
    pixels = env.observe(states[near])
    place = [torch.atanh(encoder(p)[:, :2]) * 0.625 * 1.2 * env.arena_half_size for p in (pixels, change(pixels))]
    assert (place[1] - place[0]).square().sum(-1).mean().sqrt() < most  # m

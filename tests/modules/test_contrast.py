"""The encoder on what differs from the background: noise and brightness of a camera do not reach its convolutions."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import EmptyRegionError
from torchrl_sspl.lipschitz import SandwichBarrier
from torchrl_sspl.modules import ContrastEncoder, LatentDynamics, Policy
from torchrl_sspl.modules import contrast as module
from torchrl_sspl.modules.agent import Agent, build_encoder
from torchrl_sspl.modules.export import DeployedStep
from torchrl_sspl.objectives import SSPLLoss
from torchrl_sspl.runtime import CameraFault


@pytest.fixture(scope="module")
def scene():
    """A fitted encoder, and observations of 200 fresh states."""
    env = PendulumEnv(image_size=64)
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    encoder = ContrastEncoder(3, 64).eval()
    encoder.fit(env.draw(env.sample_states(500, generator)))
    return encoder, env.observe(env.sample_states(200, generator))


def contrasts(encoder, pixels):
    """What its convolutions see of the second frames."""
    with torch.no_grad():
        return encoder.trunk[0](encoder._pool(pixels[:, 3:].float()) / 127.5 - 1.0)


def changed(encoder, pixels, fault, strength):
    """By how much a fault of the camera changes that, relative to all of it, in nine of ten frames at most."""
    clean = contrasts(encoder, pixels)
    off = contrasts(encoder, CameraFault(fault, strength, onset=0, seed=0)(pixels, 0)) - clean
    return float((off.flatten(1).norm(dim=1) / clean.flatten(1).norm(dim=1)).quantile(0.9))


@pytest.mark.parametrize(("fault", "strength", "most"), [("noise", 12.0, 0.1), ("dark", 0.85, 0.01)])
def test_noise_and_darkness_are_hardly_seen(scene, fault, strength, most):
    assert changed(*scene, fault, strength) < most


def test_without_its_threshold_noise_is(scene, monkeypatch):
    monkeypatch.setattr(module, "FAINT", 0.0)
    assert changed(*scene, "noise", 12.0) > 0.2


def test_the_background_is_not_seen(scene):
    encoder, pixels = scene
    seen = contrasts(encoder, pixels)
    assert (seen != 0).any(1).float().mean() < 0.06  # the rod covers a hundredth of the frame
    assert (seen != 0).any(1).flatten(1).any(1).all()


def test_it_is_built_again_from_its_arguments(scene):
    encoder, pixels = scene
    twin = build_encoder("ContrastEncoder", **encoder.arguments).eval()
    twin.load_state_dict(encoder.state_dict())
    assert torch.equal(twin(pixels), encoder(pixels))


@pytest.mark.slow  # as those of other encoders
def test_its_agents_are_exported_for_batches_of_any_size(scene, tmp_path):
    encoder, pixels = scene
    agent = Agent.from_networks(encoder, LatentDynamics(3, 1), SandwichBarrier(3, (8,)), Policy(3, 1), gain=0.2)
    step = torch.export.load(agent.export(tmp_path / "agent.pt2", check=8)).module()
    given = pixels[:5].roll(1, -1), torch.zeros(5, 3), torch.zeros(5, 1), torch.ones(5, dtype=torch.bool)
    with torch.no_grad():
        for found, wanted in zip(step(*given), DeployedStep(agent)(*given), strict=True):
            assert torch.allclose(found.float(), wanted.float(), atol=1e-5)


def test_too_few_frames_are_named():
    with pytest.raises(EmptyRegionError, match="10 frames"):
        ContrastEncoder(3, 64).fit(torch.zeros(5, 3, 64, 64, dtype=torch.uint8))


@pytest.mark.parametrize("encoder", ["ContrastEncoder", "BearingEncoder"])
def test_a_loss_that_is_loaded_puts_cameras_back_in_place(scene, encoder):
    _, pixels = scene
    shifted = CameraFault("shifted", 1.0, onset=0, seed=0)(pixels, 0)
    encoders = [build_encoder(encoder, latent_dim=3, image_size=64) for _ in range(2)]
    losses = [SSPLLoss(one, LatentDynamics(3, 1), nn.Linear(3, 1), Policy(3, 1)) for one in encoders]
    encoders[0].fit(pixels[:, 3:])
    losses[1].load_state_dict(losses[0].state_dict())
    with torch.no_grad():
        seen, loaded = (loss._run("encoder", shifted) for loss in losses)
        assert torch.equal(seen, loaded)
        assert torch.equal(seen, encoders[0](shifted)), "the loss sees what its encoder sees"

"""Claims about the default networks."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_sspl.errors import ConfigError, DTypeError, ShapeError
from torchrl_sspl.modules import (
    FrameEncoder,
    LatentDynamics,
    Policy,
    SaLaD,
    as_tensordict_module,
    inward_clamp,
    make_rollout_policy,
)


def _frames(*shape: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator)


@pytest.fixture
def encoder() -> FrameEncoder:
    torch.manual_seed(0)
    return FrameEncoder(2)


@pytest.mark.parametrize("size", [(32, 32), (64, 64), (128, 128), (48, 80), (20, 33)])
def test_same_weights_encode_frames_of_any_size(encoder: FrameEncoder, size: tuple[int, int]) -> None:
    latent = encoder(_frames(3, 6, *size))
    assert latent.shape == (3, 2)
    assert latent.abs().max() <= 1


def test_both_pooling_paths_average_alike(encoder: FrameEncoder) -> None:
    pixels = _frames(2, 6, 64, 64)
    constant = torch.full((2, 6, 50, 50), 77, dtype=torch.uint8)
    pooled = torch.nn.functional.adaptive_avg_pool2d(pixels.float(), 32).round().to(torch.uint8)
    assert torch.allclose(encoder(pooled), encoder(pixels), atol=2e-2)
    assert torch.allclose(encoder(constant), encoder(constant[..., :32, :32]), atol=1e-5)


def test_sequence_equals_stacks_and_encodes_each_frame_once(encoder: FrameEncoder) -> None:
    frames = _frames(4, 3, 3, 64, 64)
    seen = []
    encoder.trunk.register_forward_hook(lambda module, inputs, output: seen.append(len(output)))
    latents = encoder.sequence(frames)
    assert seen == [12]
    for k in range(2):
        stack = frames[:, k : k + 2].reshape(4, 6, 64, 64)
        assert torch.allclose(encoder(stack), latents[:, k], atol=1e-6)


def test_latent_depends_on_the_order_of_frames(encoder: FrameEncoder) -> None:
    frames = _frames(4, 2, 3, 64, 64)
    assert not torch.allclose(encoder.sequence(frames), encoder.sequence(frames.flip(1)), atol=1e-3)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_batch_dimensions_are_free(encoder: FrameEncoder, batch: tuple[int, ...]) -> None:
    assert encoder(_frames(*batch, 6, 32, 32)).shape == (*batch, 2)
    assert encoder.frames(_frames(*batch, 3, 32, 32)).shape == (*batch, 16)
    assert LatentDynamics(2, 1)(torch.zeros(*batch, 2), torch.zeros(*batch, 1)).shape == (*batch, 2)
    assert Policy(2, 1)(torch.zeros(*batch, 2)).shape == (*batch, 1)


def test_encoder_rejects_float_pixels_by_name() -> None:
    with pytest.raises(DTypeError, match=r"torch\.uint8.*torch\.float32"):
        FrameEncoder(2)(torch.zeros(1, 6, 32, 32))


@pytest.mark.parametrize("shape", [(1, 3, 32, 32), (32, 32, 6), (6, 32), (1, 6, 40, 32)])
def test_encoder_rejects_wrong_shapes(shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError, match="expected pixels of shape"):
        FrameEncoder(2, image_size=32)(_frames(*shape))


def test_sequence_needs_two_frames(encoder: FrameEncoder) -> None:
    with pytest.raises(ShapeError, match="T >= 2"):
        encoder.sequence(_frames(4, 1, 3, 32, 32))


def test_encoder_has_no_running_statistics(encoder: FrameEncoder) -> None:
    assert list(encoder.buffers()) == []


def test_gradient_reaches_every_parameter_of_the_encoder(encoder: FrameEncoder) -> None:
    encoder(_frames(4, 6, 32, 32)).square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in encoder.parameters())


@pytest.mark.parametrize(
    ("build", "name"),
    [
        (lambda: FrameEncoder(0), "latent_dim"),
        (lambda: FrameEncoder(2, image_size=(1, 2, 3)), "image_size"),
        (lambda: LatentDynamics(2, -1), "action_dim"),
        (lambda: Policy(2, 1, action_scale=0.0), "action_scale"),
        (lambda: Policy(2, 2, action_scale=[1.0, 2.0, 3.0]), "action_scale"),
        (lambda: Policy(2, 1, action_scale=float("nan")), "action_scale"),
    ],
)
def test_wrong_sizes_are_named(build, name: str) -> None:
    with pytest.raises(ConfigError, match=name):
        build()


def test_dynamics_is_the_clamped_residual_of_its_net() -> None:
    torch.manual_seed(0)
    dynamics = LatentDynamics(2, 1, action_scale=10.0)
    latent, action = torch.rand(64, 2) * 2 - 1, torch.rand(64, 1) * 20 - 10
    expected = (latent + 50 * dynamics.net(torch.cat([latent, action / 10.0], -1))).clamp(-1, 1)
    with torch.no_grad():
        dynamics.net[-1].weight.mul_(50)
        dynamics.net[-1].bias.mul_(50)
    assert torch.allclose(dynamics(latent, action), expected, atol=1e-4)
    assert (expected.abs() == 1).any()


def test_dynamics_that_remember_hand_the_action_on() -> None:
    dynamics = LatentDynamics(3, 1, action_scale=2.0, remembers=True)
    latent, action = torch.rand(5, 3) - 0.5, torch.tensor([[-2.0], [-1.0], [0.0], [1.0], [4.0]])
    after = dynamics(latent, action)
    assert after[:, 2].tolist() == [-1.0, -0.5, 0.0, 0.5, 1.0]
    assert torch.allclose(after[:, :2], (latent[:, :2] + dynamics.net(torch.cat([latent, action / 2.0], -1))).clamp(-1, 1))
    assert (dynamics(latent * torch.tensor([1.0, 1.0, -1.0]), action)[:, :2] != after[:, :2]).any()  # what was done before counts
    assert LatentDynamics(**dynamics.arguments).moving_dim == 2
    with pytest.raises(ConfigError, match="latent_dim > action_dim"):
        LatentDynamics(1, 1, remembers=True)


def test_policy_is_the_scaled_clamp_of_its_net() -> None:
    torch.manual_seed(0)
    policy = Policy(2, 2, action_scale=[10.0, 0.5])
    latent = torch.randn(64, 2)
    with torch.no_grad():
        policy.net[-1].weight.mul_(50)
    expected = torch.tensor([10.0, 0.5]) * policy.net(latent).clamp(-1, 1)
    assert torch.equal(policy(latent), expected)
    assert (expected[:, 1].abs() == 0.5).any()


def test_networks_name_the_wrong_input() -> None:
    with pytest.raises(ShapeError, match="latent"):
        Policy(2, 1)(torch.zeros(4, 3))
    with pytest.raises(ShapeError, match="action"):
        LatentDynamics(2, 1)(torch.zeros(4, 2), torch.zeros(4, 2))


def test_deployed_networks_are_linear_relu_only() -> None:
    for module in (LatentDynamics(2, 1), Policy(2, 1)):
        assert {type(layer) for layer in module.net} == {nn.Linear, nn.ReLU}
        assert isinstance(module.net[0], nn.Linear)
        assert isinstance(module.net[-1], nn.Linear)


def test_inward_clamp_is_exact_and_never_drives_outward() -> None:
    value = torch.tensor([-2.0, -2.0, -0.5, 0.5, 2.0, 2.0], requires_grad=True)
    weight = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    clamped = inward_clamp(value)
    assert torch.equal(clamped, value.detach().clamp(-1, 1))
    (clamped * weight).sum().backward()
    assert value.grad.tolist() == [0.0, -1.0, 1.0, -1.0, 1.0, 0.0]


def test_saturated_policy_comes_back_where_a_clamp_stays_stuck() -> None:
    def train(clamp) -> float:
        value = torch.tensor(5.0, requires_grad=True)
        optimizer = torch.optim.SGD([value], 0.3)
        for _ in range(50):
            optimizer.zero_grad()
            (clamp(value) + 0.5).square().backward()
            optimizer.step()
        return float(clamp(value.detach()))

    assert train(inward_clamp) == pytest.approx(-0.5, abs=1e-3)
    assert train(lambda v: v.clamp(-1, 1)) == 1.0


def test_inward_clamp_is_the_same_clamp_without_a_gradient() -> None:
    value = torch.tensor([-2.0, 0.5, 2.0, math.nan, -0.0], requires_grad=True)
    with torch.no_grad():
        quick = inward_clamp(value)
    assert torch.equal(quick.view(torch.int32), inward_clamp(value).detach().view(torch.int32))
    assert not quick.requires_grad


def test_inward_clamp_works_under_vmap_of_grad() -> None:
    values = torch.tensor([0.5, 3.0])
    gradient = torch.func.vmap(torch.func.grad(lambda v: inward_clamp(v)))(values)
    assert gradient.tolist() == [1.0, 1.0]


def _salad() -> SaLaD:
    torch.manual_seed(0)
    return SaLaD(FrameEncoder(2), LatentDynamics(2, 1), nn.Linear(2, 1))


def test_salad_writes_latent_prediction_and_barrier() -> None:
    salad = _salad()
    pixels, action = _frames(4, 6, 32, 32), torch.randn(4, 1)
    out = salad(TensorDict(pixels=pixels, action=action, batch_size=4))
    assert set(salad.in_keys) == {"pixels", "action"}
    latent = salad.encoder.module(pixels)
    assert torch.allclose(out["latent"], latent, atol=1e-6)
    assert torch.allclose(out["next", "latent"], salad.dynamics.module(latent, action), atol=1e-6)
    assert torch.allclose(out["barrier"], salad.barrier.module(latent), atol=1e-6)


def test_salad_accepts_tensordict_modules_with_their_own_keys() -> None:
    encoder = as_tensordict_module(nn.Linear(3, 2), ["observation"], ["code"])
    dynamics = as_tensordict_module(LatentDynamics(2, 1), ["code", "action"], [("next", "code")])
    barrier = as_tensordict_module(nn.Linear(2, 1), ["code"], ["barrier"])
    out = SaLaD(encoder, dynamics, barrier)(
        TensorDict(observation=torch.zeros(4, 3), action=torch.zeros(4, 1), batch_size=4)
    )
    assert out["next", "code"].shape == (4, 2)


def test_rollout_policy_writes_the_action_only() -> None:
    salad, policy = _salad(), Policy(2, 1, action_scale=3.0)
    rollout = make_rollout_policy(salad, policy)
    pixels = _frames(4, 6, 32, 32)
    out = rollout(TensorDict(pixels=pixels, batch_size=4))
    assert set(out.keys()) == {"pixels", "action"}
    assert torch.allclose(out["action"], policy(salad.encoder.module(pixels)), atol=1e-6)
    assert {id(p) for p in rollout.parameters()} == {
        id(p) for module in (salad.encoder, policy) for p in module.parameters()
    }


def test_modules_with_the_wrong_number_of_keys_are_rejected() -> None:
    with pytest.raises(ConfigError, match="keys like"):
        SaLaD(
            as_tensordict_module(nn.Linear(2, 2), ["pixels"], ["latent"]),
            as_tensordict_module(nn.Linear(2, 2), ["latent"], [("next", "latent")]),
            nn.Linear(2, 1),
        )
    with pytest.raises(ConfigError, match=r"torch\.nn\.Module"):
        as_tensordict_module(lambda z: z, ["latent"], ["barrier"])  # type: ignore[arg-type]


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_networks_run_on_cuda() -> None:
    encoder = FrameEncoder(2).cuda()
    assert encoder(_frames(4, 6, 64, 64).cuda()).device.type == "cuda"

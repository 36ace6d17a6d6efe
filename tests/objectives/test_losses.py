"""The terms against values worked out by hand, the presets, and what happens to bad input."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError, DTypeError, NotPositiveDefiniteError, ShapeError
from torchrl_sspl.functional import lmi_matrix, synthesis_violation
from torchrl_sspl.lipschitz import LMIBarrier, SandwichBarrier
from torchrl_sspl.modules import FrameEncoder, LatentDynamics, Policy, SaLaD
from torchrl_sspl.objectives import (
    PRESETS,
    ActionChangeLoss,
    LipschitzLoss,
    PolicyDeviationLoss,
    SaLaDLoss,
    SSPLLoss,
    SynthesisLoss,
)


class Reads(nn.Module):
    """First coordinate times a trainable gain, plus an offset."""

    def __init__(self, gain: float = 1.0, offset: float = 0.0) -> None:
        super().__init__()
        self.gain, self.offset = nn.Parameter(torch.tensor(gain)), nn.Parameter(torch.tensor(offset))

    def forward(self, latent: Tensor) -> Tensor:
        return self.gain * latent[..., :1] + self.offset


class Adds(nn.Module):
    """Latent plus action in the first coordinate."""

    def __init__(self) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(1.0))

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return torch.cat([latent[..., :1] + self.gain * action, latent[..., 1:]], -1)


class Sums(nn.Module):
    """Latent plus an action of as many components."""

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return latent + action


def latents(*values: float) -> Tensor:
    return torch.tensor([[value, 0.0] for value in values])


def batch(now: Tensor, after: Tensor, action: Tensor, region: list[int]) -> TensorDict:
    n = len(now)
    return TensorDict(
        latent=now,
        action=action,
        region=torch.tensor(region)[:, None],
        next=TensorDict(latent=after, batch_size=n),
        batch_size=n,
    )


no_updater = pytest.mark.filterwarnings("ignore:No target network updater:UserWarning")


@pytest.fixture
def labelled() -> TensorDict:
    # B = z_0: safe rows at -0.3 and 0.1, unsafe ones at -0.2 and 0.7; actions move z_0 by what they say.
    now = latents(-0.3, 0.1, -0.2, 0.7, 0.0)
    action = torch.tensor([[0.1], [0.2], [0.0], [0.0], [0.5]])
    after = latents(-0.2, 0.5, -0.2, 0.7, 0.5)
    return batch(now, after, action, [1, 1, 2, 2, 0])


def test_salad_terms_are_the_hinges_and_the_squared_error(labelled: TensorDict) -> None:
    loss = SaLaDLoss(None, Adds(), Reads(), safety_margin=0.1, unsafe_coeff=2.0, consistency_coeff=3.0)
    out = loss(labelled)
    # S: max(0, -0.3 + 0.1), max(0, 0.1 + 0.1); U: max(0, 0.2 + 0.1), max(0, -0.7 + 0.1); only row 2 misses, by 0.2.
    assert out["loss_safe"].item() == pytest.approx(0.2 / 2)
    assert out["loss_unsafe"].item() == pytest.approx(2.0 * 0.3 / 2)
    assert out["loss_consistency"].item() == pytest.approx(3.0 * 0.2**2 / 5)
    assert out["dynamics_error"].item() == pytest.approx(0.2 / 5)
    assert out["dynamics_error_max"].item() == pytest.approx(0.2)
    assert out["safe_error"].item() == 0.5
    assert out["unsafe_error"].item() == 0.5


@no_updater
def test_paper_preset_sums_over_the_rows(labelled: TensorDict) -> None:
    loss = SSPLLoss(
        None, Adds(), Reads(), Reads(0.0, 0.5), preset="paper", safety_margin=0.1, dynamics_margin=0.2
    )
    out = loss(labelled)
    assert out["loss_safe"].item() == pytest.approx(0.2)
    assert out["loss_unsafe"].item() == pytest.approx(0.3)
    assert out["loss_consistency"].item() == pytest.approx(0.2**2)
    # B(d(z, 0.5)) + eta - B(z) + psi = 0.5 + 0.2 + 0.1 in each of the five rows.
    assert out["loss_synthesis"].item() == pytest.approx(5 * 0.8)
    assert out["loss_policy_deviation"].item() == pytest.approx(5 * 0.5)


@no_updater
def test_weights_of_the_total_multiply_their_terms(labelled: TensorDict) -> None:
    def build(**options: float) -> TensorDict:
        return SSPLLoss(None, Adds(), Reads(), Reads(0.0, 0.5), preset="paper", **options)(labelled)

    plain = build()
    weighted = build(synthesis_coeff=2.0, salad_coeff=3.0, policy_coeff=5.0, safe_coeff=7.0)
    factors = {"loss_synthesis": 2, "loss_safe": 21, "loss_unsafe": 3, "loss_consistency": 3}
    for key, factor in (factors | {"loss_policy_deviation": 5}).items():
        assert weighted[key].item() == pytest.approx(factor * plain[key].item())


@pytest.mark.parametrize(
    ("mode", "options"),
    [("paper", {}), ("R1", {"decay": 0.3}), ("R2", {"decrement": 0.1, "floor": 0.2}), ("R3", {"band": 0.5})],
)
def test_synthesis_is_the_mean_positive_violation(mode: str, options: dict[str, float]) -> None:
    torch.manual_seed(0)
    now = torch.rand(64, 2) * 2 - 1
    policy, barrier = Reads(-0.5, 0.1), Reads()
    loss = SynthesisLoss(
        None, Adds(), barrier, policy, mode=mode, safety_margin=0.05, dynamics_margin=0.1, **options
    )
    step = Adds()(now, policy(now))
    violation = synthesis_violation(
        barrier(now), barrier(step), mode=mode, safety_margin=0.05, dynamics_margin=0.1, **options
    ).clamp_min(0)
    out = loss(TensorDict(latent=now, batch_size=64))
    assert out["loss_synthesis"].item() == pytest.approx(violation.mean().item())
    assert out["violation_max"].item() == pytest.approx(violation.max().item())
    assert out["violation_share"].item() == pytest.approx((violation > 0).float().mean().item())
    assert out["inside_share"].item() == pytest.approx((now[:, 0] <= 0).float().mean().item())


def test_growth_asks_only_where_the_successor_is_inside_by_the_margin() -> None:
    # The policy moves by -0.5: successors at -0.4, 0.2 and -0.45; the last row carries the label "unsafe".
    data = batch(latents(0.1, 0.7, 0.05), latents(0, 0, 0), torch.zeros(3, 1), [0, 0, 2])
    loss = SynthesisLoss(
        None, Adds(), Reads(), Reads(0.0, -0.5), growth_coeff=1.0, growth_depth=0.3, dynamics_margin=0.3
    )
    assert loss(data)["loss_growth"].item() == pytest.approx((0.1 + 0.3) / 3)
    wider = SynthesisLoss(
        None, Adds(), Reads(), Reads(0.0, -0.5), growth_coeff=1.0, growth_depth=0.3, dynamics_margin=0.41
    )
    assert wider(data)["loss_growth"].item() == 0.0


def test_descent_moves_the_policy_downhill_and_nothing_else() -> None:
    policy, barrier, dynamics = Reads(0.0, 0.2), Reads(), Adds()
    loss = SynthesisLoss(None, dynamics, barrier, policy, descent_coeff=1.0, descent_scale=0.5)
    out = loss(TensorDict(latent=latents(-0.5, 1.0), batch_size=2))
    weight = torch.exp(torch.tensor(-1.0 / 0.5))
    assert out["loss_descent"].item() == pytest.approx(((-0.5 + 0.2) + (1.0 + 0.2) * weight.item()) / 2)
    out["loss_descent"].backward()
    assert policy.offset.grad is not None
    assert policy.offset.grad.item() > 0
    assert all(p.grad is None for p in (*barrier.parameters(), *dynamics.parameters()))


def test_off_manifold_term_looks_at_all_of_the_latent_box() -> None:
    # The condition holds on the data and fails elsewhere in the box.
    data = TensorDict(latent=latents(*[-0.9] * 512), batch_size=512)
    loss = SynthesisLoss(None, Adds(), Reads(), Reads(0.0, 0.3), off_manifold_coeff=1.0, band=1e-3)
    out = loss(data)
    assert out["loss_synthesis"].item() == 0.0
    # B+ = z_0 + 0.3 > 0 and z_0 < 0 on 15 % of the box, where the product is about z_0 + 0.3 times -z_0 / band.
    assert out["loss_off_manifold"].item() > 1.0


def test_observed_errors_join_the_successor() -> None:
    data = TensorDict(latent=latents(-0.5), residual=latents(0.4), batch_size=1)
    loss = SynthesisLoss(None, Adds(), Reads(), Reads(0.0, 0.3), band=1.0)
    assert loss(data)["loss_synthesis"].item() == pytest.approx(0.2 * 1.5)
    assert loss(data.exclude("residual"))["loss_synthesis"].item() == 0.0


def test_worst_rows_are_added_as_their_mean(labelled: TensorDict) -> None:
    plain = SaLaDLoss(None, Adds(), Reads(), reduction="none")
    error = plain(labelled)["loss_consistency"]
    out = SaLaDLoss(None, Adds(), Reads(), worst_coeff=0.5, worst_fraction=0.4)(labelled)
    expected = error.mean() + 0.5 * error.topk(2)[0].mean()
    assert out["loss_consistency"].item() == pytest.approx(expected.item())
    # Of the two safe rows one is among the worst 40 %.
    assert SaLaDLoss(None, Adds(), Reads(), safety_margin=0.1, worst_coeff=0.5, worst_fraction=0.4)(labelled)[
        "loss_safe"
    ].item() == pytest.approx(0.2 / 2 + 0.5 * 0.2)


def test_anti_collapse_terms_are_their_statistics() -> None:
    torch.manual_seed(0)
    now = 0.2 * torch.randn(64, 2) @ torch.tensor([[1.0, 0.5], [0.0, 0.3]])
    loss = SaLaDLoss(
        None,
        Adds(),
        Reads(),
        variance_coeff=1.0,
        covariance_coeff=1.0,
        saturation_coeff=1.0,
        saturation_limit=0.3,
    )
    out = loss(batch(now, now, torch.zeros(64, 1), [0] * 64))
    covariance = torch.cov(now.T, correction=0)
    assert out["loss_variance"].item() == pytest.approx(
        (0.5 - covariance.diagonal().sqrt()).clamp_min(0).mean().item(), rel=1e-4
    )
    assert out["loss_covariance"].item() == pytest.approx((2 * covariance[0, 1] ** 2 / 2).item(), rel=1e-4)
    excess = (now.abs().atanh() - torch.atanh(torch.tensor(0.3))).clamp_min(0).square().mean()
    assert out["loss_saturation"].item() == pytest.approx(excess.item(), rel=1e-4)


def test_inverse_dynamics_is_in_units_of_the_largest_action() -> None:
    class Difference(nn.Module):
        action_scale = torch.tensor([10.0])

        def forward(self, now: Tensor, after: Tensor) -> Tensor:
            return (after - now)[..., :1]

    data = batch(latents(0.0), latents(1.0), torch.tensor([[5.0]]), [0])
    loss = SaLaDLoss(None, Adds(), Reads(), inverse_dynamics_coeff=1.0, inverse_dynamics=Difference())
    assert loss(data)["loss_inverse_dynamics"].item() == pytest.approx((4.0 / 10.0) ** 2)


def test_inverse_dynamics_is_the_mean_over_the_components_of_the_action() -> None:
    class Nothing(nn.Module):
        def forward(self, latent: Tensor, following: Tensor) -> Tensor:
            return torch.zeros_like(latent)

    loss = SaLaDLoss(None, Sums(), Reads(), consistency="online", inverse_dynamics_coeff=1.0, inverse_dynamics=Nothing())
    data = batch(latents(0.0), latents(0.0), torch.tensor([[3.0, 4.0]]), [0])
    assert loss(data)["loss_inverse_dynamics"].item() == pytest.approx((3.0**2 + 4.0**2) / 2)


@pytest.mark.parametrize("user", ["zero", "data", "network", "tensordict module"])
def test_deviation_is_the_distance_to_the_users_action(user: str) -> None:
    choices = {
        "zero": (None, 0.5),
        "data": ("data", 0.5 - 0.2),
        "network": (Reads(2.0), 0.5 - 0.6),
        "tensordict module": (TensorDictModule(Reads(3.0), ["state"], ["action"]), 0.5 - 0.3),
    }
    policy, difference = choices[user]
    data = TensorDict(
        latent=latents(0.3), state=torch.tensor([[0.1]]), user_action=torch.tensor([[0.2]]), batch_size=1
    )
    loss = PolicyDeviationLoss(None, Reads(0.0, 0.5), user_policy=policy)
    assert loss(data)["loss_policy_deviation"].item() == pytest.approx(abs(difference))
    assert len(list(loss.parameters())) == 2


def test_the_change_of_an_action_is_that_to_the_next_step_in_shares_of_the_scale() -> None:
    class Adds(nn.Module):
        def forward(self, latent: Tensor, action: Tensor) -> Tensor:
            return latent + 0.5 * action

    policy = nn.Linear(1, 1, bias=False)
    with torch.no_grad():
        policy.weight.fill_(3.0)
    loss = ActionChangeLoss(Adds(), policy, action_scale=2.0)
    latent = torch.tensor([[1.0], [-2.0]])
    found = loss(TensorDict(latent=latent, batch_size=2))["loss_action_change"]
    # u = 3 z, z' = z + 1.5 z, u' = 7.5 z: a change of 4.5 |z|
    assert found.item() == pytest.approx(4.5 * 1.5 / 2.0)
    found.backward()
    # The successor is held still: d/dw |w z' - w z| / 2 at z' = 2.5 z.
    assert next(loss.actor_network_params.parameters()).grad.item() == pytest.approx(1.5 * 1.5 / 2.0)


def test_extras_are_off_in_the_paper_preset() -> None:
    loss = SSPLLoss(None, LatentDynamics(2, 1), Reads(), Policy(2, 1), preset="paper")
    terms = {key for key in loss.out_keys if key.startswith("loss_")}
    assert terms == {
        "loss_safe",
        "loss_unsafe",
        "loss_consistency",
        "loss_synthesis",
        "loss_policy_deviation",
    }
    assert (loss.mode, loss.consistency, loss.successor, loss.detach) == ("paper", "target", "target", ())
    assert loss.reduction == "sum"
    assert float(loss.worst_coeff) == 0.0


def test_explicit_options_win_over_the_preset() -> None:
    loss = SSPLLoss(
        None, LatentDynamics(2, 1), Reads(), Policy(2, 1), preset="sound", mode="R1", growth_coeff=0.0
    )
    assert loss.mode == "R1"
    assert "loss_growth" not in loss.out_keys
    assert set(PRESETS["sound"]) <= {*SSPLLoss.options()}


def test_single_losses_start_without_extras() -> None:
    nets = None, LatentDynamics(2, 1), Reads()
    assert {k for k in SaLaDLoss(*nets).out_keys if "loss" in k} == {
        "loss_safe",
        "loss_unsafe",
        "loss_consistency",
    }
    assert {k for k in SynthesisLoss(*nets, Policy(2, 1)).out_keys if "loss" in k} == {"loss_synthesis"}


def test_frames_and_pixel_stacks_give_the_same_terms() -> None:
    torch.manual_seed(0)
    frames = torch.randint(0, 256, (6, 3, 3, 32, 32), dtype=torch.uint8)
    rest = {"action": torch.randn(6, 1), "region": torch.tensor([0, 1, 2, 0, 1, 2])[:, None]}
    stacks = TensorDict(
        pixels=frames[:, :2].flatten(1, 2),
        next=TensorDict(pixels=frames[:, 1:].flatten(1, 2)),
        **rest,
        batch_size=6,
    )
    salad = SaLaD(FrameEncoder(2), LatentDynamics(2, 1), nn.Linear(2, 1))
    for consistency in ("online", "target"):
        loss = SaLaDLoss(*salad, consistency=consistency)
        loss._has_update_associated = dict.fromkeys(loss._has_update_associated, True)
        first, second = loss(TensorDict(frames=frames, **rest, batch_size=6)), loss(stacks)
        for key, value in first.items():
            assert torch.allclose(value, second[key], atol=1e-6), key


def test_each_frame_is_encoded_once() -> None:
    salad = SaLaD(FrameEncoder(2), LatentDynamics(2, 1), nn.Linear(2, 1))
    seen = []
    salad.encoder.module.trunk.register_forward_hook(lambda module, inputs, output: seen.append(len(output)))
    frames = torch.zeros(4, 3, 3, 32, 32, dtype=torch.uint8)
    data = TensorDict(frames=frames, action=torch.zeros(4, 1), region=torch.zeros(4, 1).long(), batch_size=4)
    SSPLLoss(*salad, Policy(2, 1), preset="sound")(data)
    assert seen == [4 * 3]


def test_encoder_may_read_another_key() -> None:
    encoder = TensorDictModule(nn.Linear(3, 2), ["observation"], ["code"])
    loss = SynthesisLoss(encoder, LatentDynamics(2, 1), nn.Linear(2, 1), Policy(2, 1))
    assert loss.tensor_keys.observation == "observation"
    loss(TensorDict(observation=torch.zeros(4, 3), batch_size=4))


def _nets() -> tuple[None, nn.Module, nn.Module, nn.Module]:
    return None, LatentDynamics(2, 1), nn.Linear(2, 1), Policy(2, 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"preset": "safe"}, r"preset.*'sound'.*'safe'"),
        ({"mode": "R4"}, r"mode.*'R3'.*'R4'"),
        ({"successor": "next"}, r"successor.*'target'.*'next'"),
        ({"consistency": "ema"}, r"consistency.*'online'.*'ema'"),
        ({"detach": "encoder"}, r"detach.*tuple"),
        ({"detach": ("policy",)}, r"detach.*'policy'"),
        ({"reduction": "max"}, r"reduction.*'max'"),
        ({"band": 0.0}, r"band > 0"),
        ({"decay": 1.5}, r"decay in \[0, 1\].*1\.5"),
        ({"safety_margin": -0.1}, r"safety_margin.*-0\.1"),
        ({"growth_coeff": float("nan")}, r"growth_coeff.*nan"),
        ({"worst_fraction": 0.0}, r"worst_fraction.*0\.0"),
        ({"saturation_limit": 1.0}, r"saturation_limit.*1\.0"),
        ({"safty_margin": 0.1}, r"safety_margin.*safty_margin"),
        ({"user_policy": "zero", "policy_coeff": 1.0}, r"user_policy.*'zero'"),
        ({"user_policy": "data"}, r"policy_coeff > 0 with a user_policy, received 0\.0 with preset='sound': .*give policy_coeff"),
        ({"user_policy": nn.Linear(2, 1), "preset": "paper", "policy_coeff": 0}, r"policy_coeff > 0 with a user_policy, received 0 with preset='paper'"),
    ],
)
def test_wrong_options_are_named_with_the_valid_ones(options: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        SSPLLoss(*_nets(), **options)


def test_inverse_dynamics_of_unknown_sizes_must_be_given() -> None:
    with pytest.raises(ConfigError, match="pass inverse_dynamics"):
        SaLaDLoss(None, Adds(), Reads(), inverse_dynamics_coeff=1.0)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda data: data.exclude("region"), ConfigError, r"'region'.*set_keys\(region="),
        (lambda data: data.exclude(("next", "latent")), ConfigError, r"\('next', 'latent'\)"),
        (
            lambda data: data.set("region", data["region"].float()),
            DTypeError,
            r"torch\.int64.*torch\.float32",
        ),
        (
            lambda data: data.set("region", data["region"].squeeze(-1)),
            ShapeError,
            r"\(5, 1\), received \(5,\)",
        ),
        (lambda data: data.set("action", data["action"].squeeze(-1)), ShapeError, r"action_dim.*\(5,\)"),
        (lambda data: data.set("action", data["action"].double()), DTypeError, r"'action' .* torch\.float32, received torch\.float64; .*DoubleToFloat"),
        (lambda data: data.set("action", data["action"].long()), DTypeError, r"received torch\.int64"),
    ],
)
def test_wrong_batches_are_told_what_was_expected(labelled: TensorDict, change, error, message: str) -> None:
    with pytest.raises(error, match=message):
        SaLaDLoss(*_nets()[:3])(change(labelled))


def test_empty_regions_give_zero_terms(labelled: TensorDict) -> None:
    labelled["region"] = torch.zeros_like(labelled["region"])
    out = SaLaDLoss(None, Adds(), Reads(), safety_margin=1.0, worst_coeff=1.0)(labelled)
    assert out["loss_safe"].item() == out["loss_unsafe"].item() == 0.0


def _benchmark():
    path = Path(__file__).parents[2] / "benchmarks" / "loss_overhead.py"
    spec = importlib.util.spec_from_file_location("loss_overhead", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("preset", ["paper", "sound"])
def test_total_equals_the_same_mathematics_in_bare_pytorch(preset: str) -> None:
    result = _benchmark().main(batch=24, image_size=32, repeats=1, preset=preset)
    assert result["difference_of_losses"] < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "sound"])
def test_overhead_over_bare_pytorch_is_small(preset: str) -> None:
    assert _benchmark().main(preset=preset)["ratio"] <= 1.25


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("preset", ["paper", "sound"])
def test_compiled_loss_equals_eager(preset: str) -> None:
    import torch._inductor.config as inductor

    benchmark = _benchmark()
    encoder, dynamics, barrier, policy, _ = benchmark.networks()
    loss = SSPLLoss(encoder, dynamics, barrier, policy, preset=preset)
    data = benchmark.data(16, 32)
    results = []
    for function in (loss, torch.compile(loss, fullgraph=True)):
        loss.zero_grad()
        torch.manual_seed(0)
        with inductor.patch(fallback_random=True):  # the same random numbers as eager
            out = function(data)
        sum(value for key, value in out.items() if key.startswith("loss_")).backward()
        results.append((out.detach(), {name: p.grad.clone() for name, p in loss.named_parameters()}))
    for key, value in results[0][0].items():
        assert torch.allclose(value, results[1][0][key], atol=1e-5, rtol=1e-4), key
    for name, value in results[0][1].items():
        assert torch.allclose(value, results[1][1][name], atol=1e-4, rtol=1e-3), name


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("preset", ["paper", "sound"])
def test_loss_runs_on_cuda(preset: str) -> None:
    benchmark = _benchmark()
    loss = SSPLLoss(*benchmark.networks()[:4], preset=preset).to("cuda")
    loss._has_update_associated = dict.fromkeys(loss._has_update_associated, True)
    out = loss(benchmark.data(16, 32).to("cuda"))
    assert all(value.device.type == "cuda" for value in out.values())
    sum(value for key, value in out.items() if key.startswith("loss_")).backward()


def test_lipschitz_loss_is_the_log_determinant_of_the_certificate() -> None:
    torch.manual_seed(0)
    barrier = LMIBarrier(2, (6, 5), lipschitz_bound=1.5)
    out = LipschitzLoss(barrier, lipschitz_coeff=2.0)(TensorDict(batch_size=[]))
    matrix = lmi_matrix(
        [w.double() for w in barrier.weights()],
        [m.double() for m in barrier.multipliers()],
        1.5,
        barrier.slope,
    )
    assert out["loss_lipschitz"].item() == pytest.approx(-2.0 * torch.logdet(matrix).item())
    assert out["eigenvalue_min"].item() == pytest.approx(torch.linalg.eigvalsh(matrix)[0].item())
    assert not out["eigenvalue_min"].requires_grad


def test_lipschitz_loss_refuses_to_go_on_outside_the_cone() -> None:
    torch.manual_seed(0)
    barrier = LMIBarrier(2, (6, 5))
    loss = LipschitzLoss(barrier)
    with torch.no_grad():
        for weight in barrier.weights():
            weight.mul_(10.0)
    with pytest.raises(NotPositiveDefiniteError, match="backtracking_step"):
        loss(TensorDict(batch_size=[]))


def test_sandwich_barriers_need_no_lipschitz_loss() -> None:
    with pytest.raises(ConfigError, match="by construction"):
        LipschitzLoss(SandwichBarrier(2, (8,)))


def test_dynamics_and_policy_in_other_units_are_refused() -> None:
    salad = SaLaD.from_sizes(latent_dim=3, action_dim=1, action_scale=10.0)
    SSPLLoss(*salad, Policy(3, 1, action_scale=10.0))
    with pytest.raises(ConfigError, match=r"one action_scale .* received \[10.0\] and \[1.0\]"):
        SSPLLoss(*salad, Policy(3, 1, action_scale=1.0))


def small_batch(**extra: Tensor) -> TensorDict:
    base = {"latent": torch.rand(4, 2), "action": torch.zeros(4, 3), "region": torch.zeros(4, 1, dtype=torch.int64)}
    return TensorDict({**base, **extra}, batch_size=4)


def test_an_actor_that_gets_no_gradient_is_refused() -> None:
    class Argmax(nn.Linear):
        def forward(self, latent: Tensor) -> Tensor:
            return nn.functional.one_hot(super().forward(latent).argmax(-1), 3).float()

    loss = SynthesisLoss(None, LatentDynamics(2, 3), SandwichBarrier(2, (8,)), Argmax(2, 3))
    with pytest.raises(ConfigError, match="actions carry a gradient"):
        loss(small_batch())
    with torch.no_grad():
        loss(small_batch())  # to look at
    loss.actor_network_params.requires_grad_(False)
    assert loss(small_batch())["loss_synthesis"].requires_grad  # nobody wants to train it: the barrier is


def test_region_codes_outside_the_table_are_named() -> None:
    loss = SaLaDLoss(None, LatentDynamics(2, 3), SandwichBarrier(2, (8,)), consistency="online")
    codes = torch.tensor([[0], [1], [2], [7]])
    after = TensorDict(latent=torch.rand(4, 2), batch_size=4)
    with pytest.raises(ConfigError, match=r"received \[7\]"):
        loss(small_batch(region=codes).set("next", after))

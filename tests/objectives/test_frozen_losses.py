"""The losses of the phases on frozen latents: by hand, against the slow reference, their gradients, and empty batches."""

from __future__ import annotations

import copy

import pytest
import reference
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError, DTypeError, ShapeError
from torchrl_sspl.modules import LatentDynamics
from torchrl_sspl.objectives import ActionValueLoss, ConsistencyLoss, SynthesisLoss, TargetLoss
from torchrl_sspl.objectives.action_value import interpolate
from torchrl_sspl.sets import SAFE, UNSAFE


class Adds(nn.Module):
    """Latent plus action in the first coordinate."""

    def __init__(self) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(1.0))

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return torch.cat([latent[..., :1] + self.gain * action, latent[..., 1:]], -1)


class Reads(nn.Module):
    """First coordinate times a gain, plus an offset."""

    def __init__(self, gain: float = 1.0, offset: float = 0.0) -> None:
        super().__init__()
        self.gain, self.offset = nn.Parameter(torch.tensor(gain)), nn.Parameter(torch.tensor(offset))

    def forward(self, latent: Tensor) -> Tensor:
        return self.gain * latent[..., :1] + self.offset


class Smooth(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(inputs, 5), nn.Tanh(), nn.Linear(5, outputs))

    def forward(self, *parts: Tensor) -> Tensor:
        return self.net(torch.cat(parts, -1))


def transitions(now: Tensor, action: Tensor, after: Tensor, region: Tensor) -> TensorDict:
    following = TensorDict(latent=after, batch_size=len(now))
    return TensorDict(latent=now, action=action, region=region, next=following, batch_size=len(now))


def random_transitions(n: int = 8, dtype: torch.dtype = torch.float64) -> TensorDict:
    g = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=dtype) * 2 - 1

    return transitions(draw(n, 2), draw(n, 1), draw(n, 2), torch.arange(n)[:, None] % 3)


def target_rows(n: int = 9, dtype: torch.dtype = torch.float64) -> TensorDict:
    g = torch.Generator().manual_seed(1)

    def draw(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=dtype) * 2 - 1

    target = draw(n, 1)
    return TensorDict(
        latent=draw(n, 2), barrier_target=target, inside=target < 0, action_target=draw(n, 2), action_weight=draw(n, 1).abs(),
        region=torch.arange(n)[:, None] % 3, batch_size=n,
    )  # fmt: skip


# --- consistency ------------------------------------------------------------------------------------------------------


def by_hand() -> TensorDict:
    # Predicted 0.1, 0.4, -0.2, 0.9 in the first coordinate; errors 0, 0.1, 0.3 and 0.2 (the last in the second).
    now = torch.tensor([[0.0, 0.0], [0.2, 0.0], [-0.2, 0.0], [0.9, 0.5]])
    action = torch.tensor([[0.1], [0.2], [0.0], [0.0]])
    after = torch.tensor([[0.1, 0.0], [0.5, 0.0], [0.1, 0.0], [0.9, 0.3]])
    return transitions(now, action, after, torch.tensor([[0], [SAFE], [UNSAFE], [UNSAFE]]))


def test_consistency_is_the_mean_squared_error_with_less_weight_on_U():
    out = ConsistencyLoss(Adds(), unsafe_weight=0.5)(by_hand())
    assert out["loss_consistency"].item() == pytest.approx((0.0 + 0.1**2 + 0.5 * 0.3**2 + 0.5 * 0.2**2) / 4)
    # The metrics are errors of the dynamics: nothing is weighted.
    assert out["dynamics_error"].item() == pytest.approx((0.1 + 0.3 + 0.2) / 4)
    assert out["dynamics_error_max"].item() == pytest.approx(0.3)
    assert not out["dynamics_error"].requires_grad


def test_the_worst_rows_are_chosen_by_the_weighted_error():
    plain = ConsistencyLoss(Adds(), unsafe_weight=0.1)(by_hand())["loss_consistency"].item()
    worst = ConsistencyLoss(Adds(), unsafe_weight=0.1, worst_coeff=2.0, worst_fraction=0.25)(by_hand())
    # Squares 0, 0.01, 0.1 * 0.09 = 0.009 and 0.1 * 0.04: of four rows the second is the worst.
    assert worst["loss_consistency"].item() == pytest.approx(plain + 2.0 * 0.01)


@pytest.mark.parametrize("unsafe_weight", [1.0, 0.1, 3.0])
@pytest.mark.parametrize("outlier", [None, 0.8])
@pytest.mark.parametrize("worst", [(0.0, 0.05), (0.2, 0.3)])
@pytest.mark.parametrize("keep", [None, [True, False, True, True, False, True, True, False]])
def test_consistency_equals_the_reference(unsafe_weight, outlier, worst, keep):
    torch.manual_seed(0)
    data, dynamics = random_transitions(), Smooth(3, 2).double()
    loss = ConsistencyLoss(dynamics, unsafe_weight=unsafe_weight, outlier=outlier, worst_coeff=worst[0], worst_fraction=worst[1])
    with torch.no_grad():
        predicted = dynamics(data["latent"], data["action"]).numpy()
    if keep is not None:
        data["collector", "mask"] = torch.tensor(keep)
    rows = [k for k in range(len(data)) if keep is None or keep[k]]
    expected = reference.consistency_loss(
        predicted[rows], data["next", "latent"].numpy()[rows], data["region"].numpy()[rows], unsafe_weight, outlier, *worst
    )
    out = loss.double()(data)
    assert out["loss_consistency"].item() == pytest.approx(expected[0], rel=1e-6)
    assert out["dynamics_error"].item() == pytest.approx(expected[1], rel=1e-6)
    assert out["dynamics_error_max"].item() == pytest.approx(expected[2], rel=1e-6)


def test_an_outlier_counts_in_proportion_and_has_a_finite_gradient():
    out = ConsistencyLoss(Adds(), outlier=0.15)(by_hand())  # errors 0, 0.1, 0.3 and 0.2
    assert out["loss_consistency"].item() == pytest.approx((0.1**2 + 0.3 * 0.3 - 0.15**2 + 0.3 * 0.2 - 0.15**2) / 4)
    assert out["dynamics_error_max"].item() == pytest.approx(0.3)
    dynamics = Smooth(3, 2).double()
    data = random_transitions(4)
    data["next", "latent"] = dynamics(data["latent"], data["action"]).detach()  # no error at all
    ConsistencyLoss(dynamics, outlier=0.1).double()(data)["loss_consistency"].backward()
    assert all(p.grad.isfinite().all() for p in dynamics.parameters())
    for wrong in (0.0, -1.0, float("nan")):
        with pytest.raises(ConfigError, match="outlier > 0 or None"):
            ConsistencyLoss(Adds(), outlier=wrong)


def test_gradients_of_consistency_are_those_of_the_formula():
    torch.manual_seed(0)
    data = random_transitions(6)
    loss = ConsistencyLoss(Smooth(3, 2), unsafe_weight=0.3, outlier=0.8, worst_coeff=0.5, worst_fraction=0.3).double()

    def value(*_: Tensor) -> Tensor:
        return loss(data)["loss_consistency"]

    assert torch.autograd.gradcheck(value, tuple(loss.parameters()))

    def of_latents(now: Tensor, action: Tensor, after: Tensor) -> Tensor:
        return loss(transitions(now, action, after, data["region"]))["loss_consistency"]

    given = data["latent"], data["action"], data["next", "latent"]
    assert torch.autograd.gradcheck(of_latents, tuple(v.clone().requires_grad_() for v in given))


def test_nothing_counts_where_no_row_does():
    data = by_hand()
    data["latent"][:] = float("nan")
    data["collector", "mask"] = torch.zeros(4, dtype=torch.bool)
    dynamics = Adds()
    out = ConsistencyLoss(dynamics, unsafe_weight=0.5, worst_coeff=1.0)(data)
    assert all(out[key].item() == 0.0 for key in ("loss_consistency", "dynamics_error", "dynamics_error_max"))
    out["loss_consistency"].backward()
    assert dynamics.gain.grad.item() == 0.0


def test_a_batch_without_rows_of_U_has_no_weight_in_it():
    data = by_hand()
    data["region"][:] = 0
    weighted, plain = (ConsistencyLoss(Adds(), unsafe_weight=w)(data)["loss_consistency"] for w in (0.1, 1.0))
    assert weighted.item() == plain.item()


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda data: data.exclude("region"), ConfigError, "region"),
        (lambda data: data.exclude(("next", "latent")), ConfigError, "latent"),
        (lambda data: data.set("region", data["region"].int()), DTypeError, "int64"),
        (lambda data: data.set("action", data["action"][:, None]), ShapeError, "action_dim"),
    ],
)
def test_wrong_batches_are_told_what_was_expected(change, error, message):
    with pytest.raises(error, match=message):
        ConsistencyLoss(Adds())(change(by_hand()))


@pytest.mark.parametrize("weight", [0.0, -1.0, float("nan")])
def test_a_weight_that_makes_no_sense_is_an_error(weight):
    with pytest.raises(ConfigError, match="unsafe_weight > 0"):
        ConsistencyLoss(Adds(), unsafe_weight=weight)


# --- targets ----------------------------------------------------------------------------------------------------------


def test_targets_are_met_inside_and_only_reached_outside():
    # B = z_0 = -0.3, 0.1, 0.5; targets -0.1 (inside), 0.4 and 0.2 (outside: the last is passed, which costs nothing).
    rows = TensorDict(
        latent=torch.tensor([[-0.3, 0.0], [0.1, 0.0], [0.5, 0.0]]),
        barrier_target=torch.tensor([[-0.1], [0.4], [0.2]]),
        inside=torch.tensor([[True], [False], [False]]),
        action_target=torch.tensor([[0.0], [2.0], [0.0]]),
        action_weight=torch.tensor([[1.0], [0.5], [0.0]]),
        region=torch.tensor([[SAFE], [UNSAFE], [0]]),
        batch_size=3,
    )
    loss = TargetLoss(
        Reads(), Reads(0.0, 1.0), inside_coeff=2.0, scale=0.2, policy_coeff=3.0, safe_coeff=5.0, unsafe_coeff=7.0,
        safety_margin=0.4, action_scale=2.0,
    )  # fmt: skip
    out = loss(rows)

    def near(target: float) -> float:
        return float(torch.tensor(-abs(target) / 0.2).exp()) + 0.1

    assert out["loss_target"].item() == pytest.approx((near(-0.1) * 2.0 * 0.2**2 + near(0.4) * 0.3**2) / 3)
    assert out["loss_policy_target"].item() == pytest.approx(3.0 * (1.0 * 0.5**2 + 0.5 * 0.5**2) / 3)
    assert out["loss_safe"].item() == pytest.approx(5.0 * 0.1)  # -0.3 + 0.4
    assert out["loss_unsafe"].item() == pytest.approx(7.0 * 0.3)  # -0.1 + 0.4


@pytest.mark.parametrize("cap", [float("inf"), 0.25])
@pytest.mark.parametrize("keep", [None, [True, True, False, True, False, True, True, True, False]])
def test_targets_equal_the_reference(cap, keep):
    torch.manual_seed(0)
    data, barrier, policy = target_rows(), Smooth(2, 1).double(), Smooth(2, 2).double()
    options = {"inside_coeff": 2.0, "outside_cap": cap, "scale": 0.2, "policy_coeff": 0.3, "safe_coeff": 1.0, "unsafe_coeff": 10.0}
    worst = {"worst_coeff": 0.5, "worst_fraction": 0.3}
    loss = TargetLoss(barrier, policy, safety_margin=0.3, action_scale=[1.0, 2.0], **options, **worst).double()
    rows = [k for k in range(len(data)) if keep is None or keep[k]]
    with torch.no_grad():
        values = {"barrier": barrier(data["latent"]), "action": policy(data["latent"])}
    values |= {k: data[k] for k in ("barrier_target", "inside", "action_target", "action_weight", "region")}
    expected = reference.target_loss(
        **{k: v.numpy()[rows] for k, v in values.items()}, margin=0.3, action_scale=[1.0, 2.0], **options, **worst
    )
    if keep is not None:
        data["collector", "mask"] = torch.tensor(keep)
    out = loss(data)
    for name, value in expected.items():
        assert out[name].item() == pytest.approx(value, rel=1e-6), name


def test_gradients_of_targets_are_those_of_the_formula():
    torch.manual_seed(0)
    data = target_rows()
    loss = TargetLoss(
        Smooth(2, 1), Smooth(2, 2), safe_coeff=1.0, unsafe_coeff=2.0, safety_margin=0.3, worst_coeff=0.5, worst_fraction=0.3
    ).double()

    def value(*_: Tensor) -> Tensor:
        return sum(v for k, v in loss(data).items() if k.startswith("loss_"))  # type: ignore[return-value]

    assert torch.autograd.gradcheck(value, tuple(loss.parameters()))


def test_no_target_counts_where_no_row_does():
    data = target_rows()
    data["collector", "mask"] = torch.zeros(len(data), dtype=torch.bool)
    loss = TargetLoss(Smooth(2, 1), Smooth(2, 2), safe_coeff=1.0, unsafe_coeff=1.0, worst_coeff=1.0).double()
    out = loss(data)
    assert all(value.item() == 0.0 for value in out.values())
    sum(out.values()).backward()
    assert all(p.grad is None or not p.grad.any() for p in loss.parameters())


# --- values of actions ------------------------------------------------------------------------------------------------


def test_the_policy_is_asked_for_the_best_tabulated_action():
    # Grid -1, 0, 1; the policy says 0.5, half way between the values of 0 and 1.
    rows = TensorDict(latent=torch.zeros(2, 2), action_value=torch.tensor([[0.0, 1.0, 4.0], [3.0, 0.0, 1.0]]), batch_size=2)
    out = ActionValueLoss(Reads(0.0, 0.5), scale=0.5)(rows)
    assert out["loss_action_value"].item() == pytest.approx(((4.0 - 2.5) + (3.0 - 0.5)) / 0.5 / 2)


@pytest.mark.parametrize(("dims", "points"), [(1, 2), (1, 7), (2, 3), (3, 2)])
def test_values_between_actions_equal_the_reference(dims, points):
    g = torch.Generator().manual_seed(0)
    table = torch.rand(6, points**dims, generator=g, dtype=torch.float64)
    scale = [1.5, 0.5, 2.0][:dims]
    action = (torch.rand(6, dims, generator=g, dtype=torch.float64) * 2.4 - 1.2) * torch.tensor(scale, dtype=torch.float64)
    found = interpolate(table, action, action_scale=torch.tensor(scale, dtype=torch.float64))
    expected = [reference.multilinear(row, at, scale, points) for row, at in zip(table.numpy(), action.numpy(), strict=True)]
    assert found[:, 0].tolist() == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("dims", "points"), [(1, 5), (2, 3)])
def test_gradients_of_action_values_are_those_of_the_formula(dims, points):
    torch.manual_seed(0)
    g = torch.Generator().manual_seed(2)
    table = torch.rand(6, points**dims, generator=g, dtype=torch.float64)
    rows = TensorDict(latent=torch.rand(6, 2, generator=g, dtype=torch.float64), action_value=table, batch_size=6)
    loss = ActionValueLoss(Smooth(2, dims), worst_coeff=0.3, worst_fraction=0.3).double()
    assert torch.autograd.gradcheck(lambda *_: loss(rows)["loss_action_value"], tuple(loss.parameters()))


def test_no_action_counts_where_no_row_does():
    rows = TensorDict(latent=torch.zeros(3, 2), action_value=torch.rand(3, 5), batch_size=3)
    rows["collector", "mask"] = torch.zeros(3, dtype=torch.bool)
    out = ActionValueLoss(Reads(), worst_coeff=1.0)(rows)
    assert out["loss_action_value"].item() == 0.0
    out["loss_action_value"].backward()


# --- networks that are run as they are --------------------------------------------------------------------------------


def test_a_copy_made_after_a_call_has_networks_of_its_own():
    loss = ConsistencyLoss(Adds())
    before = loss(by_hand())["loss_consistency"].item()
    clone = copy.deepcopy(loss)
    with torch.no_grad():
        for value in clone.parameters():
            value.add_(1.0)
    assert loss(by_hand())["loss_consistency"].item() == before
    assert clone(by_hand())["loss_consistency"].item() != before


@pytest.mark.parametrize("assign", [False, True])
def test_weights_loaded_after_a_call_are_used(assign):
    loss, other = ConsistencyLoss(Adds()), ConsistencyLoss(Adds())
    loss(by_hand())
    with torch.no_grad():
        next(other.parameters()).fill_(3.0)
    loss.load_state_dict(other.state_dict(), assign=assign)
    assert loss(by_hand())["loss_consistency"].item() == other(by_hand())["loss_consistency"].item()


def test_a_loss_that_was_cast_after_a_call_computes_in_the_new_dtype():
    torch.manual_seed(0)
    loss, data = ConsistencyLoss(LatentDynamics(2, 1, (8,), 10.0)), random_transitions(8, torch.float32)
    single = loss(data)["loss_consistency"]
    double = loss.double()(data.apply(lambda v: v.double() if v.is_floating_point() else v))["loss_consistency"]
    assert double.dtype == torch.float64
    assert double.item() == pytest.approx(single.item(), rel=1e-5)


def test_a_frozen_network_may_take_a_step_before_the_others_go_backward():
    torch.manual_seed(0)
    dynamics, barrier, policy = LatentDynamics(2, 1, (8,)), Smooth(2, 1), Smooth(2, 1)
    loss = SynthesisLoss(None, dynamics, barrier, policy, mode="R3", dynamics_margin=3.0, band=5.0)
    assert "dynamics" in loss.detach
    out = loss(TensorDict(latent=torch.rand(8, 2), batch_size=8))
    with torch.no_grad():
        for value in dynamics.parameters():
            value.add_(0.1)
    out["loss_synthesis"].backward()
    assert all(p.grad is None for p in dynamics.parameters())
    assert all(isinstance(p, nn.Parameter) and p.requires_grad for p in dynamics.parameters())
    assert any(bool(p.grad.any()) for p in policy.parameters())


def test_a_network_is_put_back_after_a_mistake():
    loss = SynthesisLoss(None, Adds(), Reads(), Fails(), mode="R3")
    with pytest.raises(ZeroDivisionError):
        loss(TensorDict(latent=torch.rand(8, 2), batch_size=8))
    assert all(isinstance(p, nn.Parameter) for name in ("dynamics", "barrier") for p in getattr(loss, name).parameters())


class Fails(nn.Module):
    def forward(self, latent: Tensor) -> Tensor:
        raise ZeroDivisionError

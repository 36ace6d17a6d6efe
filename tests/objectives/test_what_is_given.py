"""Networks and batches as users give them: several entries, another order, other shapes, weights that come later."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from test_losses import Adds, Reads, _nets, batch, latents
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.modules import Policy
from torchrl_sspl.objectives import (
    CounterexampleLoss,
    PolicyDeviationLoss,
    SaLaDLoss,
    SSPLLoss,
    SynthesisLoss,
    TargetLoss,
)


def three() -> TensorDict:
    return batch(latents(-0.3, 0.1, 0.7), latents(-0.2, 0.1, 0.7), torch.zeros(3, 1), [1, 0, 2])


def test_of_several_entries_the_one_that_is_meant_is_trained() -> None:
    torch.manual_seed(0)
    body, head = nn.Linear(2, 3), nn.Linear(3, 1)
    deep = TensorDictSequential(TensorDictModule(body, ["latent"], ["hidden"]), TensorDictModule(head, ["hidden"], ["barrier"]))
    plain = nn.Sequential(body, head)
    found, wanted = (SaLaDLoss(None, Adds(), net, consistency="online")(three()) for net in (deep, plain))
    for key in sorted(wanted.keys()):
        torch.testing.assert_close(found[key], wanted[key])
    found["loss_safe"].backward()
    assert head.weight.grad is not None
    other = TensorDictSequential(TensorDictModule(body, ["latent"], ["hidden"]), TensorDictModule(head, ["hidden"], ["height"]))
    with pytest.raises(ConfigError, match=r"a module that writes 'barrier', or one entry alone, received one that writes \['hidden', 'height'\]"):
        SaLaDLoss(None, Adds(), other, consistency="online")


def test_networks_that_read_in_another_order_are_refused() -> None:
    turned = TensorDictModule(Adds(), in_keys=["action", "latent"], out_keys=[("next", "latent")])
    with pytest.raises(ConfigError, match="in this order, received"):
        SaLaDLoss(None, turned, Reads(), consistency="online")


class Flat(Reads):
    def forward(self, latent: Tensor) -> Tensor:
        return super().forward(latent)[..., 0]


@pytest.mark.parametrize("make", [
    lambda: SaLaDLoss(None, Adds(), Flat(), consistency="online"),
    lambda: SynthesisLoss(None, Adds(), Flat(), Reads()),
])  # fmt: skip
def test_a_barrier_without_its_last_dimension_is_refused(make) -> None:
    with pytest.raises(ShapeError, match=r"one value for each latent, \(.*, 1\), received \(.*3,?\); let it keep its last dimension"):
        make()(three())


def test_targets_may_lack_their_last_dimension() -> None:
    row = {"latent": latents(-0.3, 0.1), "region": torch.zeros(2, 1, dtype=torch.int64), "action_target": torch.ones(2, 1)}
    flat = {"barrier_target": torch.tensor([-0.5, 0.2]), "inside": torch.tensor([True, False]), "action_weight": torch.tensor([1.0, 0.5])}
    deep = {key: value[:, None] for key, value in flat.items()}
    loss = TargetLoss(Reads(), Reads())
    found, wanted = (loss(TensorDict(row | part, [2])) for part in (flat, deep))
    for key in sorted(wanted.keys()):
        torch.testing.assert_close(found[key], wanted[key])


@pytest.mark.parametrize(("make", "name"), [
    (lambda **weight: SSPLLoss(*_nets(), **weight), "policy_coeff"),
    (lambda **weight: SSPLLoss(*_nets(), **weight), "growth_coeff"),
    (lambda **weight: SaLaDLoss(None, Adds(), Reads(), consistency="online", **weight), "variance_coeff"),
    (lambda **weight: TargetLoss(Reads(), Reads(), **weight), "unsafe_coeff"),
])  # fmt: skip
def test_a_term_that_was_left_out_cannot_be_weighted_later(make, name: str) -> None:
    left_out, loss = make(**{name: 0.0}), make(**{name: 0.5})
    for value in (0.5, torch.tensor(0.5)):
        with pytest.raises(ConfigError, match=f"expected {name} > 0 when .* is made.* with {name}=0.5 and"):
            setattr(left_out, name, value)
    for given in (left_out, copy.deepcopy(left_out)):
        with pytest.raises(ConfigError, match=f"expected {name} > 0 when .* is made"):
            given.load_state_dict(left_out.state_dict() | {name: loss.state_dict()[name]})
        assert float(getattr(given, name)) == 0.0
    nested = nn.ModuleDict({"loss": left_out})
    with pytest.raises(ConfigError, match=f"expected {name} > 0 when .* is made"):
        nested.load_state_dict(nested.state_dict() | {f"loss.{name}": torch.tensor(0.5)})
    left_out.load_state_dict(left_out.state_dict())
    for value in (0.0, torch.tensor(0.0)):
        setattr(left_out, name, value)
    for value in (0.0, 0.25, torch.tensor(0.25)):
        setattr(loss, name, value)
        assert float(getattr(loss, name)) == float(value)
    loss.load_state_dict(make(**{name: 0.75}).state_dict())
    assert float(getattr(loss, name)) == 0.75


def test_an_encoder_without_sequence_is_told_how_to_get_observations() -> None:
    class Mean(nn.Module):
        def forward(self, pixels: Tensor) -> Tensor:
            return pixels.float().mean((-1, -2))[..., :2]

    data = three().set("frames", torch.zeros(3, 3, 3, 4, 4, dtype=torch.uint8))
    with pytest.raises(ConfigError, match=r"received 'frames', which only an encoder with a method sequence reads; TransitionStore\(capacity, pixel_views=True\)"):
        SaLaDLoss(Mean(), Adds(), Reads(), consistency="online")(data)


@pytest.mark.parametrize("detach", ["encoder", ("encode",)])
def test_networks_to_detach_are_named_in_a_tuple(detach) -> None:
    with pytest.raises(ConfigError, match="expected detach to be"):
        PolicyDeviationLoss(None, Policy(2, 1), detach=detach)


def test_a_users_policy_that_reads_what_is_not_there_is_told_so() -> None:
    user = TensorDictModule(nn.Identity(), ["elsewhere"], ["action"])
    with pytest.raises(ConfigError, match="to hold 'elsewhere'"):
        PolicyDeviationLoss(None, Policy(2, 1), user_policy=user)(three())


def test_what_a_users_policy_reads_is_among_the_keys_of_the_loss() -> None:
    user = TensorDictModule(nn.Linear(3, 1), ["goal"], ["action"])
    data = three().set("goal", torch.rand(3, 3))
    for loss in (PolicyDeviationLoss(None, Policy(2, 1), user_policy=user), SSPLLoss(*_nets(), policy_coeff=1.0, user_policy=user)):
        assert loss.in_keys.count("goal") == 1
        loss.select_out_keys("loss_policy_deviation")
        flat = {"_".join(key) if isinstance(key, tuple) else key: data[key] for key in loss.in_keys if key in data.keys(True)}
        torch.testing.assert_close(loss(**flat), loss(data)["loss_policy_deviation"])
    reads_latents = TensorDictModule(nn.Linear(2, 1), ["latent"], ["action"])
    assert PolicyDeviationLoss(None, Policy(2, 1), user_policy=reads_latents).in_keys.count("latent") == 1


def test_a_users_policy_may_name_its_action_otherwise() -> None:
    net, data = nn.Linear(2, 1), three()
    wanted = PolicyDeviationLoss(None, Reads(), user_policy=net)(data)["loss_policy_deviation"]
    loss = PolicyDeviationLoss(None, Reads(), user_policy=TensorDictModule(net, ["latent"], ["wish"]))
    torch.testing.assert_close(loss(data)["loss_policy_deviation"], wanted)
    both = TensorDictSequential(TensorDictModule(nn.Identity(), ["latent"], ["u"]), TensorDictModule(net, ["u"], ["action"]))
    loss = PolicyDeviationLoss(None, Reads(), user_policy=both)
    for name in ("action", "other"):
        loss.set_keys(action=name)
        torch.testing.assert_close(loss(data)["loss_policy_deviation"], wanted)
    many = TensorDictModule(lambda latent: (latent, latent), ["latent"], ["loc", "scale"])
    with pytest.raises(ConfigError, match=r"a module that writes 'action', or one entry alone, received one that writes \['loc', 'scale'\]"):
        PolicyDeviationLoss(None, Reads(), user_policy=many)


@pytest.mark.parametrize("wrap", [lambda net: net, lambda net: TensorDictModule(net, ["latent"], ["action"])])
def test_a_users_policy_is_cast_with_the_loss_that_does_not_train_it(wrap) -> None:
    net = nn.Linear(2, 1)
    loss = PolicyDeviationLoss(None, Policy(2, 1), user_policy=wrap(net))
    before = len(list(loss.parameters())), sorted(loss.state_dict())
    loss.to(torch.float64)
    assert loss(three().to(torch.float64))["loss_policy_deviation"].dtype == net.weight.dtype == torch.float64
    assert (len(list(loss.parameters())), sorted(loss.state_dict())) == before
    assert not any(net.weight is parameter for parameter in loss.parameters())


def test_frames_in_rows_that_do_not_count_may_be_nan() -> None:
    class Mean(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = nn.Linear(2, 2)

        def sequence(self, frames: Tensor) -> Tensor:
            mean = frames.mean((-1, -2, -3))
            return self.net(torch.stack([mean[..., :-1], mean[..., 1:]], -1))

    torch.manual_seed(0)
    loss = SaLaDLoss(Mean(), Adds(), Reads(), consistency="online", variance_coeff=1.0)
    data = three().set("frames", torch.rand(3, 3, 3, 1, 2)).set(("collector", "mask"), torch.tensor([True, True, False]))
    wanted = loss(data)
    data["frames"][2] = torch.nan
    found = loss(data)
    for key in sorted(wanted.keys()):
        torch.testing.assert_close(found[key], wanted[key])
    sum(value for key, value in found.items() if key.startswith("loss_")).backward()
    assert all(bool(parameter.grad.isfinite().all()) for parameter in loss.parameters() if parameter.grad is not None)


def test_rows_that_do_not_count_are_no_counterexamples() -> None:
    data = TensorDict(latent=latents(-0.5, -0.5), batch_size=[2])
    loss = CounterexampleLoss(Adds(), Reads(), Shift())
    assert loss(data)["counterexample_share"] == 1.0
    data["collector", "mask"] = torch.tensor([True, False])
    data["latent"][1] = 0.5
    found = loss(data)
    assert found["counterexample_share"] == 1.0
    data["collector", "mask"] = torch.tensor([False, True])
    assert loss(data)["counterexample_max"] == 0.0


def test_counterexamples_count_by_their_share_of_all_rows() -> None:
    loss = CounterexampleLoss(Adds(), Reads(), Shift(), depth=0.01, cap=0.05, policy_coeff=0.3)
    for others in (0, 1, 3):  # rows that are outside already
        found = loss(TensorDict(latent=latents(0.0, *[0.5] * others), batch_size=[1 + others]))["loss_counterexample"]
        assert found.item() == pytest.approx((0.01 + 0.3 * 1.0) / (1 + others))


class Shift(nn.Module):
    """A policy that moves every latent by one."""

    def __init__(self) -> None:
        super().__init__()
        self.by = nn.Parameter(torch.ones(1))

    def forward(self, latent: Tensor) -> Tensor:
        return self.by.expand(*latent.shape[:-1], 1)

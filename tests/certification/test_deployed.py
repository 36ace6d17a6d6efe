"""What is proved is what is deployed: networks that compute anything else are refused, each for its reason."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from plain import linear
from torch import Tensor, nn
from torch.nn.utils import parametrizations, parametrize

from torchrl_sspl.certification.branch_and_bound import Budget
from torchrl_sspl.certification.certificate import Reason
from torchrl_sspl.certification.conditions import decide_invariance, decide_vacuity, largest_error
from torchrl_sspl.certification.deployed import check_deployed
from torchrl_sspl.certification.layers import deterministic_layer
from torchrl_sspl.certification.loop import closed_loop, closed_loop_lipschitz
from torchrl_sspl.errors import StructureError
from torchrl_sspl.lipschitz import SandwichBarrier, prove_lipschitz
from torchrl_sspl.lipschitz.layers import FORMS, LAYERS, ORIGINAL, Activation, known_form
from torchrl_sspl.modules import LatentDynamics, Policy


def with_net(module: nn.Module, net: nn.Module) -> nn.Module:
    module.net = net
    return module


def parts(scale: float = 2.0) -> dict[str, Any]:
    """z1+ = 1.8 z1 + 0.6 v with v = clamp(-2 z1), z2+ = z2 / 2; B = |z|_1 - 1/2."""
    eye = torch.eye(2)
    signs = torch.cat([eye, -eye])
    first = linear(torch.cat([signs, torch.tensor([[0.75], [0.0], [-0.75], [0.0]])], 1))
    move = nn.Sequential(first, nn.ReLU(), linear([[0.8, 0.0, -0.8, 0.0], [0.0, -0.5, 0.0, 0.5]]))
    control = nn.Sequential(linear(signs), nn.ReLU(), linear([[-2.0, 0.0, 2.0, 0.0]]))
    return {
        "barrier": nn.Sequential(linear(signs), nn.ReLU(), linear(torch.ones(1, 4), [-0.5])),
        "dynamics": with_net(LatentDynamics(2, 1, (1,), scale), move).eval(),
        "policy": with_net(Policy(2, 1, (1,), scale), control).eval(),
        "latent_dim": 2,
        "lipschitz_bound": 1.5,
    }


def refused(layer) -> Reason:
    assert not layer.holds, [(s.name, s.holds) for s in layer.statements]
    return layer.reasons[0]


# --- networks that compute something else than their weights say ------------------------------------------------------


class OwnForward(nn.Sequential):
    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x) - 0.3


class OtherLinear(nn.Linear):
    def forward(self, x: Tensor) -> Tensor:
        return 2.0 * super().forward(x)


class SameLinear(nn.Linear):
    pass


class OtherReLU(nn.ReLU):
    def forward(self, x: Tensor) -> Tensor:
        return x


class OtherPolicy(Policy):
    def forward(self, latent: Tensor) -> Tensor:
        return -super().forward(latent)


class OtherDynamics(LatentDynamics):
    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return 2.0 * super().forward(latent, action)


class Collapsing(nn.Module):
    """A barrier that is high everywhere, and says that it is another one."""

    def __init__(self, barrier: nn.Sequential) -> None:
        super().__init__()
        self.barrier = barrier

    def forward(self, z: Tensor) -> Tensor:
        return self.barrier(z) - 9.0

    def collapse(self) -> nn.Sequential:
        return self.barrier


class Duck(nn.Module):
    def __init__(self, net: nn.Sequential) -> None:
        super().__init__()
        self.net, self.action_scale = net, torch.ones(1)

    def forward(self, z: Tensor) -> Tensor:
        return -self.net(z)


class Double(nn.Module):
    def forward(self, weight: Tensor) -> Tensor:
        return 2.0 * weight


def replace_layer(net: nn.Sequential, index: int, layer: nn.Module) -> None:
    if isinstance(layer, nn.Linear):
        layer.load_state_dict(net[index].state_dict())
    net[index] = layer


def unregistered(layer: nn.Linear) -> None:
    weight = layer.weight.data
    del layer.weight
    layer.weight = weight


def scales(value: Any) -> Callable[[dict[str, Any]], None]:
    def change(p: dict[str, Any]) -> None:
        for name in ("dynamics", "policy"):
            p[name].action_scale = torch.as_tensor(value, dtype=torch.float32).reshape(-1)

    return change


def nothing(*_: Any) -> None:
    return None


def as_type(kind: type[nn.Module], module: nn.Module, net: nn.Sequential) -> nn.Module:
    return with_net(kind(2, 1, (1,), 2.0), net)


TWINS: dict[str, tuple[Callable[[dict[str, Any]], Any], Reason]] = {
    "hook on the barrier": (lambda p: p["barrier"].register_forward_hook(lambda m, i, o: o - 1.0), Reason.HOOKED),
    "hook on a layer of the barrier": (lambda p: p["barrier"][0].register_forward_hook(lambda m, i, o: 2 * o), Reason.HOOKED),
    "hook that does nothing": (lambda p: p["barrier"][1].register_forward_hook(nothing), Reason.HOOKED),
    "pre-hook on a layer of the barrier": (lambda p: p["barrier"][2].register_forward_pre_hook(lambda m, i: (i[0] * 0,)), Reason.HOOKED),
    "hook on the policy": (lambda p: p["policy"].register_forward_hook(lambda m, i, o: -o), Reason.HOOKED),
    "pre-hook on the policy": (lambda p: p["policy"].register_forward_pre_hook(lambda m, i: (-i[0],)), Reason.HOOKED),
    "hook on the policy's network": (lambda p: p["policy"].net.register_forward_hook(lambda m, i, o: -o), Reason.HOOKED),
    "hook on the dynamics": (lambda p: p["dynamics"].register_forward_hook(lambda m, i, o: 2 * o), Reason.HOOKED),
    "hook on a layer of the dynamics": (lambda p: p["dynamics"].net[0].register_forward_hook(lambda m, i, o: o + 1), Reason.HOOKED),
    "hook with keywords": (lambda p: p["policy"].register_forward_hook(lambda m, a, k, o: -o, with_kwargs=True), Reason.HOOKED),
    "hook that is always called": (lambda p: p["barrier"].register_forward_hook(nothing, always_call=True), Reason.HOOKED),
    "backward hook": (lambda p: p["barrier"].register_full_backward_hook(nothing), Reason.HOOKED),
    "backward pre-hook": (lambda p: p["dynamics"].register_full_backward_pre_hook(nothing), Reason.HOOKED),
    "barrier with a forward of its own": (lambda p: setattr(p["barrier"], "forward", lambda z: z[:, :1] * 0 - 1), Reason.OVERRIDDEN),
    "layer with a forward of its own": (lambda p: setattr(p["barrier"][0], "forward", lambda z: torch.zeros(len(z), 4)), Reason.OVERRIDDEN),
    "activation with a forward of its own": (lambda p: setattr(p["dynamics"].net[1], "forward", torch.sin), Reason.OVERRIDDEN),
    "policy with a forward of its own": (lambda p: setattr(p["policy"], "forward", lambda z: z[:, :1]), Reason.OVERRIDDEN),
    "policy's network with a forward of its own": (lambda p: setattr(p["policy"].net, "forward", lambda z: z[:, :1]), Reason.OVERRIDDEN),
    "dynamics with a forward of its own": (lambda p: setattr(p["dynamics"], "forward", lambda z, u: 2 * z), Reason.OVERRIDDEN),
    "the call itself replaced": (lambda p: setattr(p["policy"], "_call_impl", lambda z: z[:, :1]), Reason.OVERRIDDEN),
    "compiled": (lambda p: p["barrier"].compile(), Reason.OVERRIDDEN),
    "parameters that are other ones for those who ask": (lambda p: setattr(p["barrier"], "named_parameters", lambda **_: iter(())), Reason.OVERRIDDEN),
    "subclass of Sequential": (lambda p: p.update(barrier=OwnForward(*p["barrier"])), Reason.SUBCLASSED),
    "subclass of Sequential in the policy": (lambda p: with_net(p["policy"], OwnForward(*p["policy"].net)), Reason.NOT_UNDERSTOOD),
    "subclass of Sequential as dynamics": (lambda p: p.update(dynamics=OwnForward(linear(torch.zeros(2, 3)))), Reason.SUBCLASSED),
    "subclass of Linear": (lambda p: replace_layer(p["barrier"], 0, OtherLinear(2, 4)), Reason.SUBCLASSED),
    "subclass of Linear that changes nothing": (lambda p: replace_layer(p["policy"].net, 2, SameLinear(4, 1)), Reason.SUBCLASSED),
    "subclass of ReLU": (lambda p: replace_layer(p["barrier"], 1, OtherReLU()), Reason.SUBCLASSED),
    "subclass of the policy": (lambda p: p.update(policy=as_type(OtherPolicy, p["policy"], p["policy"].net)), Reason.SUBCLASSED),
    "subclass of the dynamics": (lambda p: p.update(dynamics=as_type(OtherDynamics, p["dynamics"], p["dynamics"].net)), Reason.SUBCLASSED),
    "parametrization": (lambda p: parametrize.register_parametrization(p["barrier"][0], "weight", Double()), Reason.PARAMETRIZED),
    "spectral norm": (lambda p: parametrizations.spectral_norm(p["policy"].net[2]), Reason.PARAMETRIZED),
    "weight norm": (lambda p: parametrizations.weight_norm(p["dynamics"].net[0]), Reason.PARAMETRIZED),
    "weight that is no parameter": (lambda p: unregistered(p["barrier"][0]), Reason.PARAMETRIZED),
    "lying collapse()": (lambda p: p.update(barrier=Collapsing(p["barrier"])), Reason.NOT_UNDERSTOOD),
    "barrier that is deployed without collapse()": (lambda p: p.update(barrier=SandwichBarrier(2, (4,), 1.5)), Reason.NOT_UNDERSTOOD),
    "anything with a net and a scale": (lambda p: p.update(policy=Duck(p["policy"].net)), Reason.NOT_UNDERSTOOD),
    "policy in place of dynamics": (lambda p: p.update(dynamics=p["policy"]), Reason.NOT_UNDERSTOOD),
    "policy of the sizes of dynamics in their place": (
        lambda p: p.update(dynamics=as_type(Policy, p["dynamics"], p["dynamics"].net)), Reason.NOT_UNDERSTOOD),
    "dynamics of the sizes of a policy in its place": (
        lambda p: p.update(policy=as_type(LatentDynamics, p["policy"], p["policy"].net)), Reason.NOT_UNDERSTOOD),
    "scale of zero": (scales(0.0), Reason.SCALE_INVALID),
    "negative scale": (scales(-2.0), Reason.SCALE_INVALID),
    "infinite scale": (scales(math.inf), Reason.NOT_FINITE),
    "scale that is not a number": (scales(math.nan), Reason.NOT_FINITE),
    "scale so small that float32 loses the action": (scales(1e-30), Reason.SCALE_INVALID),
    "scale of another size": (scales([2.0, 2.0]), Reason.SCALE_INVALID),
    "two scales": (lambda p: setattr(p["policy"], "action_scale", torch.tensor([1.0])), Reason.NOT_UNDERSTOOD),
    "softplus that jumps": (lambda p: replace_layer(p["barrier"], 1, nn.Softplus(threshold=0.5)), Reason.NOT_UNDERSTOOD),
    "softplus turned round": (lambda p: replace_layer(p["barrier"], 1, nn.Softplus(beta=-1.0)), Reason.NOT_UNDERSTOOD),
    "GELU by its approximation": (lambda p: replace_layer(p["barrier"], 1, nn.GELU("tanh")), Reason.NOT_UNDERSTOOD),
    "dropout": (lambda p: replace_layer(p["policy"].net, 1, nn.Dropout(0.5)), Reason.NOT_UNDERSTOOD),
    "batch normalisation": (lambda p: replace_layer(p["barrier"], 1, nn.BatchNorm1d(4)), Reason.NOT_UNDERSTOOD),
    "activation without bounds": (lambda p: replace_layer(p["barrier"], 1, nn.Softsign()), Reason.NOT_UNDERSTOOD),
    "NaN among the weights": (lambda p: p["barrier"][0].weight.data[0, 0].fill_(math.nan), Reason.NOT_FINITE),
    "infinite bias": (lambda p: p["policy"].net[0].bias.data[0].fill_(math.inf), Reason.NOT_FINITE),
    "half precision": (lambda p: [p[k].half() for k in ("barrier", "dynamics", "policy")], Reason.WRONG_DTYPE),
    "bfloat16": (lambda p: [p[k].bfloat16() for k in ("barrier", "dynamics", "policy")], Reason.WRONG_DTYPE),
    "policy in double precision": (lambda p: p["policy"].double(), Reason.WRONG_DTYPE),
    "policy that changes its input": (
        lambda p: with_net(p["policy"], nn.Sequential(nn.ReLU(inplace=True), *p["policy"].net)), Reason.VALUES_DIFFER),
    "barrier that changes its input": (lambda p: p.update(barrier=nn.Sequential(nn.ReLU(inplace=True), *p["barrier"])), Reason.VALUES_DIFFER),
    "domain without width": (lambda p: p.update(low=1.0, high=1.0), Reason.NOT_UNDERSTOOD),
    "domain that is not a number": (lambda p: p.update(low=math.nan), Reason.NOT_UNDERSTOOD),
    "infinite domain": (lambda p: p.update(high=math.inf), Reason.NOT_UNDERSTOOD),
}  # fmt: skip


@pytest.mark.parametrize("name", TWINS)
def test_networks_that_are_not_what_is_proved_are_refused(name):
    breaking, reason = TWINS[name]
    twin = parts()
    breaking(twin)
    assert refused(deterministic_layer(**twin)) is reason


def test_there_are_as_many_broken_networks_as_promised():
    assert len(TWINS) >= 60


@pytest.fixture
def registered() -> Iterator[None]:
    """Whatever a test makes known is forgotten after it."""
    before = [dict(LAYERS), dict(FORMS), dict(ORIGINAL)]
    yield
    for table, old in zip((LAYERS, FORMS, ORIGINAL), before, strict=True):
        table.clear()
        table.update(old)


class Turned(Policy):
    def forward(self, latent: Tensor) -> Tensor:
        return self.action_scale * (-self.net(latent)).clamp(-1.0, 1.0)


class Unclamped(Policy):
    def forward(self, latent: Tensor) -> Tensor:
        return self.action_scale * self.net(latent)


class WiderClamp(LatentDynamics):
    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return (latent + self.net(torch.cat([latent, action / self.action_scale], -1))).clamp(-1.01, 1.01)


class WithoutScale(LatentDynamics):
    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return (latent + self.net(torch.cat([latent, action], -1))).clamp(-1.0, 1.0)


class OffByALittle(Policy):
    def forward(self, latent: Tensor) -> Tensor:
        return self.action_scale * self.net(latent).clamp(-1.0, 1.0) + 3e-6


class OffByATenThousandth(Policy):
    """What it adds is far more than rounding, and nothing at the centre of the domain."""

    def forward(self, latent: Tensor) -> Tensor:
        return self.action_scale * (1.0001 * self.net(latent)).clamp(-1.0, 1.0)


class Remembering(Policy):
    calls = 0

    def forward(self, latent: Tensor) -> Tensor:
        self.calls += 1
        return self.action_scale * self.net(latent).clamp(-1.0, 1.0) * (1.0 if self.calls < 3 else 0.5)


class WithinTheBatch(Policy):
    def forward(self, latent: Tensor) -> Tensor:
        value = self.net(latent).clamp(-1.0, 1.0)
        return self.action_scale * (value if len(latent) > 1 else 0.5 * value)


class Failing(Policy):
    def forward(self, latent: Tensor) -> Tensor:
        raise RuntimeError("no")


class NaNAtACorner(Policy):
    def forward(self, latent: Tensor) -> Tensor:
        value = self.action_scale * self.net(latent).clamp(-1.0, 1.0)
        return torch.where((latent == 1.0).all(-1, keepdim=True), math.nan, value)


@pytest.mark.parametrize(
    ("form", "kind"),
    [("bounded", k) for k in (Turned, Unclamped, OffByALittle, OffByATenThousandth)]
    + [("bounded", k) for k in (Remembering, WithinTheBatch, Failing, NaNAtACorner)]
    + [("residual", k) for k in (WiderClamp, WithoutScale)],
)
def test_values_are_compared_where_a_module_is_not_of_the_form_that_it_was_given(registered, form, kind):
    known_form(form)(kind)
    twin = parts()
    if kind is WiderClamp:
        twin["dynamics"].net[0].weight.data[:, 0].mul_(3.0)  # the clamp is reached
    name = "policy" if form == "bounded" else "dynamics"
    twin[name] = as_type(kind, twin[name], twin[name].net)
    assert refused(deterministic_layer(**twin)) is Reason.VALUES_DIFFER


def test_hooks_of_all_modules_and_methods_replaced_in_a_class_are_found(monkeypatch):
    handle = nn.modules.module.register_module_forward_hook(nothing)
    try:
        assert refused(deterministic_layer(**parts())) is Reason.HOOKED
    finally:
        handle.remove()
    for kind in (nn.ReLU, nn.Sequential, Policy, LatentDynamics):
        with monkeypatch.context() as patch:
            patch.setattr(kind, "forward", lambda *_: 0.0)
            assert refused(deterministic_layer(**parts())) is Reason.OVERRIDDEN
    with monkeypatch.context() as patch:
        patch.setattr(Policy, "__call__", lambda self, z: z[:, :1])
        assert refused(deterministic_layer(**parts())) is Reason.OVERRIDDEN


def test_collapse_of_a_plain_network_is_not_asked():
    twin = parts()
    twin["policy"].net[2].weight.data.mul_(-1.0)
    harmless = nn.Sequential(linear(torch.zeros(1, 2), [-1.0]))
    twin["barrier"].collapse = lambda: harmless
    assert refused(deterministic_layer(**twin)) is Reason.NOT_INVARIANT


# --- networks that are what is proved ---------------------------------------------------------------------------------


def valid(name: str) -> dict[str, Any]:
    p = parts(scale=7.0 if name == "another scale" else 2.0)
    if name == "nested":
        p["barrier"] = nn.Sequential(nn.Sequential(p["barrier"][0], nn.Identity()), nn.Sequential(*p["barrier"][1:]))
    elif name == "double precision":
        for k in ("barrier", "dynamics", "policy"):
            p[k].double()
    elif name == "training mode":
        for k in ("barrier", "dynamics", "policy"):
            p[k].train()
    elif name == "with gradients":
        p["barrier"].requires_grad_()
    elif name == "in place after a linear layer":
        p["barrier"][1] = nn.ReLU(inplace=True)
    elif name == "without a bias":
        p["barrier"][0].bias = None
    elif name == "names and notes attached":
        p["policy"].note, p["policy"].extra = "mine", nn.Linear(3, 3)
    elif name == "plain policy":
        p["policy"] = nn.Sequential(*p["policy"].net, nn.Hardtanh(), linear([[2.0]]))
    elif name == "state was loaded":
        p["dynamics"].load_state_dict(p["dynamics"].state_dict())
    elif name == "wider domain":
        p.update(low=-1.25, high=1.25)
    return p


@pytest.mark.parametrize(
    "name",
    ["as it is", "nested", "double precision", "training mode", "with gradients", "in place after a linear layer",
     "without a bias", "names and notes attached", "another scale", "plain policy", "state was loaded", "wider domain"],
)  # fmt: skip
def test_valid_networks_pass(name):
    layer = deterministic_layer(**valid(name))
    assert layer.holds, layer.verdict
    assert layer["deployed"].holds
    assert layer["tolerated error"].value == pytest.approx(0.2 / 1.5, abs=2e-3)


def test_a_layer_is_made_known_by_one_entry(registered):
    class Bent(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return torch.where(x > 0, x, 0.25 * x)

    twin = parts()
    twin["dynamics"].net[1] = Bent()
    assert refused(deterministic_layer(**twin)) is Reason.NOT_UNDERSTOOD
    LAYERS[Bent] = lambda m: Activation("Bent", m.forward, (0.25, 1.0), knots=(0.0,))
    layer = deterministic_layer(**twin)
    assert layer["deployed"].holds
    assert {s.name for s in layer.statements} >= {"deployed", "Lipschitz constant", "invariance"}
    net = nn.Sequential(linear([[1.0]]), Bent(), linear([[1.0]]))
    assert prove_lipschitz(net, 1.001).proved
    assert not prove_lipschitz(net, 0.999).proved


# --- the clamp and the scale are those of the modules -----------------------------------------------------------------


def one_norm(radius: float) -> nn.Sequential:
    return nn.Sequential(linear([[1.0], [-1.0]]), nn.ReLU(), linear([[1.0, 1.0]], [-radius]))


def spike(at: float, width: float, height: float, factor: float = 0.5) -> nn.Sequential:
    """z+ = factor z, but for a narrow spike of this height."""
    hidden = linear([[1.0, 0.0], [-1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 0.0]], [0.0, 0.0, width - at, -at, -at - width])
    out = linear([[factor, -factor, height / width, -2 * height / width, height / width]])
    return nn.Sequential(hidden, nn.ReLU(), out)


def test_the_domain_does_not_clamp_what_the_dynamics_do_not():
    # B = |z| - 1.2 on [-2, 2]; at z = 0.3137 the plant throws to 1.9, which a clamp to 1 would hide.
    plant = spike(0.3137, 1e-4, 1.75)
    idle = nn.Sequential(linear([[0.0]]))
    kind = {"latent_dim": 1, "lipschitz_bound": 1.001, "low": -2.0, "high": 2.0}
    layer = deterministic_layer(one_norm(1.2), plant, idle, **kind, budget=Budget(boxes=100_000))
    assert refused(layer) is Reason.NOT_INVARIANT


@pytest.mark.parametrize("plain", ["policy", "dynamics"])
def test_the_scale_counts_where_one_module_has_none(plain):
    # z+ = 0.9 z + 0.5 v with v = u / 10: harmless if u is taken for v, not with u = 10 v; and the other way round.
    if plain == "policy":
        policy = nn.Sequential(linear([[-1.0]]))
        dynamics = with_net(LatentDynamics(1, 1, (1,), 0.1), nn.Sequential(linear([[0.0, -1.0], [0.0, 1.0]]), nn.ReLU(), linear([[-0.5, 0.5]])))
        step = lambda z: dynamics(z, policy(z))  # noqa: E731
    else:
        policy = with_net(Policy(1, 1, (1,), 10.0), nn.Sequential(linear([[-1.0]])))
        dynamics = nn.Sequential(linear([[1.0, 0.5]]))
        step = lambda z: dynamics(torch.cat([z, policy(z)], -1))  # noqa: E731
    barrier = one_norm(0.5)
    system = closed_loop(barrier, dynamics, policy, latent_dim=1, lipschitz_bound=1.001)
    z = torch.linspace(-1, 1, 101)[:, None]
    with torch.no_grad():
        torch.testing.assert_close(system.step(z).float(), step(z), atol=1e-6, rtol=1e-6)
        assert bool((barrier(step(z)) > 0)[barrier(z) <= 0].any())
    assert check_deployed(system, barrier, dynamics, policy) > 1000
    layer = deterministic_layer(barrier, dynamics, policy, latent_dim=1, lipschitz_bound=1.001)
    assert refused(layer) in (Reason.LEAVES_DOMAIN, Reason.NOT_INVARIANT)
    assert Reason.NOT_INVARIANT in layer.reasons


# --- what decides, decides by more than rounding ----------------------------------------------------------------------


def test_noise_is_no_witness():
    # B = -|z| + tiny steps: at most 8.9e-16, and that only by rounding.
    barrier = nn.Sequential(linear([[1.0], [-1.0]]), nn.ReLU(), linear([[-1.0, -1.0]], [0.0])).double()
    barrier[2].bias.data.fill_(8.9e-16)
    half = nn.Sequential(linear([[0.5, 0.0]])).double()
    idle = nn.Sequential(linear([[0.0]])).double()
    system = closed_loop(barrier, half, idle, latent_dim=1, lipschitz_bound=1.001)
    found = decide_vacuity(system, budget=Budget(boxes=50_000))
    assert found.status == "undecided"
    layer = deterministic_layer(barrier, half, idle, latent_dim=1, lipschitz_bound=1.001, budget=Budget(boxes=50_000))
    assert refused(layer) is Reason.VACUITY_UNDECIDED


@pytest.mark.parametrize("shift", [-5e-7, 0.0, 5e-7])
def test_a_maximum_within_the_slack_is_neither_proved_nor_refuted(shift):
    # B(z+) <= 0.6 |z| - 0.5 <= -0.2 on the set, with a margin of 0.2: zero up to the shift.
    plant = nn.Sequential(linear([[0.6, 0.0]])).double()
    plant[0].weight.data[0, 0] = 0.6
    idle = nn.Sequential(linear([[0.0]])).double()
    system = closed_loop(one_norm(0.5).double(), plant, idle, latent_dim=1, lipschitz_bound=1.001)
    found = decide_invariance(system, margin=0.2 + shift, budget=Budget(boxes=50_000))
    assert found.status == "undecided"
    assert found.upper >= shift
    assert decide_invariance(system, margin=0.2 - 1e-5).status == "proved"
    assert decide_invariance(system, margin=0.2 + 1e-5).status == "refuted"


def test_the_tolerated_error_is_on_the_safe_side_of_the_truth():
    plant, idle = nn.Sequential(linear([[0.5, 0.0]])), nn.Sequential(linear([[0.0]]))
    system = closed_loop(one_norm(0.5), plant, idle, latent_dim=1, lipschitz_bound=1.0)
    for tolerance in (1e-2, 1e-3, 1e-5):
        found = largest_error(system, tolerance=tolerance)
        assert 0.25 - 2 * tolerance - 3e-6 <= found.delta <= 0.25 <= found.refuted_above


def test_structure_errors_name_a_reason():
    with pytest.raises(StructureError) as error:
        closed_loop(OwnForward(linear([[1.0]])), *[nn.Sequential(linear([[0.5, 0.0]]))] * 2, latent_dim=1, lipschitz_bound=1.0)
    assert Reason[error.value.reason] is Reason.SUBCLASSED


@pytest.mark.parametrize("remembers", [False, True])
def test_the_lipschitz_constant_of_the_loop_is_one(remembers):
    torch.manual_seed(0)
    dynamics, policy = LatentDynamics(3, 1, (8,), 2.0, remembers=remembers), Policy(3, 1, (8,), 2.0)
    with torch.no_grad():
        policy.net[-1].weight.mul_(5.0)
        dynamics.net[-1].weight.mul_(0.01)
        bound = closed_loop_lipschitz(dynamics, policy)
        z = torch.rand(2000, 3) - 0.5
        near = z + 1e-3 * torch.randn(2000, 3)
        slopes = (dynamics(z, policy(z)) - dynamics(near, policy(near))).norm(dim=1) / (z - near).norm(dim=1)
    assert 0.9 < float(slopes.max()) <= bound

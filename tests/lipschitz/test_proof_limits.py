"""What a proof refuses to speak of, what it withstands, and that it decides as exact elimination does."""

from __future__ import annotations

import copy
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from torchrl_sspl.errors import ConfigError, ShapeError, StructureError
from torchrl_sspl.lipschitz import (
    LMIBarrier,
    SandwichBarrier,
    lipschitz_lower,
    lipschitz_upper,
    prove_lipschitz,
    slope_interval,
    solve_multipliers,
)
from torchrl_sspl.lipschitz.exact import _exact_square

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import reference

ACTIVATIONS = [nn.ReLU(), nn.LeakyReLU(0.3), nn.Tanh(), nn.Softplus(3.0), nn.Sigmoid(), nn.SiLU(), nn.GELU()]


class Residual(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(2, 2)
        nn.init.zeros_(self.linear.weight)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x + self.linear(x)


def plain(activation: nn.Module, sizes=(2, 8, 8, 1), seed: int = 0) -> nn.Sequential:
    torch.manual_seed(seed)
    layers: list[nn.Module] = []
    for a, b in zip(sizes[:-1], sizes[1:], strict=True):
        layers += [nn.Linear(a, b), activation]
    return nn.Sequential(*layers[:-1])


def secant_slope(network: nn.Module, n: int = 4000) -> float:
    g = torch.Generator().manual_seed(1)
    x = 8 * torch.rand(n, 2, generator=g, dtype=torch.float64) - 4
    y = x + 0.1 * torch.randn(n, 2, generator=g, dtype=torch.float64)
    with torch.no_grad():
        return float(((network(x) - network(y)).norm(dim=1) / (x - y).norm(dim=1)).max())


# --- what a proof speaks of -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "network",
    [
        Residual(),
        nn.Sequential(nn.Linear(2, 2), Residual()),
        nn.Sequential(nn.Linear(2, 2), nn.Softmax(-1), nn.Linear(2, 1)),
        nn.Sequential(nn.Linear(2, 2), nn.ReLU(), nn.SiLU(), nn.Linear(2, 1)),
        nn.Sequential(nn.ReLU(), nn.Linear(2, 1)),
        nn.Sequential(nn.Linear(2, 1), nn.Tanh()),
        nn.Sequential(),
    ],
)
def test_modules_that_are_more_than_their_weights_are_refused(network):
    for function in (lambda: prove_lipschitz(network, 5.0), lambda: lipschitz_upper(network)):
        with pytest.raises(ConfigError, match="plain network"):
            function()


def test_nested_networks_and_linear_pairs_are_plain():
    inner = nn.Sequential(nn.Linear(2, 3), nn.Linear(3, 3))
    network = nn.Sequential(inner, nn.Sigmoid(), nn.Linear(3, 1))
    assert slope_interval(network) == (0.0, 1.0)  # the pair has slope 1, the sigmoid at most 1/4
    assert lipschitz_upper(network) >= secant_slope(network.double())


@pytest.mark.parametrize("activation", ACTIVATIONS, ids=lambda a: type(a).__name__)
def test_slopes_of_the_activation_lie_in_the_interval(activation):
    low, high = slope_interval(nn.Sequential(nn.Linear(1, 1), activation, nn.Linear(1, 1)))
    x = torch.linspace(-12, 12, 24001, dtype=torch.float64)
    slopes = activation(x).diff() / x.diff()
    assert low - 1e-9 <= float(slopes.min()) <= low + 0.01
    assert high - 0.01 <= float(slopes.max()) <= high + 1e-9


@pytest.mark.parametrize("slope", [0.1, -0.3, 1.7])
def test_slope_of_a_leaky_relu_holds_that_of_its_float32_kernel(slope):
    low, high = slope_interval(nn.Sequential(nn.Linear(1, 1), nn.LeakyReLU(slope), nn.Linear(1, 1)))
    deployed = float(torch.tensor(slope, dtype=torch.float32))
    assert low <= min(slope, deployed, 1.0)
    assert max(slope, deployed, 1.0) <= high


# --- networks that are more than they say, or jump ---------------------------------------------------------------------


class TwiceLinear(nn.Linear):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return 2.0 * super().forward(x)


class Shifted(nn.Sequential):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x + super().forward(x)


def changed(change) -> nn.Sequential:
    network = plain(nn.ReLU(), (2, 4, 1))
    return change(network) or network


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda n: nn.Sequential(TwiceLinear(2, 1)), "SUBCLASSED"),
        (lambda n: Shifted(*n), "SUBCLASSED"),
        (lambda n: nn.Sequential(n[0], nn.Softplus(threshold=0.5), n[2]), "NOT_UNDERSTOOD"),
        (lambda n: n.register_forward_hook(lambda m, i, o: 2 * o) and None, "HOOKED"),
        (lambda n: n[0].register_forward_pre_hook(lambda m, i: (2 * i[0],)) and None, "HOOKED"),
        (lambda n: setattr(n[0], "forward", lambda x: x.square()), "OVERRIDDEN"),
        (lambda n: torch.nn.utils.parametrizations.spectral_norm(n[0]) and None, "PARAMETRIZED"),
        (lambda n: LMIBarrier(2, (4,)).register_forward_hook(lambda m, i, o: 2 * o) and Collapses(n), "NOT_UNDERSTOOD"),
    ],
)
def test_proofs_refuse_what_they_do_not_know_exactly(change, reason):
    network = changed(change)
    for function in (lambda: prove_lipschitz(network, 50.0), lambda: lipschitz_upper(network)):
        with pytest.raises(StructureError) as error:
            function()
        assert error.value.reason == reason


class Collapses(nn.Module):
    """Says that it is a network which it is not."""

    def __init__(self, network: nn.Sequential) -> None:
        super().__init__()
        self.network = network

    def collapse(self) -> nn.Sequential:
        return self.network


def test_barriers_of_the_library_are_proved_by_what_they_collapse_to_unless_they_were_changed():
    for barrier in (SandwichBarrier(2, (8,), 2.0), LMIBarrier(2, (8,), 2.0)):
        assert prove_lipschitz(barrier, 2.0).proved
        barrier.collapse = lambda: nn.Sequential(nn.Linear(2, 1))
        with pytest.raises(StructureError, match="collapse"):
            prove_lipschitz(barrier, 2.0)


def test_softplus_with_a_low_threshold_jumps():
    soft = nn.Softplus(threshold=0.5)
    x = torch.tensor([0.5, 0.500001])
    assert float(soft(x).diff()) < -0.4  # from above: no Lipschitz constant at all
    high = nn.Sequential(nn.Linear(1, 1), nn.Softplus(threshold=25.0), nn.Linear(1, 1))
    assert slope_interval(high) == (0.0, 1.0)


@pytest.mark.parametrize("slope", [(0.0, 1.0), (0.0, 1.1), (-0.1, 1.0), (-0.2, 1.09)])
def test_slope_that_the_activation_exceeds_is_refused(slope):
    network = nn.Sequential(nn.Linear(1, 1), nn.SiLU(), nn.Linear(1, 1))
    with torch.no_grad():
        network[0].weight.fill_(1.0)
        network[2].weight.fill_(1.0)
    with pytest.raises(ConfigError, match=r"\(-0.1, 1.1\)"):
        prove_lipschitz(network, 1.01, slope)
    assert not prove_lipschitz(network, 1.01).proved  # its slope reaches 1.0998
    assert prove_lipschitz(network, 1.1001).proved


@pytest.mark.parametrize("slope", [(1.0, 0.0), (math.nan, 1.0), (0.0, math.inf)])
def test_slopes_that_are_no_interval_are_refused(slope):
    with pytest.raises(ConfigError, match="slope"):
        prove_lipschitz([torch.ones(1, 1), torch.ones(1, 1)], 1.0, slope)


def test_vectors_among_the_weights_are_refused():
    with pytest.raises(ShapeError, match=r"\(3,\)"):
        prove_lipschitz([torch.ones(3, 2), torch.ones(3)], 1.0)


# --- what it withstands -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bound", [1e-4, 0.1, 2.0, 1e4])
@pytest.mark.parametrize(("gain", "spread"), [(1.0, 0.0), (300.0, 0.0), (1.0, 5.0), (0.01, 2.0)])
def test_sandwich_bound_is_proved_at_every_scale(bound, gain, spread):
    torch.manual_seed(0)
    barrier = SandwichBarrier(3, (16, 16), bound)
    with torch.no_grad():
        for g, p in zip(barrier.gain[:-1], barrier.log_psi, strict=True):
            g.mul_(gain)
            p.normal_(std=spread)
    proof = prove_lipschitz(barrier.collapse(), bound, multipliers=barrier.multipliers())
    assert proof.proved, proof.reason


def test_witness_of_the_barrier_is_used_only_where_it_serves():
    torch.manual_seed(0)
    barrier = SandwichBarrier(2, (8,), 2.0)
    own = solve_multipliers(barrier, lipschitz_bound=2.0)
    assert own is not None
    assert all(torch.equal(a, b) for a, b in zip(own, barrier.multipliers(), strict=True))
    upper = lipschitz_upper(barrier)
    assert upper < 1.9
    assert prove_lipschitz(barrier, 1.001 * upper).proved
    assert not prove_lipschitz(barrier, 0.999 * upper).proved


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_witness_that_is_not_positive_is_refused(value):
    proof = prove_lipschitz([torch.eye(2), torch.ones(1, 2)], 5.0, multipliers=[torch.tensor([1.0, value])])
    assert not proof.proved
    assert "positive and finite" in proof.reason


@pytest.mark.parametrize("seed", range(3))
def test_smallest_bound_is_found_for_multipliers_of_unlike_sizes(seed):
    torch.manual_seed(seed)
    barrier = SandwichBarrier(2, (32, 32, 32), 2.0)
    with torch.no_grad():
        for p in barrier.log_psi:
            p.normal_(std=1.5)
    weights = barrier.weights(torch.float64)
    with torch.no_grad():  # the same function from rows of unlike scale: the bound does not change
        weights[0][:16] *= 0.05
        weights[1][:, :16] /= 0.05
    upper = lipschitz_upper(weights)
    assert upper == pytest.approx(lipschitz_upper(barrier), rel=1e-5)
    assert upper <= 2.0


def test_collapsed_weights_are_rounded_from_double_precision():
    torch.manual_seed(0)
    barrier = SandwichBarrier(2, (16, 16), 2.0)
    with torch.no_grad():
        for g in barrier.gain:
            g.mul_(100.0)
    deployed, precise = barrier.collapse(), copy.deepcopy(barrier).double().weights()
    layers = [m for m in deployed if isinstance(m, nn.Linear)]
    assert all(m.weight.dtype == torch.float32 for m in layers)
    assert all(torch.equal(m.weight, w.detach().float()) for m, w in zip(layers, precise, strict=True))


def test_constant_network_has_a_tiny_bound():
    network = plain(nn.ReLU())
    with torch.no_grad():
        for p in network.parameters():
            p.zero_()
    assert lipschitz_upper(network) <= 1e-4
    assert lipschitz_lower(network, -1.0, 1.0, 10) == 0.0


def test_affine_network_of_several_outputs_has_its_norm_as_bound():
    layer = nn.Linear(2, 3)
    assert lipschitz_upper(layer) == pytest.approx(float(torch.linalg.matrix_norm(layer.weight.detach(), 2)), rel=1e-6)


# --- every slope interval ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("activation", ACTIVATIONS, ids=lambda a: type(a).__name__)
@pytest.mark.parametrize("sizes", [(2, 8, 1), (2, 6, 6, 6, 2)])
def test_provable_bound_lies_between_secants_and_the_product_of_norms(activation, sizes):
    network = plain(activation, sizes)
    steepest = max(map(abs, slope_interval(network)))
    norms = [float(torch.linalg.matrix_norm(m.weight.detach(), 2)) for m in network if isinstance(m, nn.Linear)]
    product = math.prod(norms) * steepest ** (len(norms) - 1)
    assert secant_slope(network.double()) <= lipschitz_upper(network) <= product * (1 + 1e-6)


@pytest.mark.parametrize("slope", [(-1.0, 1.0), (-0.5, 1.0), (-1.0, 0.5), (-2.0, 0.0), (0.5, 0.5), (0.9, 3.0)])
def test_bound_of_a_scalar_chain_is_the_product_of_the_slopes(slope):
    weights = [torch.full((1, 1), w, dtype=torch.float64) for w in (0.5, -2.0, 3.0)]
    assert lipschitz_upper(weights, slope) == pytest.approx(3.0 * max(map(abs, slope)) ** 2, rel=1e-4)


def test_reflected_slopes_give_the_same_bound():
    network = plain(nn.ReLU())
    weights = [m.weight.detach() for m in network if isinstance(m, nn.Linear)]
    assert lipschitz_upper(weights, (-1.1, 0.1)) == pytest.approx(lipschitz_upper(weights, (-0.1, 1.1)), rel=1e-4)


def test_lmi_barrier_with_a_negative_slope_is_proved():
    torch.manual_seed(0)
    barrier = LMIBarrier(2, (8, 8), 2.0, activation="silu", start_ratio=0.9)
    assert prove_lipschitz(barrier, 2.0, multipliers=barrier.multipliers()).proved
    assert secant_slope(barrier.collapse().double()) <= 2.0


# --- against exact elimination ----------------------------------------------------------------------------------------


@settings(max_examples=15, deadline=None, derandomize=True)
@given(
    st.integers(0, 10**6),
    st.sampled_from([(1, 2, 1), (2, 3, 1), (2, 3, 3, 1)]),
    st.sampled_from([(0.0, 1.0), (0.1, 1.0), (-0.5, 1.0)]),
    st.floats(0.6, 1.6),
)
def test_verdict_is_that_of_exact_elimination(seed, sizes, slope, factor):
    g = torch.Generator().manual_seed(seed)
    weights = [torch.randn(b, a, generator=g) for a, b in zip(sizes[:-1], sizes[1:], strict=True)]
    lams = solve_multipliers(weights, slope)
    bound = factor * lipschitz_upper(weights, slope)
    lams = [m.float() for m in lams]  # as many bits as a proof keeps
    proof = prove_lipschitz(weights, bound, slope, multipliers=lams)
    assert proof.proved == reference.is_positive_definite(
        [w.numpy() for w in weights], [m.numpy() for m in lams], bound, slope
    )


@pytest.mark.parametrize("size", [1, 7, 200])
def test_square_of_the_factor_is_exact(size):
    g = np.random.default_rng(size)
    factor = np.clip(g.normal(size=(size, size)), -1, 1)
    factor[0] = 1.0  # the largest entries that can occur
    whole = np.array([[int(v) for v in row] for row in np.round(factor * 2.0**44)], dtype=object)
    assert (_exact_square(factor) == whole.dot(whole.T)).all()


def test_proof_does_not_rest_on_the_floating_factor(monkeypatch):
    weights = [torch.tensor([[0.5], [0.5]]), torch.tensor([[1.0, 1.0]])]
    lams = solve_multipliers(weights, lipschitz_bound=1.5)
    assert prove_lipschitz(weights, 1.5, multipliers=lams).proved
    for wrong in (np.zeros_like, np.ones_like, lambda m: 0.9 * np.eye(len(m))):
        monkeypatch.setattr(np.linalg, "cholesky", wrong)
        proof = prove_lipschitz(weights, 0.5, multipliers=lams)
        assert not proof.proved
        assert "dominant" in proof.reason


# --- parameters from outside ------------------------------------------------------------------------------------------


def test_sandwich_follows_parameters_that_are_swapped_in():
    torch.manual_seed(0)
    first, second = SandwichBarrier(2, (8, 8)), SandwichBarrier(2, (8, 8))
    z = torch.randn(16, 2)
    swapped = torch.func.functional_call(first, dict(second.named_parameters()), (z,))
    assert torch.equal(swapped, second(z))
    assert not torch.equal(swapped, first(z))


def test_sandwich_is_differentiated_by_torch_func():
    torch.manual_seed(0)
    barrier, z = SandwichBarrier(2, (8, 8)), torch.randn(16, 2)
    parameters = dict(barrier.named_parameters())
    by_func = torch.func.grad(lambda p: torch.func.functional_call(barrier, p, (z,)).square().mean())(parameters)
    barrier(z).square().mean().backward()
    for name, parameter in barrier.named_parameters():
        torch.testing.assert_close(by_func[name], parameter.grad)


def test_sandwich_compiles_to_one_graph():
    torch.manual_seed(0)
    barrier, z = SandwichBarrier(2, (8, 8)), torch.randn(16, 2)
    compiled = torch.compile(barrier, backend="eager", fullgraph=True)
    torch.testing.assert_close(compiled(z), barrier(z))

"""Lipschitz bounds: what is proved holds, what is false is refused, and the cone is never left."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError, NonFiniteError, NotPositiveDefiniteError, ShapeError
from torchrl_sspl.functional import lmi_matrix
from torchrl_sspl.lipschitz import (
    LMIBarrier,
    SandwichBarrier,
    cayley,
    layer_weights,
    lipschitz_lower,
    lipschitz_upper,
    prove_lipschitz,
    solve_multipliers,
)
from torchrl_sspl.lipschitz.layers import activation_of
from torchrl_sspl.lipschitz.lmi import ACTIVATIONS

quick = settings(max_examples=15, deadline=None, derandomize=True)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_sandwich(seed: int, hidden=(8, 8), bound: float = 2.0, spread: float = 1.0) -> SandwichBarrier:
    barrier = SandwichBarrier(3, hidden, bound)
    g = generator(seed)
    with torch.no_grad():
        for p in barrier.parameters():
            p.copy_(spread * torch.randn(p.shape, generator=g))
    return barrier


def secant_slope(function, dim: int = 3, n: int = 4000) -> float:
    g = generator(7)
    x = 4 * torch.rand(n, dim, generator=g, dtype=torch.float64) - 2
    y = x + 0.3 * torch.randn(n, dim, generator=g, dtype=torch.float64)
    with torch.no_grad():
        return float(((function(x) - function(y)).norm(dim=1) / (x - y).norm(dim=1)).max())


@pytest.fixture(scope="module")
def trained() -> SandwichBarrier:
    """A 3 x 64 sandwich barrier that was taught a distance steeper than its bound."""
    torch.manual_seed(0)
    barrier = SandwichBarrier(3, (64, 64, 64), 2.0)
    optimiser = torch.optim.Adam(barrier.parameters(), 3e-3)
    g = generator()
    for _ in range(150):
        x = 2 * torch.rand(128, 3, generator=g) - 1
        target = 3 * (x.norm(dim=1, keepdim=True) - 0.6)
        optimiser.zero_grad()
        (barrier(x) - target).square().mean().backward()
        optimiser.step()
    return barrier


# --- sandwich layers --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(5, 2), (2, 5), (3, 3)])
def test_cayley_is_orthonormal(shape):
    q = cayley(torch.randn(*shape, generator=generator(), dtype=torch.float64))
    gram = q.mT @ q if shape[0] >= shape[1] else q @ q.mT
    torch.testing.assert_close(gram, torch.eye(min(shape), dtype=torch.float64))


@quick
@given(st.integers(0, 10**6), st.sampled_from([(4,), (8, 8), (16, 4, 8)]), st.sampled_from([0.3, 2.0, 7.0]))
def test_collapsed_network_is_the_same_function(seed, hidden, bound):
    barrier = random_sandwich(seed, hidden, bound)
    z = torch.randn(64, 3, generator=generator(seed))
    torch.testing.assert_close(barrier(z), barrier.collapse()(z))


@quick
@given(st.integers(0, 10**6), st.sampled_from([0.3, 2.0, 7.0]), st.sampled_from([0.1, 1.0, 2.0]))
def test_no_parameters_exceed_the_bound(seed, bound, spread):
    plain = random_sandwich(seed, bound=bound, spread=spread).collapse().double()
    assert secant_slope(plain) <= bound
    assert lipschitz_lower(plain.float(), -2.0, 2.0, 500, generator(seed)) <= bound


def test_bound_is_nearly_reached(trained):
    assert lipschitz_lower(trained.collapse(), -1.0, 1.0, 5000, generator()) > 0.95 * 2.0


def test_sandwich_refuses_bad_sizes_and_latents():
    for arguments in ((0, (4,), 1.0), (2, (), 1.0), (2, (4, 0), 1.0), (2, (4,), 0.0), (2, (4,), math.nan)):
        with pytest.raises(ConfigError, match="expected"):
            SandwichBarrier(*arguments)
    with pytest.raises(ShapeError, match=r"\(5, 4\)"):
        SandwichBarrier(3, (4,))(torch.zeros(5, 4))


# --- exact proof ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_true_bound_is_proved_with_the_barrier_s_own_witness(seed):
    barrier = random_sandwich(seed)
    proof = prove_lipschitz(barrier.collapse(), 2.0, multipliers=barrier.multipliers())
    assert proof.proved, proof.reason
    assert proof.method == "exact"
    assert proof.slack >= 0


def test_true_bound_of_a_trained_barrier_is_proved(trained):
    assert prove_lipschitz(trained.collapse(), 2.0, multipliers=trained.multipliers()).proved
    assert prove_lipschitz(trained.collapse(), 2.0).proved


def test_bound_below_the_sampled_slope_is_refused(trained):
    plain = trained.collapse()
    false = 0.99 * lipschitz_lower(plain, -1.0, 1.0, 5000, generator())
    searched = prove_lipschitz(plain, false)
    assert not searched.proved
    assert "no multipliers" in searched.reason
    witness = prove_lipschitz(plain, false, multipliers=trained.multipliers())
    assert not witness.proved
    assert "eigenvalue" in witness.reason


@pytest.mark.parametrize("factor", [1e-6, 0.3, 3.0, 1e6])
def test_wrong_witness_proves_nothing(trained, factor):
    wrong = [factor * m for m in trained.multipliers()]
    assert not prove_lipschitz(trained.collapse(), 2.0, multipliers=wrong).proved


def test_wrong_witness_cannot_make_a_false_claim_pass():
    weights = [torch.tensor([[0.5], [0.5]]), torch.tensor([[1.0, 1.0]])]  # slope 1
    g = generator()
    for _ in range(50):
        assert not prove_lipschitz(weights, 0.999, multipliers=[10 ** (4 * torch.rand(2, generator=g) - 2)]).proved


@pytest.mark.parametrize("witness", [True, False])
def test_weight_that_was_tampered_with_is_refused(trained, witness):
    plain = trained.collapse()
    with torch.no_grad():
        last = plain[-1].weight
        last[0, int(last.abs().argmax())] *= 1.5
    multipliers = trained.multipliers() if witness else None
    assert not prove_lipschitz(plain, 2.0, multipliers=multipliers).proved


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_weights_that_are_not_finite_are_an_error(value):
    plain = random_sandwich(0).collapse()
    with torch.no_grad():
        plain[2].weight[1, 1] = value
    for function in (lambda: prove_lipschitz(plain, 2.0), lambda: lipschitz_upper(plain)):
        with pytest.raises(NonFiniteError, match="finite weights"):
            function()


def test_bad_claims_are_errors():
    weights = [torch.ones(2, 1), torch.ones(1, 2)]
    for bound in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ConfigError, match="lipschitz_bound > 0"):
            prove_lipschitz(weights, bound)
    with pytest.raises(ConfigError, match="slope"):
        prove_lipschitz(weights, 1.0, (1.0, 0.0))
    with pytest.raises(ShapeError, match="multipliers of sizes"):
        prove_lipschitz(weights, 1.0, multipliers=[torch.ones(3)])
    with pytest.raises(ShapeError, match="follow each other"):
        layer_weights([torch.ones(2, 1), torch.ones(1, 3)])
    with pytest.raises(ShapeError, match="at least one"):
        layer_weights([])


def test_affine_network_is_proved_by_its_norm():
    weight = torch.tensor([[3.0, 4.0]])
    assert prove_lipschitz([weight], 5.000001).proved
    assert not prove_lipschitz([weight], 4.999999).proved
    assert lipschitz_upper([weight]) == pytest.approx(5.0)


# --- smallest bound ---------------------------------------------------------------------------------------------------


def test_smallest_provable_bound_of_a_trained_barrier_is_tight(trained):
    plain = trained.collapse()
    upper, lower = lipschitz_upper(plain), lipschitz_lower(plain, -1.0, 1.0, 5000, generator())
    assert lower <= upper <= 2.0
    assert upper <= 1.05 * lower
    assert prove_lipschitz(plain, upper * (1 + 1e-6)).proved


def plain_network(seed: int, sizes=(3, 12, 12, 1), activation=nn.ReLU) -> nn.Sequential:
    torch.manual_seed(seed)
    layers: list[nn.Module] = []
    for a, b in zip(sizes[:-1], sizes[1:], strict=True):
        layers += [nn.Linear(a, b), activation()]
    return nn.Sequential(*layers[:-1])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("sizes", [(3, 12, 1), (3, 12, 12, 1), (3, 6, 6, 6, 2)])
def test_provable_bound_lies_between_samples_and_the_product_of_norms(seed, sizes):
    network = plain_network(seed, sizes)
    upper = lipschitz_upper(network)
    product = math.prod(float(torch.linalg.matrix_norm(w, 2)) for w in layer_weights(network))
    assert secant_slope(network.double()) <= upper <= product * 1.0001


def test_provable_bound_with_units_that_are_dead_or_zero():
    network = plain_network(0)
    with torch.no_grad():
        network[0].weight[:4] = 0.0
        network[4].weight[0, 5:] = 0.0
    upper = lipschitz_upper(network)
    assert secant_slope(network.double()) <= upper
    assert prove_lipschitz(network.float(), upper * (1 + 1e-6)).proved


def test_narrower_slopes_allow_smaller_bounds():
    weights = layer_weights(plain_network(0))
    bounds = [lipschitz_upper(weights, slope) for slope in ((0.0, 1.0), (0.5, 1.0), (0.0, 0.25))]
    assert bounds[0] > bounds[1] > bounds[2]


def test_multipliers_are_found_exactly_where_the_bound_is_provable():
    network = plain_network(1)
    upper = lipschitz_upper(network)
    found = solve_multipliers(network, lipschitz_bound=1.001 * upper)
    assert found is not None
    assert all(bool((m > 0).all()) for m in found)
    matrix = lmi_matrix([w.double() for w in layer_weights(network)], found, 1.001 * upper)
    assert float(torch.linalg.eigvalsh(matrix)[0]) > 0
    assert solve_multipliers(network, lipschitz_bound=0.99 * upper) is None


def test_sampled_slope_needs_a_dimension():
    with pytest.raises(ConfigError, match="dim"):
        lipschitz_lower(lambda x: x, -1.0, 1.0, 10)
    norm = lipschitz_lower(lambda x: 3 * x[:, :1] + 4 * x[:, 1:], -1.0, 1.0, 10, generator(), dim=2)
    assert norm == pytest.approx(5.0)


# --- the paper's barrier ----------------------------------------------------------------------------------------------


def lmi_barrier(**options) -> LMIBarrier:
    torch.manual_seed(0)
    return LMIBarrier(3, (8, 8), **options)


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
@pytest.mark.parametrize("bound", [0.5, 2.0, 10.0])
def test_start_is_feasible_for_every_slope_interval(activation, bound):
    barrier = lmi_barrier(activation=activation, lipschitz_bound=bound)
    assert barrier.feasible()
    assert float(torch.linalg.eigvalsh(barrier.matrix().detach())[0]) > 0
    barrier.reset_parameters()
    assert barrier.feasible()


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_slope_interval_contains_the_slopes_of_the_activation(activation):
    make = ACTIVATIONS[activation]
    low, high = activation_of(make()).slope
    x = torch.linspace(-6, 6, 1201, dtype=torch.float64)
    y = make()(x)
    slopes = y.diff() / x.diff()
    assert low - 1e-9 <= float(slopes.min())
    assert float(slopes.max()) <= high + 1e-9
    assert float(slopes.max()) >= 0.98 * high


def test_barrier_s_multipliers_prove_its_bound():
    barrier = lmi_barrier(lipschitz_bound=2.0)
    assert prove_lipschitz(barrier.collapse(), 2.0, multipliers=barrier.multipliers()).proved
    assert secant_slope(barrier.collapse().double()) <= 2.0


def cloned(barrier: LMIBarrier) -> dict[str, Tensor]:
    return {k: v.clone() for k, v in barrier.state_dict().items()}


@pytest.mark.parametrize("size", [1e-3, 0.1, 10.0, 1e4])
def test_backtracking_never_leaves_the_cone(size):
    barrier, g = lmi_barrier(), generator()
    for _ in range(10):
        before = cloned(barrier)
        with torch.no_grad():
            for p in barrier.parameters():
                p.add_(size * torch.randn(p.shape, generator=g))
        share = barrier.backtracking_step(before)
        assert 0.0 <= share <= 1.0
        assert barrier.feasible()


def test_backtracking_keeps_steps_that_are_feasible_whole():
    barrier = lmi_barrier()
    before = cloned(barrier)
    with torch.no_grad():
        barrier.net[-1].bias.add_(3.0)
    assert barrier.backtracking_step(before) == 1.0
    assert not torch.equal(before["net.4.bias"], barrier.net[-1].bias)


def test_backtracking_restores_the_start_after_a_step_to_nan():
    barrier = lmi_barrier()
    before = cloned(barrier)
    with torch.no_grad():
        barrier.net[0].weight.fill_(math.nan)
    assert barrier.backtracking_step(before) == 0.0
    assert all(torch.equal(v, before[k]) for k, v in barrier.state_dict().items())


def test_backtracking_from_outside_the_cone_is_an_error():
    barrier = lmi_barrier()
    with torch.no_grad():
        barrier.net[0].weight.mul_(1e3)
    with pytest.raises(NotPositiveDefiniteError, match="feasible point"):
        barrier.backtracking_step(cloned(barrier))


def test_descent_on_the_paper_s_loss_stays_feasible_and_lowers_it():
    barrier = lmi_barrier()
    optimiser = torch.optim.SGD(barrier.parameters(), 0.5)
    losses = []
    for _ in range(15):
        losses.append(float(barrier.loss().detach()))
        before = cloned(barrier)
        optimiser.zero_grad()
        barrier.loss().backward()
        optimiser.step()
        barrier.backtracking_step(before)
        assert barrier.feasible()
    assert losses[-1] < losses[0]


def test_loss_outside_the_cone_is_an_error_even_where_the_determinant_is_positive():
    barrier = lmi_barrier()
    g = generator()
    for _ in range(200):
        with torch.no_grad():
            for weight in barrier.weights():
                weight.copy_(2.0 * torch.randn(weight.shape, generator=g))
        values = torch.linalg.eigvalsh(barrier.matrix().detach())
        if int((values < 0).sum()) % 2 == 0 and float(values.abs().log().sum()) > 0 and values[0] < 0:
            break
    else:
        pytest.fail("no indefinite matrix with an even number of negative eigenvalues was drawn")
    assert float(torch.linalg.slogdet(barrier.matrix().detach()).logabsdet) > 0  # the printed test calls this certified
    with pytest.raises(NotPositiveDefiniteError, match="feasible point"):
        barrier.loss()


def test_bad_options_are_errors():
    for options in ({"activation": "maxout"}, {"lipschitz_bound": 0.0}, {"start_ratio": 1.0}):
        with pytest.raises(ConfigError, match="expected"):
            lmi_barrier(**options)
    with pytest.raises(ShapeError, match=r"\(5, 2\)"):
        lmi_barrier()(torch.zeros(5, 2))


def test_gradients_are_taken_in_the_numbers_of_the_weights():
    net = nn.Sequential(nn.Linear(2, 4), nn.ReLU(), nn.Linear(4, 1))
    single = lipschitz_lower(net, -1.0, 1.0, 50, generator())
    assert lipschitz_lower(net.double(), -1.0, 1.0, 50, generator()) == pytest.approx(single, rel=1e-5)

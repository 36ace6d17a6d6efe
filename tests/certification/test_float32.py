"""The theorem about the numbers that are computed: bounds of rounding hold, and what they do not cover is refused."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import torchrl_sspl as sspl
from torchrl_sspl.certification.branch_and_bound import Budget
from torchrl_sspl.certification.certificate import Reason
from torchrl_sspl.certification.conditions import computed_error, largest_error
from torchrl_sspl.certification.floating import UNITS, largest_rounding, rounding_bound
from torchrl_sspl.certification.graph import Affine, Graph
from torchrl_sspl.certification.layers import deterministic_layer
from torchrl_sspl.certification.loop import ClosedLoop, closed_loop
from torchrl_sspl.lipschitz.layers import Abs, activation_of
from torchrl_sspl.modules import LatentDynamics, Policy

U = 2.0**-24
ACTIVATIONS = [
    nn.ReLU(), nn.LeakyReLU(0.1), nn.LeakyReLU(1.7), nn.LeakyReLU(-0.3), nn.Hardtanh(-0.7, 0.4), nn.ReLU6(), nn.Tanh(),
    nn.Sigmoid(), nn.Softplus(), nn.Softplus(3.0, 25.0), nn.SiLU(), nn.GELU(), Abs(),
]  # fmt: skip


def linear(weight, bias=None) -> nn.Linear:
    weight = torch.as_tensor(weight, dtype=torch.float32)
    layer = nn.Linear(weight.shape[1], weight.shape[0])
    layer.weight.data.copy_(weight)
    layer.bias.data.copy_(torch.zeros(len(weight)) if bias is None else torch.as_tensor(bias, dtype=torch.float32))
    return layer.requires_grad_(False)


def one_norm(radius: float) -> nn.Sequential:
    return nn.Sequential(linear([[1.0], [-1.0]]), nn.ReLU(), linear([[1.0, 1.0]], [-radius]))


# --- layers -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("module", ACTIVATIONS, ids=str)
def test_float32_activations_are_as_accurate_as_is_assumed(module):
    x = torch.cat([torch.linspace(-30, 30, 200_001), torch.tensor([0.0, -0.7, 0.4, 6.0, 20.0, 1e-20, -1e-20])])
    act = activation_of(module)
    exact = act.value(x.double())
    off = (module(x).double() - exact).abs()
    allowed = act.ulps * U * (x.double().abs() + exact.abs()) + act.jump
    assert bool((off <= allowed).all()), float((off - allowed).max())


@pytest.mark.parametrize("module", [m for m in ACTIVATIONS if not isinstance(m, nn.Hardtanh | nn.LeakyReLU)], ids=str)
def test_float64_activations_are_as_accurate_as_is_assumed(module):
    # Where PyTorch goes over to another formula, float64 shows what float32 hides in its rounding.
    x = torch.linspace(-30, 30, 200_001, dtype=torch.float64)
    act = activation_of(module)
    exact = act.value(x)
    off = (module(x) - exact).abs()
    allowed = act.ulps * UNITS[torch.float64] * (x.abs() + exact.abs()) + act.jump
    assert bool((off <= allowed).all()), float((off - allowed).max())


@pytest.mark.parametrize("module", ACTIVATIONS, ids=str)
def test_slopes_of_intervals_hold_every_secant(module):
    act, g = activation_of(module), torch.Generator().manual_seed(0)
    lower = 14 * torch.rand(5000, generator=g, dtype=torch.float64) - 7
    upper = lower + 10 ** (4 * torch.rand(5000, generator=g, dtype=torch.float64) - 3)
    least, most = act.slopes(lower, upper)
    share = torch.rand(40, 2, 5000, generator=g, dtype=torch.float64)
    a, b = (lower + (upper - lower) * share).unbind(1)
    secant = (act.value(b) - act.value(a)) / (b - a)
    apart = (a - b).abs() > 1e-5
    assert bool((secant <= most + 1e-9)[apart].all())
    assert bool((secant >= least - 1e-9)[apart].all())
    assert float((most - least).mean()) < 0.95 * (act.slope[1] - act.slope[0])  # and is better than the whole range


def test_slopes_of_piecewise_linear_functions_are_exact():
    relu, hard = activation_of(nn.ReLU()), activation_of(nn.Hardtanh())
    lower, upper = torch.tensor([-2.0, -1.0, 0.0, 0.5]).double(), torch.tensor([-1.0, 0.0, 1.0, 0.75]).double()
    assert [t.tolist() for t in relu.slopes(lower, upper)] == [[0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 1.0, 1.0]]
    lower, upper = torch.tensor([-2.0, -2.0, 0.5, 1.0]).double(), torch.tensor([-1.0, 0.0, 2.0, 3.0]).double()
    assert [t.tolist() for t in hard.slopes(lower, upper)] == [[0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 1.0, 0.0]]


# --- bounds against exact arithmetic ----------------------------------------------------------------------------------


def in_order(weight: Tensor, bias: Tensor, x: Tensor, order: np.ndarray, skip: Tensor | None = None) -> Tensor:
    """A layer in float32, its terms (and the bias) summed one after the other in this order; then a skip connection."""
    terms = np.concatenate([(weight * x).numpy(), bias[:, None].numpy()], 1)[:, order]
    total = terms[:, 0].astype(np.float32)
    for k in range(1, terms.shape[1]):
        total = (total + terms[:, k]).astype(np.float32)
    if skip is not None:
        total = (skip.numpy() + total).astype(np.float32)
    return torch.from_numpy(total)


def exactly(layer: nn.Linear, x: list[Fraction]) -> list[Fraction]:
    rows = zip(layer.weight.tolist(), layer.bias.tolist(), strict=True)
    return [sum((Fraction(w) * v for w, v in zip(row, x, strict=True)), Fraction(b)) for row, b in rows]


def modules(seed: int, p: int = 2, width: int = 8, scale: float = 3.0) -> tuple[nn.Sequential, LatentDynamics, Policy]:
    torch.manual_seed(seed)
    barrier = nn.Sequential(nn.Linear(p, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 1))
    made = barrier, LatentDynamics(p, 1, (width, width), scale), Policy(p, 1, (width, width), scale)
    for module in made:
        for q in module.parameters():
            q.data.mul_(1.5)
        module.requires_grad_(False)
    return made


def loop(seed: int, p: int = 2, width: int = 8) -> tuple[ClosedLoop, tuple[nn.Sequential, LatentDynamics, Policy]]:
    made = modules(seed, p, width)
    return closed_loop(*made, latent_dim=p, lipschitz_bound=100.0), made


@pytest.mark.parametrize("seed", range(6))
def test_bounds_hold_for_sums_in_any_order_against_rational_arithmetic(seed):
    system, (barrier, dynamics, policy) = loop(seed)
    g, shuffle = torch.Generator().manual_seed(seed), np.random.default_rng(seed)
    points = 2 * torch.rand(12, 2, generator=g) - 1
    points[0] = 1.0
    boxes = points.double() - 0.05, points.double() + 0.05
    bounds = {
        (name, refined): [rounding_bound(graph, *where, U, refined=refined)[-1] for where in ((points.double(),) * 2, boxes)]
        for name, graph in (("d", system.step), ("B", system.barrier))
        for refined in (False, True)
    }

    def network(net: nn.Sequential, x: Tensor, skip: Tensor | None = None) -> Tensor:
        last = list(net)[-1]
        for layer in net:
            if isinstance(layer, nn.Linear):
                order = shuffle.permutation(layer.in_features + 1)
                x = in_order(layer.weight, layer.bias, x, order, skip if layer is last else None)
            else:
                x = x.clamp_min(0.0)
        return x

    def exact_network(net: nn.Sequential, x: list[Fraction]) -> list[Fraction]:
        for layer in net:
            x = exactly(layer, x) if isinstance(layer, nn.Linear) else [max(v, Fraction(0)) for v in x]
        return x

    one = Fraction(1)
    for i, z in enumerate(points):
        exact_z = [Fraction(v) for v in z.tolist()]
        action = [max(min(v, one), -one) for v in exact_network(policy.net, exact_z)]
        moved = [z_ + v for z_, v in zip(exact_z, exact_network(dynamics.net, exact_z + action), strict=True)]
        truth = {"d": [max(min(v, one), -one) for v in moved], "B": exact_network(barrier, exact_z)}
        for _ in range(4):
            u = policy.action_scale * network(policy.net, z).clamp(-1.0, 1.0)
            step = network(dynamics.net, torch.cat([z, u / dynamics.action_scale]), z).clamp(-1.0, 1.0)
            for name, value in (("d", step), ("B", network(barrier, z))):
                gap = [abs(Fraction(v) - w) for v, w in zip(value.tolist(), truth[name], strict=True)]
                for at_point, on_box in (bounds[name, False], bounds[name, True]):
                    assert all(a <= Fraction(b) for a, b in zip(gap, at_point[i].tolist(), strict=True))
                    assert bool((at_point[i] <= on_box[i]).all())
    assert bool((bounds["d", True][0] <= bounds["d", False][0]).all())
    assert float(bounds["B", True][0].max()) < 300 * U  # and are no empty promise


@pytest.mark.parametrize("module", ACTIVATIONS, ids=str)
def test_bounds_hold_for_networks_of_every_activation(module):
    torch.manual_seed(0)
    layers = [nn.Linear(2, 16), module, nn.Linear(16, 16), module, nn.Linear(16, 2)]
    net = nn.Sequential(*layers).requires_grad_(False)
    for layer in net[::2]:
        layer.weight.mul_(3.0)
    graph, points = Graph(2), 4 * torch.rand(2000, 2) - 2
    graph.network(0, net)
    gap = (net(points).double() - graph(points)).abs()
    for refined in (False, True):
        bound = rounding_bound(graph, points.double(), points.double(), U, refined=refined)[-1]
        assert bool((gap <= bound).all())
    assert float(bound.max()) < 1e-3


@pytest.mark.parametrize("module", ACTIVATIONS, ids=str)
def test_bounds_hold_for_an_activation_alone(module):
    # Between two layers, what the sums are allowed to lose hides what it loses itself.
    graph, x = Graph(1), torch.linspace(-25, 25, 20_001)[:, None]
    graph.apply(0, activation_of(module))
    gap = (module(x).double() - graph(x)).abs()
    for refined in (False, True):
        assert bool((gap <= rounding_bound(graph, x.double(), x.double(), U, refined=refined)[-1]).all())


def test_units_are_those_of_the_dtypes():
    assert {dtype: torch.finfo(dtype).eps / 2 for dtype in (torch.float32, torch.float64)} == UNITS


def test_bound_is_reached_by_the_worst_order_up_to_a_quarter():
    n = 64
    net = nn.Linear(n, 1)
    net.weight.data.fill_(U)  # half a unit in the last place of one: each is lost when it is added to the one
    net.weight.data[0, 0] = 1.0
    net.bias.data.zero_()
    graph = Graph(n)
    graph.network(0, net.requires_grad_(False))
    x = torch.ones(n)
    lost = abs(float(in_order(net.weight, net.bias, x, np.arange(n + 1))[0]) - (1.0 + (n - 1) * U))
    for refined in (False, True):
        bound = float(rounding_bound(graph, x[None].double(), x[None].double(), U, refined=refined)[-1])
        assert 0.75 * bound < lost <= bound


def test_products_and_sums_each_round_once():
    net = linear([[1.0 + 2.0**-12]])
    graph = Graph(1)
    graph.network(0, net)
    x = torch.tensor([[1.0 + 2.0**-12]])
    lost = abs(float(net(x).double() - graph(x)))  # the product needs one bit more than there is
    bound = float(rounding_bound(graph, x.double(), x.double(), U)[-1])
    assert 0.0 < lost <= bound < 3 * U
    assert rounding_bound(graph, x.double(), x.double(), 2.0**-53)[-1].item() < 1e-15


@pytest.mark.parametrize("clamped", [False, True])
def test_errors_of_the_action_reach_the_next_latent(clamped):
    # The policy is u = K (z + 2) - K (z + 1) - K + z / 10: nothing but rounding beside z, and the plant takes it as it is.
    # Clamped, the action is a small number again, which rounds off little itself.
    k = 2.0**20
    policy = nn.Sequential(linear([[k], [k], [1.0], [-1.0]], [2 * k, k, 0.0, 0.0]), nn.ReLU(), linear([[1.0, -1.0, 0.1, -0.1]], [-k]))
    if clamped:
        policy.append(nn.Hardtanh())
    plant = nn.Sequential(linear([[0.5, 0.5]]))
    system = closed_loop(one_norm(0.5), plant, policy, latent_dim=1, lipschitz_bound=1.001)
    z = (2 * torch.rand(20_000, 1, generator=torch.Generator().manual_seed(0)) - 1)
    gap = (plant(torch.cat([z, policy(z)], 1)).double() - system.step(z)).abs()
    for refined in (False, True):
        bound = rounding_bound(system.step, z.double(), z.double(), U, refined=refined)[-1]
        assert bool((gap <= bound).all())
    assert float(gap.max()) > 0.02
    assert float(bound.max()) < 20 * float(gap.max())


def test_terms_that_are_zero_do_not_round_and_roundings_besides_do():
    graph = Graph(3)
    graph.linear([0], [torch.eye(3)])
    more = Graph(3)
    more.linear([0], [torch.eye(3)], roundings=5)
    one = torch.ones(1, 3, dtype=torch.float64)
    few, many = (float(rounding_bound(g, one, one, U)[-1].max()) for g in (graph, more))
    assert few == pytest.approx(2 * U, rel=1e-4)
    assert many == pytest.approx(7 * U, rel=1e-4)
    assert isinstance(more.steps[1], Affine)


def test_a_bias_rounds_as_every_other_term():
    net = linear([[1.0]], [1.0])
    graph = Graph(1)
    graph.network(0, net)
    x = torch.full((1, 1), 0.9 * U)  # less than half a unit in the last place of the bias: lost
    lost = abs(float(net(x).double() - graph(x)))
    assert lost > 0.8 * U
    for refined in (False, True):
        assert lost <= float(rounding_bound(graph, x.double(), x.double(), U, refined=refined)[-1]) < 3 * U


def test_a_sum_that_may_overflow_has_no_bound():
    net = nn.Sequential(linear([[1e30]]), nn.ReLU(), linear([[1e30]]))
    graph = Graph(1)
    graph.network(0, net)
    one = torch.ones(1, dtype=torch.float64)
    assert largest_rounding(graph, -one, one, U, boxes=16) == math.inf


@pytest.mark.parametrize("seed", range(3))
def test_rounding_of_a_domain_bounds_that_of_its_points(seed):
    system, (barrier, dynamics, policy) = loop(seed, width=16)
    z = (2 * torch.rand(3000, 2, generator=torch.Generator().manual_seed(seed)) - 1)
    for graph, value in ((system.barrier, barrier(z)), (system.step, dynamics(z, policy(z)))):
        coarse, fine = (largest_rounding(graph, system.low, system.high, U, boxes=n) for n in (64, 2048))
        at_points = rounding_bound(graph, z.double(), z.double(), U, refined=True)[-1].norm(dim=1)
        assert float((value.double() - graph(z)).norm(dim=1).max()) < float(at_points.max()) <= fine <= coarse


@pytest.mark.parametrize("seed", range(3))
def test_rounding_where_the_barrier_is_low_bounds_that_of_its_points_there(seed):
    system, (_, dynamics, policy) = loop(seed, width=16)
    z = 2 * torch.rand(3000, 2, generator=torch.Generator().manual_seed(seed)) - 1
    low = z[system.barrier(z)[:, 0] <= float(system.barrier(z).quantile(0.3))]
    level = float(system.barrier(low).max())
    off = (dynamics(low, policy(low)).double() - system.step(low)).norm(dim=1).max()
    everywhere, there = (largest_rounding(system.step, system.low, system.high, U, boxes=2048, where=w) for w in (None, (system.barrier, level)))
    assert float(off) < there <= everywhere
    assert largest_rounding(system.step, system.low, system.high, U, where=(system.barrier, -1e6)) == 0.0  # nowhere


def test_rounding_counts_where_the_barrier_has_no_bound():
    step, barrier = Graph(1), Graph(1)
    step.network(0, linear([[3.0]], [1.0]))
    barrier.network(0, nn.Sequential(linear([[1.0]]), nn.ReLU(), linear([[1.0]])))
    barrier.steps[-1].weights[0].fill_(math.nan)
    one = torch.ones(1, dtype=torch.float64)
    everywhere, there = (largest_rounding(step, -one, one, U, boxes=16, where=w) for w in (None, (barrier, 0.0)))
    assert there == everywhere > 0.0


def test_rounding_of_the_step_counts_where_the_set_is():
    steep = nn.Sequential(linear([[1e3]], [-900.0]), nn.ReLU(), linear([[1e-3]]))  # a policy that is large from z = .9 on
    barrier, plant = nn.Sequential(linear([[1.0]])), nn.Sequential(linear([[0.5, 1e3]]))
    system = closed_loop(barrier, plant, steep, latent_dim=1, lipschitz_bound=1.0)
    assert system.rounding(U, level=0.0)[1] < 0.1 * system.rounding(U)[1]


# --- the statement ----------------------------------------------------------------------------------------------------


def cancelling(k: float, dtype: torch.dtype = torch.float32) -> tuple[nn.Sequential, nn.Sequential, nn.Sequential]:
    """z+ = z / 2 in real arithmetic; three large units cancel, and float32 leaves what they round off."""
    first = linear([[1.0, 0.0], [-1.0, 0.0], [k, 0.0], [k, 0.0], [0.0, 0.0]], [0.0, 0.0, 2 * k, k, k])
    plant = nn.Sequential(first, nn.ReLU(), linear([[0.5, -0.5, 1.0, -1.0, -1.0]]))
    return one_norm(0.5).to(dtype), plant.to(dtype), nn.Sequential(linear([[0.0]])).to(dtype)


def test_units_that_cancel_in_real_arithmetic_only_are_refused():
    barrier, plant, idle = cancelling(1e7)
    z = torch.linspace(-1, 1, 49_018)[:, None]
    after = barrier(plant(torch.cat([z, idle(z)], 1)))
    assert int(((barrier(z) <= 0) & (after > 0)).sum()) > 100  # led out by what is computed
    layer = deterministic_layer(barrier, plant, idle, latent_dim=1, lipschitz_bound=1.001)
    assert layer["invariance"].holds
    assert layer["tolerated error"].holds
    assert layer.reasons[0] is Reason.ROUNDING
    assert layer["float32"].value < 0.0 < layer["float32"].misses_by
    assert "deploy in float64" in layer["float32"].detail


def test_the_same_network_is_certified_in_double_precision():
    layer = deterministic_layer(*cancelling(1e5, torch.float64), latent_dim=1, lipschitz_bound=1.001)
    assert layer.holds, layer.verdict
    assert layer["float64"].value == pytest.approx(0.25, abs=2e-3)
    with pytest.raises(KeyError):
        layer["float32"]


def test_a_search_that_float64_cannot_decide_is_said_to_be_none():
    layer = deterministic_layer(*cancelling(1e9, torch.float64), latent_dim=1, lipschitz_bound=1.001)
    assert not layer["rounding"].holds
    assert layer["rounding"].value > 1e-7
    assert not layer.holds


def test_what_is_left_of_the_tolerated_error_is_what_rounding_leaves():
    system = closed_loop(*cancelling(1e4), latent_dim=1, lipschitz_bound=1.001)
    known = largest_error(system)
    real = computed_error(system, known, unit=U)
    assert 1e-3 < real.step_rounding < 0.05
    assert real.delta <= known.delta - real.step_rounding - real.barrier_rounding / 1.001 + 1e-3
    assert real.delta >= known.delta - real.step_rounding - real.barrier_rounding / 1.001 - 2e-3
    double = computed_error(system, known, unit=2.0**-53)
    assert abs(double.delta - known.delta) < 1e-3


def rough(k: float) -> nn.Sequential:
    """B = |z| - 1/2 in real arithmetic; three large units cancel, and float32 leaves what they round off."""
    first = linear([[1.0], [-1.0], [k], [k], [0.0]], [0.0, 0.0, 2 * k, k, k])
    return nn.Sequential(first, nn.ReLU(), linear([[1.0, 1.0, 1.0, -1.0, -1.0]], [-0.5]))


def test_a_point_that_only_the_computed_barrier_takes_in_counts():
    # In real arithmetic the set ends at 0.5; beyond 0.5001 the plant throws out. The computed barrier is off by more.
    barrier = rough(1e4)
    throw = nn.Sequential(linear([[1.0, 0.0], [-1.0, 0.0], [1.0, 0.0]], [0.0, 0.0, -0.5001]), nn.ReLU(), linear([[0.5, -0.5, 9e3]]))
    idle = nn.Sequential(linear([[0.0]]))
    # The weights of the barrier prove no small constant; for this test it is 1 in real arithmetic.
    system = closed_loop(barrier, throw, idle, latent_dim=1, lipschitz_bound=1.0)
    known = largest_error(system)
    assert known.delta > 0.2
    real = computed_error(system, known, unit=U, budget=Budget(boxes=5000))
    assert 1e-4 < real.barrier_rounding + real.step_rounding < 0.2
    assert real.delta < 0.0


def test_rounding_of_the_barrier_counts_where_a_step_begins_and_where_it_ends():
    # z+ = z / 2: from |z| <= 1/2 + e, which may look inside, to |z+| <= 1/2 - e, which looks inside for certain.
    halved, idle = nn.Sequential(linear([[0.5, 0.0]])), nn.Sequential(linear([[0.0]]))
    system = closed_loop(rough(2e4), halved, idle, latent_dim=1, lipschitz_bound=1.0)
    real = computed_error(system, largest_error(system, tolerance=1e-5), unit=U, tolerance=1e-5)
    e = real.barrier_rounding
    assert 0.005 < e < 0.1
    assert real.step_rounding < 1e-6
    assert 0.25 - 1.5 * e - 1e-4 < real.delta <= 0.25 - 1.5 * e


@pytest.mark.slow
def test_shipped_pendulum_keeps_its_set_in_float32():
    agent = sspl.load("pendulum")
    parts = (agent.barrier, agent.dynamics, agent.policy)
    system = closed_loop(*parts, latent_dim=3, lipschitz_bound=agent.lipschitz_bound)
    known = largest_error(system)
    real = computed_error(system, known, unit=UNITS[torch.float32])
    # The search ends within 0.0005 of the largest error; how far below it, the machine's arithmetic decides.
    assert 0.0 < real.delta < known.delta
    z = (2 * torch.rand(200_000, 3, generator=torch.Generator().manual_seed(0)) - 1)
    with torch.no_grad():
        for size in (1, 7, 1000):
            some = z[: 50 * size] if size < 1000 else z
            value = torch.cat([agent.barrier(part) for part in some.split(size)])
            step = torch.cat([agent.dynamics(part, agent.policy(part)) for part in some.split(size)])
            assert float((value.double() - system.barrier(some)).abs().max()) <= real.barrier_rounding
            assert float((step.double() - system.step(some)).norm(dim=1).max()) <= real.step_rounding
        # The theorem itself: from the computed set, with any error of this size, into the computed set.
        inside = z[agent.barrier(z)[:, 0] <= 0]
        error = torch.randn(len(inside), 3, generator=torch.Generator().manual_seed(1)).double()
        error *= 0.999999 * real.delta / error.norm(dim=1, keepdim=True)
        after = (agent.dynamics(inside, agent.policy(inside)).double() + error).clamp(-1.0, 1.0).float()
        assert float(agent.barrier(after).max()) <= 0.0

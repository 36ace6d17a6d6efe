"""Conditions on systems whose certificates are known, and on the shipped agent."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn

import torchrl_sspl as sspl
from torchrl_sspl.certification.branch_and_bound import SLACK, Budget, maximise
from torchrl_sspl.certification.conditions import (
    decide_domain,
    decide_invariance,
    decide_vacuity,
    find_counterexamples,
    largest_error,
    search_level,
)
from torchrl_sspl.certification.loop import ClosedLoop, closed_loop, closed_loop_lipschitz, evaluation_rounding
from torchrl_sspl.errors import ConfigError, NonFiniteError, ShapeError
from torchrl_sspl.modules import LatentDynamics, Policy


def linear(weight: Tensor, bias: Tensor | None = None) -> nn.Linear:
    layer = nn.Linear(weight.shape[1], weight.shape[0])
    layer.weight.data.copy_(weight)
    layer.bias.data.copy_(torch.zeros(weight.shape[0]) if bias is None else bias)
    return layer.requires_grad_(False)


def one_norm(p: int, radius: float = 0.5) -> nn.Sequential:
    """B(z) = |z|_1 - radius, Lipschitz constant sqrt(p)."""
    eye = torch.eye(p)
    return nn.Sequential(
        linear(torch.cat([eye, -eye])), nn.ReLU(), linear(torch.ones(1, 2 * p), torch.tensor([-radius]))
    )


def no_policy(p: int) -> nn.Sequential:
    return nn.Sequential(linear(torch.zeros(1, p)))


def plant(matrix: Tensor, bias: Tensor | None = None) -> nn.Sequential:
    """z+ = A z + b, the action has no effect."""
    return nn.Sequential(linear(torch.cat([matrix, torch.zeros(len(matrix), 1)], 1), bias))


def linear_system(p: int, factor: float, seed: int = 0) -> ClosedLoop:
    """A random matrix whose induced 1-norm is the factor: |A z|_1 <= factor |z|_1, and attained."""
    a = torch.randn(p, p, generator=torch.Generator().manual_seed(seed))
    a *= factor / a.abs().sum(0).max()
    return closed_loop(one_norm(p), plant(a), no_policy(p), latent_dim=p, lipschitz_bound=math.sqrt(p))


def folded(p: int, factor: float) -> ClosedLoop:
    """A contracting nonlinear system, z+ = factor (relu(Q z) - relu(-Q z) / 2) with a permutation Q."""
    q = torch.eye(p).roll(1, 0)
    out = torch.cat([factor * torch.eye(p), -0.5 * factor * torch.eye(p)], 1)
    net = nn.Sequential(linear(torch.cat([torch.cat([q, -q]), torch.zeros(2 * p, 1)], 1)), nn.ReLU(), linear(out))
    return closed_loop(one_norm(p), net, no_policy(p), latent_dim=p, lipschitz_bound=math.sqrt(p))


@pytest.mark.parametrize("p", [2, 3, 4])
@pytest.mark.parametrize("make", [linear_system, folded])
def test_contracting_systems_are_proved_with_the_margin_that_they_have(make, p):
    # max of |z+|_1 - 1/2 where |z|_1 <= 1/2 is (0.8 - 1) / 2 = -0.1.
    system = make(p, 0.8)
    proved = decide_invariance(system, margin=0.099)
    assert proved.status == "proved", proved
    assert decide_invariance(system, margin=0.102).status == "refuted"


@pytest.mark.parametrize("p", [2, 3, 4])
@pytest.mark.parametrize("make", [linear_system, folded])
def test_expanding_systems_are_refuted_by_a_point_that_leaves(make, p):
    system = make(p, 1.1)
    refuted = decide_invariance(system)
    assert refuted.status == "refuted"
    point = refuted.witness[None]
    assert float(system.barrier(point)) <= 0.0 < float(system.looped(point))


@pytest.mark.parametrize("p", [2, 3])
def test_largest_error_is_the_distance_that_the_mathematics_says(p):
    found = largest_error(linear_system(p, 0.8), tolerance=1e-3)
    expected = 0.1 / math.sqrt(p)
    assert expected - 2e-3 < found.delta <= expected
    assert found.refuted_above >= expected - 1e-6


def test_largest_error_of_an_expanding_system_is_negative():
    assert largest_error(linear_system(2, 1.2)).delta < 0.0


def test_decay_and_decrement_are_proved_exactly_as_far_as_they_hold():
    system = linear_system(2, 0.8)  # on |z| <= 1/2, B(z+) = |z+| - 1/2 <= 0.8 B(z) - 0.1: R1 holds with margin 0.1
    assert decide_invariance(system, condition="R1", decay=0.2, margin=0.099).status == "proved"
    assert decide_invariance(system, condition="R1", decay=0.2, margin=0.11).status == "refuted"
    # Where |z| >= 0.25 it falls by 0.05 or more, where it is below it stays below 0.2.
    assert decide_invariance(system, condition="R2", decrement=0.049, floor=0.29).status == "proved"
    assert decide_invariance(system, condition="R2", decrement=0.2, floor=0.45).status == "refuted"


def test_level_below_zero_is_found_where_zero_fails():
    # z+ = 2 z + relu(...) pushes outward only beyond |z| = 0.3: z+ = z / 2 below, steeper above.
    net = nn.Sequential(
        linear(torch.tensor([[1.0, 0.0], [1.0, 0.0], [-1.0, 0.0]]), torch.tensor([0.0, -0.3, -0.3])),
        nn.ReLU(),
        linear(torch.tensor([[0.5, 3.0, -3.0]])),
    )
    system = closed_loop(one_norm(1), net, no_policy(1), latent_dim=1, lipschitz_bound=1.0)
    assert decide_invariance(system).status == "refuted"
    level, outcome = search_level(system, levels=[0.0, -0.1, -0.2, -0.3])
    assert level == pytest.approx(-0.2)
    assert outcome.status == "proved"
    assert search_level(system, levels=[0.0, -0.1]) is None
    assert search_level(system, levels=[-2.0]) is None  # an empty set is kept, and worth nothing
    with pytest.raises(ConfigError, match="at most zero"):
        search_level(system, levels=[0.1])


def test_empty_and_full_sets_are_called_so():
    step = plant(0.5 * torch.eye(2))
    make = lambda radius: closed_loop(one_norm(2, radius), step, no_policy(2), latent_dim=2, lipschitz_bound=1.5)  # noqa: E731
    assert decide_vacuity(make(-0.1)).status == "empty"
    assert decide_vacuity(make(3.0)).status == "everything"
    found = decide_vacuity(make(0.5))
    assert found.status == "neither"
    assert float(found.inside.abs().sum()) < 0.5 < float(found.outside.abs().sum())


def test_a_set_in_a_corner_is_not_overlooked():
    barrier = nn.Sequential(linear(torch.full((1, 2), 0.7071), torch.tensor([1.413])))  # below zero near (-1, -1) only
    system = closed_loop(barrier, plant(-torch.eye(2)), no_policy(2), latent_dim=2, lipschitz_bound=1.0)
    assert maximise(system.problem(level=0.0), threshold=0.0, budget=Budget(boxes=2000), seek=False).status != "proved"


def test_a_decrease_that_fails_deep_in_the_set_is_not_proved_without_a_search():
    problem = linear_system(2, 0.8).problem(level=0.0, weight=(1.2,), constant=(-0.05,))  # 0.05 - 0.4 |z|, above zero near 0
    assert maximise(problem, threshold=0.0, budget=Budget(boxes=2000), seek=False).status != "proved"


def test_domain_is_kept_or_a_point_leaves_it():
    keep = closed_loop(one_norm(2), plant(0.9 * torch.eye(2)), no_policy(2), latent_dim=2, lipschitz_bound=1.5)
    leave = closed_loop(one_norm(2), plant(1.1 * torch.eye(2)), no_policy(2), latent_dim=2, lipschitz_bound=1.5)
    assert decide_domain(keep).status == "proved"
    refuted = decide_domain(leave)
    assert refuted.status == "refuted"
    assert float(leave.step(refuted.witness[None]).abs().max()) > 1.0


@pytest.mark.parametrize(
    ("low", "high", "status"), [(-0.9, 0.9, "proved"), (-1.0, 1.0, "proved"), (-1.5, 0.9, "refuted"), (-0.9, 1.5, "refuted")]
)
def test_a_clamp_proves_the_domain_only_if_it_lies_in_it(low, high, status):
    step = nn.Sequential(*plant(2.0 * torch.eye(2)), nn.Hardtanh(low, high))
    system = closed_loop(one_norm(2), step, no_policy(2), latent_dim=2, lipschitz_bound=1.5)
    assert decide_domain(system).status == status


def test_a_domain_that_is_left_by_less_than_the_slack_is_neither_kept_nor_left():
    beyond = 3 * 2.0**-23  # a number of float32, and less than the slack
    assert 0.0 < beyond < SLACK
    step = plant((1 + beyond) * torch.eye(1))
    found = decide_domain(closed_loop(one_norm(1), step, no_policy(1), latent_dim=1, lipschitz_bound=1.0))
    assert found.status == "undecided"
    assert found.lower == pytest.approx(beyond, rel=1e-6)
    assert beyond <= found.upper <= SLACK
    assert found.boxes < 5000  # nothing is left that further bisection could decide


def test_budget_of_no_boxes_leaves_it_undecided():
    found = decide_invariance(linear_system(3, 0.99), budget=Budget(boxes=0))
    assert found.status == "undecided"
    assert found.remaining_volume == pytest.approx(1.0)


def test_counterexamples_are_counterexamples():
    g = torch.Generator().manual_seed(0)
    system = linear_system(3, 1.3)
    points = find_counterexamples(system, 20, generator=g)
    assert points.shape == (20, 3)
    assert bool((system.barrier(points) <= 1e-6).all())
    assert bool((system.looped(points) > -1e-6).all())
    assert len(find_counterexamples(linear_system(3, 0.7), 20, generator=g)) == 0


def test_rounding_is_bounded_and_far_below_what_decides():
    agent = sspl.load("pendulum")
    system = pendulum()
    z = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    with torch.no_grad():
        deployed = agent.barrier(agent.dynamics(z, agent.policy(z)))
    gap = float((deployed.double() - system.looped(z)).abs().max())
    assert 0.0 < gap <= evaluation_rounding(system, unit=2.0**-24)
    assert gap < 1e-4
    assert evaluation_rounding(system) < 0.01 * SLACK


def pendulum() -> ClosedLoop:
    agent = sspl.load("pendulum")
    return closed_loop(agent.barrier, agent.dynamics, agent.policy, latent_dim=3, lipschitz_bound=agent.lipschitz_bound)


def test_shipped_agent_keeps_its_set_on_the_whole_latent_domain():
    system = pendulum()
    assert decide_invariance(system, budget=Budget(boxes=200_000)).status == "proved"
    assert largest_error(system, tolerance=5e-3, budget=Budget(boxes=200_000)).delta > 0.0
    assert decide_domain(system).status == "proved"
    assert decide_vacuity(system).status == "neither"


def test_graph_of_the_shipped_agent_is_what_is_deployed():
    agent, system = sspl.load("pendulum"), pendulum()
    z = torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1
    with torch.no_grad():
        torch.testing.assert_close(system.step(z).float(), agent.dynamics(z, agent.policy(z)), atol=1e-5, rtol=0)
        torch.testing.assert_close(system.barrier(z).float(), agent.barrier(z), atol=1e-5, rtol=0)


def test_shipped_agent_with_a_policy_turned_round_is_refuted():
    agent = sspl.load("pendulum")
    agent.policy.net[-1].weight.mul_(-1)
    system = closed_loop(agent.barrier, agent.dynamics, agent.policy, latent_dim=3, lipschitz_bound=2.0)
    assert decide_invariance(system, budget=Budget(boxes=200_000)).status == "refuted"


def test_lipschitz_constant_of_the_closed_loop_bounds_its_secants():
    agent, system = sspl.load("pendulum"), pendulum()
    bound = closed_loop_lipschitz(agent.dynamics, agent.policy)
    a, b = (torch.rand(2, 20000, 3, generator=torch.Generator().manual_seed(2)) * 2 - 1).double()
    b = a + 0.01 * (b - a)
    secant = ((system.step(a) - system.step(b)).norm(dim=1) / (a - b).norm(dim=1)).max()
    assert 1.0 < float(secant) <= bound


def test_lipschitz_constant_of_a_loop_that_stands_still_is_one():
    dynamics, policy = LatentDynamics(2, 1, (4,)), Policy(2, 1, (4,))
    for q in dynamics.parameters():
        q.data.zero_()
    assert 1.0 <= closed_loop_lipschitz(dynamics, policy) < 1.001
    with pytest.raises(ConfigError, match="one action scale"):
        closed_loop_lipschitz(dynamics, Policy(2, 1, (4,), 3.0))


def test_what_cannot_be_certified_is_refused():
    with pytest.raises(NonFiniteError):
        closed_loop(one_norm(2, math.nan), plant(torch.eye(2)), no_policy(2), latent_dim=2, lipschitz_bound=1.5)
    with pytest.raises(ShapeError):
        closed_loop(one_norm(3), plant(torch.eye(2)), no_policy(2), latent_dim=2, lipschitz_bound=1.5)
    with pytest.raises(ConfigError, match="expected the dynamics"):
        closed_loop(one_norm(2), nn.GRUCell(2, 2), no_policy(2), latent_dim=2, lipschitz_bound=1.5)
    with pytest.raises(ConfigError, match="low < high"):
        closed_loop(one_norm(2), plant(torch.eye(2)), no_policy(2), latent_dim=2, lipschitz_bound=1.5, low=1.0)
    with pytest.raises(ConfigError, match="condition"):
        decide_invariance(linear_system(2, 0.5), condition="R4")
    with pytest.raises(ConfigError, match="decay"):
        decide_invariance(linear_system(2, 0.5), condition="R1", decay=2.0)

"""Invariant sets of point clouds against systems whose sets are known."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchrl_sspl.envs import CMUDubinsEnv
from torchrl_sspl.errors import EmptyRegionError, ShapeError
from torchrl_sspl.viability import viability_kernel
from torchrl_sspl.viability.cloud import (
    barrier_targets,
    nearby_residuals,
    nearest_distance,
    normal_projectors,
    reach_times,
    robust_invariant_set,
    safety_values,
    signed_margin,
    value_targets,
)

# --- an unstable line: z+ = 1.5 z + u, |u| <= 0.2; inside |z| < 1 it can be held exactly up to |z| = 0.2 / 0.5 = 0.4 ---

ACTIONS = torch.linspace(-0.2, 0.2, 5)
LINE = torch.linspace(-0.995, 0.995, 399)[:, None]  # a point every 0.005
RIM = torch.cat([torch.linspace(-2.0, -1.0, 201), torch.linspace(1.0, 2.0, 201)])[:, None]


def unstable(z: Tensor) -> Tensor:
    return 1.5 * z[:, None] + ACTIONS[None, :, None]


def errors(size: float) -> Tensor:
    """Errors of both signs at every point of the line."""
    return torch.tensor([[size], [-size]]).expand(len(LINE), 2, 1)


def reach(residuals: Tensor | None = None) -> float:
    found = robust_invariant_set(unstable(LINE), LINE, RIM, residuals=residuals)
    inside = LINE[found.inside, 0]
    assert len(inside), "the set is empty"
    assert float(inside.min()) == pytest.approx(-float(inside.max()), abs=1e-4)
    assert len(inside) == round(float(inside.max()) / 0.005) * 2 + 1  # no holes
    return float(inside.max())


def test_unstable_line_can_be_held_up_to_its_known_border():
    assert reach() == pytest.approx(0.4, abs=0.011)


@pytest.mark.parametrize("error", [0.02, 0.05, 0.1])
def test_error_costs_what_the_mathematics_says(error):
    # Held if 1.5 z - 0.2 + error < z, up to the spacing of the points.
    assert reach(errors(error)) == pytest.approx((0.2 - error) / 0.5, abs=0.016)


def test_larger_error_gives_a_smaller_set():
    sets = [robust_invariant_set(unstable(LINE), LINE, RIM, residuals=errors(e)).inside for e in (0.0, 0.03, 0.06, 0.1)]
    for larger, smaller in zip(sets[:-1], sets[1:], strict=True):
        assert bool((smaller <= larger).all())
        assert int(smaller.sum()) < int(larger.sum())


def test_error_beyond_the_control_leaves_nothing():
    assert not bool(robust_invariant_set(unstable(LINE), LINE, RIM, residuals=errors(0.3)).inside.any())


def test_residual_on_one_side_moves_the_set_and_does_not_shrink_it():
    # z+ = 1.5 z + u + 0.05 is the same system around z = -0.1.
    offset = torch.full((len(LINE), 1, 1), 0.05)
    found = robust_invariant_set(unstable(LINE), LINE, RIM, residuals=offset)
    inside = LINE[found.inside, 0]
    assert float(inside.min()) == pytest.approx(-0.5, abs=0.016)
    assert float(inside.max()) == pytest.approx(0.3, abs=0.016)


@pytest.mark.parametrize("error", [0.0, 0.05])
def test_every_point_of_the_set_has_an_action_that_stays_in_it_and_its_clearance(error):
    found = robust_invariant_set(unstable(LINE), LINE, RIM, residuals=errors(error))
    complement = torch.cat([RIM, LINE[~found.inside]])
    best = found.clearance[found.inside].max(1)
    assert bool((best.values > 0).all())
    after = unstable(LINE)[found.inside][torch.arange(len(best.indices)), best.indices]
    worst = torch.minimum(nearest_distance(after + error, complement), nearest_distance(after - error, complement))
    torch.testing.assert_close(worst, best.values)
    ends = torch.cat([after + error, after - error])
    assert bool((nearest_distance(ends, LINE[found.inside]) <= nearest_distance(ends, complement)).all())


def test_outside_the_set_nothing_has_a_clearance():
    found = robust_invariant_set(unstable(LINE), LINE, RIM)
    assert float(found.clearance[~found.inside].abs().max()) == 0.0


# --- values of actions, on the same line ---

BOTH = torch.cat([LINE, RIM])
MARGIN = signed_margin(BOTH, torch.arange(len(BOTH)) >= len(LINE))


@pytest.mark.parametrize("error", [0.0, 0.05, 0.1])
def test_margin_stays_positive_exactly_where_the_line_can_be_held(error):
    residuals = torch.tensor([[error], [-error]]).expand(len(BOTH), 2, 1)
    value = safety_values(unstable(BOTH), BOTH, MARGIN, residuals=residuals).amax(1).minimum(MARGIN)
    held = BOTH[value > 0, 0]
    assert float(held.max()) == pytest.approx((0.2 - error) / 0.5, abs=0.016)
    assert float(held.min()) == pytest.approx(-(0.2 - error) / 0.5, abs=0.016)


def test_values_tell_actions_apart_where_one_step_does_not():
    # In the middle of the line every action keeps a large clearance; the value knows where it leads.
    near = int((BOTH[:, 0] - 0.38).abs().argmin())
    value = safety_values(unstable(BOTH), BOTH, MARGIN)[near]
    assert int(value.argmax()) == 0
    assert float(value[0] - value[2]) > 0.5


def test_margin_never_falls_along_the_policy_that_it_belongs_to():
    policy = (-0.5 * BOTH).clamp(-0.2, 0.2)
    step = (1.5 * BOTH + policy)[:, None]
    value = safety_values(step, BOTH, MARGIN, neighbours=1)[:, 0].minimum(MARGIN)
    following = value[(step[:, 0, None] - BOTH[None]).norm(dim=-1).argmin(1)]
    assert bool((following >= value - 2e-3).all())


def test_targets_rise_off_the_data_and_keep_the_sign_of_the_margin_on_it():
    data = torch.cat([BOTH, torch.zeros_like(BOTH)], -1)
    target = value_targets(data, data, MARGIN, tube_radius=0.3, lipschitz_bound=2.0)
    clear = MARGIN.abs() > 0.02  # beside the border two points share a value
    assert bool(((target < 0) == (MARGIN > 0))[clear].all())
    assert float(target.min()) >= -0.6 - 1e-6
    away = value_targets(data + torch.tensor([0.0, 0.5]), data, MARGIN, tube_radius=0.3, lipschitz_bound=2.0)
    assert float(away.min()) == pytest.approx(0.4, abs=1e-5)


def test_a_way_is_worth_its_narrowest_place():
    chain, margin = torch.tensor([[0.0], [1.0], [2.0]]), torch.tensor([0.3, 0.1, 0.5])
    value = safety_values(chain[[1, 2, 2]][:, None], chain, margin, neighbours=1)
    torch.testing.assert_close(value[:, 0], torch.tensor([0.1, 0.5, 0.5]))


def test_values_between_latents_are_those_of_a_plane():
    data, queries = (side * (2 * torch.rand(n, 2, generator=torch.Generator().manual_seed(n)) - 1) for n, side in ((4000, 1.0), (500, 0.9)))
    slope = torch.tensor([1.0, -0.5])
    off = (value_targets(queries, data, data @ slope, tube_radius=10.0, lipschitz_bound=1.0) + queries @ slope).abs()
    assert float(off.mean()) < 1e-3  # the mean of three neighbours, the near ones counting more, is 0.0082 off
    between = value_targets(queries, data, (data[:, 0] > 0).float(), tube_radius=1.0, lipschitz_bound=1.0)
    assert float(between.min()) >= -1.0  # a step is not overshot
    assert float(between.max()) <= 0.0


@pytest.mark.slow
def test_values_on_a_cloud_are_the_kernel_of_a_car_that_is_known_exactly():
    env, random = CMUDubinsEnv(batch_size=[1], seed=0), torch.Generator().manual_seed(0)
    kernel = viability_kernel(env, resolution=(51, 51, 40))
    states, queries = (torch.tensor([1.1, 1.1, math.pi]) * (2 * torch.rand(n, 3, generator=random) - 1) for n in (10_000, 4000))
    latent = lambda x: torch.cat([x[..., :2] / 1.3, 0.4 * x[..., 2:].cos(), 0.4 * x[..., 2:].sin()], -1)  # noqa: E731
    after = torch.stack([env.dynamics(states, torch.full((len(states), 1), rate)) for rate in (-1.25, 0.0, 1.25)], 1)
    margin = signed_margin(latent(states), env.region(states)[:, 0] == 2)
    value = safety_values(latent(after), latent(states), margin).amax(1).minimum(margin)
    called = value_targets(latent(queries), latent(states), value, tube_radius=1.0, lipschitz_bound=1.0) <= 0.0
    safe = kernel.contains(queries)
    assert float(called[safe].float().mean()) > 0.98
    assert float(called[~safe].float().mean()) < 0.05  # with means of three neighbours 0.18, of eight 0.06


def test_a_cloud_may_have_fewer_latents_than_neighbours():
    few = torch.tensor([[0.0], [1.0]])
    assert safety_values(few[:, None], few, torch.tensor([0.2, 0.1])).shape == (2, 1)
    target = value_targets(few, few, torch.tensor([0.2, 0.1]), tube_radius=1.0, lipschitz_bound=1.0)
    assert bool(((target >= -0.2) & (target <= -0.1)).all())


def test_values_need_a_row_for_every_latent():
    with pytest.raises(ShapeError, match="one row per latent"):
        safety_values(unstable(LINE), LINE, MARGIN)


# --- the integrator: z+ = z + u, every point can be held -------------------------------------------------------------

DRIFT = LINE[:, None] + torch.tensor([0.1, 0.2])[None, :, None]


def test_integrator_holds_everything():
    step = LINE[:, None] + torch.tensor([-0.1, 0.0, 0.1])[None, :, None]
    assert bool(robust_invariant_set(step, LINE, RIM).inside.all())


def test_what_looks_unsafe_within_its_own_error_is_outside_from_the_start():
    step = LINE[:, None] + torch.tensor([-0.1, 0.0, 0.1])[None, :, None]
    inside = robust_invariant_set(step, LINE, RIM, residuals=errors(0.05)).inside
    assert float(LINE[inside].abs().max()) == pytest.approx(0.95, abs=0.006)
    assert bool(inside[LINE[:, 0].abs() < 0.94].all())


def test_integrator_that_cannot_stop_holds_nothing():
    found = robust_invariant_set(DRIFT, LINE, RIM)
    assert not bool(found.inside.any())
    assert found.iterations > 3
    assert int(found.removed.min()) == 1  # at the upper end
    assert bool((found.removed.diff() <= 0).all())  # the lower end is kept longest


def test_what_ends_safely_is_never_removed_and_saves_what_leads_there():
    absorbing = LINE[:, 0].abs() < 0.101
    found = robust_invariant_set(DRIFT, LINE, RIM, absorbing=absorbing)
    assert bool(found.inside[absorbing].all())
    assert bool(found.inside[LINE[:, 0].sub(-0.7).abs() < 0.2].all())  # they drift into it
    assert not bool(found.inside[LINE[:, 0] > 0.11].any())  # they have passed it


def test_bad_shapes_and_missing_labels_are_errors():
    step = unstable(LINE)
    with pytest.raises(EmptyRegionError, match="unsafe latent"):
        robust_invariant_set(step, LINE, RIM[:0])
    with pytest.raises(ShapeError, match="one row per candidate"):
        robust_invariant_set(step, LINE[:-1], RIM)
    with pytest.raises(ShapeError, match="residuals"):
        robust_invariant_set(step, LINE, RIM, residuals=torch.zeros(3, 1, 1))


# --- residuals --------------------------------------------------------------------------------------------------------


def test_ends_of_the_leading_axis_are_where_the_errors_spread():
    g = torch.Generator().manual_seed(0)
    reference = torch.rand(4000, 2, generator=g)
    along = torch.tensor([0.6, 0.8])
    noise = 0.1 * torch.randn(4000, 1, generator=g) * along + torch.tensor([0.3, 0.0])
    sample, ends = nearby_residuals(reference[:20], reference, noise, count=4, spread=2.0, neighbours=2000)
    assert sample.shape == (20, 4, 2)
    mean = ends[:, 0]
    torch.testing.assert_close(mean, torch.tensor([[0.3, 0.0]]).expand(20, 2), atol=0.02, rtol=0)
    offsets = ends[:, 1:] - mean[:, None]
    longest = offsets[torch.arange(20), offsets.norm(dim=-1).argmax(1)]
    torch.testing.assert_close(longest.norm(dim=-1), torch.full((20,), 0.2), atol=0.02, rtol=0)
    torch.testing.assert_close((longest @ along).abs(), longest.norm(dim=-1), atol=1e-3, rtol=0)
    torch.testing.assert_close(offsets.sum(1), torch.zeros(20, 2), atol=1e-5, rtol=0)  # both ends


def test_sampled_residuals_are_those_of_the_nearest_latents():
    reference = torch.linspace(0, 1, 101)[:, None]
    sample, _ = nearby_residuals(torch.tensor([[0.5]]), reference, 10 * reference, count=3, spread=1.0, neighbours=9)
    assert sorted(sample[0, :, 0].tolist()) == pytest.approx([4.9, 5.0, 5.1], abs=1e-4)


def test_normal_projectors_of_a_plane_in_space():
    g = torch.Generator().manual_seed(0)
    plane = torch.cat([torch.rand(500, 2, generator=g), torch.full((500, 1), 0.2)], 1)
    expected = torch.diag(torch.tensor([0.0, 0.0, 1.0])).expand(10, 3, 3)
    torch.testing.assert_close(normal_projectors(plane[:10], plane), expected, atol=1e-4, rtol=0)


# --- targets of the barrier -------------------------------------------------------------------------------------------


def disc_targets(queries: Tensor, bound: float = 2.0) -> tuple[Tensor, Tensor]:
    axis = torch.linspace(-1, 1, 81)
    grid = torch.cartesian_prod(axis, axis)
    disc = grid.norm(dim=1) <= 0.5
    return barrier_targets(queries, grid[disc], grid[~disc], tube_radius=0.1, lipschitz_bound=bound)


@pytest.mark.parametrize("bound", [0.5, 2.0])
def test_targets_are_lipschitz_inside(bound):
    queries = torch.rand(600, 2, generator=torch.Generator().manual_seed(0)) * 1.2 - 0.6
    target, member = disc_targets(queries, bound)
    x, t = queries[member], target[member]
    assert 100 < len(x) < 600
    slope = (t[:, None] - t).abs() / torch.cdist(x, x).clamp_min(1e-9)
    assert float(slope.max()) <= bound * (1 + 1e-4)
    assert float(slope.max()) > 0.9 * bound


def test_targets_are_the_signed_distance_of_the_disc():
    target, member = disc_targets(torch.tensor([[0.0, 0.0], [0.3, 0.0], [0.9, 0.0]]))
    assert member.tolist() == [True, True, False]
    assert target[:2].tolist() == pytest.approx([-2 * 0.5, -2 * 0.2], abs=2 * 0.04)
    assert target[2] == pytest.approx(2 * (0.4 - 0.1), abs=2 * 0.04)


def test_targets_are_negative_exactly_on_members():
    queries = torch.rand(500, 2, generator=torch.Generator().manual_seed(1)) * 2 - 1
    target, member = disc_targets(queries)
    assert bool((target[member] < 0).all())
    assert bool((target[~member] > 0).all())


def test_targets_need_both_sides():
    some = torch.zeros(1, 2)
    for inside, outside in ((some[:0], some), (some, some[:0])):
        with pytest.raises(EmptyRegionError, match="at least one point"):
            barrier_targets(some, inside, outside, tube_radius=0.1, lipschitz_bound=1.0)


# --- times ------------------------------------------------------------------------------------------------------------


def test_times_of_a_chain_are_its_lengths():
    chain, goal = torch.arange(0, 10.0)[:, None], torch.tensor([[10.0]])
    steps = reach_times(torch.stack([(chain - 1).clamp_min(0), chain + 1], 1), chain, goal, neighbours=1)
    lengths = 10 - chain[:, 0]
    torch.testing.assert_close(steps[:, 1], lengths)  # towards the goal
    torch.testing.assert_close(steps[1:, 0], lengths[1:] + 2)  # one step back and forth
    assert steps[0, 0] == 11


def test_what_cannot_reach_the_goal_gets_the_horizon():
    chain, goal = torch.arange(0, 5.0)[:, None], torch.tensor([[10.0]])
    steps = reach_times((chain - 1).clamp_min(0)[:, None], chain, goal, horizon=20, neighbours=1)
    assert float(steps.min()) >= 20
    assert float(steps.max()) <= 21


def test_ways_back_do_not_lead_through_where_there_is_no_data():
    # Two ways to the goal at 1: through a gap without data in one leap, or in small steps around it.
    z = torch.cat([torch.linspace(0.0, 0.3, 31), torch.linspace(0.7, 0.95, 26)])[:, None]
    leap, step = z + 0.3, z + 0.05
    goal = torch.tensor([[1.0]])
    free = reach_times(torch.stack([leap, step], 1), z, goal, neighbours=1)
    careful = reach_times(torch.stack([leap, step], 1), z, goal, neighbours=1, known_within=0.03)
    assert float(free[25].min()) < 20  # the nearest known latent stands in for the gap
    assert float(careful[25].min()) >= 120
    torch.testing.assert_close(careful[-3:].min(1).values, free[-3:].min(1).values)

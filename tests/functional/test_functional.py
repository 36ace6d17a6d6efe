"""The equations: by hand, against the slow reference, their gradients, and their errors."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_sspl import functional as F
from torchrl_sspl.errors import ConfigError, EmptyRegionError, NotPositiveDefiniteError, ShapeError

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import reference

quick = settings(max_examples=25, deadline=None, derandomize=True)
numbers = st.floats(-3, 3, allow_nan=False, width=32)
columns = st.lists(numbers, min_size=1, max_size=8)
MODES = ("paper", "R1", "R2", "R3")
OPTIONS = {"safety_margin": 0.05, "dynamics_margin": 0.1, "decay": 0.2, "decrement": 0.3, "floor": 0.4, "band": 0.25}


def column(values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None]


def call(mode: str, barrier: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
    return F.synthesis_violation(barrier, after, mode=mode, **OPTIONS)


def same(found: torch.Tensor, expected: np.ndarray) -> None:
    assert tuple(found.shape) == expected.shape
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-9, atol=1e-12)


# --- hinges -----------------------------------------------------------------------------------------------------------


def test_safe_hinge_by_hand():
    assert F.safe_hinge(column([-0.5, -0.1, 0.0, 2.0]), 0.1).flatten().tolist() == pytest.approx([0, 0, 0.1, 2.1])


def test_unsafe_hinge_by_hand():
    assert F.unsafe_hinge(column([-2.0, 0.0, 0.1, 0.5]), 0.1).flatten().tolist() == pytest.approx([2.1, 0.1, 0, 0])


@quick
@given(columns, st.floats(0, 1))
def test_hinges_equal_the_reference(values, margin):
    b = column(values)
    same(F.safe_hinge(b, margin), reference.safe_hinge(b.numpy(), margin))
    same(F.unsafe_hinge(b, margin), reference.unsafe_hinge(b.numpy(), margin))


@quick
@given(columns, st.floats(0.01, 1))
def test_no_value_satisfies_both_hinges_with_a_positive_margin(values, margin):
    b = column(values)
    assert bool((F.safe_hinge(b, margin) + F.unsafe_hinge(b, margin) > 0).all())


# --- synthesis --------------------------------------------------------------------------------------------------------

BY_HAND = {  # B = -0.2, B+ = 0.05 with OPTIONS
    "paper": 0.05 + 0.1 + 0.2 + 0.05,
    "R1": 0.05 + 0.1 + 0.8 * 0.2,
    "R2": 0.05 + 0.1 + 0.4,  # max(-0.2 - 0.3, -0.4) = -0.4
    "R3": 0.15 * 0.45 / 0.25,
}


@pytest.mark.parametrize("mode", MODES)
def test_synthesis_by_hand(mode):
    assert float(call(mode, column([-0.2]), column([0.05]))) == pytest.approx(BY_HAND[mode])


@pytest.mark.parametrize("mode", MODES)
@quick
@given(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=8))
def test_synthesis_equals_the_reference(mode, rows):
    b, n = column([r[0] for r in rows]), column([r[1] for r in rows])
    same(call(mode, b, n), reference.synthesis_violation(b.numpy(), n.numpy(), mode, 0.05, 0.1, 0.2, 0.3, 0.4, 0.25))


@quick
@given(numbers, numbers)
def test_r3_is_zero_inside_only_where_the_implication_holds(b, n):
    violated = float(call("R3", column([b]), column([n]))) > 0
    assert violated == (n + 0.1 > 0 and b < 0.25)


def test_default_mode_is_r3():
    b, n = column([-0.02]), column([0.3])
    assert torch.equal(F.synthesis_violation(b, n), F.synthesis_violation(b, n, mode="R3"))


def test_without_decay_r1_is_the_paper():
    b, n = column([0.3, -0.4]), column([0.1, 0.2])
    assert torch.equal(F.synthesis_violation(b, n, mode="R1"), F.synthesis_violation(b, n, mode="paper"))


def test_unknown_mode_names_the_modes():
    with pytest.raises(ConfigError, match=r"'R1', 'R2', 'R3'.*'R4'"):
        F.synthesis_violation(column([0.0]), column([0.0]), mode="R4")


# --- distances --------------------------------------------------------------------------------------------------------


def test_distances_by_hand():
    a, b = torch.tensor([[3.0, 0.0], [1.0, 1.0]]), torch.tensor([[0.0, 4.0], [1.0, 1.0]])
    assert F.consistency_error(a, b).tolist() == [[25.0], [0.0]]
    assert F.dynamics_error(a, b).tolist() == [5.0, 0.0]
    assert F.policy_deviation(a, b).tolist() == [[5.0], [0.0]]


def test_distances_equal_the_reference():
    g = torch.Generator().manual_seed(0)
    a, b = (torch.randn(20, 3, generator=g, dtype=torch.float64) for _ in range(2))
    same(F.consistency_error(a, b), reference.squared_distance(a.numpy(), b.numpy()))
    same(F.policy_deviation(a, b), reference.distance(a.numpy(), b.numpy()))
    same(F.dynamics_error(a, b), reference.distance(a.numpy(), b.numpy())[:, 0])


def test_policy_deviation_has_a_finite_gradient_at_zero():
    a = torch.zeros(2, 1, requires_grad=True)
    F.policy_deviation(a, torch.zeros(2, 1)).sum().backward()
    assert a.grad is not None
    assert a.grad.abs().max() == 0


@pytest.mark.parametrize("function", [F.consistency_error, F.dynamics_error, F.policy_deviation, F.synthesis_violation])
def test_shapes_that_would_broadcast_are_refused(function):
    with pytest.raises(ShapeError, match=r"\(4, 1\).*\(4,\)"):
        function(torch.zeros(4, 1), torch.zeros(4))


# --- empty batches, batch shapes, gradients ---------------------------------------------------------------------------

UNARY = {"safe": lambda x: F.safe_hinge(x, 0.1), "unsafe": lambda x: F.unsafe_hinge(x, 0.1)}
BINARY = {
    "consistency": F.consistency_error,
    "deviation": F.policy_deviation,
    **{m: (lambda a, b, m=m: call(m, a, b)) for m in MODES},
}


@pytest.mark.parametrize("name", [*UNARY, *BINARY])
@pytest.mark.parametrize("batch", [(0,), (2, 3), ()])
def test_every_batch_shape_is_kept(name, batch):
    x = torch.zeros(*batch, 1)
    found = UNARY[name](x) if name in UNARY else BINARY[name](x, x)
    assert found.shape == (*batch, 1)
    assert found.dtype == torch.float32


def test_dynamics_error_of_an_empty_batch_is_empty():
    assert F.dynamics_error(torch.zeros(0, 3), torch.zeros(0, 3)).shape == (0,)


@pytest.mark.parametrize("name", [*UNARY, *BINARY])
def test_gradients_equal_finite_differences(name):
    g = torch.Generator().manual_seed(1)
    x, y = (torch.randn(6, 1, generator=g, dtype=torch.float64).requires_grad_() for _ in range(2))
    arguments = (x,) if name in UNARY else (x, y)
    assert torch.autograd.gradcheck({**UNARY, **BINARY}[name], arguments)


# --- the matrix -------------------------------------------------------------------------------------------------------


def random_network(sizes, seed=0):
    g = torch.Generator().manual_seed(seed)
    weights = [torch.randn(b, a, generator=g, dtype=torch.float64) for a, b in zip(sizes[:-1], sizes[1:], strict=True)]
    return weights, [torch.rand(n, generator=g, dtype=torch.float64) + 0.1 for n in sizes[1:-1]]


def test_lmi_matrix_of_two_hidden_layers_is_the_printed_one():
    (w0, w1, w2), (l1, l2) = random_network((2, 3, 4, 1))
    zero = torch.zeros
    a, b = torch.diag(l1) @ w0, torch.diag(l2) @ w1
    printed = torch.cat([
        torch.cat([9.0 * torch.eye(2), -a.T, zero(2, 4), zero(2, 1)], 1),
        torch.cat([-a, 2 * torch.diag(l1), -b.T, zero(3, 1)], 1),
        torch.cat([zero(4, 2), -b, 2 * torch.diag(l2), -w2.T], 1),
        torch.cat([zero(1, 2), zero(1, 3), -w2, torch.eye(1)], 1),
    ])
    assert torch.equal(F.lmi_matrix([w0, w1, w2], [l1, l2], 3.0), printed)


@pytest.mark.parametrize("sizes", [(2, 3, 1), (3, 4, 2, 1), (1, 2, 2, 2, 3)])
@pytest.mark.parametrize("slope", [(0.0, 1.0), (0.1, 1.0), (0.0, 0.25), (-0.1, 1.1)])
def test_lmi_matrix_equals_the_reference(sizes, slope):
    weights, multipliers = random_network(sizes)
    expected = reference.lmi_matrix([w.numpy() for w in weights], [m.numpy() for m in multipliers], 1.7, slope)
    same(F.lmi_matrix(weights, multipliers, 1.7, slope), expected)


def test_lmi_matrix_is_differentiable():
    weights, multipliers = random_network((2, 3, 1))
    inputs = [t.requires_grad_() for t in (*weights, *multipliers)]
    assert torch.autograd.gradcheck(lambda a, b, c: F.lmi_matrix([a, b], [c], 2.0, (0.1, 1.0)), inputs)


def test_lmi_matrix_refuses_sizes_that_do_not_follow():
    weights, multipliers = random_network((2, 3, 1))
    with pytest.raises(ShapeError, match="multipliers"):
        F.lmi_matrix(weights, [multipliers[0][:-1]], 1.0)
    with pytest.raises(ShapeError, match="follow"):
        F.lmi_matrix([weights[0].T, weights[1]], multipliers, 1.0)


def test_lmi_loss_equals_the_reference_and_has_its_gradient():
    g = torch.Generator().manual_seed(0)
    root = torch.randn(5, 5, generator=g, dtype=torch.float64)
    matrix = root @ root.T + 0.1 * torch.eye(5)
    assert float(F.lmi_loss(matrix)) == pytest.approx(reference.minus_log_det(matrix.numpy()))
    assert torch.autograd.gradcheck(lambda r: F.lmi_loss(r @ r.T + 0.1 * torch.eye(5)), root.requires_grad_())


def test_lmi_loss_by_hand():
    assert float(F.lmi_loss(torch.diag(torch.tensor([4.0, 0.5, 1.0])))) == pytest.approx(-math.log(2.0))


def test_indefinite_matrix_with_positive_determinant_is_refused():
    matrix = torch.diag(torch.tensor([-1.0, -2.0, 3.0]))
    assert float(torch.linalg.det(matrix)) > 1  # the printed test -log det < 0 would pass
    with pytest.raises(NotPositiveDefiniteError, match="order 1"):
        F.lmi_loss(matrix)


def test_nan_matrix_is_refused():
    with pytest.raises(NotPositiveDefiniteError):
        F.lmi_loss(torch.full((2, 2), math.nan))


# --- margins and radii ------------------------------------------------------------------------------------------------


def test_margins_by_hand():
    assert F.safety_margin(2.0, 0.1, mode="paper") == pytest.approx((0.2, 0.2, 0.2))
    assert F.safety_margin(2.0, 0.1, closed_loop_lipschitz=1.5) == pytest.approx((0.2, 0.2, 0.5))
    assert F.dynamics_margin(2.0, 0.25) == 0.5


def test_sound_margin_is_never_below_the_paper_s():
    for closed in (0.0, 0.5, 3.0):
        sound, paper = F.safety_margin(2.0, 0.1, closed_loop_lipschitz=closed), F.safety_margin(2.0, 0.1, mode="paper")
        assert all(a >= b for a, b in zip(sound, paper, strict=True))


def test_sound_margin_asks_for_the_closed_loop():
    with pytest.raises(ConfigError, match="closed_loop_lipschitz"):
        F.safety_margin(2.0, 0.1)
    with pytest.raises(ConfigError, match="'sund'"):
        F.safety_margin(2.0, 0.1, mode="sund")


def test_sound_margin_carries_the_condition_from_samples_to_their_neighbourhood():
    # B(z) = 2 z, closed loop z -> -3 z: q3 = B(-3 z) - B(z) = -8 z has the constant 2 (3 + 1).
    margin = F.safety_margin(2.0, 0.1, closed_loop_lipschitz=3.0).q3
    change = abs(-8 * 0.5 + 8 * 0.4)
    assert change <= margin + 1e-12
    assert change > F.safety_margin(2.0, 0.1, mode="paper").q3


@quick
@given(st.integers(1, 9), st.integers(1, 9), st.integers(1, 4))
def test_covering_radius_equals_the_reference(n, m, chunk):
    g = torch.Generator().manual_seed(n + 10 * m)
    points, samples = torch.randn(n, 2, generator=g), torch.randn(m, 2, generator=g)
    expected = reference.covering_radius(points.tolist(), samples.tolist())
    assert F.covering_radius(points, samples, chunk=chunk) == pytest.approx(expected, rel=1e-4, abs=1e-5)


def test_covering_radius_quantile_and_empty():
    points = torch.linspace(0, 1, 101)[:, None]
    assert F.covering_radius(points, torch.zeros(1, 1), quantile=0.5) == pytest.approx(0.5)
    for a, b in ((points[:0], points), (points, points[:0])):
        with pytest.raises(EmptyRegionError, match="received"):
            F.covering_radius(a, b)

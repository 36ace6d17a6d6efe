"""Sets and labels: borders, circles, differences, and what is refused."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_sspl.errors import ConfigError, EmptyRegionError, NonFiniteError, OverlapError, ShapeError
from torchrl_sspl.evaluation.known import states_where
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE, Box, Difference, Mixture, Region, Union, check_disjoint, label

quick = settings(max_examples=40, deadline=None, derandomize=True)
TURN = 2 * math.pi


def contains(region: Region, *states: float, dtype=torch.float32) -> list[bool]:
    return region.contains(torch.tensor(states, dtype=dtype)[:, None]).tolist()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_box_is_closed(dtype):
    assert contains(Box([-1.0], [2.0]), -1.0, 2.0, -1.001, 2.001, dtype=dtype) == [True, True, False, False]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_both_ends_of_the_circle_belong_to_the_full_turn(dtype):
    circle = Box([-math.pi], [math.pi], period=[TURN])
    assert all(contains(circle, -math.pi, math.pi, -3 * math.pi, 3 * math.pi, 0.0, dtype=dtype))


def test_arc_that_ends_at_pi_holds_both_names_of_its_end():
    assert contains(Box([2.0], [math.pi], period=[TURN]), -math.pi, math.pi, 2.0, -2.0, 1.9) == [
        True, True, True, False, False,
    ]


def test_rounding_of_a_turn_does_not_push_an_end_out():
    arc = Box([-1.0], [1.0], period=[TURN])
    ends = [end + turns * TURN for end in (-1.0, 1.0) for turns in range(-20, 21)]
    assert all(contains(arc, *ends))


def test_arc_across_pi_is_one_piece():
    assert contains(Box([3.0], [3.5], period=[TURN]), 3.1, -3.1, -math.pi, 3.5 - TURN, -2.7, 2.9) == [
        True, True, True, True, False, False,
    ]


@quick
@given(st.floats(-3, 3), st.integers(-5, 5))
def test_membership_does_not_change_with_whole_turns(angle, turns):
    arc = Box([-1.0], [1.0], period=[TURN])
    if abs(abs(angle) - 1.0) > 1e-3:
        assert contains(arc, angle + turns * TURN) == [abs(angle) < 1.0]


def test_components_without_a_period_do_not_wrap():
    box = Box([-1.0, -1.0], [1.0, 1.0], period=[TURN, None])
    assert box.contains(torch.tensor([[TURN, 0.0], [0.0, TURN]])).tolist() == [True, False]


@pytest.mark.parametrize("batch", [(), (0,), (2, 3)])
def test_every_batch_shape_is_kept(batch):
    box, other = Box([-1.0, -1.0], [1.0, 1.0]), Box([3.0, 3.0], [4.0, 4.0])
    states = torch.zeros(*batch, 2)
    for region in (box, box - other, box | other):
        found = region.contains(states)
        assert found.shape == batch
        assert found.dtype == torch.bool
    assert label(states, box, other).shape == (*batch, 1)


def test_samples_belong_to_their_set_and_are_reproducible():
    box, hole = Box([-2.0, 0.0], [2.0, 1.0]), Box([-1.0, 0.0], [1.0, 1.0])
    for region in (box, box - hole, Union(hole, Box([5.0, 5.0], [6.0, 6.0]))):
        first, second = (region.sample(500, torch.Generator().manual_seed(1)) for _ in range(2))
        assert first.shape == (500, 2)
        assert bool(region.contains(first).all())
        assert torch.equal(first, second)
        assert region.sample(0).shape == (0, 2)


def test_samples_of_a_box_fill_it():
    x = Box([-2.0], [4.0]).sample(4000, torch.Generator().manual_seed(0))
    assert float(x.mean()) == pytest.approx(1.0, abs=0.15)
    assert float(x.min()) < -1.95
    assert float(x.max()) > 3.95


@quick
@given(st.lists(st.floats(-3, 3, width=32), min_size=1, max_size=10))
def test_operators_are_set_operations(values):
    a, b = Box([-2.0], [1.0]), Box([-1.0], [2.0])
    in_a, in_b = contains(a, *values), contains(b, *values)
    assert contains(a - b, *values) == [x and not y for x, y in zip(in_a, in_b, strict=True)]
    assert contains(a | b, *values) == [x or y for x, y in zip(in_a, in_b, strict=True)]
    assert isinstance(a - b, Difference)
    assert isinstance(a | b, Union)


def test_grid_holds_the_corners_last_component_fastest():
    assert Box([0.0, 0.0], [1.0, 4.0]).grid([2, 3]).tolist() == [[0, 0], [0, 2], [0, 4], [1, 0], [1, 2], [1, 4]]
    for sizes in ([2], [2, 0], 0):
        with pytest.raises(ConfigError, match="2 sizes"):
            Box([0.0, 0.0], [1.0, 4.0]).grid(sizes)


def test_labels_by_hand_and_unsafe_wins():
    safe, unsafe = Box([0.0], [1.0]), Box([0.9], [2.0])
    codes = label(torch.tensor([[0.5], [0.95], [1.5], [3.0]]), safe, unsafe)
    assert codes.dtype == torch.int64
    assert codes.flatten().tolist() == [SAFE, UNSAFE, UNSAFE, UNLABELLED] == [1, 2, 2, 0]


def test_nan_states_are_an_error():
    states = torch.tensor([[0.0], [math.nan]])
    box = Box([0.0], [1.0])
    for region in (box, Box([0.0], [1.0], period=[TURN]), box - Box([0.5], [0.6]), box | box):
        with pytest.raises(NonFiniteError, match="1 of 2 values NaN"):
            region.contains(states)


def test_infinite_states_are_outside():
    assert contains(Box([0.0], [1.0]), math.inf, -math.inf) == [False, False]


@pytest.mark.parametrize("shape", [(4, 3), (4,), ()])
def test_states_of_another_dimension_are_an_error(shape):
    with pytest.raises(ShapeError, match=r"\(\*batch, 2\)"):
        Box([0.0, 0.0], [1.0, 1.0]).contains(torch.zeros(shape))


@pytest.mark.parametrize(
    ("low", "high", "period"),
    [
        ([0.0], [0.0], None),
        ([1.0], [0.0], None),
        ([0.0], [1.0, 2.0], None),
        ([math.nan], [1.0], None),
        ([0.0], [math.inf], None),
        ([0.0], [1.0], [1.0, 1.0]),
        ([0.0], [1.0], [-1.0]),
        (0.0, 1.0, None),
    ],
)
def test_boxes_that_make_no_sense_are_an_error(low, high, period):
    with pytest.raises(ConfigError, match="expected"):
        Box(low, high, period)


def test_sets_of_different_dimensions_do_not_combine():
    a, b = Box([0.0], [1.0]), Box([0.0, 0.0], [1.0, 1.0])
    for combine in (lambda: a - b, lambda: a | b):
        with pytest.raises(ShapeError, match=r"\[1, 2\]"):
            combine()
    with pytest.raises(ConfigError, match="at least one"):
        Union()


def test_empty_difference_has_no_samples():
    empty = Box([0.0], [1.0]) - Box([-1.0], [2.0])
    assert contains(empty, 0.5) == [False]
    with pytest.raises(EmptyRegionError, match="received 0 states"):
        empty.sample(1)


def test_sets_that_share_states_are_an_error_and_touching_ones_are_not():
    check_disjoint(Box([0.0], [1.0]), Box([1.0], [2.0]))
    with pytest.raises(OverlapError, match="safe samples in the unsafe set"):
        check_disjoint(Box([0.0], [1.0]), Box([0.9], [2.0]))
    with pytest.raises(OverlapError):  # a small set inside a large one is seen from the small one
        check_disjoint(Box([-1e4], [1e4]), Box([0.0], [1e-3]))


def shares(region: Region, drawn: torch.Tensor) -> list[float]:
    return [float(part.contains(drawn).float().mean()) for part in region.parts]


def test_a_mixture_draws_from_its_parts_in_their_shares():
    parts = [Box([k], [k + 0.5]) for k in range(3)]
    mixture = Mixture(parts, [1.0, 0.0, 3.0])
    drawn = mixture.sample(4000, torch.Generator().manual_seed(0))
    assert drawn.shape == (4000, 1)
    assert shares(mixture, drawn) == pytest.approx([0.25, 0.75], abs=0.02)
    assert not parts[1].contains(drawn).any()
    low, high = Mixture(parts, [2, 0, 6]), mixture  # only their ratio counts
    g = torch.Generator()
    assert torch.equal(low.sample(50, g.manual_seed(1)), high.sample(50, g.manual_seed(1)))


def test_a_mixture_is_the_union_of_what_it_draws_from():
    mixture = Mixture([Box([0.0], [1.0]), Box([2.0], [3.0]), Box([4.0], [5.0])], [1, 1, 0])
    assert contains(mixture, 0.5, 1.5, 2.5, 4.5) == [True, False, True, False]
    assert mixture.dim == 1


def test_overlapping_parts_are_not_drawn_apart():
    """Half of the states anywhere, half in a small part: S is seen often, and nothing else is left out."""
    everywhere, small = Box([0.0], [1.0]), Box([0.0], [0.1])
    drawn = Mixture([everywhere, small], [0.5, 0.5]).sample(6000, torch.Generator().manual_seed(0))
    assert float(small.contains(drawn).float().mean()) == pytest.approx(0.55, abs=0.02)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_a_mixture_gives_exactly_as_many_states_as_asked_for(n):
    assert Mixture([Box([0.0], [1.0]), Box([2.0], [3.0])], [1, 1]).sample(n, torch.Generator().manual_seed(0)).shape == (n, 1)


def test_the_same_seed_gives_the_same_mixture():
    mixture, g = Mixture([Box([0.0], [1.0]), Box([2.0], [3.0])], [1, 2]), torch.Generator()
    assert torch.equal(mixture.sample(20, g.manual_seed(4)), mixture.sample(20, g.manual_seed(4)))
    assert not torch.equal(mixture.sample(20, g.manual_seed(4)), mixture.sample(20, g.manual_seed(5)))


@pytest.mark.parametrize("wrong", [[1.0], [1.0, -0.1], [0.0, 0.0], [1.0, 2.0, 3.0], []])
def test_shares_that_make_no_sense_are_an_error(wrong):
    with pytest.raises(ConfigError, match="one share >= 0 for each of 2 regions"):
        Mixture([Box([0.0], [1.0]), Box([2.0], [3.0])], wrong)


def test_a_union_has_the_box_around_its_parts():
    both = Box([0.0, -1.0], [1.0, 0.0]) | Box([2.0, -3.0], [3.0, -2.0])
    assert both.low.tolist() == [0.0, -3.0]
    assert both.high.tolist() == [3.0, 0.0]


def test_the_first_of_many_samples_are_samples_whatever_a_union_groups():
    left, right = Box([0.0], [1.0]), Box([2.0], [3.0])
    for region in (left | right, Mixture([left, right], [0.5, 0.5])):
        found = (region - Box([0.9], [1.0])).sample(400, torch.Generator().manual_seed(0))
        assert 0.4 < float(right.contains(found).float().mean()) < 0.6
        found = states_where(lambda state: state[:, 0] < 9.0, region, 400, torch.Generator().manual_seed(0))
        assert 0.4 < float(right.contains(found).float().mean()) < 0.6
        grouped = right.contains(region.sample(400, torch.Generator().manual_seed(0)))
        assert bool((grouped.int().diff() >= 0).all())

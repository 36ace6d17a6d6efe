"""Figures show what they are given: lines where the data have them, areas where the sets are, typed errors else."""

from __future__ import annotations

import json
import math
import sys

import numpy as np
import pytest
import torch
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb
from matplotlib.contour import QuadContourSet
from matplotlib.quiver import Quiver

from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import CheckpointError, ConfigError, MissingDependencyError, NonFiniteError, ShapeError
from torchrl_sspl.sets import Box
from torchrl_sspl.viz import Plane, frames, latent_space, read_log, state_plane, training_curves, trajectories
from torchrl_sspl.viz.plane import SAFE_FILL, UNSAFE_FILL


def lines(axes):
    return [c for c in axes.collections if isinstance(c, QuadContourSet) and not c.filled]


def labels(figure):
    return [t.get_text() for t in figure.legends[0].get_texts()]


def test_zero_level_lies_on_the_true_circle(plane, grid, disk):
    (line,) = lines(state_plane(plane, grid, disk).axes[0])
    radius = np.linalg.norm(line.get_paths()[0].vertices, axis=1)
    np.testing.assert_allclose(radius, 1.0, atol=0.01)


def test_kernel_gets_a_line_of_its_own(plane, grid, disk):
    viable = grid.norm(dim=-1) < 1.3
    figure = state_plane(plane, grid, disk, viable=viable)
    assert len(lines(figure.axes[0])) == 2
    assert {"B = 0", "true viability kernel", "S", "U"} <= set(labels(figure))
    smooth = lines(state_plane(plane, grid, disk, viable=1.3 - grid.norm(dim=-1)).axes[0])[0]
    np.testing.assert_allclose(np.linalg.norm(smooth.get_paths()[0].vertices, axis=1), 1.3, atol=0.01)


def test_empty_set_has_no_line_and_says_so(plane, grid):
    axes = state_plane(plane, grid, torch.ones(len(grid))).axes[0]
    assert lines(axes) == []
    assert axes.get_title() == "B \u2264 0 nowhere"


def test_areas_are_where_the_sets_are(plane, grid, disk):
    axes = state_plane(plane, grid, disk).axes[0]
    image = axes.images[0].get_array()
    n = len(image)
    np.testing.assert_allclose(image[n // 2, n // 2], to_rgb(SAFE_FILL))
    np.testing.assert_allclose(image[2, n // 2], to_rgb(UNSAFE_FILL))
    np.testing.assert_allclose(image[n // 2, round(0.7 * n)], 1.0)
    assert (image == np.array(to_rgb(SAFE_FILL))).all(-1).mean() == pytest.approx(0.01, rel=0.05)


def test_order_of_the_grid_does_not_matter(plane, grid, disk):
    order = torch.randperm(len(grid), generator=torch.Generator().manual_seed(0))
    _, _, straight = plane.grid(grid, {"b": disk})
    _, _, mixed = plane.grid(grid[order], {"b": disk[order]})
    np.testing.assert_array_equal(straight["b"], mixed["b"])


def test_other_coordinates_are_reduced_to_the_worst_or_fixed():
    box = Box([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0])
    states = box.grid([5, 4, 3])
    plane = Plane(("x", "y"), [-1] * 3, [1] * 3)
    value, member = states[:, 0] + 10 * states[:, 2], states[:, 2] > -2 + states[:, 1]
    x, y, worst = plane.grid(states, {"b": value, "m": member})
    assert worst["b"].shape == (4, 5)
    np.testing.assert_allclose(worst["b"][0], x + 10)
    np.testing.assert_array_equal(worst["m"][:, 0], y < 1)
    _, _, best = plane.grid(states, {"b": value, "m": member}, "min")
    np.testing.assert_allclose(best["b"][0], x - 10)
    assert best["m"].all()
    _, _, cut = Plane(("x", "y"), [-1] * 3, [1] * 3, fixed={2: 0.1}).grid(states, {"b": value})
    np.testing.assert_allclose(cut["b"][0], x)


def test_captions_say_at_which_values_of_the_other_coordinates_a_line_holds(plane, grid, disk):
    states = Box([-1.0] * 3, [1.0] * 3).grid([5, 4, 3])
    solid, value = Plane(("x", "y"), [-1] * 3, [1] * 3), states.norm(dim=-1) - 1.2
    cut = Plane(("x", "y"), [-1] * 3, [1] * 3, fixed={2: 0.0})
    assert "at every value of the coordinates that are not shown" in state_plane(solid, states, value).get_label()
    assert "at some values of the coordinates that are not shown" in state_plane(solid, states, value, reduce="min").get_label()
    paths = torch.zeros(3, 1, 3), torch.zeros(2, 1, 1)
    assert "at every value" in trajectories(solid, *paths, background=(states, value)).get_label()
    for figure in (state_plane(plane, grid, disk), state_plane(cut, states, value), trajectories(solid, *paths)):
        assert "not shown" not in figure.get_label()


def test_swapped_coordinates_swap_the_axes(grid):
    swapped = Plane(("y", "x"), [-2, -2], [2, 2], coords=(1, 0))
    _, _, table = swapped.grid(grid, {"b": grid[:, 0]})
    assert (np.diff(table["b"], axis=0) > 0).all()


def test_sampled_points_are_drawn_per_region_and_thinned(plane, grid, disk):
    points = torch.rand(900, 2) - 0.5
    codes = torch.arange(900).remainder(3)[:, None]
    axes = state_plane(plane, grid, disk, points=points, region=codes, max_points=50).axes[0]
    drawn = [c for c in axes.collections if type(c) is PathCollection]
    assert sorted(len(c.get_offsets()) for c in drawn) == [50, 50, 50]


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        (lambda s, b: (s[:-1], b[:-1]), ShapeError, "regular grid"),
        (lambda s, b: (s[:, :1], b), ShapeError, r"\(n, 2\)"),
        (lambda s, b: (s, b[:-1]), ShapeError, "barrier"),
        (lambda s, b: (s, b * math.nan), NonFiniteError, "barrier"),
    ],
)
def test_state_plane_rejects_what_is_no_grid(plane, grid, disk, change, error, text):
    states, barrier = change(grid, disk)
    with pytest.raises(error, match=text):
        state_plane(plane, states, barrier)


@pytest.mark.parametrize(
    "arguments",
    [dict(coords=(0, 0)), dict(coords=(0, 2)), dict(period=[1.0]), dict(low=[1, 1]), dict(low=[0, 0, 0])],
)
def test_plane_rejects_wrong_coordinates_and_ranges(arguments):
    with pytest.raises(ConfigError):
        Plane(**{"names": ("a", "b"), "low": [-1, -1], "high": [1, 1], **arguments})


def test_plane_of_the_pendulum_knows_period_and_sets():
    plane = Plane.of(PendulumEnv(seed=0), ("angle", "speed"))
    assert plane.period == pytest.approx([2 * math.pi, 0.0])
    path = plane.unwrap_breaks(np.array([[3.0, 0.0], [3.1, 0.0], [-3.1, 0.0], [-3.0, 0.0]]))
    assert np.isnan(path[2]).all()
    assert len(path) == 5


@pytest.mark.parametrize(("p", "panels"), [(2, 2), (3, 2), (6, 1)])
def test_latent_space_of_any_dimension(p, panels):
    z = torch.rand(300, p, generator=torch.Generator().manual_seed(0)) * 2 - 1
    codes = torch.arange(300).remainder(3)
    figure = latent_space(z, codes, lambda z: z.norm(dim=-1, keepdim=True) - 0.7, near=0.1)
    assert len(figure.axes) == panels
    assert {"buffer", "safe (S)", "unsafe (U)"} <= set(labels(figure))
    assert figure.get_label()
    if p == 2:
        (line,) = lines(figure.axes[0])
        np.testing.assert_allclose(np.linalg.norm(line.get_paths()[0].vertices, axis=1), 0.7, atol=0.01)
    else:
        assert "|B| \u2264 0.1" in labels(figure)


@pytest.mark.parametrize(
    ("latent", "codes", "error"),
    [
        (torch.zeros(4, 1), torch.zeros(4), ShapeError),
        (torch.zeros(4), torch.zeros(4), ShapeError),
        (torch.zeros(4, 2), torch.zeros(3), ShapeError),
        (torch.zeros(4, 2), torch.full((4,), 7), ConfigError),
        (torch.full((4, 2), math.inf), torch.zeros(4), NonFiniteError),
    ],
)
def test_latent_space_rejects_wrong_input(latent, codes, error):
    with pytest.raises(error):
        latent_space(latent, codes)


def test_arrows_have_the_size_of_the_action(plane):
    t = torch.linspace(0, 1, 31)
    states = torch.stack([-1 + 2 * t, 0 * t], -1)[:, None]
    actions = torch.linspace(0, 4, 30)[:, None, None]
    figure = trajectories(plane, states, actions, torch.zeros(31, 1), arrows=10)
    (arrows,) = [c for c in figure.axes[0].collections if isinstance(c, Quiver)]
    step = np.round((arrows.X + 1) / 2 * 30).astype(int)
    assert 5 <= len(step) <= 11
    assert step[0] == 0
    np.testing.assert_allclose(arrows.U, 0.13 * actions[step, 0, 0].numpy(), rtol=1e-5)
    np.testing.assert_allclose(arrows.V, 0.0, atol=1e-9)
    figure = trajectories(plane, states, -actions, action_direction=(0.0, 1.0))
    (arrows,) = [c for c in figure.axes[0].collections if isinstance(c, Quiver)]
    assert (arrows.V[1:] < 0).all()
    assert len(figure.axes) == 2


def test_trajectories_choose_starts_far_apart_and_show_what_leaves_the_space(plane):
    states = torch.zeros(6, 50, 2)
    states[:, :, 0] = torch.linspace(-1, 1, 50)
    states[-1, 0, 1] = 5.0
    figure = trajectories(plane, states, torch.zeros(5, 50, 1), torch.zeros(6, 50), episodes=3)
    assert figure.axes[0].get_ylim()[1] > 5
    assert len(figure.axes[1].lines) == 3 + 1


@pytest.mark.parametrize(
    ("states", "actions", "barrier"),
    [
        (torch.zeros(5, 2), torch.zeros(4, 2, 1), None),
        (torch.zeros(5, 2, 3), torch.zeros(4, 2, 1), None),
        (torch.zeros(5, 2, 2), torch.zeros(5, 2, 1), None),
        (torch.zeros(5, 2, 2), torch.zeros(4, 2, 1), torch.zeros(4, 2)),
        (torch.zeros(1, 2, 2), torch.zeros(0, 2, 1), None),
    ],
)
def test_trajectories_reject_wrong_shapes(plane, states, actions, barrier):
    with pytest.raises(ShapeError):
        trajectories(plane, states, actions, barrier)


def test_frames_show_the_observed_pictures():
    env = PendulumEnv(seed=0, image_size=32)
    states = torch.tensor([[0.0, 0.0], [1.0, 2.0]])
    figure = frames(env, states, captions=["up", "moving"])
    pixels = env.observe(states)
    shown = [ax.images[0].get_array() for ax in figure.axes]
    np.testing.assert_array_equal(shown[1], pixels[1, :3].permute(1, 2, 0))
    np.testing.assert_array_equal(shown[3], pixels[1, 3:].permute(1, 2, 0))
    assert figure.axes[1].get_title() == "moving"
    with pytest.raises(ShapeError, match="captions"):
        frames(env, states, captions=["one"])
    with pytest.raises(ShapeError, match="1 to 12"):
        frames(env, torch.zeros(13, 2))


def write_log(path, rows, rest=""):
    path.write_text("".join(json.dumps(r) + "\n" for r in rows) + rest)
    return path


def test_training_curves_follow_phases_and_rounds(tmp_path):
    rows = [{"phase": "fit", "round": k, "step": s, "loss_a": 1 / s, "loss_b": 0.0} for k in (0, 1) for s in (10, 20)]
    rows += [{"phase": "check", "round": 0, "step": 0, "size": 0.4, "returned": 1.0, "passed": True}]
    figure = training_curves(write_log(tmp_path / "log.jsonl", rows))
    fit, check = figure.axes
    assert [fit.get_title(), check.get_title()] == ["fit", "check"]
    curve = next(line for line in fit.lines if line.get_label() == "a")
    np.testing.assert_allclose(curve.get_xdata(), [10, 20, 30, 40])
    assert "b (0)" in [t.get_text() for t in fit.get_legend().get_texts()]
    assert fit.get_yscale() == "log"


def test_log_cut_short_is_read_up_to_the_cut(tmp_path):
    row = {"phase": "fit", "round": 0, "step": 1, "loss": 1.0}
    assert len(read_log(write_log(tmp_path / "log.jsonl", [row, row], '{"phase": "fi'))) == 2


@pytest.mark.parametrize("text", ["", "no json\n", '{"a": 1}\n', 'broken\n{"phase": "fit", "round": 0, "step": 1}\n'])
def test_what_is_no_log_is_refused(tmp_path, text):
    (tmp_path / "log.jsonl").write_text(text)
    with pytest.raises(CheckpointError, match=r"log\.jsonl"):
        training_curves(tmp_path / "log.jsonl")
    with pytest.raises(CheckpointError, match="no file"):
        training_curves(tmp_path / "other.jsonl")


def test_without_matplotlib_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingDependencyError, match=r"torchrl-sspl\[viz\]"):
        latent_space(torch.zeros(4, 2), torch.zeros(4))


def test_figures_leave_pyplot_alone(plane, grid, disk):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    before = pyplot.get_fignums()
    state_plane(plane, grid, disk)
    assert pyplot.get_fignums() == before


def test_an_arrow_of_full_length_is_the_largest_of_those_that_are_drawn(plane):
    states, actions = torch.zeros(4, 3, 2), torch.ones(3, 3, 1)
    actions[:, 0], actions[2, 1] = 9.0, 5.0  # not drawn: another episode, and a step after the end of this one
    states[:, 1:] = torch.tensor([[-1.0, 0.0], [1.0, 0.0]])
    drawn = trajectories(plane, states[:, 1:], actions[:, 1:], lengths=[2, 3])
    assert "an arrow of full length is 1 (action)" in drawn.get_label()
    assert "an arrow of full length is 9 (action)" in trajectories(plane, states, actions).get_label()

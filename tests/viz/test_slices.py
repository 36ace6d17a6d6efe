"""Slices of a space of three coordinates, and paths in full physics."""

from __future__ import annotations

import math

import pytest
import torch

pytest.importorskip("matplotlib")

from torchrl_sspl.envs import CMUDubinsEnv, DubinsEnv
from torchrl_sspl.errors import ConfigError, NonFiniteError, ShapeError
from torchrl_sspl.viz import Plane, slices, walks


@pytest.fixture(scope="module")
def plane():
    env = DubinsEnv(image_size=32)
    return Plane.of(env, env.system.state_names[:2])


def straight(n: int = 2):
    """n walks along y of four poses each."""
    return torch.tensor([[[-1.5 + k, 0.1 * t, 0.0] for k in range(n)] for t in range(4)])


def test_every_heading_shows_its_own_level(plane):
    states = DubinsEnv(image_size=32).state_space.grid([21, 21, 9])
    # Safe on the side to which the robot heads.
    barrier = -(states[:, 0] * states[:, 2].cos() + states[:, 1] * states[:, 2].sin()) - 1.0
    figure = slices(plane, states, barrier, -barrier, values=[0.0, math.pi])
    edges = [ax.collections[0].get_paths()[0].vertices[:, 0].mean() for ax in figure.axes]
    assert edges[0] == pytest.approx(-1.0, abs=0.05)
    assert edges[1] == pytest.approx(1.0, abs=0.05)
    assert "kernel" in figure.get_label()
    assert [ax.get_title() for ax in figure.axes] == ["heading 0°", "heading 180°"]


def test_a_third_coordinate_that_is_no_direction_has_no_arrow(plane):
    states = DubinsEnv(image_size=32).state_space.grid([5, 5, 5])
    with_arrows, without = (slices(plane, states, states[:, 0], arrows=a, name="phase [rad]") for a in (True, False))
    assert [len(f.axes[0].patches) for f in (with_arrows, without)] == [1, 0]
    assert "arrow" not in without.get_label()


def test_walks_that_went_wrong_are_drawn_first_and_counted(plane):
    alive = torch.ones(4, 2, dtype=torch.bool)
    figure = walks(plane, straight(), alive, torch.tensor([False, True]), limit=1)
    assert figure.get_label().startswith("1 of 2, those that went wrong first: walks in full physics")
    assert walks(plane, straight(), alive, torch.zeros(2)).get_label().startswith("2: walks in full physics")
    assert walks(plane, straight(), alive, torch.zeros(2), limit=1, caption="Paths").get_label() == "1 of 2: Paths"
    assert any("went wrong (1)" in text.get_text() for text in figure.legends[0].get_texts())
    with pytest.raises(ConfigError, match="walks"):
        walks(plane, torch.zeros(4, 0, 3), torch.zeros(4, 0, dtype=torch.bool), torch.zeros(0))


def test_a_walk_ends_where_it_is_no_longer_alive(plane):
    states, alive = straight(3), torch.ones(4, 3, dtype=torch.bool)
    alive[2:, 1] = False
    states[2:, 1] = float("nan")  # means nothing
    figure = walks(plane, states, alive, torch.tensor([True, False, True]))
    lines = [line for line in figure.axes[0].lines if len(line.get_xdata()) > 1]
    assert [len(line.get_xdata()) for line in lines] == [4, 4, 2]
    assert [line.get_color() for line in lines].count("#c8372d") == 2
    states[0, 0] = float("nan")
    with pytest.raises(NonFiniteError, match="states"):
        walks(plane, states, alive, torch.zeros(3))
    with pytest.raises(ShapeError, match="wrong"):
        walks(plane, straight(3), alive, torch.zeros(2))


def test_a_set_that_depends_on_the_heading_is_said_to_be_drawn_at_one():
    names, env = ("x [m]", "y [m]"), CMUDubinsEnv(image_size=32)
    labels = [[h.get_label() for h in Plane.of(e, names, fixed=fixed).set_handles()] for e, fixed in ((env, {}), (env, {2: 1.0}), (DubinsEnv(image_size=32), {}))]
    assert labels == [["S (rest mid-range)", "U", "obstacle"], ["S", "U", "obstacle"], ["S", "U", "obstacle"]]

"""Figures, film and report of the quadruped."""

from __future__ import annotations

import math

import pytest
import torch

pytest.importorskip("matplotlib")

from torchrl_sspl.envs.dubins import DubinsEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.trainers.quadruped import Walk
from torchrl_sspl.viz.plane import Plane
from torchrl_sspl.viz.quadruped import AXES, film_of_walk, headings_figure, walks_figure


@pytest.fixture(scope="module")
def plane():
    return Plane.of(DubinsEnv(image_size=32), AXES)


def a_walk(*, entered: bool = False, frames: bool = False) -> Walk:
    poses = torch.tensor([[-1.5, 0.1 * k, 0.0] for k in range(4)])
    pictures = torch.zeros(4, 3, 32, 32, dtype=torch.uint8) if frames else None
    return Walk(poses, torch.zeros(3, 1), torch.zeros(4), entered, False, False, False, pictures)


def test_every_heading_shows_its_own_level(plane):
    states = DubinsEnv(image_size=32).state_space.grid([21, 21, 9])
    # Safe on the side to which the robot heads.
    barrier = -(states[:, 0] * states[:, 2].cos() + states[:, 1] * states[:, 2].sin()) - 1.0
    figure = headings_figure(plane, states, barrier, -barrier, headings=[0.0, math.pi])
    edges = [ax.collections[0].get_paths()[0].vertices[:, 0].mean() for ax in figure.axes]
    assert edges[0] == pytest.approx(-1.0, abs=0.05)
    assert edges[1] == pytest.approx(1.0, abs=0.05)
    assert "kernel" in figure.get_label()


def test_walks_that_went_wrong_are_drawn_first_and_counted(plane):
    figure = walks_figure(plane, [a_walk(), a_walk(entered=True)], limit=1)
    assert "1 of 2" in figure.get_label()
    assert any("went wrong (1)" in text.get_text() for text in figure.legends[0].get_texts())
    with pytest.raises(ConfigError, match="walks"):
        walks_figure(plane, [])


def test_walks_of_different_lengths_and_fates_are_drawn_together(plane):
    short = a_walk()
    short.poses = short.poses[:2]
    figure = walks_figure(plane, [a_walk(entered=True), short, a_walk(entered=True)])
    colours = [line.get_color() for line in figure.axes[0].lines if len(line.get_xdata()) > 1]
    assert colours.count("#c8372d") == 2


def test_film_of_a_walk(plane, tmp_path):
    path = film_of_walk(a_walk(frames=True), tmp_path / "walk.gif", plane=plane)
    assert path.stat().st_size > 0
    with pytest.raises(ConfigError, match="frames"):
        film_of_walk(a_walk(), tmp_path / "walk.gif", plane=plane)
    with pytest.raises(ConfigError, match=r"\.mp4"):
        film_of_walk(a_walk(frames=True), tmp_path / "walk.png", plane=plane)

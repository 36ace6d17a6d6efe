"""A film shows every moment of its scenes, in a format that a browser plays."""

from __future__ import annotations

import importlib.util
import math
import subprocess

import numpy as np
import pytest
import torch
from PIL import Image

from torchrl_sspl.envs import CMUTwoDiscsEnv, DubinsEnv, PendulumEnv
from torchrl_sspl.errors import ConfigError, NonFiniteError, ShapeError
from torchrl_sspl.viz import Plane, Scene, Take, animate
from torchrl_sspl.viz.animation import _Drawing


@pytest.fixture
def env():
    return PendulumEnv(seed=0, image_size=32)


def pushed(env, n, *, torque=2.0, **changes):
    """Take of n pictures of a pendulum with a torque throughout."""
    states = [torch.tensor([[1.0, 0.0]])]
    for _ in range(n - 1):
        states.append(env.wrap(env.dynamics(states[-1], torch.tensor([[torque]]))))
    x = torch.cat(states)
    given = {
        "pictures": env.draw(x).permute(0, 2, 3, 1).numpy(), "said": [("inside", "good")] * n, "states": x,
        "values": torch.linspace(-0.5, 0.2, n), "seen": env.draw(x).permute(0, 2, 3, 1),
    }  # fmt: skip
    return Take("policy", **(given | changes))


def pages(path):
    with Image.open(path) as film:
        found = []
        for k in range(film.n_frames):
            film.seek(k)
            found.append((np.asarray(film.convert("RGB")), film.info["duration"]))
    return found


def test_the_last_picture_stays_for_a_second_and_all_others_differ(env, tmp_path):
    path = animate([Scene("A", [pushed(env, 4)])], tmp_path / "film.gif", plane=Plane.of(env), fps=5)
    found = pages(path)
    assert [p.shape for p, _ in found] == [(432, 768, 3)] * len(found)
    assert all((a != b).any() for (a, _), (b, _) in zip(found, found[1:], strict=False))
    assert sum(d for _, d in found) == (4 + 5) * 200
    assert found[-1][1] >= 1000


def test_scenes_follow_one_another(env, tmp_path):
    scenes = [Scene(name, [pushed(env, 2, torque=u)]) for name, u in (("A", 2.0), ("B", -2.0))]
    path = animate(scenes, tmp_path / "film.gif", plane=Plane.of(env), fps=1)
    assert sum(d for _, d in pages(path)) == 2 * 3 * 1000


def test_the_shorter_of_two_takes_stays_as_it_ended(env, tmp_path):
    long, short = pushed(env, 5), pushed(env, 2, torque=-2.0)
    alone = [p for p, _ in pages(animate([Scene("A", [short, long])], tmp_path / "two.gif", plane=Plane.of(env), fps=5))]
    left = [p[100:250, 10:230] for p in alone]  # the picture of the first take
    assert (left[0] != left[1]).any()
    assert all((left[1] == other).all() for other in left[2:5])
    right = [p[100:250, 250:470] for p in alone]
    assert all((a != b).any() for a, b in zip(right[:4], right[1:5], strict=True))


@pytest.mark.parametrize("claimed", [False, True])
def test_the_zero_level_is_that_at_the_heading_of_the_robot(tmp_path, claimed):
    car = DubinsEnv(image_size=32, seed=0)
    states = car.state_space.grid((9, 9, 9))
    level = states[:, 0] - states[:, 2]  # B = 0 where x is the heading
    level = level <= 0 if claimed else level
    shown = {}
    for heading in (-1.0, 1.0):
        x = torch.tensor([[0.0, 0.0, heading]]).repeat(2, 1)
        take = Take("policy", [np.zeros((8, 8, 3), np.uint8)] * 2, [("", "fair")] * 2, x)
        path = tmp_path / f"{heading}.gif"
        shown[heading] = pages(animate([Scene("A", [take])], path, plane=Plane.of(car), levels=(states, {"B": level}), fps=1))[0][0]
    different = (shown[-1.0] != shown[1.0]).any(-1)
    columns = different[:, 400:].any(0).nonzero()[0] + 400
    assert columns.max() - columns.min() > 80  # the line has moved by 2 m of 4


@pytest.mark.parametrize(("heading", "goal"), [(0.0, 0.0), (2.0, 0.3), (3.1, -0.6), (-3.1, 0.6), (0.5, 0.7)])  # the last beyond the grid
def test_the_zero_level_is_that_of_all_coordinates_that_are_not_shown(heading, goal):
    car = CMUTwoDiscsEnv(image_size=8)
    plane, states = Plane.of(car, car.system.state_names[:2]), car.state_space.grid((21, 7, 121, 3))
    level = states[:, 0] - 0.5 * states[:, 2].cos() - states[:, 3]
    take = Take("policy", [np.zeros((8, 8, 3), np.uint8)], [("", "fair")], torch.tensor([[0.0, 0.0, heading, goal]]))
    drawing = _Drawing(Scene("A", [take]), plane, (states, {"B": level}), "B", 1)
    next(drawing.images())
    assert "true state; line: B = 0 in its plane" in [axes.get_title() for axes in drawing.figure.axes]
    (line,) = drawing.levels[0].lines.get_segments()
    assert line[:, 0] == pytest.approx(0.5 * math.cos(heading) + min(goal, 0.6), abs=2e-3)


def test_mp4_has_the_asked_for_length_and_size(env, tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = animate([Scene("A", [pushed(env, 10)])], tmp_path / "sub" / "film.mp4", plane=Plane.of(env), fps=10)
    frames, seconds = ffmpeg.count_frames_and_secs(str(path))
    assert frames == 20
    assert seconds == pytest.approx(2.0, abs=0.11)
    told = subprocess.run([ffmpeg.get_ffmpeg_exe(), "-i", str(path)], capture_output=True, text=True, check=False)
    assert "768x432" in told.stderr
    assert "yuv420p" in told.stderr  # what browsers play
    assert b"ftyp" in path.read_bytes()[:16]
    with Image.open(tmp_path / "sub" / "film.jpg") as poster:  # shown before it begins
        assert poster.size == (768, 432)


def test_without_ffmpeg_the_film_becomes_a_gif(env, tmp_path, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n, *a: None if n == "imageio_ffmpeg" else find(n, *a))
    with pytest.warns(UserWarning, match="gif"):
        path = animate([Scene("A", [pushed(env, 1)])], tmp_path / "film.mp4", fps=1)
    assert path.suffix == ".gif"
    assert path.is_file()


def test_pictures_alone_make_a_film(env, tmp_path):
    take = pushed(env, 2, states=None, values=None, seen=None)
    assert animate([Scene("A", [take])], tmp_path / "film.gif", fps=1).stat().st_size > 0


@pytest.mark.parametrize(
    ("change", "name", "error"),
    [
        ({"states": torch.zeros(3, 3)}, "a.gif", ShapeError),
        ({"states": None}, "a.gif", ShapeError),
        ({"states": torch.full((3, 2), float("nan"))}, "a.gif", NonFiniteError),
        ({"said": []}, "a.gif", ShapeError),
        ({"values": torch.zeros(2)}, "a.gif", ShapeError),
        ({"seen": torch.zeros(3, 8, 8, 6)}, "a.gif", ShapeError),
        ({}, "a.avi", ConfigError),
    ],
)
def test_wrong_arguments_are_named(env, tmp_path, change, name, error):
    with pytest.raises(error):
        animate([Scene("A", [pushed(env, 3, **change)])], tmp_path / name, plane=Plane.of(env))
    assert not (tmp_path / name).exists()


def test_three_takes_are_refused(env, tmp_path):
    with pytest.raises(ShapeError, match="one or two"):
        animate([Scene("A", [pushed(env, 2)] * 3)], tmp_path / "a.gif")

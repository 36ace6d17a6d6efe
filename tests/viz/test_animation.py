"""A film shows every step of the episode, in a format that a browser plays."""

from __future__ import annotations

import importlib.util
import subprocess

import numpy as np
import pytest
import torch
from PIL import Image

from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import ConfigError, NonFiniteError, ShapeError
from torchrl_sspl.viz import Plane, animate


@pytest.fixture
def env():
    return PendulumEnv(seed=0, image_size=32)


def pushed(env, steps):
    """States, frames, barrier values and actions of an episode with 2 N m throughout."""
    states, actions = [torch.tensor([[1.0, 0.0]])], torch.full((steps, 1), 2.0)
    for action in actions:
        states.append(env.wrap(env.dynamics(states[-1], action[None])))
    x = torch.cat(states)
    return x, env.draw(x), torch.full((steps + 1,), -0.5), actions


def test_gif_has_one_picture_per_state_and_they_differ(env, tmp_path):
    path = animate(*pushed(env, 3), tmp_path / "film.gif", plane=Plane.of(env), fps=10)
    with Image.open(path) as film:
        assert film.n_frames == 4
        pictures = []
        for k in range(4):
            film.seek(k)
            pictures.append(np.asarray(film.convert("RGB")))
    assert pictures[0].shape == (432, 768, 3)
    assert all((a != b).any() for a, b in zip(pictures, pictures[1:], strict=False))


def test_mp4_has_the_asked_for_length_and_size(env, tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = animate(*pushed(env, 9), tmp_path / "sub" / "film.mp4", plane=Plane.of(env), fps=10)
    frames, seconds = ffmpeg.count_frames_and_secs(str(path))
    assert frames == 10
    assert seconds == pytest.approx(1.0, abs=0.11)
    told = subprocess.run([ffmpeg.get_ffmpeg_exe(), "-i", str(path)], capture_output=True, text=True, check=False)
    assert "768x432" in told.stderr
    assert "yuv420p" in told.stderr  # what browsers play
    assert b"ftyp" in path.read_bytes()[:16]


def test_without_ffmpeg_the_film_becomes_a_gif(env, tmp_path, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n, *a: None if n == "imageio_ffmpeg" else find(n, *a))
    with pytest.warns(UserWarning, match="gif"):
        path = animate(*pushed(env, 1), tmp_path / "film.mp4", plane=Plane.of(env))
    assert path.suffix == ".gif"
    assert path.is_file()


def test_without_a_barrier_the_action_is_shown(env, tmp_path):
    states, frames, _, actions = pushed(env, 2)
    path = animate(states, frames, None, actions, tmp_path / "film.gif", plane=Plane.of(env))
    assert path.stat().st_size > 0


@pytest.mark.parametrize(
    ("change", "name", "error"),
    [
        ({"states": torch.zeros(3, 3)}, "a.gif", ShapeError),
        ({"states": torch.full((3, 2), float("nan"))}, "a.gif", NonFiniteError),
        ({"actions": torch.zeros(0, 1), "states": torch.zeros(1, 2)}, "a.gif", ShapeError),
        ({"barrier": torch.zeros(2)}, "a.gif", ShapeError),
        ({"frames": torch.zeros(3, 6, 8, 8)}, "a.gif", ShapeError),
        ({}, "a.avi", ConfigError),
    ],
)
def test_wrong_arguments_are_named(env, tmp_path, change, name, error):
    states, frames, barrier, actions = pushed(env, 2)
    given = {"states": states, "frames": frames, "barrier": barrier, "actions": actions} | change
    with pytest.raises(error):
        animate(**given, path=tmp_path / name, plane=Plane.of(env))
    assert not (tmp_path / name).exists()

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
from torchrl_sspl.viz import animate


class Pusher:
    """An agent that always pushes with 2 N m and knows no danger."""

    def act(self, pixels):
        return torch.full((len(pixels), 1), 2.0), torch.full((len(pixels), 1), -0.5)


@pytest.fixture
def env():
    return PendulumEnv(seed=0, image_size=32)


def test_gif_has_one_picture_per_state_and_they_differ(env, tmp_path):
    path = animate(Pusher(), env, torch.tensor([1.0, 0.0]), 3, tmp_path / "film.gif", fps=10)
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
    path = animate(Pusher(), env, torch.tensor([[1.0, 0.0]]), 9, tmp_path / "sub" / "film.mp4", fps=10)
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
        path = animate(Pusher(), env, torch.tensor([1.0, 0.0]), 1, tmp_path / "film.mp4")
    assert path.suffix == ".gif"
    assert path.is_file()


@pytest.mark.parametrize(
    ("start", "steps", "name", "error"),
    [
        (torch.zeros(3), 2, "a.gif", ShapeError),
        (torch.tensor([0.0, float("nan")]), 2, "a.gif", NonFiniteError),
        (torch.zeros(2), 0, "a.gif", ConfigError),
        (torch.zeros(2), 2, "a.avi", ConfigError),
    ],
)
def test_wrong_arguments_are_named(env, tmp_path, start, steps, name, error):
    with pytest.raises(error):
        animate(Pusher(), env, start, steps, tmp_path / name)

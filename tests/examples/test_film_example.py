"""The example that films an agent."""

from __future__ import annotations

import pytest
from PIL import Image


@pytest.mark.slow  # a report's film is made of the same parts
def test_the_pendulum_is_filmed(program, tmp_path):
    assert program("film.py", "pendulum", str(tmp_path / "film.gif")) == 0
    with Image.open(tmp_path / "film.gif") as film:
        assert film.size == (768, 432)
        assert film.n_frames > 150

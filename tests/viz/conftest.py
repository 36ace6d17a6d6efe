"""A plane with a known barrier: a disk of radius 1 inside a box, and a turning pair of frames."""

from __future__ import annotations

import pytest
import torch

from torchrl_sspl.sets import Box
from torchrl_sspl.viz import Plane

SPACE = Box([-2.0, -2.0], [2.0, 2.0])


@pytest.fixture
def plane() -> Plane:
    inner = Box([-1.5, -1.5], [1.5, 1.5])
    return Plane(("x [m]", "y [m]"), [-2, -2], [2, 2], [], Box([-0.2, -0.2], [0.2, 0.2]), SPACE - inner)


@pytest.fixture
def grid() -> torch.Tensor:
    return SPACE.grid(41)


@pytest.fixture
def disk(grid: torch.Tensor) -> torch.Tensor:
    return grid.norm(dim=-1) - 1.0

"""The batched renderer against gymnasium's own picture."""

from __future__ import annotations

import math
import sys
import time

import pytest
import torch

from torchrl_sspl.envs.rendering import GymnasiumRenderer, PendulumRenderer, _picture_borders
from torchrl_sspl.errors import ConfigError, DTypeError, MissingDependencyError, NonFiniteError

pytest.importorskip("pygame")


@pytest.fixture(autouse=True, scope="module")
def _one_thread():
    """Small tensors on several threads cost more than they gain, above all on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def gymnasium_frames() -> tuple[torch.Tensor, torch.Tensor]:
    """Angles of more than a full turn, and gymnasium's frames of them."""
    angle = (torch.rand(300, generator=torch.Generator().manual_seed(0)) * 2 - 1) * 4
    return angle, GymnasiumRenderer(64)(angle)


def test_frames_agree_with_gymnasium(gymnasium_frames):
    angle, expected = gymnasium_frames
    error = (PendulumRenderer(64)(angle).int() - expected.int()).abs()
    assert error.float().mean() <= 0.03  # the requirement is 1
    assert error.max() <= 14  # the requirement is 24


def test_smooth_frames_stay_near_gymnasium(gymnasium_frames):
    angle, expected = gymnasium_frames
    error = (PendulumRenderer(64, snap=False)(angle).int() - expected.int()).abs()
    assert error.float().mean() <= 0.06
    assert error.max() <= 27


@pytest.mark.parametrize("size", [32, 48])
def test_other_sizes_agree_with_gymnasium(size):
    angle = (torch.rand(30, generator=torch.Generator().manual_seed(1)) * 2 - 1) * math.pi
    error = (PendulumRenderer(size)(angle).int() - GymnasiumRenderer(size)(angle).int()).abs()
    assert error.max() <= 24


@pytest.mark.slow
def test_frames_agree_with_gymnasium_at_a_thousand_angles():
    angle = (torch.rand(1000, generator=torch.Generator().manual_seed(2)) * 2 - 1) * math.pi
    error = (PendulumRenderer(64)(angle).int() - GymnasiumRenderer(64).draw(angle).int()).abs()
    assert error.float().mean() <= 1
    assert error.max() <= 24


def test_the_picture_is_the_right_way_round():
    up, left, down, right = PendulumRenderer(64)(torch.tensor([0.0, math.pi / 2, math.pi, -math.pi / 2]))
    rod = torch.tensor([204, 77, 77], dtype=torch.uint8)
    for frame, (row, column) in zip((up, left, down, right), ((20, 32), (32, 20), (44, 32), (32, 44)), strict=True):
        assert torch.equal(frame[:, row, column], rod)
        assert (frame[1] < 200).sum() < 80  # nothing but the rod is coloured
        assert (frame[:, 32, 32] < rod).all()  # the axle is darker than the rod


def test_every_rotation_draws_the_same_amount_of_rod():
    frames = PendulumRenderer(64, snap=False)(torch.linspace(0, 2 * math.pi, 200))
    area = (255 - frames[:, 1].float()).sum((-1, -2)) / 178
    assert (area - area.mean()).abs().max() < 0.01 * area.mean()


def test_smooth_frames_change_little_with_the_angle():
    angle = torch.linspace(-math.pi, math.pi, 2001)[:400]
    smooth = PendulumRenderer(64, snap=False)(angle).int().diff(dim=0).abs().amax((1, 2, 3))
    snapped = PendulumRenderer(64)(angle).int().diff(dim=0).abs().amax((1, 2, 3))
    assert smooth.max() <= 12  # 0.003 rad move the tip by 0.05 pixels
    assert snapped.max() > smooth.max()


def test_the_table_of_pictures_equals_gymnasium_drawing_anew():
    angle = (torch.rand(40, generator=torch.Generator().manual_seed(3)) * 2 - 1) * 7
    renderer = GymnasiumRenderer(64)
    assert torch.equal(renderer(angle), renderer.draw(angle))
    assert torch.equal(renderer(angle), renderer(angle.double()))


def test_the_table_knows_every_border_between_pictures():
    borders = _picture_borders()
    middle = (borders[:-1] + borders[1:]) / 2
    renderer = PendulumRenderer(64)
    corners = torch.cat([c.reshape(len(middle), -1) for c in renderer._corners(middle)], dim=1)
    assert (corners[1:] != corners[:-1]).any(1).all()
    near = torch.cat([c.reshape(len(middle), -1) for c in renderer._corners(borders[:-1] + 1e-9)], dim=1)
    assert torch.equal(near, corners)


def test_drawing_is_much_faster_than_gymnasium():
    """At least 100 times, measured in the benchmark; here 40 times, to leave room for a busy machine."""
    angle = torch.linspace(-3, 3, 256)
    renderer, slow = PendulumRenderer(64), GymnasiumRenderer(64)
    renderer(angle)
    slow.draw(angle[:2])

    def fastest(call, n):
        times = []
        for _ in range(3):
            start = time.perf_counter()
            call()
            times.append((time.perf_counter() - start) / n)
        return min(times)

    assert fastest(lambda: slow.draw(angle[:20]), 20) > 40 * fastest(lambda: renderer(angle), 256)


def test_batch_shapes_are_kept_and_chunks_do_not_matter():
    renderer = PendulumRenderer(32)
    angle = torch.linspace(-3, 3, 300)
    frames = renderer(angle)
    assert renderer(angle.reshape(3, 100)).shape == (3, 100, 3, 32, 32)
    assert torch.equal(renderer(angle.reshape(3, 100)).flatten(0, 1), frames)
    assert torch.equal(torch.cat([renderer(a) for a in angle.split(7)]), frames)
    assert renderer(angle[:0]).shape == (0, 3, 32, 32)


def test_bad_input_is_named():
    with pytest.raises(NonFiniteError, match="received 1 of 2"):
        PendulumRenderer()(torch.tensor([0.0, float("nan")]))
    with pytest.raises(DTypeError, match="int64"):
        PendulumRenderer()(torch.tensor([0]))
    with pytest.raises(ConfigError, match="image_size"):
        PendulumRenderer(4)


def test_a_missing_pygame_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    monkeypatch.delitem(sys.modules, "pygame.gfxdraw", raising=False)
    with pytest.raises(MissingDependencyError, match="pip install"):
        GymnasiumRenderer()

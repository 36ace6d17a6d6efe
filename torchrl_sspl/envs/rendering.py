"""Batched pictures of the pendulum: gymnasium's own Pendulum-v1 frame, computed in closed form with torch."""

from __future__ import annotations

import math
import os

import torch
from torch import Tensor

from torchrl_sspl.devices import usable_device
from torchrl_sspl.errors import ConfigError, DTypeError, MissingDependencyError, NonFiniteError

# The scene of gymnasium's Pendulum-v1, in pixels of its 500 x 500 screen, before the final vertical flip.
_SCREEN = 500
_ROD = _SCREEN / 4.4  # rod length: one metre on a screen that shows 4.4 m
_HALF_WIDTH = 0.1 * _ROD
_CENTRE = _SCREEN // 2
_CAP_RADIUS = 11.5  # integer radius 11, plus the half pixel by which a filled circle covers its border
_AXLE_RADIUS = 5.5
_GROW = 0.5  # filled polygons cover their boundary pixels as well
_GAUSS = 0.5 / math.sqrt(3.0)  # two-point Gauss node on [-1/2, 1/2]
_CHUNK = 128  # frames at a time: the intermediate tensors stay in the cache

_WHITE, _ROD_COLOUR = (255, 255, 255), (204, 77, 77)


class PendulumRenderer:
    """Draws pendulum frames from angles, many at a time, each pixel from its own area coverage.

    A pixel's colour is ``white + coverage * (rod - white)``. The coverage of the rod is the product rule
    ``H(left) + H(right) - 1`` of its two long edges, where ``H`` is the area of a unit pixel on one side of
    a straight line (two-point Gauss quadrature, exact for edges along the axes); the round ends replace it
    beyond the short edges. Only the square that the rod can reach is computed.

    gymnasium draws with integer coordinates, so its picture jumps as the angle moves: about 2,700 different pictures in
    a full turn.

    Args:
        image_size: height and width of the frames, in pixels; at least 16.
        snap: round the corners of the rod to whole pixels of the 500 x 500 screen exactly as gymnasium does (largest
            error of any pixel about 12/255 over thousands of angles); False: draw the picture that it approximates,
            continuous in the angle (largest error about 25/255, caused by the rounding).
        device: device of the frames.

    Source: gymnasium 1.x, ``envs/classic_control/pendulum.py``; the paper (Section V-A) uses its frames. Deviation: the
    torque arrow, which would show the action in the observation, is never drawn.

    Example:
        >>> frames = PendulumRenderer(image_size=64)(torch.tensor([0.0, 1.0]))
        >>> frames.shape, frames.dtype
        (torch.Size([2, 3, 64, 64]), torch.uint8)
        >>> frames[0, :, 20, 32].tolist()  # upright: the rod is above the centre
        [204, 77, 77]
    """

    def __init__(self, image_size: int = 64, *, snap: bool = True, device: torch.device | str | None = None) -> None:
        if not isinstance(image_size, int) or image_size < 16:
            raise ConfigError(f"image_size: expected an integer >= 16, received {image_size!r}.")
        self.image_size = image_size
        self.snap = bool(snap)
        scale = image_size / _SCREEN
        first = math.floor((_CENTRE - _ROD - _CAP_RADIUS - 1) * scale) - 1
        self._window = slice(max(first, 0), image_size - max(first, 0))
        x = torch.arange(self._window.start, self._window.stop, device=usable_device(device or "cpu")) + 0.5
        self._x, self._y = x, image_size - x  # the screen is flipped at the end, so rows count from below
        self._scale = scale
        # The cap at the pivot and the axle never move: their coverage is supersampled once.
        centre = (_CENTRE + 0.5) * scale
        sub = (torch.arange(16, device=device) + 0.5) / 16 - 0.5
        dx = (self._x[:, None] + sub - centre)[None, :, None, :]
        dy = (self._y[:, None] + sub - centre)[:, None, :, None]
        distance = torch.hypot(dx, dy)
        self._pivot = (distance < _CAP_RADIUS * scale).float().mean((-1, -2))
        axle = (distance < _AXLE_RADIUS * scale).float().mean((-1, -2))
        # White where nothing is drawn; black replaces the rod's colour (not white) under the axle. + 0.5 rounds.
        self._ground = [white + 0.5 - rod * axle for white, rod in zip(_WHITE, _ROD_COLOUR, strict=True)]

    def __call__(self, angle: Tensor) -> Tensor:
        """Draw uint8 ``(*batch, 3, image_size, image_size)`` of angles ``(*batch,)`` in rad.

        An angle of 0 is upright, positive is counter-clockwise. Raises DTypeError or NonFiniteError for angles that are
        no finite floating-point numbers.
        """
        if not angle.is_floating_point():
            raise DTypeError(f"angle: expected floating point, received {angle.dtype}; call .float().")
        if not torch.isfinite(angle).all():
            bad = int((~torch.isfinite(angle)).sum())
            raise NonFiniteError(f"angle: expected finite values, received {bad} of {angle.numel()} NaN or infinite.")
        flat = angle.detach().reshape(-1).to(self._x.device)
        size = self.image_size
        frames = torch.full((flat.shape[0], 3, size, size), 255, dtype=torch.uint8, device=self._x.device)
        for start in range(0, flat.shape[0], _CHUNK):
            part = slice(start, start + _CHUNK)
            window = frames[part, :, self._window, self._window]
            coverage = self._coverage(*self._corners(flat[part]))
            for k in range(2):
                window[:, k].copy_(torch.sub(self._ground[k], coverage, alpha=_WHITE[k] - _ROD_COLOUR[k]))
            window[:, 2].copy_(window[:, 1])  # green and blue are the same in all three colours
        return frames.reshape(*angle.shape, 3, size, size)

    def _corners(self, angle: Tensor) -> tuple[Tensor, Tensor]:
        """Corners ``(n, 4, 2)`` of the rod and centre ``(n, 2)`` of the cap at its end, in screen pixels."""
        turned = angle.double() + math.pi / 2  # double: which side of a pixel border decides the rounding
        cos, sin = turned.cos(), turned.sin()
        points = torch.tensor(
            [(0, -_HALF_WIDTH), (0, _HALF_WIDTH), (_ROD, _HALF_WIDTH), (_ROD, -_HALF_WIDTH), (_ROD, 0)],
            dtype=torch.float64,
            device=angle.device,
        )
        x = points[:, 0] * cos[:, None] - points[:, 1] * sin[:, None]
        y = points[:, 0] * sin[:, None] + points[:, 1] * cos[:, None]
        placed = torch.stack([x, y], dim=-1) + _CENTRE
        if self.snap:
            placed = placed.floor_().add_(0.5)  # the centre of the pixel that the integer coordinates name
        placed = placed.float()
        return placed[:, :4], placed[:, 4]

    def _edge(self, start: Tensor, end: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Line through two points as ``column + row``: the signed distance that a box filter sees, plus 1/2.

        The distance (positive on the left of ``start -> end``) is divided by the larger component of the normal, so
        that ``clamp(column + row, 0, 1)`` is the covered part of a segment through the pixel along that axis; the third
        result shifts the segment to the two Gauss nodes across it.
        """
        direction = end - start
        normal = torch.stack([-direction[:, 1], direction[:, 0]], dim=-1)
        normal = normal / normal.norm(dim=-1, keepdim=True)
        offset = (_GROW - (normal * start).sum(-1)) * self._scale
        large = normal.abs().amax(-1)
        column = (normal[:, 0] / large)[:, None, None] * self._x
        row = (normal[:, 1] / large)[:, None, None] * self._y[:, None] + (offset / large + 0.5)[:, None, None]
        shift = _GAUSS * normal.abs().amin(-1) / large
        return column, row, shift[:, None, None]

    def _coverage(self, corners: Tensor, tip: Tensor) -> Tensor:
        """Part of each pixel of the window that the rod covers, ``(n, window, window)`` in [0, 1]."""
        a, b, c, d = corners.unbind(1)
        halves = []
        for start, end in ((a, d), (c, b)):  # the long edges, with the rod on their left
            column, row, shift = self._edge(start, end)
            halves.append(((column + shift) + row).clamp_(0, 1).add_(((column - shift) + row).clamp_(0, 1)))
        coverage = halves[0].add_(halves[1]).mul_(0.5).sub_(1).clamp_(min=0)
        # Beyond the short edges the round caps take over. A box filter moves the border of a disc of radius r
        # inwards by 1 / (24 r).
        radius = _CAP_RADIUS * self._scale
        radius = radius - 1 / (24 * radius)
        centre = tip * self._scale
        across, up = (self._x - centre[:, :1]).square(), (self._y - centre[:, 1:]).square()
        cap = (across[:, None, :] + up[:, :, None]).sqrt_().neg_().add_(radius + 0.5).clamp_(0, 1)
        column, row, _ = self._edge(d, c)
        coverage = torch.lerp(cap, coverage, (column + row).clamp_(0, 1))
        column, row, _ = self._edge(b, a)
        return torch.lerp(self._pivot.expand_as(coverage), coverage, (column + row).clamp_(0, 1))


class GymnasiumRenderer:
    """Frames drawn by gymnasium's own Pendulum-v1 renderer and area-averaged, for evaluation.

    gymnasium's picture is constant between the angles at which a corner of the rod crosses a whole pixel. Those angles
    are known in closed form, so every different picture is drawn by gymnasium once (about 3 ms), kept, and looked up
    afterwards; all of them together (about 3,000) take 36 MB at 64 x 64. ``image_size``: height and width in pixels.

    Raises MissingDependencyError without pygame, which gymnasium draws with. Source: the frames of the paper's
    Section V-A; deviation: none.

    Example:
        >>> GymnasiumRenderer(image_size=64)(torch.tensor([0.0])).shape
        torch.Size([1, 3, 64, 64])
    """

    def __init__(self, image_size: int = 64) -> None:
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # no greeting on standard output
        try:
            import pygame.gfxdraw  # noqa: F401
        except ImportError as error:
            raise MissingDependencyError(
                "Frames of gymnasium's own renderer need pygame, which is not installed; "
                "run `pip install 'gymnasium[classic-control]'`."
            ) from error
        import gymnasium

        self.image_size = image_size
        self._env = gymnasium.make("Pendulum-v1", render_mode="rgb_array", disable_env_checker=True)
        self._env.reset()
        self._borders = _picture_borders()
        n = self._borders.shape[0]
        self._known = torch.zeros(n, dtype=torch.bool)
        self._frames = torch.zeros(n, 3, image_size, image_size, dtype=torch.uint8)
        edges = torch.arange(image_size + 1, dtype=torch.float64) * _SCREEN / image_size
        pixels = torch.arange(_SCREEN, dtype=torch.float64)
        overlap = torch.minimum(pixels + 1, edges[1:, None]) - torch.maximum(pixels, edges[:-1, None])
        self._area = (overlap.clamp_min(0) * image_size / _SCREEN).float()

    def __call__(self, angle: Tensor) -> Tensor:
        """Look up, and where necessary draw, uint8 ``(*batch, 3, H, W)`` of angles ``(*batch,)`` in rad."""
        turn = 2 * math.pi
        wrapped = angle.detach().cpu().double().reshape(-1).remainder(turn)
        # Cell k lies between border k and border k + 1; before the first border begins the last cell.
        cell = (torch.searchsorted(self._borders, wrapped, right=True) - 1) % self._borders.shape[0]
        for k in cell[~self._known[cell]].unique().tolist():
            last = k + 1 == len(self._borders)
            width = self._borders[0] + turn - self._borders[k] if last else self._borders[k + 1] - self._borders[k]
            self._frames[k] = self._draw(float(self._borders[k] + width / 2))
            self._known[k] = True
        size = self.image_size
        return self._frames[cell].reshape(*angle.shape, 3, size, size).to(angle.device)

    def draw(self, angle: Tensor) -> Tensor:
        """Draw every frame anew, without the table: ``(n,)`` rad -> uint8 ``(n, 3, H, W)``."""
        return torch.stack([self._draw(value) for value in angle.double().reshape(-1).tolist()])

    def _draw(self, angle: float) -> Tensor:
        import numpy as np

        scene = self._env.unwrapped
        scene.state = np.array([angle, 0.0])  # type: ignore[attr-defined]
        scene.last_u = None  # type: ignore[attr-defined]  # no torque arrow
        picture = torch.from_numpy(np.ascontiguousarray(scene.render())).permute(2, 0, 1).float()
        return (self._area @ picture @ self._area.T + 0.5).to(torch.uint8)


def _picture_borders() -> Tensor:
    """Sorted angles in [0, 2 pi) at which a coordinate of gymnasium's rod passes a whole pixel."""
    borders = []
    for along, side in ((0, -1), (0, 1), (_ROD, 1), (_ROD, -1), (_ROD, 0)):
        across = side * _HALF_WIDTH
        radius, phase = math.hypot(along, across), math.atan2(across, along)
        reach = math.floor(radius)
        whole = torch.arange(-reach, reach + 1, dtype=torch.float64) / radius
        # x = radius cos(angle + pi/2 + phase), y = radius sin(...)
        for root in (whole.arccos(), -whole.arccos(), whole.arcsin(), math.pi - whole.arcsin()):
            borders.append(root - phase - math.pi / 2)
    angles = torch.cat(borders).remainder(2 * math.pi).sort().values
    return angles[torch.cat([torch.ones(1, dtype=torch.bool), angles.diff() > 1e-12])]

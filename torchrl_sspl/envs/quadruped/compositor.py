"""Frames of the robot and the obstacle from above, composed in batches from pictures that were drawn once."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchrl_sspl.envs.base import check_tensor
from torchrl_sspl.envs.quadruped.camera import CAMERA_HEIGHT, HALF_VIEW, SUPERSAMPLE
from torchrl_sspl.envs.quadruped.sprites import HEIGHT_UNIT, TEXEL, Sprites, load_sprites
from torchrl_sspl.envs.quadruped.world import OBSTACLE_COLOUR, OBSTACLE_HEIGHT
from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.sets import Region

_ROBOT_RADIUS = 0.42  # m on the ground; nothing of the robot is seen farther from its base
_REFERENCE_HEIGHT = 0.344  # m; the back of the robot, whose edges say where it is and where it heads
_AMBIENT = 0.6  # brightness of walls under a light from above
_WALL_LEVELS = 17
_CHUNK = 64  # frames at a time; their samples stay in the cache

# A colour is one integer, red + 2^10 green + 2^20 blue: the sum of four fits without carry, so that the area average
# of all three channels is one sum. Bit 30 says that something is higher than the obstacle (robot), or as high (ground).
_GREEN, _BLUE, _HIGH = 1 << 10, 1 << 20, 1 << 30
_LANES = _HIGH - 1
_NOTHING = -1


class TopViewCompositor:
    """Draws the top view of many robots at once, as PyBullet's renderer draws each of them.

    The camera is far and looks straight down: a frame is the empty arena plus the robot, moved, turned and scaled
    by a constant. Each sample of a frame (four per pixel, where PyBullet's renderer takes them) looks up the
    texel of the robot's picture at its gait phase. Parts of the robot below the top of the obstacle are hidden by
    it. Not reproduced: the parallax between the back of the robot and its legs, 2 cm at the rim of the arena, and
    the facets of a round obstacle.

    Args:
        image_size: height and width of the frames, in pixels; at least 32.
        obstacle: what stands on the ground, a set of points (x, y) in m, of dimension 2; None: nothing.
        half_view: distance from the middle of the frame to its edge, on the ground, in m.
        device: where the frames are drawn.

    Raises ConfigError or ShapeError for another size or obstacle; CheckpointError if the pictures of the robot cannot
    be read. Source: paper, Section IV-B (top view, RGB); deviation: none.

    Example:
        >>> frames = TopViewCompositor()(torch.tensor([[1.0, 0.5, 0.0]]), torch.tensor([0.25]))
        >>> frames.shape, frames.dtype
        (torch.Size([1, 3, 128, 128]), torch.uint8)
    """

    def __init__(
        self,
        image_size: int = 128,
        *,
        obstacle: Region | None = None,
        half_view: float = HALF_VIEW,
        device: torch.device | str | None = None,
    ) -> None:
        if not isinstance(image_size, int) or image_size < 32:
            raise ConfigError(f"image_size: expected an integer >= 32, received {image_size!r}.")
        if obstacle is not None and obstacle.dim != 2:
            raise ShapeError(f"obstacle: expected a set of points (x, y), dimension 2, received {obstacle.dim}.")
        self.image_size, self.device = image_size, torch.device(device or "cpu")
        size = image_size * SUPERSAMPLE
        self._half, self._sample = size / 2, 2 * half_view / size  # samples, m
        self._window = min(SUPERSAMPLE * (math.ceil(_ROBOT_RADIUS / self._sample / SUPERSAMPLE) * 2 + 2), size)
        sprites = load_sprites()
        self._table, self._table_size = self._robot(sprites)
        self.phases = len(sprites.postures)
        self._ground = self._arena(obstacle, size).to(self.device)
        self._empty = _unpack(_area(self._ground[None])).to(self.device)[0]

    def __call__(self, pose: Tensor, phase: Tensor | None = None) -> Tensor:
        """Draw uint8 ``(*batch, 3, image_size, image_size)``; outside the view nothing is drawn of a robot.

        Poses are ``(*batch, 3)``, x and y in m, heading in rad; phases of the gait ``(*batch,)``, taken modulo 1, None:
        0. Raises ShapeError, DTypeError or NonFiniteError for other tensors.
        """
        check_tensor("pose", pose, 3)
        batch = pose.shape[:-1]
        phase = pose.new_zeros(batch) if phase is None else phase
        if phase.shape != batch:
            raise ShapeError(f"phase: expected shape {tuple(batch)}, one per pose, received {tuple(phase.shape)}.")
        check_tensor("phase", phase[..., None], 1)
        flat = pose.detach().reshape(-1, 3).to(self.device)
        index = torch.round(phase.detach().to(self.device).reshape(-1) * self.phases).long().remainder(self.phases)
        size = self.image_size
        frames = self._empty.expand(len(flat), 3, size, size).clone()
        for start in range(0, len(flat), _CHUNK):
            part = slice(start, start + _CHUNK)
            self._draw(frames[part], flat[part], index[part])
        return frames.reshape(*batch, 3, size, size)

    def _draw(self, frames: Tensor, pose: Tensor, index: Tensor) -> None:
        """Draw robots into frames ``(n, 3, size, size)``."""
        n, width = len(pose), self._window
        scale = CAMERA_HEIGHT / (CAMERA_HEIGHT - _REFERENCE_HEIGHT)
        # Samples: column i is at x = (i - half) sample, row j at y = (half - 1 - j) sample.
        column = self._half + pose[:, 0] * (scale / self._sample)
        row = self._half - 1 - pose[:, 1] * (scale / self._sample)
        left, top = self._corner(column), self._corner(row)
        steps = torch.arange(width, device=pose.device)
        columns, rows = left[:, None] + steps, top[:, None] + steps
        right = (columns - column[:, None]) * (self._sample / TEXEL)  # texels from the base
        up = (row[:, None] - rows) * (self._sample / TEXEL)
        cos, sin = pose[:, 2].cos()[:, None], pose[:, 2].sin()[:, None]
        # A quarter turn of headings is enough to stay in the table: robots beyond the edge of the view look at
        # texels farther out, where nothing is.
        middle, last = self._table_size // 2, self._table_size - 1
        ahead = ((cos * right)[:, None, :] + (sin * up + middle + 0.5)[:, :, None]).clamp_(0, last).int()
        aside = ((sin * right)[:, None, :] + (middle - 0.5 - cos * up)[:, :, None]).clamp_(0, last).int()
        texel = aside.mul_(self._table_size).add_(ahead).add_((index * self._table_size**2).int()[:, None, None])
        robot = self._table[texel]
        ground = self._ground[rows[:, :, None], columns[:, None, :]]
        seen = torch.where(robot >= (ground & _HIGH), robot, ground).bitwise_and_(_LANES)
        colours = _unpack(_area(seen))
        small = width // SUPERSAMPLE
        pixels = torch.arange(small, device=pose.device)
        y, x = top[:, None] // SUPERSAMPLE + pixels, left[:, None] // SUPERSAMPLE + pixels
        which = torch.arange(n, device=pose.device)[:, None, None]
        frames.permute(0, 2, 3, 1)[which, y[:, :, None], x[:, None, :]] = colours.permute(0, 2, 3, 1)

    def _corner(self, middle: Tensor) -> Tensor:
        """First sample of the windows, on a border between pixels and within the frame."""
        first = torch.floor((middle - self._window / 2) / SUPERSAMPLE + 0.5) * SUPERSAMPLE
        return first.clamp(0, 2 * self._half - self._window).long()

    def _robot(self, sprites: Sprites) -> tuple[Tensor, int]:
        """Packed colours of the pictures with a rim of nothing, flat, and the size of one picture."""
        colours, heights = torch.from_numpy(sprites.colours).int(), torch.from_numpy(sprites.heights).int()
        packed = colours[..., 0] + colours[..., 1] * _GREEN + colours[..., 2] * _BLUE
        packed += (heights * HEIGHT_UNIT > OBSTACLE_HEIGHT).int() * _HIGH
        packed = torch.where(heights > 0, packed, _NOTHING)
        table = torch.nn.functional.pad(packed, (2, 2, 2, 2), value=_NOTHING)
        return table.reshape(-1).contiguous().to(self.device), table.shape[-1]

    def _arena(self, obstacle: Region | None, size: int) -> Tensor:
        """Packed colours ``(size, size)`` of the empty arena at the samples."""
        arena = torch.full((size, size), 255 * (1 + _GREEN + _BLUE), dtype=torch.int32)
        if obstacle is None:
            return arena
        x = (torch.arange(size) - self._half) * self._sample
        y = (self._half - 1 - torch.arange(size)) * self._sample
        points = torch.stack(torch.meshgrid(y, x, indexing="ij")[::-1], dim=-1)
        shrink = [1 - z / CAMERA_HEIGHT for z in torch.linspace(0, OBSTACLE_HEIGHT, _WALL_LEVELS).tolist()]
        anywhere = torch.stack([obstacle.contains(points * s) for s in shrink])
        for seen, brightness, high in ((anywhere.any(0), _AMBIENT, 0), (anywhere[-1], 1.0, _HIGH)):
            red, green, blue = (int(255 * c * brightness) for c in OBSTACLE_COLOUR[:3])
            arena[seen] = red + green * _GREEN + blue * _BLUE + high
        return arena


def _area(samples: Tensor) -> Tensor:
    """Sums of four packed samples, plus one half for rounding: ``(n, 2 h, 2 w) -> (n, h, w)``."""
    samples = samples & _LANES
    total = samples[:, 0::2, 0::2] + samples[:, 0::2, 1::2]
    total += samples[:, 1::2, 0::2]
    total += samples[:, 1::2, 1::2]
    return total.add_(2 * (1 + _GREEN + _BLUE))


def _unpack(total: Tensor) -> Tensor:
    """Colours uint8 ``(n, 3, h, w)`` of packed sums of four samples."""
    return torch.stack([(total >> (shift + 2)) & 255 for shift in (0, 10, 20)], dim=1).to(torch.uint8)

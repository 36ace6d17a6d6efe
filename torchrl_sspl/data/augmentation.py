"""Changes of pictures that should not matter, made while transitions are stored: one camera for each episode."""

from __future__ import annotations

import copy

import torch
from torch import Tensor
from torch.nn import functional as F

from torchrl_sspl.errors import ConfigError, DTypeError, ShapeError
from torchrl_sspl.seeds import spawn

_PART = 512  # frames that are floating point at a time


class Augmentation:
    r"""Frames as cameras with noise, of another brightness, or slightly out of place would have captured them.

    .. math:: o' = \operatorname{round} \big( f \cdot o(x + s) + \sigma \xi \big), \qquad \xi \sim \mathcal{N}(0, 1) \text{ for every number}

    Each of the three is drawn for every episode by itself, with a chance of ``share``: :math:`\sigma` uniform in [0, noise],
    :math:`f` in [1 - brightness, 1 + brightness], :math:`s` in [-shift, shift]\ :sup:`2`. An episode keeps its camera; noise is new in every
    frame, which is changed once however often it is used. Source: none.

    Args:
        share: chance of each change, in [0, 1].
        noise: largest standard deviation, grey levels of 255.
        brightness: largest change of the brightness, as a share of it, below 1.
        shift: largest shift along each axis, pixels of 64; the border goes on.
        seed: of what is random.

    Raises ConfigError for other values.

    Example:
        >>> frames = torch.full((3, 3, 8, 8), 100, dtype=torch.uint8)
        >>> changed = Augmentation(share=1.0, noise=0.0)(frames, torch.tensor([0, 0, 1]))
        >>> [bool((a == b).all()) for a, b in ((changed[0], changed[1]), (changed[1], changed[2]))]
        [True, False]
    """

    def __init__(
        self, *, share: float = 0.3, noise: float = 12.0, brightness: float = 0.15, shift: float = 1.0, seed: int = 0
    ) -> None:
        if not 0.0 <= share <= 1.0 or not 0.0 <= brightness < 1.0 or not (0.0 <= noise < 256.0 and 0.0 <= shift < 32.0):
            raise ConfigError(
                "augmentation: expected share in [0, 1], noise in [0, 256), brightness in [0, 1) and shift in [0, 32), received "
                f"{share!r}, {noise!r}, {brightness!r} and {shift!r}"
            )
        self.share, self.noise, self.brightness, self.shift, self.seed = share, noise, brightness, shift, seed

    def with_seed(self, seed: int) -> Augmentation:
        """The same changes, drawn anew."""
        other = copy.copy(self)
        other.seed = seed
        return other

    def __call__(self, frames: Tensor, episode: Tensor, position: int = 0) -> Tensor:
        """Changed frames ``(n, 3, H, W)`` uint8, those of one number of ``episode`` ``(n,)`` by one camera; another draw for
        every ``position``. Raises ShapeError or DTypeError for other tensors."""
        if frames.ndim != 4 or episode.shape != frames.shape[:1]:
            raise ShapeError(
                f"augmentation: expected frames (n, c, H, W) and n numbers of episodes, received {tuple(frames.shape)} and "
                f"{tuple(episode.shape)}"
            )
        if frames.dtype != torch.uint8:
            raise DTypeError(f"augmentation: expected uint8 frames, received {frames.dtype}; keep frames unconverted.")
        draw = torch.Generator().manual_seed(spawn(self.seed, "pictures", position))
        cameras = int(episode.max()) + 1 if len(episode) else 0
        chosen = torch.rand(cameras, 3, generator=draw) < self.share
        drawn = torch.rand(cameras, 4, generator=draw)
        noise = chosen[:, 0] * self.noise * drawn[:, 0]
        factor = 1.0 + chosen[:, 1] * self.brightness * (2.0 * drawn[:, 1] - 1.0)
        shift = chosen[:, 2:] * self.shift * (2.0 * drawn[:, 2:] - 1.0)
        out = frames.clone()
        changed = chosen.any(1)[episode].nonzero()[:, 0]
        for rows in changed.split(_PART) if len(changed) else ():
            camera = episode[rows]
            seen = _shifted(frames[rows].float(), shift[camera]) * factor[camera, None, None, None]
            seen += noise[camera, None, None, None] * torch.randn(seen.shape, generator=draw)
            out[rows] = seen.round_().clamp_(0, 255).to(torch.uint8)
        return out


def _shifted(frames: Tensor, by: Tensor) -> Tensor:
    """Frames ``(n, c, H, W)`` shifted by ``(n, 2)`` pixels of 64."""
    to = torch.cat([torch.eye(2).expand(len(by), 2, 2), by[..., None] / 32.0], 2)
    grid = F.affine_grid(to, list(frames.shape), align_corners=False)
    return F.grid_sample(frames, grid, padding_mode="border", align_corners=False)


__all__ = ["Augmentation"]

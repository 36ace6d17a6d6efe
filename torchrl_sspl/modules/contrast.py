"""An encoder that learns from what differs from the background, as a camera in its place and of the usual brightness sees it."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_sspl.modules.moments import FAINT, NOISE, REACH, WHOLE, Fitted, background_of, in_parts

_MARKS = 4  # pixels of what stands still by which the camera's place is told
_PER_PIXEL = 4  # places that are tried, per pixel of 64 and axis
_SURE = 0.02  # mean squared difference by which another place has to fit better to be believed
_GLARE, _LIKE = 1.05, 0.002  # brightness from which white may be cut off, and mean squared difference at which it is believed
_WHITE = 2.0 - 1.5 / 127.5  # black is zero


class Contrast(nn.Module):
    r"""What differs from the background, of frames as bright as it is, from a camera in its place.

    .. math:: x_k = \kappa_k f_k(\cdot + s) - b_k, \qquad h_k = \operatorname{sign}(x_k) \max(0, |x_k| - \epsilon)

    The background b is the median of frames from different moments; :math:`\kappa_k` makes a frame as bright as the frames are in the
    median, black counting zero. Where something stands still before plain ground, such as the axle of a pendulum or an obstacle, the
    shift s, at most one and a half pixels of 64, puts its most distinct pixels to where they were. What is smaller than :math:`\epsilon`
    is a camera's noise. All of it comes from frames alone and is set by :meth:`fit`. Source: none.

    Args:
        size: height and width of the (pooled) frames that are seen, even; what is given has half of it.
        channels: colours.

    Example:
        >>> frames = torch.ones(50, 3, 64, 64)
        >>> frames[:, :, 32, 32] = -1.0  # it stands still
        >>> places = torch.randint(2, 28, (50, 2), generator=torch.Generator().manual_seed(0))
        >>> frames[torch.arange(50), :, places[:, 0], places[:, 1]] = 0.0  # one dark pixel each moves
        >>> contrast = Contrast(64)
        >>> contrast.fit(frames)
        >>> darker = contrast((frames + 1.0) * 0.9 - 1.0)
        >>> bool(torch.allclose(darker, contrast(frames), atol=1e-6)), bool((darker[:, :, 16, 16] == 0.0).all())
        (True, True)
        >>> bool(torch.allclose(contrast(frames.roll(1, -1)), contrast(frames), atol=1e-4))
        True
    """

    background: Tensor
    light: Tensor
    mixing: Tensor
    around: Tensor
    moving: Tensor
    marks: Tensor
    places: Tensor
    weights: Tensor

    def __init__(self, size: int, channels: int = 3) -> None:
        super().__init__()
        self.register_buffer("background", torch.ones(channels, size, size))
        self.register_buffer("light", torch.full((channels,), 2.0))  # mean over the frame, black counts zero
        reach, steps = REACH * size / 64, int(REACH * _PER_PIXEL)
        along = torch.arange(-steps, steps + 1) * reach / steps  # k shifts of one axis, in pixels
        shifts = torch.cartesian_prod(along, along)  # (k * k, 2), down and to the right
        pixels = torch.arange(-math.ceil(reach), math.ceil(reach) + 1)
        around = torch.cartesian_prod(pixels, pixels)  # (w, 2), of which the pixel of any such place is mixed
        mixing = (1.0 - (around[:, None] - shifts).abs()).clamp_min(0.0).prod(-1)  # bilinear: (w, k * k)
        line = torch.arange(size)
        sampled = (line + along[:, None]).clamp(0, size - 1)[..., None]
        # Bilinear too, as matrices (k, size / 2, size) that halve an axis in the same breath: exact, and faster than sampling a grid.
        moving = (1.0 - (sampled - line).abs()).clamp_min(0.0).unflatten(1, (-1, 2)).mean(2)
        self.register_buffer("mixing", mixing, persistent=False)
        self.register_buffer("around", around, persistent=False)
        self.register_buffer("moving", moving, persistent=False)
        self.register_buffer("marks", torch.zeros(channels, _MARKS, 1), persistent=False)  # pixels by which places are told; black is zero
        self.register_buffer("places", torch.zeros(_MARKS, len(around), dtype=torch.long), persistent=False)  # these, and around them
        self.register_buffer("weights", torch.zeros(_MARKS), persistent=False)  # 1 for those that are distinct enough
        self._look()

    def _look(self) -> None:
        """Takes from the background by which pixels :meth:`in_place` tells where the camera is; in place, as losses hold these tensors."""
        colours = self.background.flatten(1)
        off = (colours - colours.median(1, keepdim=True).values).abs().amax(0)
        marks = off.argsort(descending=True, stable=True)[:_MARKS]
        size = self.background.shape[-1]
        rows, columns = ((at[:, None] + by).clamp(0, size - 1) for at, by in zip((marks // size, marks % size), self.around.T, strict=True))
        self.places.copy_(rows * size + columns)
        self.marks.copy_(colours[:, marks, None] + 1.0)
        self.weights.copy_(off[marks] > max(NOISE, WHOLE * float(off.amax())))

    def _load_from_state_dict(self, *arguments: Any) -> None:
        super()._load_from_state_dict(*arguments)
        self._look()

    @torch.no_grad()
    def fit(self, frames: Tensor) -> None:
        """Take background and brightness from frames ``(n, c, H, W)``; fewer than ten are an EmptyRegionError."""
        self.background.copy_(background_of(frames))
        self.light.copy_((frames + 1.0).mean((-2, -1)).median(0).values)
        self._look()

    def without_glare(self, frames: Tensor) -> Tensor:
        """Frames ``(n, c, H, W)`` of a camera so bright that white is cut off, as what stands still shows them; others as they are."""
        seen = frames.flatten(2)[:, :, self.places[:, self.places.shape[1] // 2, None]]  # (n, c, marks, 1)
        weighted = self.marks * self.weights[:, None]
        gain = (seen * weighted).sum((1, 2, 3)) / (self.marks * weighted).sum().clamp_min(1e-9)
        believed = (gain > _GLARE) & (self._apart(seen - gain[:, None, None, None] * self.marks)[:, 0] < _LIKE)
        if not (torch.compiler.is_compiling() or torch.compiler.is_exporting()) and not bool(believed.any()):
            return frames  # most often
        gain, background = torch.where(believed, gain, 1.0)[:, None, None, None], self.background + 1.0
        cut = (frames > _WHITE) & (background * gain > _WHITE)
        return torch.where(believed[:, None, None, None], torch.where(cut, background, frames / gain), frames)

    def _apart(self, off: Tensor) -> Tensor:
        """Mean square ``(n, s)`` of differences ``(n, c, marks, s)`` at the marks; 0 where nothing is distinct."""
        return (off.square().mean(1) * self.weights[:, None]).sum(1) / self.weights.sum().clamp_min(1.0)

    def in_place(self, frames: Tensor) -> Tensor:
        """Frames ``(n, c, H, W)`` as a camera that is in its place sees them, halved: ``(n, c, H / 2, W / 2)``."""
        apart = self._apart(frames.flatten(2)[:, :, self.places] @ self.mixing - self.marks)
        still = apart.shape[1] // 2
        apart[:, still] -= _SURE
        best, k = apart.argmin(1), len(self.moving)
        down, right = (self.moving[by][:, None] for by in (best // k, best % k))
        return down @ frames @ right.mT

    def forward(self, frames: Tensor) -> Tensor:
        """Differences ``(n, c, H / 2, W / 2)`` of frames ``(n, c, H, W)`` in [-1, 1]."""
        return in_parts(self._differences, frames)

    def _differences(self, frames: Tensor) -> Tensor:
        frames = self.without_glare(frames + 1.0)  # black counts zero from here on
        light = frames.mean((-2, -1))
        factor = (self.light / light.clamp_min(1e-3)).clamp(0.5, 2.0)[..., None, None]
        off = self.in_place(frames * factor) - F.avg_pool2d(self.background + 1.0, 2)
        return off - off.clamp(-FAINT, FAINT)


class ContrastEncoder(Fitted):
    r"""Frame encoder on what differs from the background, for a camera that should stand still.

    .. math:: z_t = \operatorname{FrameEncoder}(h_t, h_{t-1}) \in (-1, 1)^p

    with the contrasts h of :class:`Contrast` in place of the frames: convolutions learn as in
    :class:`~torchrl_sspl.modules.FrameEncoder`, whose arguments and errors it has, from pictures in which a camera's noise, another
    brightness and a small shift are hardly seen. Before the training :meth:`fit` takes the background from frames; no label and no
    state enters. Source: paper eq. (7); the paper does not give an architecture.

    Args:
        latent_dim: size p of the latent.
        image_size: height and width of the frames in pixels; ``None`` accepts any size.
        pool_to: height and width after average pooling, before the camera's place is told; even. Convolutions see half of it.
        velocity_gain: gain k of the difference of the two frames' features.

    Example:
        >>> ContrastEncoder(latent_dim=3, image_size=64)(torch.zeros(2, 6, 64, 64, dtype=torch.uint8)).shape
        torch.Size([2, 3])
    """

    def __init__(self, latent_dim: int, image_size: int | None = None, *, pool_to: int = 64, velocity_gain: float = 4.0) -> None:
        super().__init__(latent_dim, image_size, pool_to=pool_to // 2, velocity_gain=velocity_gain)
        self.trunk = nn.Sequential(Contrast(pool_to, self.in_channels), *self.trunk)
        self.pool_to = (pool_to, pool_to)
        self.arguments = {
            "latent_dim": latent_dim, "image_size": self.arguments["image_size"], "pool_to": pool_to, "velocity_gain": velocity_gain,
        }  # fmt: skip

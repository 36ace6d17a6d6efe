"""An encoder that learns from what differs from the background, which a camera's noise and brightness do not."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_sspl.modules.moments import FAINT, Fitted, background_of


class Contrast(nn.Module):
    r"""What differs from the background, of frames as bright as it is.

    .. math:: x_k = \kappa_k f_k - b_k, \qquad h_k = \operatorname{sign}(x_k) \max(0, |x_k| - \epsilon)

    The background b is the median of frames from different moments; :math:`\kappa_k` makes a frame as bright as the frames are in the
    median, black counting zero, and what is smaller than :math:`\epsilon` is a camera's noise. All of it comes from frames alone and is
    set by :meth:`fit`. Source: none.

    Args:
        size: height and width of the (pooled) frames.
        channels: colours.

    Example:
        >>> frames = torch.ones(50, 3, 16, 16)
        >>> places = torch.randint(16, (50, 2), generator=torch.Generator().manual_seed(0))
        >>> frames[torch.arange(50), :, places[:, 0], places[:, 1]] = 0.0  # one dark pixel each
        >>> contrast = Contrast(16)
        >>> contrast.fit(frames)
        >>> darker = contrast((frames + 1.0) * 0.9 - 1.0)
        >>> int((darker != 0.0).sum()), bool(torch.allclose(darker, contrast(frames), atol=1e-6))
        (150, True)
    """

    background: Tensor
    light: Tensor

    def __init__(self, size: int, channels: int = 3) -> None:
        super().__init__()
        self.register_buffer("background", torch.ones(channels, size, size))
        self.register_buffer("light", torch.full((channels,), 2.0))  # mean over the frame, black counts zero

    @torch.no_grad()
    def fit(self, frames: Tensor) -> None:
        """Take background and brightness from frames ``(n, c, H, W)``; fewer than ten are an EmptyRegionError."""
        self.background.copy_(background_of(frames))
        self.light.copy_((frames + 1.0).mean((-2, -1)).median(0).values)

    def forward(self, frames: Tensor) -> Tensor:
        """Differences ``(n, c, H, W)`` of frames ``(n, c, H, W)`` in [-1, 1]."""
        light = (frames + 1.0).mean((-2, -1))
        factor = (self.light / light.clamp_min(1e-3)).clamp(0.5, 2.0)[..., None, None]
        off = (frames + 1.0) * factor - 1.0 - self.background
        return off - off.clamp(-FAINT, FAINT)


class ContrastEncoder(Fitted):
    r"""Frame encoder on what differs from the background, for a camera that stands still.

    .. math:: z_t = \operatorname{FrameEncoder}(h_t, h_{t-1}) \in (-1, 1)^p

    with the contrasts h of :class:`Contrast` in place of the frames: convolutions learn as in
    :class:`~torchrl_sspl.modules.FrameEncoder`, whose arguments and errors it has, from pictures in which a camera's noise (up to about
    12 grey levels of 255 before pooling by two) and another brightness are hardly seen. Before the training :meth:`fit` takes the
    background from frames; no label and no state enters. Source: paper eq. (7); the paper does not give an architecture.

    Example:
        >>> ContrastEncoder(latent_dim=3, image_size=64)(torch.zeros(2, 6, 64, 64, dtype=torch.uint8)).shape
        torch.Size([2, 3])
    """

    def __init__(self, latent_dim: int, image_size: int | None = None, *, pool_to: int = 32, velocity_gain: float = 4.0) -> None:
        super().__init__(latent_dim, image_size, pool_to=pool_to, velocity_gain=velocity_gain)
        self.trunk = nn.Sequential(Contrast(pool_to, self.in_channels), *self.trunk)
        self.arguments = {
            "latent_dim": latent_dim, "image_size": self.arguments["image_size"], "pool_to": pool_to, "velocity_gain": velocity_gain,
        }  # fmt: skip

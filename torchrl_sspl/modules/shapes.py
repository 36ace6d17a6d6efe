"""Encoders that see where one thing of one colour, with a front and a back, is and where it heads, from its place and shape."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.modules.moments import (
    NOISE,
    WHOLE,
    MomentEncoder,
    background_of,
    centre_of,
    facing,
    in_parts,
    still_of,
    turned,
    without_weights,
)
from torchrl_sspl.modules.networks import mlp

_VAGUE = 0.03  # scaled length below which a direction is none


class ShapeMoments(nn.Module):
    r"""Place and shape of what differs from the background: centre, third moment, and whether the frame's border cuts it.

    .. math:: w = \max_k |f_k - b_k|, \qquad d = (x, y) - c, \qquad
        h = \Big(\langle (x, y) \rangle / \sigma_1, \;\langle |d|^2 d \rangle / \sigma_2, \;\big(1 - \max_{\text{border}} w\big)_+\Big)

    with averages over w. The third moment points along whatever has one end that is heavier than the other, such as an arrow
    of one colour. The largest difference over the colours counts, so that a thing covers the same share before every
    background. Background b and the scales :math:`\sigma` come from frames alone and are set by :meth:`fit`.
    Source: none.

    Args:
        size: height and width of the (pooled) frames.
        channels: colours.

    Example:
        >>> frames = torch.ones(50, 3, 16, 16)
        >>> places = torch.randint(16, (50, 2), generator=torch.Generator().manual_seed(0))
        >>> frames[torch.arange(50), :, places[:, 0], places[:, 1]] = 0.0  # one dark pixel each
        >>> moments = ShapeMoments(16)
        >>> moments.fit(frames)
        >>> moments(frames).shape
        torch.Size([50, 5])
    """

    background: Tensor
    scale: Tensor
    axis: Tensor

    def __init__(self, size: int, channels: int = 3) -> None:
        super().__init__()
        self.register_buffer("background", torch.ones(channels, size, size))
        self.register_buffer("scale", torch.ones(5))
        self.register_buffer("axis", (torch.arange(size) + 0.5) / size * 2 - 1, persistent=False)

    def notice(self, frames: Tensor) -> None:
        """What is to be known of frames, beside their background, before moments are taken; nothing here."""

    def weight(self, frames: Tensor) -> Tensor:
        """How much of the thing every pixel shows, ``(n, H, W)``; what a camera's noise changes is not a thing."""
        return ((frames - self.background).abs().amax(1) - NOISE).clamp_min(0.0)

    def moments(self, frames: Tensor) -> Tensor:
        """Moments ``(n, 5)``, not scaled, of frames ``(n, c, H, W)`` in [-1, 1]; x to the right, y down."""
        weight = self.weight(frames)
        columns, rows = weight.sum(-2), weight.sum(-1)
        mass = rows.sum(-1, keepdim=True).clamp_min(1e-3 * self.axis.numel())  # less than that is nothing: the middle
        x, y = columns @ self.axis[:, None] / mass, rows @ self.axis[:, None] / mass
        right, down = self.axis - x, self.axis - y

        def mean(of_rows: Tensor, of_columns: Tensor) -> Tensor:
            return ((weight @ of_columns[..., None])[..., 0] * of_rows).sum(-1, keepdim=True) / mass

        third_x = (columns * right**3).sum(-1, keepdim=True) / mass + mean(down**2, right)
        third_y = (rows * down**3).sum(-1, keepdim=True) / mass + mean(down, right**2)
        border = torch.stack([weight[:, 0], weight[:, -1], weight[..., 0], weight[..., -1]]).amax((0, 2))
        return torch.cat([x, y, third_x, third_y, (1.0 - border).clamp_min(0.0)[:, None]], -1)

    @torch.no_grad()
    def fit(self, frames: Tensor) -> None:
        """Take background and scales from frames ``(n, c, H, W)``; fewer than ten are an EmptyRegionError."""
        self.background.copy_(background_of(frames))
        self.notice(frames)
        found = in_parts(self.moments, frames)
        # One scale for both directions: turning the frame turns what is seen.
        pairs = found[:, :4].unflatten(-1, (2, 2)).square().mean((0, 2)).sqrt()
        self.scale[:4] = pairs.repeat_interleave(2).clamp_min(1e-8)

    def forward(self, frames: Tensor) -> Tensor:
        """Scaled moments ``(n, 5)`` of frames ``(n, c, H, W)``."""
        return in_parts(self.moments, frames) / self.scale


class ShapeEncoder(MomentEncoder):
    r"""Frame encoder on moments, for a scene in which one thing of one colour, with a front and a back, moves.

    .. math:: a_t = s_t m_t + (1 - s_t) \big(s_{t-1} m_{t-1} + (1 - s_{t-1}) k (c_t - c_{t-1})\big), \qquad
        h_t = (c_t, a_t / \|a_t\|), \qquad z_t = \tanh(g \, h_t + \operatorname{MLP}(h_t)) \in (-1, 1)^p

    with centre c and third moment m of :class:`ShapeMoments`, and s in [0, 1], one where all of the thing is seen. The shape
    tells the direction more exactly than the motion from one frame to the next, unless the border of the frame cuts it; that
    of the frame before says how it was a step ago. Before the training :meth:`fit` takes the statistics from frames; no label and no state enters. Sizes
    that are not valid are a ConfigError. Source: paper eq. (7); the paper does not give an architecture.

    Args:
        latent_dim: size p of the latent, at least four.
        image_size: height and width of the frames in pixels; ``None`` accepts any size.
        pool_to: height and width after average pooling.
        hidden: width of the MLP.
        velocity_gain: gain k of the difference of the two frames' centres.

    Example:
        >>> ShapeEncoder(latent_dim=4, image_size=128)(torch.zeros(2, 6, 128, 128, dtype=torch.uint8)).shape
        torch.Size([2, 4])
    """

    def __init__(
        self,
        latent_dim: int,
        image_size: int | None = None,
        *,
        pool_to: int = 64,
        hidden: int = 64,
        velocity_gain: float = 12.0,
    ) -> None:
        if latent_dim < 4:
            raise ConfigError(f"expected latent_dim >= 4 for place and direction, received {latent_dim}")
        super().__init__(latent_dim, image_size, pool_to=pool_to, hidden=hidden, velocity_gain=velocity_gain)
        self.features = 5
        self.trunk = nn.Sequential(ShapeMoments(pool_to, self.in_channels))
        self.latent_head = mlp((4, hidden, latent_dim), nn.SiLU)

    def ahead(self, previous: Tensor, current: Tensor) -> Tensor:
        """Direction ``(*batch, 2)`` of the thing, of length one where it is known, from the moments of two successive frames."""
        ahead = self.velocity_gain * (current - previous)[..., :2]
        for frame in (previous, current):
            ahead = frame[..., 4:] * frame[..., 2:4] + (1.0 - frame[..., 4:]) * ahead
        return ahead / (ahead.square().sum(-1, keepdim=True) + _VAGUE**2).sqrt()

    def head(self, previous: Tensor, current: Tensor) -> Tensor:
        """Latent from the moments of two successive frames; see :meth:`FrameEncoder.head`."""
        seen = torch.cat([current[..., :2], self.ahead(previous, current)], -1)
        return torch.tanh(self.gain * F.pad(seen, (0, self.latent_dim - 4)) + self.latent_head(seen))


class _ShapeBearing(ShapeMoments):
    """Shape moments that also know where the thing that stands still is: the middle of what is not plain ground."""

    anchor: Tensor

    def __init__(self, size: int, channels: int = 3) -> None:
        super().__init__(size, channels)
        self.register_buffer("anchor", torch.zeros(2))

    @torch.no_grad()
    def fit(self, frames: Tensor) -> None:
        """Take background, scales and place from frames ``(n, c, H, W)``; fewer than ten are an EmptyRegionError."""
        super().fit(frames)
        self.anchor.copy_(torch.stack(centre_of(still_of(self.background), self.axis)))


class ShapeBearingEncoder(ShapeEncoder):
    r"""Where the thing that stands still lies, seen from one thing of one colour, with a front and a back, that moves.

    .. math:: z_t = \Big(\tanh \frac{1}{r} \begin{pmatrix} e_1 & e_2 \\ -e_2 & e_1 \end{pmatrix} (q - c_t), \; 0\Big) \in (-1, 1)^p

    with the centre c and the direction e of :class:`ShapeEncoder`, the place q of the still thing (the middle of what is not plain
    ground in the background) and a reach r. As with :class:`BearingEncoder` the latent has two numbers that the data fill, a still thing
    counts as the disc around it, and entries beyond the second are zero and left to the memory. There is no weight to train;
    :meth:`fit` takes the statistics from frames. Sizes that are not valid are a ConfigError. Source: paper eq. (7); the paper does
    not give an architecture.

    Args:
        latent_dim: size p of the latent, at least two.
        image_size: height and width of the frames in pixels; ``None`` accepts any size.
        pool_to: height and width after average pooling.
        velocity_gain: gain k of the difference of the two frames' centres, where the border of the frame cuts the thing.
        reach: r, in half widths of the frame.

    Example:
        >>> ShapeBearingEncoder(latent_dim=2, image_size=128)(torch.zeros(2, 6, 128, 128, dtype=torch.uint8)).shape
        torch.Size([2, 2])
    """

    seen_dim = 2

    def __init__(
        self, latent_dim: int, image_size: int | None = None, *, pool_to: int = 64, velocity_gain: float = 12.0, reach: float = 1.0
    ) -> None:
        super().__init__(4, image_size, pool_to=pool_to, velocity_gain=velocity_gain)
        without_weights(self, _ShapeBearing(pool_to, self.in_channels), latent_dim, reach)
        kept = ("image_size", "pool_to", "velocity_gain")
        self.arguments = {"latent_dim": latent_dim, **{k: self.arguments[k] for k in kept}, "reach": float(reach)}

    def _weight(self) -> Tensor:
        return self.gain

    def head(self, previous: Tensor, current: Tensor) -> Tensor:
        """Latent from the moments of two successive frames; see :meth:`FrameEncoder.head`."""
        moments: Any = self.trunk[0]
        ahead, away = self.ahead(previous, current), moments.anchor - current[..., :2] * moments.scale[:2]
        return F.pad(torch.tanh(self.gain * turned(ahead, away)), (0, self.latent_dim - self.seen_dim))


class _ColouredShape(ShapeMoments):
    """Shape moments of what has one colour, that of most of what differs from the background."""

    colour: Tensor

    def __init__(self, size: int, channels: int = 3) -> None:
        super().__init__(size, channels)
        self.register_buffer("colour", torch.zeros(channels))

    def weight(self, frames: Tensor) -> Tensor:
        """Share of every pixel that the thing covers, less how far its colour lies off the way from the background to the thing's."""
        way = self.colour[:, None, None] - self.background
        length = way.norm(dim=0).clamp_min(NOISE)  # before a background of its own colour a thing is not seen
        change = frames - self.background
        along = (change * way).sum(1) / length
        off = (change.square().sum(1) - along.square()).clamp_min(0.0).sqrt()
        return ((along - off) / length - NOISE).clamp_min(0.0)

    def notice(self, frames: Tensor) -> None:
        """The colour, from the pixels of frames ``(n, c, H, W)`` that differ most from the background."""
        change = (frames - self.background).abs().amax(1)
        whole = change >= WHOLE * change.max()
        self.colour.copy_(frames.movedim(1, -1)[whole].median(0).values)


class ShapePlaceEncoder(ShapeEncoder):
    r"""Where one thing of one colour, with a front and a back, is in the frame, and where it heads; things of other colours do not count.

    .. math:: z_t = \Big(\tanh \frac{c_t}{r}, \; \rho \cos \alpha_t, \; \rho \sin \alpha_t, \; 0\Big) \in [-1, 1]^p, \qquad
        w = \Big(\frac{\langle f - b, q - b \rangle}{\|q - b\|^2} - \frac{\|(f - b)_\perp\|}{\|q - b\|} - \epsilon\Big)_+

    with the centre c and the direction :math:`\alpha` of :class:`ShapeEncoder`, but of the weights w: how much of a pixel f has gone from
    the background b to the colour q, less what has gone elsewhere. q is the median of what differs most from the background. A mark of
    another colour that lies elsewhere in every episode is nothing then. The last two entries are a :class:`~torchrl_sspl.direction.Direction`,
    for dynamics of this ``turn_radius``. There is no weight to train; :meth:`fit` takes the statistics from frames. Sizes that
    are not valid are a ConfigError. Source: paper eq. (7); the paper does not give an architecture.

    Args:
        latent_dim: size p of the latent, at least four.
        image_size: height and width of the frames in pixels; ``None`` accepts any size.
        pool_to: height and width after average pooling.
        velocity_gain: gain k of the difference of the two frames' centres, where the border of the frame cuts the thing.
        reach: r, in half widths of the frame.
        turn_radius: :math:`\rho`, latent units; how much a turn counts beside a distance.

    Example:
        >>> ShapePlaceEncoder(latent_dim=4, image_size=128)(torch.zeros(2, 6, 128, 128, dtype=torch.uint8)).shape
        torch.Size([2, 4])
    """

    seen_dim = 4

    def __init__(
        self, latent_dim: int, image_size: int | None = None, *, pool_to: int = 64, velocity_gain: float = 12.0, reach: float = 1.0,
        turn_radius: float = 0.3,
    ) -> None:  # fmt: skip
        if not 0.0 < turn_radius <= 1.0:
            raise ConfigError(f"expected turn_radius in (0, 1], received {turn_radius!r}")
        super().__init__(max(4, latent_dim), image_size, pool_to=pool_to, velocity_gain=velocity_gain)
        without_weights(self, _ColouredShape(pool_to, self.in_channels), latent_dim, reach)
        self.turn_radius = float(turn_radius)
        kept = ("image_size", "pool_to", "velocity_gain")
        self.arguments = {"latent_dim": latent_dim, **{k: self.arguments[k] for k in kept}, "reach": float(reach), "turn_radius": self.turn_radius}

    def _weight(self) -> Tensor:
        return self.gain

    def head(self, previous: Tensor, current: Tensor) -> Tensor:
        """Latent from the moments of two successive frames; see :meth:`FrameEncoder.head`."""
        moments: Any = self.trunk[0]
        ahead, place = self.ahead(previous, current), current[..., :2] * moments.scale[:2]
        angle = torch.atan2(ahead[..., 1:], ahead[..., :1])
        return facing(torch.tanh(self.gain * place), angle, self.turn_radius, self.latent_dim)

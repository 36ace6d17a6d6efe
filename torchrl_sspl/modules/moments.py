"""An encoder that sees where things are and how they are turned, from the centres of colours."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_sspl.errors import ConfigError, EmptyRegionError
from torchrl_sspl.modules.networks import FrameEncoder, mlp

NOISE = 0.05  # difference in [-1, 1] that is not seen
FAINT = 0.15  # the same of a bearing: the noise of a bad camera
REACH = 1.5  # pixels of 64 by which a camera may be out of place
_EDGE = 16  # of a frame's width: so many pixels have to speak for it
_VAGUE = 0.03  # scaled length below which a direction is none
WHOLE = 0.9  # of the largest difference, from which a pixel shows the whole colour of a thing


def background_of(frames: Tensor) -> Tensor:
    """The median ``(c, H, W)`` of frames ``(n, c, H, W)``; fewer than ten are an EmptyRegionError."""
    if len(frames) < 10:
        raise EmptyRegionError(f"expected at least 10 frames to fit to, received {len(frames)}; collect more data")
    return frames[:2000].median(0).values


def _centre(weight: Tensor, axis: Tensor) -> tuple[Tensor, Tensor]:
    """Mean x and y (down) under weights ``(..., H, W)``, each ``(...)``."""
    # Less than one pixel in a thousand counts as nothing seen: the middle of the frame.
    mass = weight.sum((-2, -1)).clamp_min(1e-3 * axis.numel())
    return (weight.sum(-2) @ axis) / mass, (weight.sum(-1) @ axis) / mass


def in_parts(function: Callable[[Tensor], Tensor], frames: Tensor) -> Tensor:
    """A function of frames, of a few at a time, which stay in the cache; an exported graph has no loop."""
    return torch.cat([function(part) for part in ([frames] if torch.compiler.is_exporting() else frames.split(32))])


class ColourMoments(nn.Module):
    r"""Centre of what differs from the background, per colour, with respect to the statistics of the data.

    .. math:: c_k = \frac{\sum_{ij} |f_{kij} - b_{kij}| (x_j, y_i)}{\sum_{ij} |f_{kij} - b_{kij}|}, \qquad
        h = \operatorname{diag}(\lambda)^{-1/2} V^\top (c - \mu)

    The background b is the median of frames from different moments; the whitening (:math:`\mu`, and the leading
    eigenvectors V and eigenvalues of the covariance of c) makes the small distance between the centres of two colours,
    which tells the heading, as large as the place. All of it comes from frames alone and is set by :meth:`fit`.
    Source: none (the paper does not give an architecture).

    Args:
        size: height and width of the (pooled) frames.
        channels: colours.
        kept: number of leading components kept, at most ``2 * channels``.

    Example:
        >>> frames = torch.ones(50, 3, 16, 16)
        >>> places = torch.randint(16, (50, 2), generator=torch.Generator().manual_seed(0))
        >>> frames[torch.arange(50), :, places[:, 0], places[:, 1]] = 0.0  # one dark pixel each
        >>> moments = ColourMoments(16, kept=2)
        >>> moments.fit(frames)
        >>> moments(frames).std(0).round(decimals=1)
        tensor([1., 1.])
    """

    background: Tensor
    mean: Tensor
    whitening: Tensor
    axis: Tensor

    def __init__(self, size: int, channels: int = 3, kept: int = 4) -> None:
        super().__init__()
        self.register_buffer("background", torch.ones(channels, size, size))
        self.register_buffer("mean", torch.zeros(2 * channels))
        self.register_buffer("whitening", torch.eye(2 * channels)[:, :kept].clone())
        self.register_buffer("axis", (torch.arange(size) + 0.5) / size * 2 - 1, persistent=False)

    def centres(self, frames: Tensor) -> Tensor:
        """Centres ``(n, 2 c)`` in [-1, 1] of frames ``(n, c, H, W)``: first all x, then all y (down)."""
        return torch.cat(_centre((frames - self.background).abs(), self.axis), -1)

    @torch.no_grad()
    def fit(self, frames: Tensor) -> None:
        """Take background and whitening from frames ``(n, c, H, W)``; fewer than ten are an EmptyRegionError."""
        self.background.copy_(background_of(frames))
        centre = in_parts(self.centres, frames).double()
        values, vectors = torch.linalg.eigh(torch.cov(centre.T))
        kept = self.whitening.shape[1]
        scale = values[-kept:].clamp_min(1e-8).rsqrt()
        self.mean.copy_(centre.mean(0))
        self.whitening.copy_(vectors[:, -kept:] * scale)

    def forward(self, frames: Tensor) -> Tensor:
        """Whitened centres ``(n, kept)`` of frames ``(n, c, H, W)``."""
        return (in_parts(self.centres, frames) - self.mean) @ self.whitening


class Fitted(FrameEncoder):
    """Frame encoder whose first layer takes statistics from frames before the training. Source: none."""

    @torch.no_grad()
    def fit(self, frames: Tensor) -> None:
        """Take the statistics from frames, uint8 ``(n, 3, H, W)`` of different moments; fewer than ten are an EmptyRegionError."""
        self._check(frames, self.in_channels, "frames")
        device = self._weight().device
        pooled = [F.adaptive_avg_pool2d(part.to(device).float(), self.pool_to) for part in frames.split(500)]
        self.trunk[0].fit(torch.cat(pooled) / 127.5 - 1.0)  # type: ignore[operator]


class MomentEncoder(Fitted):
    r"""Frame encoder on the centres of colours, for a scene in which one thing moves before a background.

    .. math:: z_t = \tanh(a \, h_t + \operatorname{MLP}(h_t, k (h_t - h_{t-1}))) \in (-1, 1)^p

    with h the whitened centres of :class:`ColourMoments`. Averages over the frame tell places to a fraction of a pixel
    and the heading of a robot whose ends differ in colour, at every place alike; the MLP shapes the latent. Before the
    training :meth:`fit` takes the statistics from frames; no label and no state enters. Sizes that are not positive
    integers are a ConfigError. Source: paper eq. (7); the paper does not give an architecture.

    Args:
        latent_dim: size p of the latent, at most six.
        image_size: height and width of the frames in pixels; ``None`` accepts any size.
        pool_to: height and width after average pooling.
        hidden: width of the MLP.
        velocity_gain: gain k of the difference of the two frames' centres; 0 where one frame shows all.

    Example:
        >>> MomentEncoder(latent_dim=4, image_size=128)(torch.zeros(2, 6, 128, 128, dtype=torch.uint8)).shape
        torch.Size([2, 4])
    """

    def __init__(
        self,
        latent_dim: int,
        image_size: int | None = None,
        *,
        pool_to: int = 64,
        hidden: int = 64,
        velocity_gain: float = 0.0,
    ) -> None:
        super().__init__(
            latent_dim,
            image_size,
            pool_to=pool_to,
            channels=(1,),
            features=latent_dim,
            hidden=hidden,
            velocity_gain=velocity_gain,
        )
        self.trunk = nn.Sequential(ColourMoments(pool_to, self.in_channels, latent_dim))
        self.gain = nn.Parameter(torch.tensor(0.6))
        kept = ("latent_dim", "image_size", "velocity_gain", "hidden")
        self.arguments = {**{k: self.arguments[k] for k in kept}, "pool_to": pool_to}

    def head(self, previous: Tensor, current: Tensor) -> Tensor:
        """Latent from the centres of two successive frames; see :meth:`FrameEncoder.head`."""
        motion = self.velocity_gain * (current - previous)
        shaped = self.latent_head(torch.cat([current, motion], -1))
        return torch.tanh(self.gain * current + shaped)


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


def _still(background: Tensor) -> Tensor:
    """How much of a background ``(c, H, W)`` is not plain ground, ``(H, W)``: its largest difference over the colours, where that is seen."""
    off = (background - background.flatten(1).median(1).values[:, None, None]).abs().amax(0)
    return torch.where(off > NOISE, off, 0.0)


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
        self.anchor.copy_(torch.stack(_centre(_still(self.background), self.axis)))


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
        _without_weights(self, _ShapeBearing(pool_to, self.in_channels), latent_dim, reach)
        kept = ("image_size", "pool_to", "velocity_gain")
        self.arguments = {"latent_dim": latent_dim, **{k: self.arguments[k] for k in kept}, "reach": float(reach)}

    def _weight(self) -> Tensor:
        return self.gain

    def head(self, previous: Tensor, current: Tensor) -> Tensor:
        """Latent from the moments of two successive frames; see :meth:`FrameEncoder.head`."""
        moments: Any = self.trunk[0]
        ahead, away = self.ahead(previous, current), moments.anchor - current[..., :2] * moments.scale[:2]
        return F.pad(torch.tanh(self.gain * _turned(ahead, away)), (0, self.latent_dim - self.seen_dim))


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
        _without_weights(self, _ColouredShape(pool_to, self.in_channels), latent_dim, reach)
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
        seen = [torch.tanh(self.gain * place), self.turn_radius * angle.cos(), self.turn_radius * angle.sin()]
        return F.pad(torch.cat(seen, -1), (0, self.latent_dim - self.seen_dim))


def _without_weights(encoder: Any, seen: nn.Module, latent_dim: int, reach: float) -> None:
    """Gives an encoder the latent of what the data fill, without a weight to train."""
    if latent_dim < encoder.seen_dim or not reach > 0.0:
        raise ConfigError(f"expected latent_dim >= {encoder.seen_dim} and reach > 0, received {latent_dim} and {reach}")
    encoder.latent_dim, encoder.reach = latent_dim, float(reach)
    encoder.trunk, encoder.latent_head = nn.Sequential(seen), nn.Sequential()
    encoder.gain.data.fill_(1.0 / encoder.reach)
    encoder.gain.requires_grad_(False)


def _turned(ahead: Tensor, away: Tensor) -> Tensor:
    """Places ``(*batch, 2)`` as seen in directions ``(*batch, 2)`` of length one: ahead and aside."""
    across = ahead[..., 0] * away[..., 1] - ahead[..., 1] * away[..., 0]
    return torch.stack([(ahead * away).sum(-1), across], -1)


class Bearing(nn.Module):
    r"""Where the thing that stands still lies, seen from the one that moves, in its own directions.

    .. math:: w_\pm = \max \Big( 0, \pm \sum_k \alpha_k |\kappa_k f_k - b_k| - \epsilon \Big), \qquad
        c = \tfrac{1}{2} (c_+ + c_-), \qquad e = c_+ - c_-, \qquad
        h = \frac{1}{\|e\|} \begin{pmatrix} e_1 & e_2 \\ -e_2 & e_1 \end{pmatrix} (q - c)

    with the centres :math:`c_\pm` of the weights :math:`w_\pm` on plain ground. What a camera's noise changes is no thing
    (:math:`\epsilon`), nor are another brightness (:math:`\kappa_k` makes the plain ground as bright as it was) and edges of the
    background that a camera shifted by a pixel moves (only plain ground counts). A camera that is out of place by up to one and a half
    pixels of 64 is put back by whole pixels, to where most of what has the still thing's colour lies on it. Where the ends of what moves differ in colour,
    e points from one to the other: :math:`\alpha`, of sum zero, is the contrast of colours whose centres differ most. What is as dark in
    all colours, such as legs, counts nothing. The place q is the middle of what is not plain ground, the middle of the frame where all of it is. Background b and all statistics come
    from frames alone and are set by :meth:`fit`. Distances are in half widths of the frame. Source: none.

    Args:
        size: height and width of the (pooled) frames.
        channels: colours, at least two.

    Example:
        >>> frames = torch.ones(50, 3, 16, 16)
        >>> places = torch.randint(15, (50, 2), generator=torch.Generator().manual_seed(0))
        >>> rows = torch.arange(50)
        >>> frames[rows, 0, places[:, 0], places[:, 1]] = 0.0  # one end
        >>> frames[rows, 1:, places[:, 0], places[:, 1] + 1] = 0.0  # the other, to the right of it
        >>> bearing = Bearing(16)
        >>> bearing.fit(frames)
        >>> bearing(frames).shape
        torch.Size([50, 4])
    """

    background: Tensor
    ground: Tensor
    light: Tensor
    contrast: Tensor
    anchor: Tensor
    axis: Tensor
    shifts: Tensor
    still: Tensor
    colours: Tensor
    places: Tensor

    def __init__(self, size: int, channels: int = 3) -> None:
        super().__init__()
        self.register_buffer("background", torch.ones(channels, size, size))
        self.register_buffer("ground", torch.ones(size, size))  # 1 where it is plain
        self.register_buffer("light", torch.full((channels,), 2.0 * size * size))  # on it, black counts zero
        self.register_buffer("contrast", torch.zeros(channels))
        self.register_buffer("anchor", torch.zeros(2))
        self.register_buffer("axis", (torch.arange(size) + 0.5) / size * 2 - 1, persistent=False)
        reach = torch.arange(-int(REACH * size / 64), int(REACH * size / 64) + 1)
        self.register_buffer("shifts", torch.cartesian_prod(reach, reach), persistent=False)  # down, to the right
        still = (self.shifts == 0).all(1) * size / _EDGE  # only what is seen clearly moves a frame
        self.register_buffer("still", still, persistent=False)
        self.register_buffer("colours", torch.ones(2, channels), persistent=False)  # of the still thing, and beside it
        self.register_buffer("places", torch.zeros(len(self.shifts), size * size), persistent=False)  # 1 on it
        self._look()

    def _look(self) -> None:
        """Takes from the background what :meth:`in_place` compares frames with."""
        beside = self.background.flatten(1).median(1).values
        off = (self.background - beside[:, None, None]).abs().amax(0)
        shape = off / off.max().clamp_min(NOISE)
        core = (shape > WHOLE).float()
        self.colours.copy_(torch.stack([(self.background * core).sum((1, 2)) / core.sum().clamp_min(1.0), beside]))
        moved = [shape.roll((down, right), (0, 1)) for down, right in self.shifts.tolist()]
        self.places.copy_(torch.stack(moved).flatten(1))

    def _load_from_state_dict(self, *arguments: Any) -> None:
        super()._load_from_state_dict(*arguments)
        self._look()

    def in_place(self, frames: Tensor) -> Tensor:
        """Frames ``(n, c, H, W)`` as a camera that is in its place sees them."""
        thing, beside = self.colours
        apart = (frames - thing[:, None, None]).square().sum(1).sqrt() / (thing - beside).norm().clamp_min(NOISE)
        like = (1.0 - 2.0 * apart).clamp_min(0.0)
        down, right = self.shifts[(like.flatten(1) @ self.places.T + self.still).argmax(1)].unbind(1)
        if not torch.compiler.is_compiling() and not bool((down | right).any()):
            return frames
        size = len(self.axis)
        pixels = torch.arange(size, device=frames.device)
        rows, columns = ((pixels + by[:, None]).clamp(0, size - 1) for by in (down, right))
        at = (size * rows[:, :, None] + columns[:, None, :]).flatten(1)[:, None].expand(-1, frames.shape[1], -1)
        return frames.flatten(2).gather(2, at).reshape(frames.shape)

    def centres(self, frames: Tensor, mixed: Tensor | None = None) -> Tensor:
        """Centres ``(n, 2, m)`` of mixtures ``(m, c)`` of the colours of frames ``(n, c, H, W)``, by default of the two ends: in [-1, 1],
        x to the right and y down."""
        mixed = torch.stack([self.contrast, -self.contrast]) if mixed is None else mixed
        light = ((frames + 1.0) * self.ground).sum((-2, -1))
        factor = (self.light / light.clamp_min(1e-3)).clamp(0.5, 2.0)[..., None, None]
        off = ((frames + 1.0) * factor - 1.0 - self.background).abs()
        seen = (mixed @ off.flatten(2)).unflatten(2, off.shape[2:])
        return torch.stack(_centre((seen - FAINT).clamp_min(0.0) * self.ground, self.axis), 1)

    @torch.no_grad()
    def fit(self, frames: Tensor) -> None:
        """Take everything from frames ``(n, c, H, W)``; fewer than ten are an EmptyRegionError."""
        self.background.copy_(background_of(frames))
        self._look()
        thing = _still(self.background)
        self.anchor.copy_(torch.stack(_centre(thing, self.axis)))
        self.ground.copy_(1.0 - F.max_pool2d((thing > 0.0).float()[None], 3, 1, 1)[0])
        self.light.copy_(((self.background + 1.0) * self.ground).sum((-2, -1)))
        colours = torch.eye(len(self.contrast), device=frames.device)
        centres = in_parts(lambda part: self.centres(part, colours), frames).double()
        apart = centres - centres.mean(-1, keepdim=True)
        _, vectors = torch.linalg.eigh(torch.einsum("nik,nil->kl", apart, apart))
        contrast = vectors[:, -1] - vectors[:, -1].mean()
        self.contrast.copy_(contrast / contrast.abs().amax().clamp_min(1e-9))

    def forward(self, frames: Tensor) -> Tensor:
        """Place of the still thing, ahead and aside of the moving one, and e of length one: ``(n, 4)`` of frames ``(n, c, H, W)``."""
        centres = in_parts(lambda part: self.centres(self.in_place(part)), frames)
        ahead = centres[..., 0] - centres[..., 1]
        ahead = ahead / ahead.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        away = self.anchor - centres.mean(-1)
        return torch.cat([_turned(ahead, away), ahead], -1)


class BearingEncoder(MomentEncoder):
    r"""Frame encoder that sees where the thing that stands still lies, seen from the one that moves.

    .. math:: z_t = (\tanh(h_t / r), 0) \in (-1, 1)^p

    with h of :class:`Bearing` and a reach r. For a robot that has to keep away from an obstacle this is a latent of two numbers
    that the data fill: there is nothing off the manifold. What is turned or mirrored with the robot looks the same, so that
    a square obstacle counts as the disc around it. Entries beyond the second are zero and left to the memory
    (:class:`~torchrl_sspl.modules.LatentDynamics` with ``remembers``). There is no weight to train; :meth:`fit` takes the
    statistics from frames. Sizes that are not valid are a ConfigError. Source: paper eq. (7); the paper does not give an
    architecture.

    Args:
        latent_dim: size p of the latent, at least two.
        image_size: height and width of the frames in pixels; ``None`` accepts any size.
        pool_to: height and width after average pooling.
        reach: r, in half widths of the frame.

    Example:
        >>> BearingEncoder(latent_dim=3, image_size=128)(torch.zeros(2, 6, 128, 128, dtype=torch.uint8)).shape
        torch.Size([2, 3])
    """

    seen_dim = 2

    def __init__(
        self, latent_dim: int, image_size: int | None = None, *, pool_to: int = 64, reach: float = 0.625
    ) -> None:
        super().__init__(self.seen_dim, image_size, pool_to=pool_to)
        _without_weights(self, Bearing(pool_to, self.in_channels), latent_dim, reach)
        self.features = 4
        self.arguments = {"latent_dim": latent_dim, "image_size": self.arguments["image_size"], "pool_to": pool_to, "reach": float(reach)}

    def _weight(self) -> Tensor:
        return self.gain

    def head(self, previous: Tensor, current: Tensor) -> Tensor:
        """Latent from the bearings of two successive frames, of which the second counts; see :meth:`FrameEncoder.head`."""
        return F.pad(torch.tanh(self.gain * current[..., :2]), (0, self.latent_dim - self.seen_dim))


class TurnedBearingEncoder(BearingEncoder):
    r"""Bearing encoder that also sees how the thing that stands still is turned.

    .. math:: z_t = (\tanh(h_t / r), \; \rho \cos k \alpha_t, \; \rho \sin k \alpha_t, \; 0) \in [-1, 1]^p

    with the direction :math:`(\cos \alpha, \sin \alpha) = e` of :class:`Bearing` in the frame. What looks the same k times in a whole
    turn needs a k-th of it: four for a square, one where nothing is known. The two entries are a
    :class:`~torchrl_sspl.direction.Direction`, for dynamics of this ``turn_radius``. Source: paper eq. (7); the paper does not give
    an architecture.

    Args:
        latent_dim: size p of the latent, at least four.
        image_size, pool_to, reach: as for :class:`BearingEncoder`.
        turn_radius: :math:`\rho`, latent units; how much a turn counts beside a distance.
        folds: k.

    Example:
        >>> TurnedBearingEncoder(latent_dim=5, image_size=128)(torch.zeros(2, 6, 128, 128, dtype=torch.uint8)).shape
        torch.Size([2, 5])
    """

    seen_dim = 4

    def __init__(
        self, latent_dim: int, image_size: int | None = None, *, pool_to: int = 64, reach: float = 0.625, turn_radius: float = 0.3,
        folds: int = 4,
    ) -> None:  # fmt: skip
        if latent_dim < self.seen_dim or not 0.0 < turn_radius <= 1.0 or not isinstance(folds, int) or folds < 1:
            raise ConfigError(
                f"expected latent_dim >= 4, turn_radius in (0, 1] and folds >= 1, received {latent_dim}, {turn_radius!r} and {folds!r}"
            )
        super().__init__(latent_dim, image_size, pool_to=pool_to, reach=reach)
        self.turn_radius, self.folds = float(turn_radius), folds
        self.arguments |= {"turn_radius": self.turn_radius, "folds": folds}

    def head(self, previous: Tensor, current: Tensor) -> Tensor:
        """Latent from the bearings of two successive frames, of which the second counts; see :meth:`FrameEncoder.head`."""
        angle = self.folds * torch.atan2(current[..., 3:], current[..., 2:3])
        seen = [torch.tanh(self.gain * current[..., :2]), self.turn_radius * angle.cos(), self.turn_radius * angle.sin()]
        return F.pad(torch.cat(seen, -1), (0, self.latent_dim - self.seen_dim))

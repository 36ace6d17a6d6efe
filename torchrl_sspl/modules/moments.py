"""An encoder that sees where things are and how they are turned, from the centres of colours."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_sspl.errors import ConfigError, EmptyRegionError
from torchrl_sspl.modules.networks import FrameEncoder

NOISE = 0.05  # difference in [-1, 1] that is not seen
FAINT = 0.15  # the same of a bearing: the noise of a bad camera
REACH = 1.5  # pixels of 64 by which a camera may be out of place
_EDGE = 16  # of a frame's width: so many pixels have to speak for it
WHOLE = 0.9  # of the largest difference, from which a pixel shows the whole colour of a thing


def background_of(frames: Tensor) -> Tensor:
    """The median ``(c, H, W)`` of frames ``(n, c, H, W)``; fewer than ten are an EmptyRegionError."""
    if len(frames) < 10:
        raise EmptyRegionError(f"expected at least 10 frames to fit to, received {len(frames)}; collect more data")
    return frames[:2000].median(0).values


def centre_of(weight: Tensor, axis: Tensor) -> tuple[Tensor, Tensor]:
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
        return torch.cat(centre_of((frames - self.background).abs(), self.axis), -1)

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


def still_of(background: Tensor) -> Tensor:
    """How much of a background ``(c, H, W)`` is not plain ground, ``(H, W)``: its largest difference over the colours, where that is seen."""
    off = (background - background.flatten(1).median(1).values[:, None, None]).abs().amax(0)
    return torch.where(off > NOISE, off, 0.0)


def without_weights(encoder: Any, seen: nn.Module, latent_dim: int, reach: float) -> None:
    """Gives an encoder the latent of what the data fill, without a weight to train."""
    if latent_dim < encoder.seen_dim or not reach > 0.0:
        raise ConfigError(f"expected latent_dim >= {encoder.seen_dim} and reach > 0, received {latent_dim} and {reach}")
    encoder.latent_dim, encoder.reach = latent_dim, float(reach)
    encoder.trunk, encoder.latent_head = nn.Sequential(seen), nn.Sequential()
    encoder.gain.data.fill_(1.0 / encoder.reach)
    encoder.gain.requires_grad_(False)


def turned(ahead: Tensor, away: Tensor) -> Tensor:
    """Places ``(*batch, 2)`` as seen in directions ``(*batch, 2)`` of length one: ahead and aside."""
    across = ahead[..., 0] * away[..., 1] - ahead[..., 1] * away[..., 0]
    return torch.stack([(ahead * away).sum(-1), across], -1)


def facing(place: Tensor, angle: Tensor, radius: float, size: int) -> Tensor:
    """Latents ``(*batch, size)`` of places ``(*batch, 2)`` and angles ``(*batch, 1)``, which lie on a circle; the other entries are zero."""
    seen = torch.cat([place, radius * angle.cos(), radius * angle.sin()], -1)
    return F.pad(seen, (0, size - seen.shape[-1]))


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
        return torch.stack(centre_of((seen - FAINT).clamp_min(0.0) * self.ground, self.axis), 1)

    @torch.no_grad()
    def fit(self, frames: Tensor) -> None:
        """Take everything from frames ``(n, c, H, W)``; fewer than ten are an EmptyRegionError."""
        self.background.copy_(background_of(frames))
        self._look()
        thing = still_of(self.background)
        self.anchor.copy_(torch.stack(centre_of(thing, self.axis)))
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
        return torch.cat([turned(ahead, away), ahead], -1)


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
        without_weights(self, Bearing(pool_to, self.in_channels), latent_dim, reach)
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
        return facing(torch.tanh(self.gain * current[..., :2]), angle, self.turn_radius, self.latent_dim)

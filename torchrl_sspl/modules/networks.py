r"""Default networks: per-frame encoder :math:`E`, latent dynamics :math:`d` and policy :math:`\pi`.

All three live on the bounded latent domain :math:`[-1, 1]^p`. Dynamics and policy are made of linear layers,
ReLU and clamps only, so that linear bound propagation is tight on them.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_sspl.direction import Direction
from torchrl_sspl.errors import ConfigError, DTypeError, ShapeError
from torchrl_sspl.lipschitz.layers import known_form


class _InwardClamp(torch.autograd.Function):
    """Clamp to ``[-1, 1]`` whose gradient vanishes only where descent would move further out."""

    generate_vmap_rule = True

    @staticmethod
    def forward(value: Tensor) -> Tensor:
        return value.clamp(-1.0, 1.0)

    @staticmethod
    def setup_context(ctx, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(inputs[0])

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tensor:
        (value,) = ctx.saved_tensors
        outward = ((value > 1.0) & (grad < 0.0)) | ((value < -1.0) & (grad > 0.0))
        return torch.where(outward, 0.0, grad)


def inward_clamp(value: Tensor) -> Tensor:
    r"""Clamps to :math:`[-1, 1]`, any shape and floating dtype, with a gradient that can always lead back inside.

    .. math:: c(v) = \min(1, \max(-1, v)), \qquad
        \frac{\partial \ell}{\partial v} = \begin{cases} 0 & v > 1, \partial \ell / \partial c < 0 \\
        0 & v < -1, \partial \ell / \partial c > 0 \\ \partial \ell / \partial c & \text{else} \end{cases}

    The value is the exact clamp. The gradient is the straight-through one, except that a step which would
    move further out is dropped. An ordinary clamp (or a saturated tanh) keeps a network that has left the
    interval stuck outside for good; the unrestricted straight-through gradient drives it further out. Source: none.

    Example:
        >>> value = torch.tensor([2.0, 2.0], requires_grad=True)
        >>> (inward_clamp(value) * torch.tensor([1.0, -1.0])).sum().backward()
        >>> value.grad  # the first entry may come down, the second must not go further up
        tensor([1., 0.])
    """
    # Without a gradient it is the clamp alone, which costs a tenth.
    return _InwardClamp.apply(value) if torch.is_grad_enabled() else value.clamp(-1.0, 1.0)


def mlp(sizes: Sequence[int], activation: type[nn.Module] = nn.ReLU) -> nn.Sequential:
    """Linear layers with an activation between them."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), activation()]
    return nn.Sequential(*layers[:-1])


def as_pair(value: int | Sequence[int], name: str) -> tuple[int, int]:
    """Height and width of a size; a ConfigError that names the option if it is none."""
    pair = (value, value) if isinstance(value, int) else tuple(value)
    if len(pair) != 2 or min(pair) < 1:
        raise ConfigError(
            f"expected {name} to be a positive int or a pair (height, width), received {value!r}; "
            f"for instance {name}=64"
        )
    return int(pair[0]), int(pair[1])


def _positive(value: int, name: str) -> int:
    if not isinstance(value, int) or value < 1:
        raise ConfigError(f"expected {name} to be a positive int, received {value!r}; e.g. {name}=2")
    return value


def _action_scale(action_scale: float | Sequence[float] | Tensor, action_dim: int) -> Tensor:
    scale = torch.as_tensor(action_scale, dtype=torch.float32).flatten()
    if scale.numel() not in (1, action_dim) or not bool((scale > 0).all() & scale.isfinite().all()):
        raise ConfigError(
            f"expected action_scale to be one positive number or {action_dim} of them (physical units "
            f"per unit of normalised action), received {action_scale!r}; pass the largest action"
        )
    return scale.expand(action_dim).clone()


def _check_last(tensor: Tensor, size: int, name: str) -> None:
    if tensor.shape[-1:] != (size,):
        raise ShapeError(
            f"expected {name} of shape (*batch, {size}), received {tuple(tensor.shape)}; "
            f"check the sizes that the network was built with"
        )


class FrameEncoder(nn.Module):
    r"""Encodes two stacked frames into a bounded latent, each frame on its own.

    .. math::
        h_t = \operatorname{CNN}(\operatorname{pool}(\text{frame}_t)), \qquad
        z_t = \tanh(\operatorname{MLP}(h_t, k (h_t - h_{t-1}))) \in (-1, 1)^p

    A siamese network needs each frame once, however many stacks it appears in (three passes instead of four
    for a transition), and the difference of smooth features carries the velocity. Frames are pooled to about
    32 x 32 first, which makes the weights independent of the size of the picture. Normalisation is by layer;
    there is no running statistic, so a target network that follows the parameters misses nothing.
    Source: paper eq. (7), :math:`z_i = E_\theta(\mathcal{O}_i)`; the paper does not give an architecture, and its
    latent is unbounded.

    Args:
        latent_dim: size p of the latent.
        image_size: height and width of the frames in pixels; ``None`` accepts any size.
        pool_to: height and width after average pooling.
        channels: output channels of the stride-2 convolutions.
        features: size of the features of one frame.
        hidden: width of the two MLPs.
        velocity_gain: gain k of the difference of features.
        in_channels: colour channels of one frame.

    Raises:
        ConfigError: if a size is not a positive integer.
        DTypeError: when called, if frames are not uint8.
        ShapeError: when called, if channels or size do not fit.

    Example:
        >>> encoder = FrameEncoder(latent_dim=2, image_size=64)
        >>> encoder(torch.zeros(5, 6, 64, 64, dtype=torch.uint8)).shape
        torch.Size([5, 2])
        >>> encoder.sequence(torch.zeros(5, 3, 3, 64, 64, dtype=torch.uint8)).shape
        torch.Size([5, 2, 2])
    """

    def __init__(
        self,
        latent_dim: int,
        image_size: int | Sequence[int] | None = None,
        *,
        pool_to: int | Sequence[int] = 32,
        channels: Sequence[int] = (16, 32, 32),
        features: int = 16,
        hidden: int = 128,
        velocity_gain: float = 4.0,
        in_channels: int = 3,
    ) -> None:
        super().__init__()
        self.latent_dim = _positive(latent_dim, "latent_dim")
        self.image_size = None if image_size is None else as_pair(image_size, "image_size")
        self.pool_to = as_pair(pool_to, "pool_to")
        self.features = _positive(features, "features")
        self.velocity_gain = float(velocity_gain)
        self.in_channels = _positive(in_channels, "in_channels")
        #: How to build it again; travels with an agent.
        self.arguments: dict[str, Any] = {
            "latent_dim": latent_dim, "image_size": image_size if self.image_size is None else list(self.image_size),
            "pool_to": list(self.pool_to), "channels": list(channels), "features": features, "hidden": hidden,
            "velocity_gain": self.velocity_gain, "in_channels": in_channels,
        }  # fmt: skip
        layers: list[nn.Module] = []
        height, width, previous = *self.pool_to, self.in_channels
        for size in channels:
            layers += [nn.Conv2d(previous, size, 3, stride=2, padding=1), nn.SiLU()]
            height, width, previous = (height + 1) // 2, (width + 1) // 2, size
        flat = height * width * previous
        self.trunk = nn.Sequential(
            *layers, nn.Flatten(), nn.LayerNorm(flat), nn.Linear(flat, hidden), nn.SiLU(), nn.Linear(hidden, features)
        )
        self.latent_head = mlp((2 * features, hidden, latent_dim), nn.SiLU)

    def _check(self, frames: Tensor, channels: int, name: str) -> None:
        height, width = self.image_size or ("H", "W")
        expected = f"(*batch, {channels}, {height}, {width})"
        if frames.dtype != torch.uint8:
            raise DTypeError(
                f"expected {name} of dtype torch.uint8 in 0..255, received {frames.dtype}; "
                f"pass the frames as they were rendered, the encoder scales them itself"
            )
        wrong_size = self.image_size is not None and frames.shape[-2:] != self.image_size
        if frames.ndim < 3 or frames.shape[-3] != channels or wrong_size:
            raise ShapeError(
                f"expected {name} of shape {expected}, received {tuple(frames.shape)}; channels come first, "
                f"and image_size=None accepts any height and width"
            )

    def _weight(self) -> Tensor:
        """One of the weights. Not ``next(self.parameters())``: a delayed copy has none."""
        return cast(Tensor, self.latent_head[0].weight)

    def frames(self, frames: Tensor) -> Tensor:
        """Features ``(*batch, features)`` of single frames ``(*batch, 3, H, W)`` uint8."""
        self._check(frames, self.in_channels, "frames")
        batch = frames.shape[:-3]
        dtype = self._weight().dtype
        flat = frames.reshape(-1, *frames.shape[-3:])
        if flat.device.type == "cpu" and not torch.compiler.is_compiling():
            # A few frames at a time stay in the cache: more than twice as fast, the same numbers.
            pooled = torch.cat([self._pool_bytes(part, dtype) / 127.5 - 1.0 for part in flat.split(32)])
        else:
            pooled = self._pool(flat.to(dtype)) / 127.5 - 1.0
        return self.trunk(pooled).reshape(*batch, self.features)

    def _pool(self, frames: Tensor) -> Tensor:
        """Average frames ``(n, c, H, W)`` to ``pool_to``."""
        height, width = frames.shape[-2:]
        if height % self.pool_to[0] or width % self.pool_to[1]:
            return F.adaptive_avg_pool2d(frames, self.pool_to)
        # The same average as the adaptive pooling, several times faster.
        kernel = (height // self.pool_to[0], width // self.pool_to[1])
        return frames if kernel == (1, 1) else F.avg_pool2d(frames, kernel)

    def _pool_bytes(self, frames: Tensor, dtype: torch.dtype) -> Tensor:
        """The same average of uint8 frames, summed in integers: several times faster, and as exact."""
        (n, c, height, width), (rows, columns) = frames.shape, self.pool_to
        k, m = height // rows, width // columns
        if height % rows or width % columns or k > 128 or k * m == 1:  # 128 rows of 255 are the most that 16 bits hold
            return self._pool(frames.to(dtype))
        parts = frames.reshape(n, c, rows, k, width)
        line = parts[:, :, :, 0].to(torch.int16)
        for i in range(1, k):
            line += parts[:, :, :, i]
        cells = line.reshape(n, c, rows, columns, m)
        total = cells[..., 0].to(dtype)
        for i in range(1, m):
            total += cells[..., i]
        return total / (k * m)

    def head(self, previous: Tensor, current: Tensor) -> Tensor:
        """Latent ``(*batch, p)`` in ``[-1, 1]`` from the features ``(*batch, features)`` of two successive frames."""
        _check_last(previous, self.features, "previous")
        _check_last(current, self.features, "current")
        motion = self.velocity_gain * (current - previous)
        return torch.tanh(self.latent_head(torch.cat([current, motion], -1)))

    def sequence(self, frames: Tensor) -> Tensor:
        """Latents ``(*batch, T - 1, p)`` of frames ``(*batch, T, 3, H, W)`` uint8, entry k of frames k and k + 1."""
        if frames.ndim < 4 or frames.shape[-4] < 2:
            raise ShapeError(
                f"expected frames of shape (*batch, T, {self.in_channels}, H, W) with T >= 2, received "
                f"{tuple(frames.shape)}; a latent needs two successive frames"
            )
        features = self.frames(frames)
        return self.head(features[..., :-1, :], features[..., 1:, :])

    def forward(self, pixels: Tensor) -> Tensor:
        """Latent ``(*batch, p)`` in ``[-1, 1]`` of pixels ``(*batch, 6, H, W)`` uint8, frame t-1 then frame t."""
        self._check(pixels, 2 * self.in_channels, "pixels")
        stacked = pixels.reshape(*pixels.shape[:-3], 2, self.in_channels, *pixels.shape[-2:])
        return self.sequence(stacked).squeeze(-2)


class _OfLatents(nn.Module):
    """A network of latents and actions: sizes of what it reads and gives, the layers between, and the scale."""

    action_scale: Tensor
    _reads: tuple[str, ...]
    _gives: str

    def __init__(
        self,
        latent_dim: int,
        action_dim: int,
        hidden: Sequence[int] = (64, 64),
        action_scale: float | Sequence[float] | Tensor = 1.0,
    ) -> None:
        super().__init__()
        self.latent_dim = _positive(latent_dim, "latent_dim")
        self.action_dim = _positive(action_dim, "action_dim")
        # A constant, not a statistic: nothing that a target network would have to follow.
        self.register_buffer("action_scale", _action_scale(action_scale, action_dim))
        self.net = mlp((sum(getattr(self, size) for size in self._reads), *hidden, getattr(self, self._gives)))
        sizes = {"latent_dim": latent_dim, "action_dim": action_dim, "hidden": list(hidden)}
        self.arguments: dict[str, Any] = {**sizes, "action_scale": self.action_scale.flatten().tolist()}


@known_form("residual")
class LatentDynamics(_OfLatents):
    r"""Predicts the next latent from latent and action, on the bounded domain.

    .. math:: d(z, u) = \operatorname{clamp}(z + \operatorname{net}(z, u / u_{\max}), -1, 1)

    The residual form makes "nothing moves" the easy guess. See :func:`inward_clamp` for the gradient.
    With ``remembers`` the last entries of the latent are the action of the step before,

    .. math:: d((y, a), u) = \operatorname{clamp}((y + \operatorname{net}(y, a, u / u_{\max}), u / u_{\max}), -1, 1)

    which a system that acts late needs, and which no picture shows: an observer keeps them. With ``turn_radius`` the two entries
    before these are a :class:`~torchrl_sspl.direction.Direction`, which the network turns: its last output is a length along the circle.
    Source: paper eq. (8), third term; the paper does not give an architecture.

    Args:
        latent_dim, action_dim: sizes of latent and action.
        hidden: widths of the hidden layers (ReLU).
        action_scale: physical units per unit of normalised action, a number or one per dimension.
        remembers: whether the last ``action_dim`` entries of the latent are the action before.
        turn_radius: r of the direction, latent units; 0: none.

    Raises:
        ConfigError: if a size or the scale is not valid.
        ShapeError: when called, if a last dimension does not fit; as for the other networks of latents.

    Example:
        >>> LatentDynamics(latent_dim=2, action_dim=1, action_scale=10.0)(torch.zeros(5, 2), torch.ones(5, 1)).shape
        torch.Size([5, 2])
    """

    _reads, _gives = ("latent_dim", "action_dim"), "moving_dim"

    def __init__(
        self,
        latent_dim: int,
        action_dim: int,
        hidden: Sequence[int] = (64, 64),
        action_scale: float | Sequence[float] | Tensor = 1.0,
        remembers: bool = False,
        turn_radius: float = 0.0,
    ) -> None:
        self.remembers = remembers
        if remembers and not latent_dim > action_dim:
            raise ConfigError(f"expected latent_dim > action_dim={action_dim} to remember actions, received {latent_dim}")
        seen = latent_dim - action_dim if remembers else latent_dim
        if not 0.0 <= turn_radius <= 1.0 or (turn_radius and seen < 2):
            raise ConfigError(f"expected turn_radius in [0, 1] and two entries for it, received {turn_radius!r} and {seen} entries")
        #: Where the latent holds a direction; None: nowhere.
        self.direction = Direction(seen - 2, float(turn_radius)) if turn_radius else None
        super().__init__(latent_dim, action_dim, hidden, action_scale)
        if remembers:
            self.arguments["remembers"] = True
        if turn_radius:
            self.arguments["turn_radius"] = float(turn_radius)

    @property
    def moving_dim(self) -> int:
        """Numbers that the network predicts: one for each entry that pictures show, one for the two of a direction."""
        seen = self.latent_dim - self.action_dim if self.remembers else self.latent_dim
        return seen if self.direction is None else seen - 1

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        """Next latent in ``[-1, 1]`` of latents ``(*batch, p)``, actions ``(*batch, action_dim)`` in physical units."""
        _check_last(latent, self.latent_dim, "latent")
        _check_last(action, self.action_dim, "action")
        action = action / self.action_scale
        by = self.net(torch.cat([latent, action], -1))
        if self.direction is None:
            moved = latent[..., : self.moving_dim] + by
            return inward_clamp(torch.cat([moved, action], -1) if self.remembers else moved)
        first = self.direction.first
        moved = [inward_clamp(latent[..., :first] + by[..., :first]), self.direction.turn(latent, by[..., first:])]
        return torch.cat([*moved, inward_clamp(action)] if self.remembers else moved, -1)


@known_form("bounded")
class Policy(_OfLatents):
    r"""Deterministic bounded policy on latents; arguments and errors as for :class:`LatentDynamics`.

    .. math:: \pi(z) = u_{\max} \operatorname{clamp}(\operatorname{net}(z), -1, 1)

    See :func:`inward_clamp` for the gradient, which does not get stuck at the limits of the action.
    Source: paper section III-C, :math:`\pi_\theta(z_i)`; the paper does not give an architecture.

    Example:
        >>> policy = Policy(latent_dim=2, action_dim=1, action_scale=10.0)
        >>> bool(policy(torch.randn(100, 2)).abs().max() <= 10.0)
        True
    """

    _reads, _gives = ("latent_dim",), "action_dim"

    def __init__(
        self,
        latent_dim: int,
        action_dim: int,
        hidden: Sequence[int] = (32, 32),
        action_scale: float | Sequence[float] | Tensor = 1.0,
    ) -> None:
        super().__init__(latent_dim, action_dim, hidden, action_scale)

    def forward(self, latent: Tensor) -> Tensor:
        """Action ``(*batch, action_dim)`` in physical units of a latent ``(*batch, p)``."""
        _check_last(latent, self.latent_dim, "latent")
        return self.action_scale * inward_clamp(self.net(latent))


class InverseDynamics(_OfLatents):
    r"""Reads the action from two successive latents; a training aid that is not deployed.

    .. math:: \hat u = u_{\max} \operatorname{net}(z_t, z_{t+1})

    A latent from which the action can be read has to keep what the action changes (here: velocities). Arguments and
    errors as for :class:`LatentDynamics`. Source: none (the paper has no such term).

    Example:
        >>> InverseDynamics(2, 1)(torch.zeros(5, 2), torch.zeros(5, 2)).shape
        torch.Size([5, 1])
    """

    _reads, _gives = ("latent_dim", "latent_dim"), "action_dim"

    def forward(self, latent: Tensor, next_latent: Tensor) -> Tensor:
        """Estimated action ``(*batch, action_dim)``, in physical units, between two latents ``(*batch, p)``."""
        _check_last(latent, self.latent_dim, "latent")
        _check_last(next_latent, self.latent_dim, "next_latent")
        return self.action_scale * self.net(torch.cat([latent, next_latent], -1))

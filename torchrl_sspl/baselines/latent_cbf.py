r"""Latent CBF: an autoencoder of bounded gain, control-affine latent dynamics and a barrier in the latent.

Faithful to what is known of Kumar, Lin, Dolan, *LatentCBF: A control barrier function in latent space for safe control*, 2024,
which this library's paper describes in a sentence: Lipschitz autoencoder, reconstruction loss, control-affine latent dynamics.
The paper itself was not at hand: sizes, weights and the order of the stages are ours. Spectral normalisation bounds each
layer's weight matrix, of convolutions the reshaped one, as common code does; it is no proof of a Lipschitz constant. The
condition outside the labels asks for the best of a few actions, as the paper names no controller.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrizations import spectral_norm

from torchrl_sspl.baselines.base import Budget, Needs, OneStepFilter
from torchrl_sspl.baselines.data import POOL, Recording, pooled
from torchrl_sspl.baselines.perception import train
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.modules import InverseDynamics
from torchrl_sspl.modules.networks import mlp
from torchrl_sspl.sets import SAFE, UNSAFE


class BoundedAutoencoder(nn.Module):
    """Two pictures to a latent and back, each layer of the encoder normalised. Source: see the module.

    Args:
        latent: size of the latent.
        gain: factor behind the normalised layers.

    Example:
        >>> net = BoundedAutoencoder(8, 4.0)
        >>> net.decode(net(torch.zeros(2, 6, 32, 32, dtype=torch.uint8))).shape
        torch.Size([2, 6, 32, 32])
    """

    def __init__(self, latent: int, gain: float) -> None:
        super().__init__()
        self.gain = gain
        layers: list[nn.Module] = []
        for a, b in ((6, 16), (16, 32), (32, 32)):
            layers += [spectral_norm(nn.Conv2d(a, b, 3, stride=2, padding=1)), nn.ReLU()]
        self.encoder = nn.Sequential(*layers, nn.Flatten(), spectral_norm(nn.Linear(32 * (POOL // 8) ** 2, latent)))
        up: list[nn.Module] = [nn.Linear(latent, 32 * (POOL // 8) ** 2), nn.ReLU(), nn.Unflatten(1, (32, POOL // 8, POOL // 8))]
        for a, b in ((32, 32), (32, 16), (16, 6)):
            up += [nn.ConvTranspose2d(a, b, 4, stride=2, padding=1), nn.ReLU()]
        self.decoder = nn.Sequential(*up[:-1])

    def forward(self, pixels: Tensor) -> Tensor:
        """Latents ``(n, latent)`` of uint8 ``(n, 6, 32, 32)``."""
        return self.gain * self.encoder(pixels.float() / 127.5 - 1.0)

    def decode(self, latent: Tensor) -> Tensor:
        """Pictures ``(n, 6, 32, 32)`` in the units of the encoder's input."""
        return self.decoder(latent)


class ControlAffine(nn.Module):
    r"""Latent dynamics :math:`z' = z + dt\,(f(z) + g(z) u / u_{max})`. Source: see the module."""

    def __init__(self, latent: int, actions: int, dt: float, scale: float) -> None:
        super().__init__()
        self.f, self.g = mlp((latent, 96, 96, latent), nn.SiLU), mlp((latent, 96, 96, latent * actions), nn.SiLU)
        self.dt, self.scale, self.actions = dt, scale, actions

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        """Next latents ``(n, p)``."""
        push = self.g(latent).reshape(*latent.shape, self.actions) @ (action / self.scale)[..., None]
        return latent + self.dt * (self.f(latent) + push[..., 0])


@dataclass
class LatentCBFConfig:
    """Options of the latent barrier."""

    latent: int = 8  # size
    gain: float = 4.0  # of the encoder
    autoencoder_steps: int = 1200  # of the optimiser
    steps: int = 2000  # of dynamics, and of the barrier
    inverse_dynamics: float = 0.0  # weight of reading the action from two latents, which the method lacks
    alpha: float = 0.9  # share of h that a step has to leave
    margin: float = 0.1  # of the hinges
    hinge: float = 1.0  # their weight
    offset: float = 0.0  # added to -h, in claim and filter
    tries: int = 7  # actions at which the condition is asked


class LatentCBF(OneStepFilter):
    r"""Latent CBF (Kumar, Lin, Dolan 2024): bounded autoencoder, control-affine latent dynamics, barrier h.

    .. math:: L_h = \mathbb{E}_S [m - h]_+ + \mathbb{E}_U [m + h]_+ + \mathbb{E}\, [\alpha h(z) - \max_u h(z')]_+

    with labels for S and U only: what this library's own method is given. Source: see the module.
    """

    name = "latent_cbf"
    Config: ClassVar[type | None] = LatentCBFConfig
    # Its hinges ask h for 0.1 on S: a larger offset may leave nothing.
    space: ClassVar[dict[str, tuple[Any, ...]]] = {
        "autoencoder_steps": (1200, 3600), "gain": (2.0, 4.0, 8.0), "hinge": (1.0, 10.0, 100.0), "alpha": (0.5, 0.8, 0.9), "offset": (0.0, 0.03, 0.09),
    }  # fmt: skip

    def fit(self, data: Recording, env: SafetyEnv, budget: Budget, seed: int) -> None:
        """Autoencoder, dynamics, barrier, one after the other; see :meth:`SafetyMethod.fit`."""
        c = self.config
        if env.action_dim != 1 or getattr(env, "dt", None) is None:
            raise ConfigError(
                f"{self.name}: expected a system of one action, whose attribute dt is the time step [s], received {type(env).__name__} with "
                f"{env.action_dim} actions and dt={getattr(env, 'dt', None)}; set dt, or take a method of another kind for more actions"
            )
        if data.frames.shape[-1] != POOL:
            raise ConfigError(f"{self.name}: expected pictures of {POOL} x {POOL}, received {data.frames.shape[-1]} x {data.frames.shape[-1]}")
        self.env, self.alpha, self.offset = env, c.alpha, c.offset
        networks = ("latent", "gain", "autoencoder_steps", "inverse_dynamics")
        self.encoder, self.notes["reconstruction_loss"], z, after = self.stage(networks, lambda: self._reconstruct(data, seed))
        self.mean, self.scale = z.mean(0), z.std(0).clamp_min(1e-3)
        z, after = (z - self.mean) / self.scale, (after - self.mean) / self.scale
        self.dynamics = ControlAffine(c.latent, env.action_dim, env.dt, env.max_action)  # type: ignore[attr-defined]

        def follow(rows: Tensor) -> dict[str, Tensor]:
            return {"loss": (self.dynamics(z[rows], data.action[rows]) - after[rows]).square().mean()}

        loop = train(seed, c.steps, {self.dynamics: 3e-3}, follow, len(data), 256)
        self.notes["dynamics_loss"] = float(loop.loss or 0.0)
        self._learn_barrier(z, data.region, seed)
        self.needs = Needs(**data.labels(), claimed="invariance of {h >= 0} under the learned latent dynamics")

    def _reconstruct(self, data: Recording, seed: int) -> tuple[BoundedAutoencoder, float, Tensor, Tensor]:
        """The autoencoder, its loss, and the latents of all pictures and of those that follow."""
        encoder = BoundedAutoencoder(self.config.latent, self.config.gain)
        median = data.frames[:: max(1, len(data) // 500), 1].float().median(0).values.repeat(2, 1, 1)
        networks: dict[nn.Module, float] = {encoder: 2e-3}
        weight = self.config.inverse_dynamics
        inverse = InverseDynamics(self.config.latent, self.env.action_dim, action_scale=self.env.max_action)
        if weight:
            networks[inverse] = 2e-3

        def loss(rows: Tensor) -> dict[str, Tensor]:
            pixels = data.frames[rows, :2].flatten(1, 2)
            z = encoder(pixels)
            wanted = pixels.float()
            heavy = 1.0 + 9.0 * ((wanted - median).abs() > 8.0)
            terms = {"loss": (heavy * (encoder.decode(z) - (wanted / 127.5 - 1.0)).square()).mean()}
            if weight:
                told = inverse(z, encoder(data.frames[rows, 1:].flatten(1, 2)))
                terms["loss_inverse"] = weight * ((told - data.action[rows]) / self.env.max_action).square().mean()
            return terms

        loop = train(seed, self.config.autoencoder_steps, networks, loss, len(data), 64)
        encoder.eval()
        with torch.no_grad():
            z, after = (torch.cat([encoder(p) for p in pixels.split(500)]) for pixels in (data.pixels, data.next_pixels))
        return encoder, float(loop.loss or 0.0), z, after

    def _learn_barrier(self, z: Tensor, region: Tensor, seed: int) -> None:
        c = self.config
        self.barrier_net = mlp((c.latent, 64, 64, 1), nn.SiLU)
        tried = torch.linspace(-self.env.max_action, self.env.max_action, c.tries)
        safe, unsafe = (region == SAFE).nonzero()[:, 0], (region == UNSAFE).nonzero()[:, 0]

        def loss(rows: Tensor) -> dict[str, Tensor]:
            k = len(rows) // 4
            own = [group[rows[:k] % len(group)] if len(group) else group for group in (safe, unsafe)]
            terms: dict[str, Tensor] = {}
            for name, index, sign in (("safe", own[0], 1.0), ("unsafe", own[1], -1.0)):
                h = sign * self.barrier_net(z[index])[:, 0]
                terms[f"loss_{name}"] = c.hinge * (c.margin - h).clamp_min(0).mean() if len(index) else h.sum()
            at = z[rows]
            with torch.no_grad():
                flat = at[:, None].expand(len(at), c.tries, at.shape[1]).reshape(-1, at.shape[1])
                after = self.dynamics(flat, tried.repeat(len(at))[:, None])
            best = self.barrier_net(after).reshape(len(at), c.tries).amax(1)
            here = self.barrier_net(at)[:, 0]
            terms["loss_kept"] = ((c.alpha * here - best).clamp_min(0) * (here > 0)).mean()
            return terms

        loop = train(seed + 1, c.steps, {self.barrier_net: 3e-3}, loss, len(z), 256)
        self.notes["barrier_loss"] = float(loop.loss or 0.0)

    @torch.no_grad()
    def perceive(self, seen: Tensor) -> Tensor:
        """Normalised latents."""
        return (self.encoder(pooled(seen)) - self.mean) / self.scale

    @torch.no_grad()
    def h(self, state: Tensor) -> Tensor:
        """Minus the learned barrier."""
        return -self.barrier_net(state)[:, 0]

    @torch.no_grad()
    def predict(self, state: Tensor, action: Tensor) -> Tensor:
        """The learned latent dynamics."""
        return self.dynamics(state, action)


__all__ = ["BoundedAutoencoder", "ControlAffine", "LatentCBF"]

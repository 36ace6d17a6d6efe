r"""Latent safety filters: a margin of failure in the latent of a world model, and its reachability value by reinforcement learning.

Faithful to Nakamura, Peters, Bajcsy, *Generalizing safety beyond collision-avoidance via latent-space reachability analysis*,
RSS 2025 (arXiv 2502.00935; code CMU-IntentLab/latent-safety): a failure label for every picture, margin hinge of 0.75, tanh, the
discounted safety Bellman backup, a filter that switches to the best action where Q falls below a
threshold. Stand-ins: this library's encoder and deterministic latent dynamics (SaLaD, trained with the failure labels alone) in
place of a recurrent world model of 27 million weights; 21 actions with one Q each, all of them backed up in imagination, in place of
DDPG; 5 x 10^3 updates in place of 6 x 10^5; and a discount that rises from 0 to its value, where theirs is 0 in the first of 15 parts of the updates and
0.9999 in the others (``warmup=0.07``). Published are that discount, tau of 0.005, a batch of 512 and a Q of three layers of 128 (``published``): on the cars
that finds more than the defaults do, with the discount that rises; with so few updates theirs keeps much less. Backups go on beyond the border of the arena, where a car is safe and nothing is learnt: a few states at the
border are not claimed for that. Between CMU's discs the latent dynamics do not keep the length of a direction, as this library's own agents do.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_sspl.baselines.base import Budget, Needs, SafetyMethod
from torchrl_sspl.baselines.data import POOL, Recording, pooled
from torchrl_sspl.baselines.perception import encoder_for, train
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.modules import FrameEncoder, LatentDynamics
from torchrl_sspl.modules.networks import mlp
from torchrl_sspl.objectives import SaLaDLoss
from torchrl_sspl.sets import SAFE, UNSAFE

_HINGE = 0.75


@dataclass
class LatentSafeConfig:
    """Options of the latent filter."""

    latent: int = 4  # size; the pendulum's is one less
    world_steps: int = 2000  # of the optimiser on pictures
    margin_steps: int = 2000  # on the margin
    steps: int = 5000  # on Q
    discount: float = 0.995  # at the end; its distance from 1 falls geometrically from 1 unless there is a warm-up
    warmup: float = 0.0  # share of the updates with a discount of 0, before the whole discount; 0: annealed
    tau: float = 0.02  # step of the delayed Q
    actions: int = 21
    threshold: float = 0.0  # eps of the filter
    batch: int = 256
    layers: int = 2  # of Q, 128 units each
    pixels: int = POOL  # height and width to which pictures are averaged; what this library's own agent sees is 64, of CMU's cars 128


class LatentSafe(SafetyMethod):
    r"""Latent safety filter (Nakamura, Peters, Bajcsy, RSS 2025): safe where the latent reachability value is positive.

    .. math:: Q(z, u) \leftarrow (1 - \gamma)\, l(z) + \gamma \min\bigl(l(z), \max_{u'} Q(d(z, u), u')\bigr)

    Source: see the module.
    """

    name = "latent_safe"
    Config: ClassVar[type | None] = LatentSafeConfig
    space: ClassVar[dict[str, tuple[Any, ...]]] = {
        "world_steps": (2000, 6000), "discount": (0.98, 0.995, 0.999), "threshold": (0.0, 0.1, 0.2, 0.3), "actions": (21, 41),
    }  # fmt: skip
    published: ClassVar[dict[str, Any]] = {"discount": 0.9999, "tau": 0.005, "batch": 512, "layers": 3}

    def fit(self, data: Recording, env: SafetyEnv, budget: Budget, seed: int) -> None:
        """World model, margin, value, one after the other; see :meth:`SafetyMethod.fit`."""
        c = self.config
        if env.action_dim != 1:
            raise ConfigError(f"{self.name}: expected a system of one action, received {type(env).__name__} with {env.action_dim}; take a method of another kind")
        self.env = env
        failed = data.region == UNSAFE
        region = torch.where(failed, UNSAFE, SAFE)
        self.encoder, self.dynamics, self.notes["world_loss"] = self.stage(("latent", "world_steps", "pixels"), lambda: self._world(data, region, seed))
        with torch.no_grad():
            z = torch.cat([self.encoder(part) for part in data.pixels.split(500)])
        self.margin = nn.Sequential(mlp((z.shape[1], 64, 64, 64, 1), nn.SiLU))
        good, bad = (~failed).nonzero()[:, 0], failed.nonzero()[:, 0]

        def hinge(rows: Tensor) -> dict[str, Tensor]:
            return self.margin_loss(z[good[rows % len(good)]], z[bad[rows % len(bad)]])

        loop = train(seed + 1, c.margin_steps, {self.margin: 1e-3}, hinge, len(z), c.batch)
        self.notes["margin_loss"] = float(loop.loss or 0.0)
        self._reach(z, seed)
        self.needs = Needs(
            transitions=len(data), safe_labels=len(good), unsafe_labels=len(bad), claimed="a value in the learned latent dynamics"
        )

    def _world(self, data: Recording, region: Tensor, seed: int) -> tuple[FrameEncoder, LatentDynamics, float]:
        c, env = self.config, self.env
        size = c.latent if env.state_dim > 2 else c.latent - 1
        encoder = encoder_for(env, size, data)
        size = encoder.latent_dim
        dynamics = LatentDynamics(size, env.action_dim, (96, 96), env.max_action)
        salad = SaLaDLoss(
            None, dynamics, mlp((size, 64, 64, 1), nn.SiLU), consistency="online", safety_margin=0.3, safe_coeff=0.3, unsafe_coeff=0.3,
            consistency_coeff=2.0, inverse_dynamics_coeff=1.0, variance_coeff=0.5, covariance_coeff=0.5, saturation_coeff=0.3,
        )  # fmt: skip

        def loss(rows: Tensor) -> dict[str, Tensor]:
            now, then = encoder.sequence(data.frames[rows]).unbind(1)
            body = {"latent": now, "action": data.action[rows], "region": region[rows, None], "next": {"latent": then}}
            return dict(salad(TensorDict(body, [len(rows)])).items())

        loop = train(seed, c.world_steps, {encoder: 3e-3, salad: 3e-3}, loss, len(data))
        return encoder.eval(), dynamics, float(loop.loss or 0.0)

    def margin_loss(self, good: Tensor, bad: Tensor) -> dict[str, Tensor]:
        """Hinges on the latents of pictures without and with a failure."""
        return {
            "loss_good": 10.0 * (_HINGE - self.margin(good)).clamp_min(0).mean(),
            "loss_bad": 10.0 * (_HINGE + self.margin(bad)).clamp_min(0).mean(),
        }

    def _reach(self, z: Tensor, seed: int) -> None:
        """The value of the latents, by backups in imagination over all actions at once."""
        c, k = self.config, self.config.actions
        self.tried = torch.linspace(-self.env.max_action, self.env.max_action, k)
        self.value = mlp((z.shape[1], *[128] * c.layers, k), nn.SiLU)
        delayed, done = copy.deepcopy(self.value), [0]

        def loss(rows: Tensor) -> dict[str, Tensor]:
            share = done[0] / max(1, c.steps)
            done[0] += 1
            annealed = 1.0 - (1.0 - c.discount) ** min(1.0, share / 0.8) if c.steps > 1 else c.discount
            gamma = c.discount * (share >= c.warmup) if c.warmup else annealed
            at = z[rows]
            with torch.no_grad():
                for slow, fast in zip(delayed.parameters(), self.value.parameters(), strict=True):
                    slow.lerp_(fast, c.tau)
                margin = self.margin(at).tanh()
                flat = at[:, None].expand(len(at), k, at.shape[1]).reshape(-1, at.shape[1])
                after = self.dynamics(flat, self.tried.repeat(len(at))[:, None])
                best = delayed(after).amax(1).reshape(len(at), k)
                wanted = (1 - gamma) * margin + gamma * torch.minimum(margin, best)
            return {"loss": (self.value(at) - wanted).square().mean()}

        loop = train(seed + 2, c.steps, {self.value: 1e-3}, loss, len(z), c.batch)
        self.notes["value_loss"] = float(loop.loss or 0.0)

    @torch.no_grad()
    def _q(self, seen: Tensor) -> Tensor:
        return self.value(self.encoder(pooled(seen, self.encoder.pool_to[0])))

    def barrier(self, seen: Tensor) -> Tensor | None:
        """Minus the value of the best action, raised by the threshold; zero does not count as safe."""
        value = self._q(seen).amax(1) - self.config.threshold
        return torch.where(value > 0, -value, (-value).clamp_min(1e-9))

    def value_of(self, q: Tensor, action: Tensor) -> Tensor:
        """Of values ``(n, k)`` that of the tried action nearest to each of ``(n, 1)``."""
        share = (action[:, 0] / self.env.max_action).clamp(-1, 1)
        index = ((share + 1) / 2 * (len(self.tried) - 1)).round().long()
        return q[torch.arange(len(q)), index]

    def act(self, seen: Tensor, nominal: Tensor) -> tuple[Tensor, Tensor]:
        """The wanted action where its value is above the threshold, else the best one."""
        q = self._q(seen)
        kept = self.value_of(q, nominal) > self.config.threshold
        action = torch.where(kept[:, None], nominal, self.tried[q.argmax(1)][:, None])
        return action, q.amax(1) <= self.config.threshold


__all__ = ["LatentSafe"]

r"""CMU's LatentCBF: a latent safety filter whose margin has a bounded slope, and a filter that keeps a share of the best value.

Faithful to Nakamura et al., *How to train your latent control barrier function*, L4DC 2026 (arXiv 2511.18606; code
CMU-IntentLab/latent_cbf): the Wasserstein-like margin with a gradient penalty on segments between safe and failed latents, and
the filter that keeps the actions of at least nine tenths of the best value and takes the nearest of 25 and the wanted one. Stand-ins: those of
:mod:`~torchrl_sspl.baselines.latent_safe`, on which it builds; and random data throughout, where the paper replays half of a
nominal and half of a safety policy; and a Q of 128 units a layer in place of 512.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchrl_sspl.baselines.base import nearest_admissible
from torchrl_sspl.baselines.latent_safe import LatentSafe, LatentSafeConfig


@dataclass
class SmoothLatentConfig(LatentSafeConfig):
    """Options of the latent barrier with a gradient penalty."""

    actions: int = 25
    slope: float = 0.1  # of the margin between safe and failed latents
    penalty: float = 10.0  # weight of what the slope differs from that
    keep: float = 0.9  # share of the best value that an action has to keep


class SmoothLatent(LatentSafe):
    r"""CMU's LatentCBF (Nakamura et al., L4DC 2026): margin with a gradient penalty, a filter on the share of the best value.

    .. math:: L_l = 0.1\,(\mathbb{E}_{fail} l - \mathbb{E}_{safe} l) + \mathbb{E}_{fail} [l]_+ + \mathbb{E}_{safe} [-l]_+
        + 10\,(\lVert \nabla l(\tilde z) \rVert - 0.1)^2

    Source: see the module.
    """

    name = "smooth_latent"
    Config: ClassVar[type | None] = SmoothLatentConfig
    # With a slope of 0.1 the margin reaches about 0.1, and no value is larger.
    space: ClassVar[dict[str, tuple[Any, ...]]] = {
        "world_steps": (2000, 6000), "discount": (0.98, 0.995, 0.999), "threshold": (0.0, 0.01, 0.02, 0.05), "keep": (0.5, 0.8, 0.9, 0.95),
    }  # fmt: skip

    def margin_loss(self, good: Tensor, bad: Tensor) -> dict[str, Tensor]:
        """The formula above."""
        c, share = self.config, torch.rand(len(good), 1)
        between = (share * good + (1 - share) * bad).requires_grad_()
        (slope,) = torch.autograd.grad(self.margin(between).sum(), between, create_graph=True)
        safe, failed = self.margin(good), self.margin(bad)
        return {
            "loss_apart": 0.1 * (failed.mean() - safe.mean()),
            "loss_sign": failed.clamp_min(0).mean() + (-safe).clamp_min(0).mean(),
            "loss_slope": c.penalty * (slope.norm(dim=-1) - c.slope).square().mean(),
        }

    def act(self, seen: Tensor, nominal: Tensor) -> tuple[Tensor, Tensor]:
        """The wanted action or the nearest that keeps the share of the best value; where that is not positive, the best one."""
        q = self._q(seen)
        best = q.amax(1)
        bound = torch.where(best > 0, self.config.keep * best, best)
        tried = torch.cat([nominal[:, None], self.tried[None, :, None].expand(len(q), -1, 1)], 1)
        # The wanted action counts as the one of the grid that is nearest to it.
        action, _ = nearest_admissible(tried, -torch.cat([self.value_of(q, nominal)[:, None], q], 1), -bound, nominal)
        return action, best <= self.config.threshold


__all__ = ["SmoothLatent"]

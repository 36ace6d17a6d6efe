r"""A policy that chooses: its own action where the barrier is content with it, else the best of a table."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.lipschitz.layers import known_form


@known_form("choosing")
class ChoosingPolicy(nn.Module):
    r"""A policy's own action where it surely keeps the set, else the one of a table whose successor lies deepest in it.

    .. math:: u = \begin{cases} \pi(z) & B(d(z, \pi(z))) \le -m \\ a_k, \; k = \arg\min_j B(d(z, a_j)) & \text{else} \end{cases}

    A continuous policy that passes an obstacle on either side does neither somewhere between; this one has to decide (the first of
    the best). Dynamics and barrier are those of :meth:`bind`; they are referred to, and no part of this module's state.
    Source: none (the paper's policy is continuous).

    Args:
        policy: latent ``(*batch, p)`` -> action ``(*batch, m)`` in physical units.
        actions: the table ``(K, m)``, physical units.
        margin: m >= 0, barrier units.

    Raises:
        ConfigError: for a table or a margin that is not valid, or a call before :meth:`bind`.

    Example:
        >>> from torchrl_sspl.modules import LatentDynamics, Policy
        >>> still = lambda net: [q.data.zero_() for q in net.parameters()] and net
        >>> policy = ChoosingPolicy(still(Policy(1, 1)), torch.tensor([[-1.0], [1.0]]), margin=0.2)
        >>> plant = LatentDynamics(1, 1, (2,))  # z+ = z + |u|+ / 2
        >>> nn.utils.vector_to_parameters(torch.tensor([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0]), plant.parameters())
        >>> barrier = nn.Sequential(nn.Linear(1, 1))  # B(z) = -z
        >>> nn.utils.vector_to_parameters(torch.tensor([-1.0, 0.0]), barrier.parameters())
        >>> policy.bind(plant, barrier)(torch.tensor([[0.3], [0.1]])).flatten().tolist()
        [0.0, 1.0]
    """

    actions: Tensor
    margin: Tensor

    def __init__(self, policy: nn.Module, actions: Any, margin: float = 0.0) -> None:
        super().__init__()
        if isinstance(policy, ChoosingPolicy):
            raise ConfigError("expected a policy that does not choose, received a ChoosingPolicy; give its 'policy'")
        like = next(policy.parameters())
        table = torch.as_tensor(actions).detach().to(like.device, like.dtype).clone()
        m = getattr(policy, "action_dim", table.shape[-1] if table.ndim else 0)
        if table.ndim != 2 or not len(table) or table.shape[1] != m or not bool(table.isfinite().all()):
            raise ConfigError(
                f"expected a table of finite actions (K, {m}) in physical units, K >= 1, received {tuple(table.shape)} of {actions!r:.80}"
            )
        scale = getattr(policy, "action_scale", None)
        if scale is not None and bool((table.abs() > scale).any()):
            raise ConfigError(f"expected actions within +-{scale.tolist()}, the policy's range, received up to {table.abs().amax(0).tolist()}")
        if type(margin) not in (int, float) or not 0.0 <= margin <= torch.finfo(like.dtype).max:
            raise ConfigError(f"expected a margin that is finite and not negative, barrier units, received {margin!r:.40}")
        self.policy = policy
        # Of the state, so that the digest of an agent's weights covers what decides.
        self.register_buffer("actions", table)
        self.register_buffer("margin", torch.tensor(margin, dtype=like.dtype, device=like.device))
        self.loop: tuple[nn.Module, nn.Module] | None = None  # in a tuple, modules are no submodules

    def bind(self, dynamics: nn.Module, barrier: nn.Module) -> ChoosingPolicy:
        """Choose by these from now on: latent and action -> latent, latent -> ``(*batch, 1)``; returns itself."""
        self.loop = (dynamics, barrier)
        return self

    @property
    def arguments(self) -> dict[str, Any]:
        """How to build it again, the policy itself among them."""
        return {"policy": self.policy, "actions": self.actions.tolist(), "margin": float(self.margin)}

    @property
    def action_scale(self) -> Tensor:
        """Largest action ``(m,)``, physical units."""
        return self.policy.action_scale  # type: ignore[return-value]

    def forward(self, latent: Tensor) -> Tensor:
        """Action ``(*batch, m)`` in physical units of a latent ``(*batch, p)``."""
        if self.loop is None:
            raise ConfigError("expected a policy that is bound to dynamics and barrier, received none; an Agent binds its own, or bind(...)")
        dynamics, barrier = self.loop
        own, (k, m) = self.policy(latent), self.actions.shape
        tried = torch.cat([own.unsqueeze(-2), self.actions.expand(*own.shape[:-1], k, m)], -2)
        after = dynamics(latent.unsqueeze(-2).expand(*latent.shape[:-1], k + 1, latent.shape[-1]), tried)
        value = barrier(after)[..., 0]
        chosen = torch.where(value[..., 0] <= -self.margin, 0, 1 + value[..., 1:].argmin(-1))
        return tried.gather(-2, chosen[..., None, None].expand(*chosen.shape, 1, m)).squeeze(-2)


__all__ = ["ChoosingPolicy"]

"""The loss that teaches barrier and policy a robust invariant set of the encoded data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import nn

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.functional import safe_hinge, unsafe_hinge
from torchrl_sspl.objectives.base import LatentLoss, _batch_last, set_action_scale, trained_action
from torchrl_sspl.sets import SAFE, UNSAFE


class TargetLoss(LatentLoss):
    r"""Regresses the barrier onto a signed distance and the policy onto the action with the most clearance.

    .. math::
        L = \operatorname{mean} w(t) r^2 + \kappa \operatorname{mean} \omega \operatorname{mean}_i \bigl( (\pi_i(z) - u^\star_i) / u_{\max, i} \bigr)^2
        + \xi_1 \operatorname{mean}_S \max(0, B + \psi) + \xi_2 \operatorname{mean}_U \max(0, -B + \psi)

    with :math:`r = B(z) - t` inside the set, :math:`r = \max(0, \min(t, t_{\max}) - B(z))` outside (only the sign
    matters there), the weight :math:`w(t) = e^{-|t| / s} + 0.1`, largest at the border, and the components i of the action.
    Targets come from :mod:`torchrl_sspl.viability.cloud`. Output: ``loss_target``, ``loss_policy_target``, ``loss_safe``,
    ``loss_unsafe``, weighted. Source: none; the paper trains barrier and policy on the condition alone, from which no
    set grows.

    Args:
        barrier: latent -> barrier value ``(*batch, 1)``, at most zero means safe.
        policy: latent -> action ``(*batch, action_dim)`` in physical units.
        inside_coeff: weight of the residual inside the set.
        outside_cap: :math:`t_{\max}`, value beyond which a target outside asks for no more.
        scale: s, in units of the barrier.
        policy_coeff: :math:`\kappa`.
        safe_coeff, unsafe_coeff: :math:`\xi_1`, :math:`\xi_2`, on rows with region code 1 and 2; 0 leaves a term out.
        action_scale: :math:`u_{\max}`, largest action in physical units, a number or one per dimension.
        **shared: ``safety_margin`` :math:`\psi`, ``worst_coeff``, ``worst_fraction``, ``reduction``; see
            :class:`LatentLoss`, for errors too.

    Example:
        >>> from torchrl_sspl.modules import Policy
        >>> one = torch.ones(4, 1)
        >>> rows = TensorDict(latent=torch.rand(4, 2), barrier_target=one, action_target=one, action_weight=one,
        ...                   inside=one.bool(), region=torch.tensor([[0], [0], [1], [2]]), batch_size=4)
        >>> sorted(TargetLoss(nn.Linear(2, 1), Policy(2, 1))(rows).keys())
        ['loss_policy_target', 'loss_safe', 'loss_target', 'loss_unsafe']
    """

    @dataclass
    class _AcceptedKeys(LatentLoss._AcceptedKeys):
        """Keys that can be changed with ``set_keys``.

        Attributes:
            barrier_target: target ``(*batch, 1)`` of the barrier.
            inside: whether the latent belongs to the set, ``(*batch, 1)`` bool.
            action_target: target ``(*batch, action_dim)`` of the policy, physical units.
            action_weight: weight ``(*batch, 1)`` of the policy's target; 0: none.
        """

        barrier_target: NestedKey = "barrier_target"
        inside: NestedKey = "inside"
        action_target: NestedKey = "action_target"
        action_weight: NestedKey = "action_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    _optional = frozenset({"safe_coeff", "unsafe_coeff"})
    _schedulable_buffers = frozenset({"inside_coeff", "policy_coeff"}) | _optional
    _reads = ("barrier_target", "inside", "action_target", "action_weight")

    def __init__(
        self,
        barrier: nn.Module,
        policy: nn.Module,
        *,
        inside_coeff: float = 1.0,
        outside_cap: float = float("inf"),
        scale: float = 0.2,
        policy_coeff: float = 1.0,
        safe_coeff: float = 0.0,
        unsafe_coeff: float = 0.0,
        action_scale: float | Sequence[float] = 1.0,
        **shared: Any,
    ) -> None:
        if not outside_cap > 0 or not scale > 0:
            raise ConfigError(f"expected outside_cap and scale > 0, received {outside_cap} and {scale}")
        super().__init__(barrier=barrier, policy=policy, **shared)
        self._coefficients(
            inside_coeff=inside_coeff, policy_coeff=policy_coeff, safe_coeff=safe_coeff, unsafe_coeff=unsafe_coeff
        )
        self.outside_cap, self.scale = float(outside_cap), float(scale)
        set_action_scale(self, action_scale)
        self._needs.add("region")
        self.out_keys += ["loss_target", "loss_policy_target", "loss_safe", "loss_unsafe"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Terms of the loss on a batch of latents with their targets; the batch is not changed."""
        keys = self.tensor_keys
        batch = self._read(tensordict)
        target = _batch_last(self._counted(tensordict, keys.barrier_target, "barrier_target", batch), batch.shape)
        inside = _batch_last(self._get(tensordict, keys.inside, "inside"), batch.shape)
        barrier = self._run("barrier", batch.latent)
        short = (target.clamp_max(self.outside_cap) - barrier).clamp_min(0.0)
        residual = (barrier - target).square() * self.inside_coeff
        near = (-target.abs() / self.scale).exp() + 0.1
        fit = near * residual.where(inside, short.square())
        action = trained_action(self, batch.latent)
        wanted = self._counted(tensordict, keys.action_target, "action_target", batch)
        gap = (action - wanted) / self.action_scale
        weight = _batch_last(self._counted(tensordict, keys.action_weight, "action_weight", batch), batch.shape)
        follow = weight * gap.square().mean(-1, keepdim=True)
        terms = {
            "loss_target": self._reduce(fit, batch, worst=True),
            "loss_policy_target": self.policy_coeff * self._reduce(follow, batch),
        }
        for name, hinge, code in (("safe", safe_hinge, SAFE), ("unsafe", unsafe_hinge, UNSAFE)):
            if f"{name}_coeff" in self._active:
                value = self._reduce(hinge(barrier, self.safety_margin), batch, batch.region == code, worst=True)
                terms[f"loss_{name}"] = getattr(self, f"{name}_coeff") * value
            else:
                terms[f"loss_{name}"] = self._reduce(torch.zeros_like(barrier), batch)
        return self._pack(terms, tensordict)

"""The loss on counterexamples of the proof: the set gives them up, or changes as little as will do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.objectives.base import LatentBatch, LatentLoss, trained_action

MODES = ("give_up", "least")


class CounterexampleLoss(LatentLoss):
    r"""Takes latents that are led out of the set out of it, and leads them back where the policy can.

    .. math::
        L = \operatorname{mean} \left( \frac{\min(\bar v, c)}{c} \max(0, b - B(z)) + \kappa v \, [B(z) < b] \right), \qquad
        v = \max(0, \bar B(d(z, \pi(z)) + e) + m), \qquad
        e = \delta \nabla \bar B / \lVert \nabla \bar B \rVert

    with the mean over all rows, to which those with :math:`B(z) \ge b` add nothing, and with bars over what is held still: the barrier
    changes at z alone, the policy through its successor alone. The product of both violations, on which :class:`SynthesisLoss` descends,
    may also lower the barrier at the successor; then the set grows to where nothing was asked of it, and what it meets there are the next
    counterexamples. Where a set is nearly kept, because its targets are exact, that does not matter, and the smaller of both changes
    leaves more of it (``mode="least"``):

    .. math:: L = \operatorname{mean} \max(0, \min(B(d(z, \pi(z)) + e) + m, b - B(z)))

    Output: ``loss_counterexample``, and the detached metrics ``counterexample_max`` (largest v) and ``counterexample_share`` (of
    rows with v > 0). Source: none (counterexample-guided synthesis).

    Args:
        dynamics: (latent, action) -> next latent ``(*batch, p)``; held still.
        barrier: latent -> barrier value ``(*batch, 1)``, at most zero means safe.
        policy: latent -> action ``(*batch, action_dim)`` in physical units.
        depth: b, barrier value up to which a counterexample is pushed.
        cap: c, violation from which on the push is no stronger.
        policy_coeff: :math:`\kappa`.
        mode: ``"give_up"`` or ``"least"``.
        error: :math:`\delta`, error per step that the set has to tolerate, in the direction in which the barrier rises.
        **shared: ``dynamics_margin`` m, ``worst_coeff``, ``worst_fraction``, ``reduction``; see :class:`LatentLoss`, for
            errors too.

    Example:
        >>> import torch
        >>> from torchrl_sspl.modules import LatentDynamics, Policy
        >>> loss = CounterexampleLoss(LatentDynamics(2, 1), nn.Linear(2, 1), Policy(2, 1))
        >>> sorted(loss(TensorDict(latent=torch.rand(8, 2), batch_size=8)).keys())
        ['counterexample_max', 'counterexample_share', 'loss_counterexample']
    """

    def __init__(
        self,
        dynamics: nn.Module,
        barrier: nn.Module,
        policy: nn.Module,
        *,
        depth: float = 0.01,
        cap: float = 0.05,
        policy_coeff: float = 0.3,
        mode: str = "give_up",
        error: float = 0.0,
        **shared: Any,
    ) -> None:
        if not depth > 0.0 or not cap > 0.0 or not error >= 0.0:
            raise ConfigError(f"expected depth > 0, cap > 0 and error >= 0, received {depth}, {cap} and {error}")
        if mode not in MODES:
            raise ConfigError(f"expected mode to be one of {MODES}, received {mode!r}")
        super().__init__(dynamics=dynamics, barrier=barrier, policy=policy, **shared)
        self._coefficients(policy_coeff=policy_coeff)
        self.mode = mode
        self.depth, self.cap, self.error = float(depth), float(cap), float(error)
        self.out_keys += ["loss_counterexample", "counterexample_max", "counterexample_share"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss on a batch of latents; the batch is not changed."""
        batch = self._read(tensordict)
        after = self._run("dynamics", batch.latent, trained_action(self, batch.latent), params="frozen")
        if self.error:
            after = after + worst_error(lambda z: self._run("barrier", z, params="frozen"), after, self.error)
        least = self.mode == "least"
        violation = (self._run("barrier", after, params="online" if least else "frozen") + self.dynamics_margin).clamp_min(0.0)
        short = (self.depth - self._run("barrier", batch.latent)).clamp_min(0.0)
        if least:
            return self._terms(self._reduce(torch.minimum(violation, short), batch, worst=True), violation, short, batch, tensordict)
        given_up = violation.detach().clamp_max(self.cap) / self.cap * short
        led_back = self.policy_coeff * violation * (short.detach() > 0.0)
        return self._terms(self._reduce(given_up, batch, worst=True) + self._reduce(led_back, batch), violation, short, batch, tensordict)

    def _terms(self, loss: Tensor, violation: Tensor, short: Tensor, batch: LatentBatch, tensordict: TensorDictBase) -> TensorDict:
        found = violation.detach() * (short.detach() > 0.0)
        counted = torch.ones_like(found, dtype=torch.bool) if batch.valid is None else batch.valid
        found = torch.where(counted, found, 0.0)
        counts = {"counterexample_max": found.max(), "counterexample_share": (found > 0.0).sum() / counted.sum().clamp_min(1)}
        return self._pack({"loss_counterexample": loss, **counts}, tensordict)


def worst_error(barrier: Callable[[Tensor], Tensor], latent: Tensor, size: float) -> Tensor:
    r"""Errors ``(n, p)`` of a size in the direction in which a barrier rises at latents ``(n, p)``, without a gradient.

    .. math:: e = \delta \nabla B / \lVert \nabla B \rVert

    Source: none.

    Example:
        >>> worst_error(lambda z: z[:, :1], torch.zeros(1, 2), 0.1).tolist()
        [[0.10000000149011612, 0.0]]
    """
    with torch.enable_grad():
        at = latent.detach().requires_grad_()
        (slope,) = torch.autograd.grad(barrier(at).sum(), at)
    return size * slope / slope.norm(dim=-1, keepdim=True).clamp_min(1e-9)

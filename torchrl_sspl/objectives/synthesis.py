"""The loss of the policy and of the barrier's invariance."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.functional import synthesis_violation
from torchrl_sspl.objectives.base import LatentBatch, LatentLoss, trained_action
from torchrl_sspl.sets import UNSAFE

MODES = ("R3", "R1", "R2", "paper")
SUCCESSORS = ("online", "target")
DETACHABLE = ("encoder", "dynamics")


class SynthesisLoss(LatentLoss):
    r"""Makes the sub-zero set of the barrier invariant under the policy.

    .. math:: L_{syn} = \operatorname{mean}_{D} \max(0, v(B(z), B(z^+))), \qquad z^+ = d(z, \pi(z))

    with the violation v of the chosen condition (margin m is the dynamics margin :math:`\eta`):

    * ``"R3"`` (weakest): :math:`B(z) \le 0` implies :math:`B(z^+) + m \le 0`; trained as the product
      :math:`\max(0, B(z^+) + m) \max(0, b - B(z)) / b` with the band b;
    * ``"R1"``: :math:`B(z^+) + m \le (1 - \alpha) B(z)`;
    * ``"R2"``: :math:`B(z^+) + m \le \max(B(z) - \gamma, -c)`;
    * ``"paper"``: :math:`B(z^+) + \eta - B(z) + \psi \le 0` everywhere, which no barrier on a compact
      invariant set can meet (look at its minimum). Only here the margin :math:`\psi` of sampling enters; the other
      conditions are meant to be verified over the whole latent domain.

    Extra terms, all off by default:

    * ``growth_coeff``: :math:`\max(0, B(z) + g)` where the predicted successor is inside by the margin
      and the row is not labelled unsafe: backward reachability, which needs no labels;
    * ``off_manifold_coeff``: the same violation on latents drawn uniformly from :math:`[-1, 1]^p`, one
      per row: a proof runs over all of them;
    * ``descent_coeff``: :math:`e^{-\max(0, B(z)) / s} B(z^+)` for the policy alone, with barrier,
      dynamics and latent held still: the hinges give the policy no direction where they are zero or
      where the state is outside;
    * ``worst_coeff``: adds the mean over the worst ``worst_fraction`` of the rows to the synthesis term.

    A batch may hold ``"residual"`` ``(*batch, p)``, an observed error of the dynamics that is added to
    the successor: the condition is then asked of what may really follow. Output: ``loss_synthesis`` and one
    ``loss_<term>`` per active extra term, weighted; and the detached metrics ``violation_max``, ``violation_share`` (of
    rows) and ``inside_share`` (of rows with :math:`B \le 0`). Source: paper eq. (10) in mode ``"paper"`` with
    ``successor="target"`` and ``detach=()``; the other modes are deviations.

    Args:
        encoder: observation -> latent ``(*batch, p)``; ``None`` if the batches hold ``"latent"``.
        dynamics: (latent, action) -> next latent ``(*batch, p)``.
        barrier: latent -> barrier value ``(*batch, 1)``, at most zero means safe.
        policy: latent -> action ``(*batch, action_dim)`` in physical units.
        mode: ``"R3"``, ``"R1"``, ``"R2"`` or ``"paper"``.
        successor: networks that value the successor, ``"online"`` :math:`B_\theta(d(E_\theta(o), \pi(z)))` or
            ``"target"`` :math:`B_{\theta^-}(d(E_{\theta^-}(o), \pi(z)))` (paper).
        detach: networks that get no gradient from this loss, any of ``"encoder"`` and ``"dynamics"``.
            With the gradient (paper) the model can learn to predict what pleases the barrier.
        band, decay, decrement, floor: b, :math:`\alpha`, :math:`\gamma` and c; all but :math:`\alpha` in barrier units.
        growth_coeff, off_manifold_coeff, descent_coeff: weights of the extra terms.
        growth_depth, descent_scale: g and s, in units of the barrier.
        **shared: ``safety_margin`` :math:`\psi`, ``dynamics_margin`` :math:`\eta`, ``worst_coeff``,
            ``worst_fraction``, ``reduction``; see :class:`LatentLoss`, for errors too.

    Example:
        >>> from torchrl_sspl.modules import LatentDynamics, Policy
        >>> loss = SynthesisLoss(None, LatentDynamics(2, 1), nn.Linear(2, 1), Policy(2, 1))
        >>> sorted(loss(TensorDict(latent=torch.rand(8, 2), batch_size=8)).keys())
        ['inside_share', 'loss_synthesis', 'violation_max', 'violation_share']
    """

    _optional = frozenset({"growth_coeff", "off_manifold_coeff", "descent_coeff"})
    _schedulable_buffers = frozenset({"growth_coeff", "growth_depth", "off_manifold_coeff", "descent_coeff"})

    def __init__(
        self,
        encoder: nn.Module | None,
        dynamics: nn.Module,
        barrier: nn.Module,
        policy: nn.Module,
        *,
        mode: str = "R3",
        successor: str = "online",
        detach: tuple[str, ...] = DETACHABLE,
        band: float = 0.1,
        decay: float = 0.0,
        decrement: float = 0.0,
        floor: float = 0.0,
        growth_coeff: float = 0.0,
        growth_depth: float = 0.3,
        off_manifold_coeff: float = 0.0,
        descent_coeff: float = 0.0,
        descent_scale: float = 0.2,
        delayed: tuple[str, ...] = (),
        **shared: Any,
    ) -> None:
        if mode not in MODES:
            raise ConfigError(f"expected mode to be one of {MODES}, received {mode!r}")
        if successor not in SUCCESSORS:
            raise ConfigError(f"expected successor to be one of {SUCCESSORS}, received {successor!r}")
        if isinstance(detach, str) or not set(detach) <= set(DETACHABLE):
            raise ConfigError(f"expected detach to be a tuple of names among {DETACHABLE}, received {detach!r}")
        if not band > 0.0 or not descent_scale > 0.0:
            raise ConfigError(f"expected band > 0 and descent_scale > 0, received {band} and {descent_scale}")
        if not 0.0 <= decay <= 1.0 or decrement < 0.0 or floor < 0.0:
            raise ConfigError(
                f"expected decay in [0, 1], decrement >= 0 and floor >= 0, received decay={decay}, "
                f"decrement={decrement}, floor={floor}"
            )
        if successor == "target":
            delayed = (*delayed, "encoder", "barrier")
        super().__init__(encoder=encoder, dynamics=dynamics, barrier=barrier, policy=policy, delayed=delayed, **shared)
        self._coefficients(
            growth_coeff=growth_coeff,
            growth_depth=growth_depth,
            off_manifold_coeff=off_manifold_coeff,
            descent_coeff=descent_coeff,
        )
        self.mode, self.successor, self.detach = mode, successor, tuple(detach)
        self.band, self.decay, self.decrement, self.floor = float(band), float(decay), float(decrement), float(floor)
        self.descent_scale = float(descent_scale)
        self._needs.add("residual")
        if successor == "target":
            self._needs.add("target_latent")
        self.out_keys.append("loss_synthesis")
        for term in ("growth", "off_manifold", "descent"):
            if f"{term}_coeff" in self._active:
                self.out_keys.append(f"loss_{term}")
        if "growth_coeff" in self._active:
            self._needs.add("region")
        self.out_keys += ["violation_max", "violation_share", "inside_share"]

    def _violation(self, barrier: Tensor, barrier_next: Tensor) -> Tensor:
        violation = synthesis_violation(
            barrier,
            barrier_next,
            mode=self.mode,
            safety_margin=self.safety_margin,  # of mode "paper" alone
            dynamics_margin=self.dynamics_margin,
            decay=self.decay,
            decrement=self.decrement,
            floor=self.floor,
            band=self.band,
        )
        return violation.clamp_min(0.0)

    def _synthesis_terms(self, batch: LatentBatch) -> dict[str, Tensor]:
        latent = batch.latent.detach() if "encoder" in self.detach else batch.latent
        online = self.successor == "online"
        start = latent if online else batch.target_latent
        origin, at = latent, start
        stray = "off_manifold_coeff" in self._active
        if stray:
            uniform = torch.rand_like(latent) * 2.0 - 1.0
            origin, at = torch.stack([latent, uniform]), torch.stack([start, uniform])
        action = trained_action(self, origin)
        successor = self._run("dynamics", at, action, params="frozen" if "dynamics" in self.detach else "online")
        if batch.residual is not None:
            # Uniform latents have no observed error.
            error = batch.residual
            error = torch.stack([error, torch.zeros_like(error)]) if stray else error
            successor = (successor + error).clamp(-1.0, 1.0)
        if online:
            # One pass: the weights of a Lipschitz barrier are assembled on every call.
            barrier, barrier_next = self._run("barrier", torch.stack([origin, successor])).unbind(0)
        else:
            barrier = self._run("barrier", origin)
            barrier_next = self._run("barrier", successor, params="target")
        violation = self._violation(barrier, barrier_next)
        terms = {}
        if stray:
            terms["loss_off_manifold"] = self.off_manifold_coeff * self._reduce(violation[1], batch, worst=True)
            barrier, barrier_next, violation = barrier[0], barrier_next[0], violation[0]
        terms["loss_synthesis"] = self._reduce(violation, batch, worst=True)
        if "growth_coeff" in self._active:
            # Only where the predicted successor is inside by the margin: elsewhere growth would buy
            # volume with invariance.
            backed = (barrier_next.detach() + self.dynamics_margin <= 0.0) & (batch.region != UNSAFE)
            grow = torch.where(backed, (barrier + self.growth_depth).clamp_min(0.0), 0.0)
            terms["loss_growth"] = self.growth_coeff * self._reduce(grow, batch)
        if "descent_coeff" in self._active:
            still = latent.detach()
            ahead = self._run("dynamics", still, trained_action(self, still), params="frozen")
            weight = (-barrier.detach().clamp_min(0.0) / self.descent_scale).exp()
            descent = weight * self._run("barrier", ahead, params="frozen")
            terms["loss_descent"] = self.descent_coeff * self._reduce(descent, batch)
        with torch.no_grad():
            counted = torch.ones_like(violation, dtype=torch.bool) if batch.valid is None else batch.valid
            positive = torch.where(counted, violation.detach(), 0.0)
            total = counted.sum().clamp_min(1)
            terms["violation_max"] = positive.max()
            terms["violation_share"] = (positive > 0.0).sum() / total
            terms["inside_share"] = ((barrier <= 0.0) & counted).sum() / total
        return terms

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Terms of the loss on a batch of observations (or frames, or latents); the batch is not changed."""
        return self._pack(self._synthesis_terms(self._read(tensordict)), tensordict)

"""The loss of the SaLaD world model."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.functional import consistency_error, safe_hinge, unsafe_hinge
from torchrl_sspl.modules import InverseDynamics
from torchrl_sspl.objectives.base import LatentBatch, LatentLoss
from torchrl_sspl.sets import SAFE, UNSAFE

CONSISTENCY = ("target", "online")


def _covariance(latent: Tensor, valid: Tensor | None) -> Tensor:
    """Covariance ``(p, p)`` of the rows that count."""
    rows = latent.reshape(-1, latent.shape[-1])
    weight = torch.ones_like(rows[:, :1]) if valid is None else valid.reshape(-1, 1).to(rows.dtype)
    total = weight.sum().clamp_min(1.0)
    centred = (rows - (weight * rows).sum(0) / total) * weight
    return centred.mT @ centred / total


class SaLaDLoss(LatentLoss):
    r"""Separates S from U in latent space and makes the latent predictable.

    .. math::
        L_{SaLaD} = \xi_1 \operatorname{mean}_{S} \max(0, B(z) + \psi) + \xi_2 \operatorname{mean}_{U}
        \max(0, -B(z) + \psi) + \xi_3 \operatorname{mean}_{D} \| \bar z_{t+1} - d(z_t, u_t) \|^2

    with :math:`z_t = E_\theta(o_t)` and :math:`\bar z_{t+1}` the delayed :math:`E_{\theta^-}(o_{t+1})`, or with
    ``consistency="online"`` the latent of the same encoder with gradient through both branches. D is every row of the
    batch; S and U are the rows with region code 1 and 2. Extra terms, all off by default:

    * ``inverse_dynamics_coeff``: :math:`\operatorname{mean}_i (\hat u_i(z_t, z_{t+1}) - u_{t,i})^2` over the components of the action, in
      units of the largest one, from encoded latents: the latent keeps what the action changes;
    * ``variance_coeff``: :math:`\operatorname{mean}_j \max(0, \sigma_0 - \operatorname{std} z_j)`, against collapse;
    * ``covariance_coeff``: :math:`\tfrac1p \sum_{i \ne j} \operatorname{cov}(z_i, z_j)^2`, against redundancy;
    * ``saturation_coeff``: :math:`\operatorname{mean}_j \max(0, \operatorname{artanh}|z_j| - \operatorname{artanh} z_0)^2`,
      against latents that stick to the walls of :math:`[-1, 1]^p`;
    * ``worst_coeff``: adds the mean over the worst ``worst_fraction`` of the rows to the three terms above.

    Output: ``loss_safe``, ``loss_unsafe``, ``loss_consistency`` and one ``loss_<term>`` per active extra term, all
    weighted; and the detached metrics ``dynamics_error`` and ``dynamics_error_max`` (2-norms), ``safe_error`` and
    ``unsafe_error`` (shares of S and U on the wrong side of zero), ``latent_std`` (of the narrowest dimension).
    Source: paper eq. (8); means over the batch in place of sums over the data (``reduction="sum"`` for sums).

    Args:
        encoder: observation -> latent ``(*batch, p)``; ``None`` if the batches hold latents.
        dynamics: (latent, action) -> next latent ``(*batch, p)``.
        barrier: latent -> barrier value ``(*batch, 1)``, at most zero means safe.
        safe_coeff, unsafe_coeff, consistency_coeff: :math:`\xi_1, \xi_2, \xi_3`.
        consistency: ``"target"`` (delayed encoder, paper) or ``"online"``.
        inverse_dynamics_coeff, variance_coeff, covariance_coeff, saturation_coeff: weights of the extra terms.
        inverse_dynamics: (latent, next latent) -> action; built from the sizes of the dynamics if not given.
        variance_floor: standard deviation :math:`\sigma_0` that every latent dimension should reach.
        saturation_limit: size :math:`z_0` of a latent coordinate from which it counts as saturated.
        **shared: ``safety_margin`` :math:`\psi`, ``worst_coeff``, ``worst_fraction``, ``reduction``; see
            :class:`LatentLoss`, for errors too.

    Example:
        >>> from torchrl_sspl.modules import LatentDynamics
        >>> loss = SaLaDLoss(None, LatentDynamics(2, 1), nn.Linear(2, 1), consistency="online")
        >>> data = TensorDict(latent=torch.rand(3, 2), action=torch.zeros(3, 1), region=torch.tensor([[0], [1], [2]]),
        ...                   next=TensorDict(latent=torch.rand(3, 2), batch_size=3), batch_size=3)
        >>> sorted(key for key in loss(data).keys() if key.startswith("loss_"))
        ['loss_consistency', 'loss_safe', 'loss_unsafe']
    """

    inverse_dynamics: TensorDictModuleBase
    inverse_dynamics_params: TensorDictParams
    target_inverse_dynamics_params: TensorDictParams
    _optional = frozenset({"inverse_dynamics_coeff", "variance_coeff", "covariance_coeff", "saturation_coeff"})
    _schedulable_buffers = frozenset({"safe_coeff", "unsafe_coeff", "consistency_coeff"}) | _optional

    def __init__(
        self,
        encoder: nn.Module | None,
        dynamics: nn.Module,
        barrier: nn.Module,
        *,
        safe_coeff: float = 1.0,
        unsafe_coeff: float = 1.0,
        consistency_coeff: float = 1.0,
        consistency: str = "target",
        inverse_dynamics_coeff: float = 0.0,
        inverse_dynamics: nn.Module | None = None,
        variance_coeff: float = 0.0,
        variance_floor: float = 0.5,
        covariance_coeff: float = 0.0,
        saturation_coeff: float = 0.0,
        saturation_limit: float = 0.9,
        delayed: tuple[str, ...] = (),
        **shared: Any,
    ) -> None:
        if consistency not in CONSISTENCY:
            raise ConfigError(f"expected consistency to be one of {CONSISTENCY}, received {consistency!r}")
        if not 0.0 < saturation_limit < 1.0:
            raise ConfigError(f"expected saturation_limit in (0, 1), received {saturation_limit}; for instance 0.9")
        if consistency == "target":
            delayed = (*delayed, "encoder")
        super().__init__(encoder=encoder, dynamics=dynamics, barrier=barrier, delayed=delayed, **shared)
        self._coefficients(
            safe_coeff=safe_coeff,
            unsafe_coeff=unsafe_coeff,
            consistency_coeff=consistency_coeff,
            inverse_dynamics_coeff=inverse_dynamics_coeff,
            variance_coeff=variance_coeff,
            covariance_coeff=covariance_coeff,
            saturation_coeff=saturation_coeff,
        )
        self.consistency = consistency
        self.variance_floor = float(variance_floor)
        self.saturation_limit = float(saturation_limit)
        self._needs |= {"action", "region", "target_next_latent" if consistency == "target" else "next_latent"}
        if "inverse_dynamics_coeff" in self._active:
            self._needs.add("next_latent")
            self._add_inverse_dynamics(inverse_dynamics)
        self.out_keys += ["loss_safe", "loss_unsafe", "loss_consistency"]
        for term in ("inverse_dynamics", "variance", "covariance", "saturation"):
            if f"{term}_coeff" in self._active:
                self.out_keys.append(f"loss_{term}")
        self.out_keys += ["dynamics_error", "dynamics_error_max", "safe_error", "unsafe_error", "latent_std"]

    def _add_inverse_dynamics(self, network: nn.Module | None) -> None:
        dynamics = getattr(self.dynamics, "module", self.dynamics)
        scale = getattr(dynamics, "action_scale", None)
        if network is None:
            if not hasattr(dynamics, "latent_dim") or not hasattr(dynamics, "action_dim"):
                raise ConfigError(
                    "expected dynamics with attributes latent_dim and action_dim to build an inverse, "
                    f"received {type(dynamics).__name__}; pass inverse_dynamics=InverseDynamics(...)"
                )
            network = InverseDynamics(
                dynamics.latent_dim, dynamics.action_dim, action_scale=1.0 if scale is None else scale
            )
            reference = next(dynamics.parameters(), None)
            network = network if reference is None else network.to(reference)
        keys = self.tensor_keys
        self._add("inverse_dynamics", network, [keys.latent, ("next", "latent")], [keys.action])
        scale = getattr(network, "action_scale", scale)
        self.register_buffer("_inverse_scale", torch.ones(1) if scale is None else scale.detach().clone())

    def _salad_terms(self, batch: LatentBatch) -> dict[str, Tensor]:
        barrier = self._run("barrier", batch.latent)
        predicted = self._run("dynamics", batch.latent, batch.action)
        actual = batch.next_latent if self.consistency == "online" else batch.target_next_latent
        error = consistency_error(predicted, actual)
        safe, unsafe = torch.eq(batch.region, SAFE), torch.eq(batch.region, UNSAFE)
        hinges = safe_hinge(barrier, self.safety_margin), unsafe_hinge(barrier, self.safety_margin)
        terms = {
            "loss_safe": self.safe_coeff * self._reduce(hinges[0], batch, safe, worst=True),
            "loss_unsafe": self.unsafe_coeff * self._reduce(hinges[1], batch, unsafe, worst=True),
            "loss_consistency": self.consistency_coeff * self._reduce(error, batch, worst=True),
        }
        if "inverse_dynamics_coeff" in self._active:
            estimate = self._run("inverse_dynamics", batch.latent, batch.next_latent)
            gap = (estimate - batch.action) / self._inverse_scale
            inverse = self._reduce(gap.square().mean(-1, keepdim=True), batch)
            terms["loss_inverse_dynamics"] = self.inverse_dynamics_coeff * inverse
        covariance = _covariance(batch.latent, batch.valid)
        # The floor keeps the gradient of the root finite when the latent has collapsed altogether.
        deviation = (covariance.diagonal() + 1e-8).sqrt()
        if "variance_coeff" in self._active:
            variance = (self.variance_floor - deviation).clamp_min(0.0).mean()
            terms["loss_variance"] = self.variance_coeff * self._reduce(variance.expand(*batch.shape, 1), batch)
        if "covariance_coeff" in self._active:
            mixed = (covariance.square().sum() - covariance.diagonal().square().sum()) / len(covariance)
            terms["loss_covariance"] = self.covariance_coeff * self._reduce(mixed.expand(*batch.shape, 1), batch)
        if "saturation_coeff" in self._active:
            # 1e-6: largest latent whose inverse tanh is finite in float32.
            depth = batch.latent.abs().clamp_max(1.0 - 1e-6).atanh()
            limit = torch.atanh(torch.as_tensor(self.saturation_limit, dtype=depth.dtype, device=depth.device))
            excess = (depth - limit).clamp_min(0.0).square().mean(-1, keepdim=True)
            terms["loss_saturation"] = self.saturation_coeff * self._reduce(excess, batch)
        with torch.no_grad():
            norm = error.detach().sqrt()
            everywhere = torch.ones_like(safe)
            if batch.valid is not None:
                norm = torch.where(batch.valid, norm, 0.0)
                safe, unsafe, everywhere = safe & batch.valid, unsafe & batch.valid, batch.valid
            terms["dynamics_error"] = norm.sum() / everywhere.sum().clamp_min(1)
            terms["dynamics_error_max"] = norm.max()
            terms["safe_error"] = ((barrier > 0) & safe).sum() / safe.sum().clamp_min(1)
            terms["unsafe_error"] = ((barrier <= 0) & unsafe).sum() / unsafe.sum().clamp_min(1)
            terms["latent_std"] = deviation.detach().min()
        return terms

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Terms of the loss on a batch of transitions; the batch is not changed."""
        return self._pack(self._salad_terms(self._read(tensordict)), tensordict)

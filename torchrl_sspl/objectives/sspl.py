"""The total loss: world model, synthesis and deviation over the same networks."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.objectives.deviation import PolicyDeviationLoss
from torchrl_sspl.objectives.salad import SaLaDLoss
from torchrl_sspl.objectives.synthesis import SynthesisLoss

#: Options that a preset sets; whatever is given explicitly wins.
PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType({
    "paper": MappingProxyType({
        "consistency": "target", "mode": "paper", "successor": "target", "detach": (), "policy_coeff": 1.0,
        "reduction": "sum",
    }),
    "sound": MappingProxyType({
        "safety_margin": 0.3, "safe_coeff": 0.3, "unsafe_coeff": 0.3, "consistency": "online", "consistency_coeff": 2.0,
        "inverse_dynamics_coeff": 1.0, "variance_coeff": 0.5, "covariance_coeff": 0.5, "saturation_coeff": 0.3,
        "mode": "R3", "successor": "online", "detach": ("encoder", "dynamics"), "growth_coeff": 0.1,
        "off_manifold_coeff": 0.1, "descent_coeff": 0.1, "synthesis_coeff": 0.3, "worst_coeff": 0.3,
        "policy_coeff": 0.0, "reduction": "mean",
    }),
})  # fmt: skip


class SSPLLoss(SaLaDLoss, SynthesisLoss, PolicyDeviationLoss):
    r"""The total loss of semi-supervised safe policy synthesis.

    .. math:: L_{total} = \lambda_1 L_{syn} + \lambda_2 L_{SaLaD} + \lambda_3 L_\pi

    It is a :class:`SaLaDLoss`, a :class:`SynthesisLoss` and a :class:`PolicyDeviationLoss` over the same networks, with
    the options, errors and outputs of all three, the terms weighted by :math:`\lambda` too; the set of keys depends on
    the options only. The Lipschitz term :math:`L_M` is not part of it: it has its own step (:class:`LipschitzLoss`),
    and the default barrier needs none. Source: paper, Algorithm 1, with eq. (8), (10) and (13).

    Args:
        encoder: observation -> latent ``(*batch, p)``; ``None`` if the batches hold latents.
            ``SSPLLoss(*salad, policy)`` unpacks a :class:`~torchrl_sspl.modules.SaLaD`.
        dynamics: (latent, action) -> next latent ``(*batch, p)``.
        barrier: latent -> barrier value ``(*batch, 1)``, at most zero means safe.
        policy: latent -> action ``(*batch, action_dim)`` in physical units.
        preset: sets options that were not given. ``"paper"``: the equations as printed, every extra term off, sums over
            the batch; needs a target-network updater. ``"sound"``: consistency through both branches kept from collapse
            by inverse dynamics and the spread of the latents, a wide and light hinge, invariance as R3 with gradient to
            barrier and policy only, slow growth, hard mining.
        synthesis_coeff, salad_coeff, policy_coeff: :math:`\lambda_1, \lambda_2, \lambda_3`; a ``policy_coeff`` of 0
            (in ``"sound"``) leaves the term out, and is refused with a ``user_policy``.
        **options: options of the three losses.

    Example:
        >>> from torchrl_sspl.modules import LatentDynamics, Policy
        >>> loss = SSPLLoss(None, LatentDynamics(2, 1), nn.Linear(2, 1), Policy(2, 1), preset="sound")
        >>> data = TensorDict(latent=torch.rand(3, 2), action=torch.zeros(3, 1), region=torch.tensor([[0], [1], [2]]),
        ...                   next=TensorDict(latent=torch.rand(3, 2), batch_size=3), batch_size=3)
        >>> sum(value for key, value in loss(data).items() if key.startswith("loss_")).backward()
    """

    _optional = frozenset({"policy_coeff"})
    _schedulable_buffers = frozenset({"synthesis_coeff", "salad_coeff", "policy_coeff"})

    def __init__(
        self,
        encoder: nn.Module | None,
        dynamics: nn.Module,
        barrier: nn.Module,
        policy: nn.Module,
        *,
        preset: str = "sound",
        synthesis_coeff: float | None = None,
        salad_coeff: float | None = None,
        policy_coeff: float | None = None,
        **options: Any,
    ) -> None:
        if preset not in PRESETS:
            raise ConfigError(f"expected preset to be one of {tuple(PRESETS)}, received {preset!r}")
        given = {"synthesis_coeff": synthesis_coeff, "salad_coeff": salad_coeff, "policy_coeff": policy_coeff}
        given = {name: value for name, value in given.items() if value is not None}
        chosen = {**PRESETS[preset], **given, **options}
        weights = {name: chosen.pop(f"{name}_coeff", 1.0) for name in ("synthesis", "salad", "policy")}
        super().__init__(encoder, dynamics, barrier, policy=policy, **chosen)
        self.preset = preset
        self._coefficients(**{f"{name}_coeff": value for name, value in weights.items()})
        if "policy_coeff" not in self._active:
            if options.get("user_policy") is not None:
                raise ConfigError(
                    f"expected policy_coeff > 0 with a user_policy, received {weights['policy']} with preset={preset!r}: nothing would keep the policy "
                    "near it; give policy_coeff=1.0, for instance, or no user_policy"
                )
            self.out_keys.remove("loss_policy_deviation")

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """All terms on a batch of transitions; the batch is not changed."""
        batch = self._read(tensordict)
        parts = [(self.salad_coeff, self._salad_terms(batch)), (self.synthesis_coeff, self._synthesis_terms(batch))]
        if "policy_coeff" in self._active:
            parts.append((self.policy_coeff, self._deviation_terms(batch)))
        return self._weighted(parts, tensordict)

    def world_model(self, tensordict: TensorDictBase) -> TensorDict:
        """The keys of :meth:`forward`, all but those of the world model zero, as in the warm start of Algorithm 1."""
        return self._weighted([(self.salad_coeff, self._salad_terms(self._read(tensordict)))], tensordict)

    def _weighted(self, parts: list[tuple[Tensor, dict[str, Tensor]]], tensordict: TensorDictBase) -> TensorDict:
        terms: dict[str, Tensor] = {}
        if len(parts) == 1:
            none = self.salad_coeff.new_zeros(()), self.salad_coeff.new_zeros(tensordict.batch_size if self.reduction == "none" else ())
            terms = {key: none[key.startswith("loss_")] for key in self.out_keys}
        for weight, part in parts:
            for key, value in part.items():
                terms[key] = weight * value if key.startswith("loss_") else value
        return self._pack(terms, tensordict)

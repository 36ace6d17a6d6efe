"""The loss of latent dynamics on frozen latents."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.functional import consistency_error
from torchrl_sspl.objectives.base import LatentBatch, LatentLoss
from torchrl_sspl.sets import UNSAFE


class ConsistencyLoss(LatentLoss):
    r"""Prediction error of the latent dynamics on frozen latents.

    .. math:: L = \operatorname{mean}_D\, w \, h(\| z_{t+1} - d(z_t, u_t) \|), \qquad w = w_U \text{ on } U, \text{ else } 1, \qquad
        h(e) = \begin{cases} e^2 & e \le \delta \\ 2 \delta e - \delta^2 & e > \delta \end{cases}

    Output: ``loss_consistency`` and the detached metrics ``dynamics_error`` and ``dynamics_error_max`` (2-norms).
    Source: paper eq. (8), third term, with the encoder frozen; deviation: the weight of U, the outliers, and the worst rows.

    Args:
        dynamics: (latent, action) -> next latent ``(*batch, p)``.
        unsafe_weight: :math:`w_U`, weight of transitions that start in U.
        outlier: :math:`\delta`, error beyond which a picture is taken to show less than the state; None: no error is.
        **shared: ``worst_coeff``, ``worst_fraction``, ``reduction``; see :class:`LatentLoss`, for errors too.

    Example:
        >>> from torchrl_sspl.modules import LatentDynamics
        >>> following = TensorDict(latent=torch.zeros(4, 2), batch_size=4)
        >>> data = TensorDict(latent=torch.zeros(4, 2), action=torch.zeros(4, 1),
        ...                   region=torch.zeros(4, 1, dtype=torch.int64), next=following, batch_size=4)
        >>> sorted(ConsistencyLoss(LatentDynamics(2, 1))(data).keys())
        ['dynamics_error', 'dynamics_error_max', 'loss_consistency']
    """

    def __init__(self, dynamics: nn.Module, *, unsafe_weight: float = 1.0, outlier: float | None = None, **shared: Any) -> None:
        if not unsafe_weight > 0:
            raise ConfigError(f"expected unsafe_weight > 0, received {unsafe_weight}")
        if outlier is not None and not outlier > 0:
            raise ConfigError(f"expected outlier > 0 or None, received {outlier}")
        super().__init__(dynamics=dynamics, **shared)
        self.register_buffer("unsafe_weight", torch.tensor(float(unsafe_weight)))
        self.outlier = outlier
        self._needs |= {"action", "region", "next_latent"}
        self.out_keys += ["loss_consistency", "dynamics_error", "dynamics_error_max"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss on a batch of transitions between latents; the batch is not changed."""
        return self._pack(self.terms(self._read(tensordict)), tensordict)

    def terms(self, batch: LatentBatch) -> dict[str, Tensor]:
        """The same for latents that have been read: what a loop of thousands of small steps calls."""
        error = consistency_error(self._run("dynamics", batch.latent, batch.action), batch.next_latent)
        counted = error
        if self.outlier is not None:
            far = 2.0 * self.outlier * error.clamp_min(self.outlier**2).sqrt() - self.outlier**2
            counted = torch.where(error > self.outlier**2, far, error)
        weighted = torch.where(batch.region == UNSAFE, self.unsafe_weight * counted, counted)
        norm = error.detach().sqrt()
        if batch.valid is not None:
            norm = torch.where(batch.valid, norm, 0.0)
        return {
            "loss_consistency": self._reduce(weighted, batch, worst=True),
            "dynamics_error": norm.mean() if batch.valid is None else norm.sum() / batch.valid.sum().clamp_min(1),
            "dynamics_error_max": norm.max(),
        }

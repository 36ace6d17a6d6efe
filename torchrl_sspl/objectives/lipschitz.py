"""The loss that keeps the matrix of a Lipschitz certificate positive definite."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import nn

from torchrl_sspl.errors import ConfigError, NotPositiveDefiniteError
from torchrl_sspl.objectives.base import LatentLoss


class LipschitzLoss(LatentLoss):
    r"""Log-determinant barrier of the cone in which the Lipschitz bound of the barrier is certified.

    .. math:: L_M(\theta, \Lambda) = -\log\det M(\theta, \Lambda)

    It reads no data. Its step is apart from that of the other losses (paper, Algorithm 1), and a plain optimiser
    step may leave the cone: follow it by ``barrier.backtracking_step``. The default
    :class:`~torchrl_sspl.lipschitz.SandwichBarrier` satisfies the matrix inequality by construction and needs no
    such loss. Output: ``loss_lipschitz`` and the detached metric ``eigenvalue_min`` of M.
    Source: paper eq. (9); deviation: outside the cone, where the printed loss goes on, it raises.

    Args:
        barrier: an :class:`~torchrl_sspl.lipschitz.LMIBarrier`, or a network with a differentiable method
            ``matrix`` that returns :math:`M`, ``(n, n)``.
        lipschitz_coeff: weight of the loss.
        **shared: see :class:`LatentLoss`; the reduction plays no part, :math:`L_M` is one number.

    Raises:
        ConfigError: if the barrier has no method ``matrix``.
        NotPositiveDefiniteError: in ``forward``, if M is not positive definite (NaN when compiled).

    Example:
        >>> from torchrl_sspl.lipschitz import LMIBarrier
        >>> _ = torch.manual_seed(0)
        >>> LipschitzLoss(LMIBarrier(2, (8,), lipschitz_bound=2.0))()[1] > 0
        tensor(True)
    """

    _schedulable_buffers = frozenset({"lipschitz_coeff"})

    def __init__(self, barrier: nn.Module, *, lipschitz_coeff: float = 1.0, **shared: Any) -> None:
        super().__init__(barrier=barrier, **shared)
        network = getattr(self.barrier, "module", self.barrier)
        if not hasattr(network, "matrix"):
            raise ConfigError(
                f"expected a barrier with a method matrix() such as LMIBarrier, received {type(network).__name__}; "
                "a sandwich barrier meets the bound by construction and needs no Lipschitz loss"
            )
        self._coefficients(lipschitz_coeff=lipschitz_coeff)
        self.out_keys += ["loss_lipschitz", "eigenvalue_min"]

    def _set_in_keys(self) -> None:
        self._in_keys = []

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss; the batch is not read and may be left out."""
        matrix = self._run("barrier", method="matrix")
        factor, info = torch.linalg.cholesky_ex(matrix)
        # Reading the flag would break the graph of a compiled loss; there the value becomes NaN.
        if not torch.compiler.is_compiling() and int(info):
            raise NotPositiveDefiniteError(
                f"expected a positive definite M, received one whose leading minor of order {int(info)} is not; "
                "take steps through barrier.backtracking_step, which stays inside the cone"
            )
        value = torch.where(info == 0, -2.0 * factor.diagonal().log().sum(), torch.nan)
        terms = {
            "loss_lipschitz": self.lipschitz_coeff * value,
            "eigenvalue_min": torch.linalg.eigvalsh(matrix.detach())[0],
        }
        return self._pack(terms, tensordict)

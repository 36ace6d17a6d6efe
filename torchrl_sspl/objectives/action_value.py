"""The loss that teaches the policy the best of tabulated action values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.objectives.base import LatentBatch, LatentLoss, set_action_scale, trained_action


def interpolate(table: Tensor, action: Tensor, *, action_scale: float | Tensor) -> Tensor:
    """Values ``(n, 1)`` of actions between those of a regular grid, multilinear and differentiable in the actions.

    Args:
        table: ``(n, k^m)`` values of k >= 2 points per dimension from ``-action_scale`` to ``action_scale``, in the
            order of ``torch.cartesian_prod``; any other number of columns is a ShapeError.
        action: ``(n, m)`` in physical units; clamped to the grid.
        action_scale: largest action, a number or ``(m,)``.

    Source: none.

    Example:
        >>> interpolate(torch.tensor([[0.0, 1.0, 4.0]]), torch.tensor([[0.5]]), action_scale=1.0)
        tensor([[2.5000]])
    """
    dims, columns = action.shape[-1], table.shape[-1]
    k = round(columns ** (1 / dims))
    if k < 2 or k**dims != columns:
        raise ShapeError(
            f"expected the values of a grid with k >= 2 points in each of {dims} dimensions, received {columns} columns"
        )
    place = (action / action_scale + 1) / 2 * (k - 1)
    low = place.detach().floor().clamp(0, k - 2)
    share = (place - low).clamp(0.0, 1.0)
    if dims == 1:
        index = low.long()
        return (1 - share) * table.gather(-1, index) + share * table.gather(-1, index + 1)
    powers = torch.tensor([k ** (dims - 1 - d) for d in range(dims)], device=action.device)
    value = torch.zeros_like(table[..., :1])
    for corner in product((0, 1), repeat=dims):
        upper = torch.tensor(corner, device=action.device)
        index = ((low.long() + upper) * powers).sum(-1, keepdim=True)
        weight = torch.where(upper.bool(), share, 1 - share).prod(-1, keepdim=True)
        value = value + weight * table.gather(-1, index)
    return value


class ActionValueLoss(LatentLoss):
    r"""Teaches the policy the action of the largest tabulated value.

    .. math:: L = \operatorname{mean} w \, (\max_u Q(z, u) - Q(z, \pi(z))) / s

    with Q between the tabulated actions by multilinear interpolation. Where two actions are as good and what lies
    between them is not, as left and right of an obstacle ahead, a regression onto the mean of the best would teach the
    worst; this loss decides for a side. Where the action does not matter it asks for nothing. Output:
    ``loss_action_value``. Source: none; the paper trains the policy on the condition alone.

    Args:
        policy: latent -> action ``(*batch, action_dim)`` in physical units.
        action_scale: largest action, end of the grid of actions; a number or one per dimension.
        scale: s, in units of the values.
        **shared: ``worst_coeff``, ``worst_fraction``, ``reduction``; see :class:`LatentLoss`, for errors too.

    Example:
        >>> from torchrl_sspl.modules import Policy
        >>> rows = TensorDict(latent=torch.rand(4, 2), action_value=torch.rand(4, 11), batch_size=4)
        >>> ActionValueLoss(Policy(2, 1))(rows)["loss_action_value"].shape
        torch.Size([])
    """

    @dataclass
    class _AcceptedKeys(LatentLoss._AcceptedKeys):
        """Keys that can be changed with ``set_keys``.

        Attributes:
            action_value: values ``(*batch, k^m)`` of a regular grid of actions.
        """

        action_value: NestedKey = "action_value"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    _reads = ("action_value",)

    def __init__(
        self, policy: nn.Module, *, action_scale: float | Sequence[float] = 1.0, scale: float = 1.0, **shared: Any
    ) -> None:
        if not scale > 0:
            raise ConfigError(f"expected scale > 0, received {scale}")
        super().__init__(policy=policy, **shared)
        self.scale = float(scale)
        set_action_scale(self, action_scale)
        self.out_keys.append("loss_action_value")

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss on a batch of latents with the values of their actions; the batch is not changed."""
        batch = self._read(tensordict)
        table = self._counted(tensordict, self.tensor_keys.action_value, "action_value", batch)
        return self._pack(self.terms(batch, table), tensordict)

    def terms(self, batch: LatentBatch, table: Tensor) -> dict[str, Tensor]:
        """The same for latents that have been read: what a loop of thousands of small steps calls."""
        action = trained_action(self, batch.latent)
        short = table.amax(-1, keepdim=True) - interpolate(table, action, action_scale=self.action_scale)
        return {"loss_action_value": self._reduce(short / self.scale, batch, worst=True)}

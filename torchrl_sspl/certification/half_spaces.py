"""Linear functions on boxes: the best value under one linear constraint, and boxes cut by half-spaces."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_sspl.certification.propagation import LinearBound


def programme(objective: LinearBound, constraint: LinearBound, radius: Tensor) -> Tensor:
    r"""Largest value ``(n, K)`` of linear functions on boxes where another one is at most zero, by its dual.

    .. math:: \min_{\lambda \ge 0} \; h - \lambda k + \sum_i |g_i - \lambda q_i| r_i

    The objective is :math:`g (z - c) + h` with K rows, the constraint :math:`q (z - c) + k` with one and the same
    centres, the radius r is ``(n, p)``. The dual is convex and piecewise linear; its minimum lies at zero or at one of
    the :math:`g_i / q_i`. Every :math:`\lambda \ge 0` gives a valid bound, whatever rounding does to it.

    Example:
        >>> one, zero = torch.ones(1, 1, 1), torch.zeros(1, 1)
        >>> programme(LinearBound(one, zero, zero), LinearBound(one, zero - 0.25, zero), torch.ones(1, 1)).item()
        0.25
    """
    ratio = objective.slope / constraint.slope
    ratio = torch.where(ratio.isfinite(), ratio, 0.0).clamp_min(0.0)
    weights = torch.cat([ratio, torch.zeros_like(ratio[..., :1])], dim=-1)  # (n, K, p + 1)
    rest = objective.slope[..., None, :] - weights[..., None] * constraint.slope[..., None, :]
    reach = (rest.abs() * radius[:, None, None, :]).sum(-1)
    return (objective.value[..., None] - weights * constraint.value[..., None] + reach).amin(-1)


def clip(low: Tensor, high: Tensor, constraint: LinearBound) -> tuple[Tensor, Tensor]:
    """Smaller boxes, corners ``(n, p)``, that still hold every point at which a linear function is at most zero.

    The function has one row, and is at most zero somewhere on each box.

    Example:
        >>> c = LinearBound(torch.ones(1, 1, 2), torch.ones(1, 1), torch.zeros(1, 2))  # z_0 + z_1 + 1 <= 0
        >>> clip(-torch.ones(1, 2), torch.ones(1, 2), c)[1].tolist()
        [[0.0, 0.0]]
    """
    center, radius = 0.5 * (low + high), 0.5 * (high - low)
    moved = constraint.at(center)
    slope = moved.slope[:, 0]
    reach = slope.abs() * radius
    room = (reach.sum(1, keepdim=True) - reach - moved.value) / slope.abs()  # how far beyond the centre z_i may go
    cut = room < radius  # false where the slope is zero
    room = torch.maximum(room, -radius)
    return torch.where(cut & (slope < 0), center - room, low), torch.where(cut & (slope > 0), center + room, high)

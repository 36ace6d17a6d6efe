r"""The equations of the paper as pure functions; nothing here reduces over a batch unless it says so.

Formula symbols: B ``barrier``, :math:`\psi` ``safety_margin``, :math:`\eta` ``dynamics_margin``, :math:`L_B`
``lipschitz_bound``, :math:`\bar\epsilon` ``covering_radius``, :math:`\delta` ``dynamics_error``, :math:`\Lambda`
``multipliers``. B <= 0 is safe.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_sspl.errors import ConfigError, EmptyRegionError, NotPositiveDefiniteError, ShapeError

Scalar = float | Tensor


def safe_hinge(barrier: Tensor, safety_margin: Scalar) -> Tensor:
    r"""Hinge that is zero where a safe latent is inside by the margin, :math:`\max(0, B(z) + \psi)`.

    For B ``(*batch, 1)`` and :math:`\psi` in its units; returns ``(*batch, 1)``. Source: paper eq. (8), first term.

    Example:
        >>> safe_hinge(torch.tensor([[-1.0], [0.5]]), 0.25).flatten().tolist()
        [0.0, 0.75]
    """
    return (barrier + safety_margin).clamp_min(0.0)


def unsafe_hinge(barrier: Tensor, safety_margin: Scalar) -> Tensor:
    r"""Hinge that is zero where an unsafe latent is outside by the margin, :math:`\max(0, -B(z) + \psi)`.

    For B ``(*batch, 1)`` and :math:`\psi` in its units; returns ``(*batch, 1)``. Source: paper eq. (8), second term.

    Example:
        >>> unsafe_hinge(torch.tensor([[1.0], [-0.5]]), 0.25).flatten().tolist()
        [0.0, 0.75]
    """
    return (safety_margin - barrier).clamp_min(0.0)


def consistency_error(predicted: Tensor, target: Tensor) -> Tensor:
    r"""Squared error of a predicted latent, :math:`\|\bar z_{t+1} - d(z_t, u_t)\|_2^2`.

    For latents ``(*batch, p)``; returns ``(*batch, 1)``. Raises ShapeError if the shapes differ. Source: paper eq. (8),
    third term.

    Example:
        >>> consistency_error(torch.tensor([[3.0, 0.0]]), torch.tensor([[0.0, 4.0]]))
        tensor([[25.]])
    """
    _same_shape(predicted, target, "predicted", "target")
    return (predicted - target).square().sum(-1, keepdim=True)


def dynamics_error(predicted: Tensor, actual: Tensor) -> Tensor:
    r"""Latent prediction error, :math:`\|E(o_{t+1}) - d(z_t, u_t)\|_2`; its maximum is the paper's delta.

    For latents ``(*batch, p)``; returns ``(*batch,)``. Raises ShapeError if the shapes differ. Source: paper Theorem 2.

    Example:
        >>> dynamics_error(torch.tensor([[3.0, 0.0]]), torch.tensor([[0.0, 4.0]]))
        tensor([5.])
    """
    _same_shape(predicted, actual, "predicted", "actual")
    return (predicted - actual).norm(dim=-1)


def synthesis_violation(
    barrier: Tensor,
    barrier_next: Tensor,
    *,
    mode: str = "R3",
    safety_margin: Scalar = 0.0,
    dynamics_margin: Scalar = 0.0,
    decay: float = 0.0,
    decrement: float = 0.0,
    floor: float = 0.0,
    band: float = 0.1,
) -> Tensor:
    r"""By how much the condition on a step is violated; the positive part is the loss.

    With the margin :math:`m` = ``dynamics_margin``:

    .. math::
        \text{paper:} &\quad B(z^+) + \eta - B(z) + \psi \\
        \text{R1:} &\quad B(z^+) + m - (1 - \alpha) B(z) \\
        \text{R2:} &\quad B(z^+) + m - \max(B(z) - \gamma, -c) \\
        \text{R3:} &\quad \max(0, B(z^+) + m) \max(0, b - B(z)) / b

    R3 is the trainable form of "B(z) <= 0 implies B(z^+) + m <= 0": positive if and only if the successor is not
    inside by the margin while the latent is inside or within the band b of it.

    Args:
        barrier: ``(*batch, 1)``, B at the latent.
        barrier_next: ``(*batch, 1)``, B at the predicted successor.
        mode: "paper", "R1", "R2" or "R3".
        safety_margin: :math:`\psi` (mode "paper").
        dynamics_margin: :math:`\eta`, or m.
        decay: :math:`\alpha` of R1.
        decrement: :math:`\gamma` of R2.
        floor: c of R2.
        band: b of R3.

    Returns ``(*batch, 1)``. Raises ConfigError if the mode is unknown; ShapeError if the shapes differ. Source: paper
    eq. (10) in mode "paper"; the other modes are deviations.

    Example:
        >>> synthesis_violation(torch.tensor([[0.0]]), torch.tensor([[0.2]]), mode="R3", dynamics_margin=0.1)
        tensor([[0.3000]])
    """
    _same_shape(barrier, barrier_next, "barrier", "barrier_next")
    if mode == "paper":
        return barrier_next + dynamics_margin - barrier + safety_margin
    if mode == "R1":
        return barrier_next + dynamics_margin - (1.0 - decay) * barrier
    if mode == "R2":
        return barrier_next + dynamics_margin - (barrier - decrement).clamp_min(-floor)
    if mode == "R3":
        return (barrier_next + dynamics_margin).clamp_min(0.0) * (band - barrier).clamp_min(0.0) / band
    raise ConfigError(f"expected mode to be one of ('paper', 'R1', 'R2', 'R3'), received {mode!r}")


def policy_deviation(action: Tensor, action_user: Tensor) -> Tensor:
    r"""Distance to the user's action, :math:`\|\pi(z) - \pi_{user}\|_2`; its gradient at zero distance is zero.

    For actions ``(*batch, m)``, physical units; returns ``(*batch, 1)``. Raises ShapeError if the shapes differ.
    Source: paper eq. (13).

    Example:
        >>> policy_deviation(torch.tensor([[3.0, 4.0]]), torch.zeros(1, 2))
        tensor([[5.]])
    """
    _same_shape(action, action_user, "action", "action_user")
    return (action - action_user).norm(dim=-1, keepdim=True)


def lmi_matrix(
    weights: Sequence[Tensor],
    multipliers: Sequence[Tensor],
    lipschitz_bound: Scalar,
    slope: tuple[float, float] = (0.0, 1.0),
) -> Tensor:
    r"""Matrix whose positive semidefiniteness certifies a Lipschitz constant.

    .. math::
        M = \begin{bmatrix} A \\ C \end{bmatrix}^\top \begin{bmatrix} 2\alpha\beta\Lambda & -(\alpha+\beta)\Lambda \\
        -(\alpha+\beta)\Lambda & 2\Lambda \end{bmatrix} \begin{bmatrix} A \\ C \end{bmatrix} + P

    with A the weights of the hidden layers, C the selection of the hidden states, and P holding
    :math:`L^2 I` at the input, I at the output and :math:`-W_l` between the last hidden state and the output.

    Args:
        weights: :math:`W_0 .. W_l`, each ``(out, in)``.
        multipliers: diagonals of :math:`\Lambda`, one positive vector per hidden layer.
        lipschitz_bound: L.
        slope: smallest and largest slope of the activation.

    Returns symmetric ``(n, n)``, n the sum of all layer sizes, input and output included. Raises ShapeError if the
    sizes do not follow each other. Source: paper Lemma 2 (Pauli et al. 2021); deviation: the selection is [0 I 0], the
    paper prints [0 I].

    Example:
        >>> lmi_matrix([torch.ones(1, 1), torch.ones(1, 1)], [torch.ones(1)], 2.0).tolist()
        [[4.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]]
    """
    hidden = len(weights) - 1
    sizes = [weights[0].shape[1], *(w.shape[0] for w in weights)]
    follows = all(w.shape[1] == n for w, n in zip(weights, sizes[:-1], strict=True))
    if not follows or [m.shape for m in multipliers] != [torch.Size([n]) for n in sizes[1:-1]]:
        raise ShapeError(
            f"expected weights that follow each other and multipliers of sizes {sizes[1:-1]}, received weights "
            f"{[tuple(w.shape) for w in weights]} and multipliers {[tuple(m.shape) for m in multipliers]}"
        )
    alpha, beta = slope
    first = weights[0]
    blocks = [[first.new_zeros(rows, columns) for columns in sizes] for rows in sizes]
    eye = torch.eye(sizes[0], dtype=first.dtype, device=first.device)
    blocks[0][0] = torch.as_tensor(lipschitz_bound, dtype=first.dtype, device=first.device) ** 2 * eye
    for k in range(hidden):
        scaled = multipliers[k][:, None] * weights[k]
        blocks[k + 1][k + 1] = blocks[k + 1][k + 1] + torch.diag(2.0 * multipliers[k])
        blocks[k + 1][k] = -(alpha + beta) * scaled
        blocks[k][k + 1] = blocks[k + 1][k].mT
        if alpha * beta != 0.0:
            blocks[k][k] = blocks[k][k] + 2.0 * alpha * beta * weights[k].mT @ scaled
    blocks[-1][-2] = blocks[-1][-2] - weights[-1]
    blocks[-2][-1] = blocks[-1][-2].mT
    blocks[-1][-1] = torch.eye(sizes[-1], dtype=first.dtype, device=first.device)
    return torch.cat([torch.cat(row, dim=1) for row in blocks])


def lmi_loss(matrix: Tensor) -> Tensor:
    r"""Log-determinant barrier of the cone, :math:`-\log\det M`, defined for positive definite M only.

    For a symmetric ``(n, n)``; returns a scalar. Raises NotPositiveDefiniteError if M is not positive definite; the
    printed loss would go on with a meaningless gradient. Source: paper eq. (9); deviation: the cone is checked, the
    sign of the loss decides nothing.

    Example:
        >>> round(float(lmi_loss(torch.diag(torch.tensor([2.0, 0.5])))), 6) == 0.0
        True
    """
    factor, info = torch.linalg.cholesky_ex(matrix)
    if int(info):
        raise NotPositiveDefiniteError(
            f"expected a positive definite matrix, received one whose leading minor of order {int(info)} is not; start "
            "from a feasible point and take smaller steps"
        )
    return -2.0 * factor.diagonal().log().sum()


class SafetyMargins(NamedTuple):
    """Margin of each condition: q1 of B <= 0 on S, q2 of B > 0 on U, q3 of the condition on a step."""

    q1: float
    q2: float
    q3: float


def safety_margin(
    lipschitz_bound: float, covering_radius: float, *, mode: str = "sound", closed_loop_lipschitz: float | None = None
) -> SafetyMargins:
    r"""Margins that carry the conditions from samples to everything within the covering radius.

    .. math:: \psi_1 = \psi_2 = L_B \bar\epsilon, \qquad
        \psi_3 = \begin{cases} L_B \bar\epsilon & \text{paper} \\ L_B (L_{cl} + 1) \bar\epsilon & \text{sound} \end{cases}

    Args:
        lipschitz_bound: :math:`L_B`.
        covering_radius: :math:`\bar\epsilon`, latent units.
        mode: "paper" or "sound".
        closed_loop_lipschitz: :math:`L_{cl}`, Lipschitz constant of z -> d(z, pi(z)) (mode "sound").

    Returns the three margins, units of the barrier. Raises ConfigError if the mode is unknown, or the constant of the
    closed loop is missing in mode "sound". Source: paper Theorem 1; deviation: the third condition has its own constant
    in mode "sound".

    Example:
        >>> safety_margin(2.0, 0.1, closed_loop_lipschitz=3.0)
        SafetyMargins(q1=0.2, q2=0.2, q3=0.8)
    """
    if mode not in ("paper", "sound"):
        raise ConfigError(f"expected mode to be 'paper' or 'sound', received {mode!r}")
    if mode == "sound" and closed_loop_lipschitz is None:
        raise ConfigError("expected closed_loop_lipschitz in mode 'sound', received None; bound z -> d(z, pi(z))")
    base = lipschitz_bound * covering_radius
    factor = 1.0 if mode == "paper" or closed_loop_lipschitz is None else closed_loop_lipschitz + 1.0
    return SafetyMargins(base, base, base * factor)


def dynamics_margin(lipschitz_bound: float, dynamics_error: float) -> float:
    r"""Margin that makes up for the error of the latent dynamics, :math:`\eta^* = L_B \delta`.

    For :math:`\delta` in latent units; returns units of the barrier. Source: paper Theorem 2; the same in both modes,
    what differs is the data on which the error is measured.

    Example:
        >>> dynamics_margin(2.0, 0.25)
        0.5
    """
    return lipschitz_bound * dynamics_error


def covering_radius(points: Tensor, samples: Tensor, *, chunk: int = 4096, quantile: float = 1.0) -> float:
    r"""How far points lie from the nearest sample, :math:`\bar\epsilon = \max_z \min_i \|z - z_i\|_2`.

    For latents this is a measurement on the given points, not a covering radius of all observations.

    Args:
        points: ``(n, p)``, held-out latents.
        samples: ``(m, p)``, latents that were trained on.
        chunk: points at a time.
        quantile: 1 for the maximum, below for a quantile.

    Returns the radius, latent units. Raises EmptyRegionError if there are no points or no samples. Source: paper
    Theorem 1.

    Example:
        >>> covering_radius(torch.tensor([[0.0], [1.0]]), torch.tensor([[0.25]]))
        0.75
    """
    if not len(points) or not len(samples):
        raise EmptyRegionError(f"expected points and samples, received {len(points)} and {len(samples)}; collect data")
    nearest = torch.cat([torch.cdist(part, samples).amin(1) for part in points.split(chunk)])
    return float(nearest.max() if quantile >= 1.0 else nearest.quantile(quantile))


def _same_shape(first: Tensor, second: Tensor, first_name: str, second_name: str) -> None:
    if first.shape != second.shape:
        raise ShapeError(
            f"expected {first_name} and {second_name} of the same shape, received {tuple(first.shape)} and "
            f"{tuple(second.shape)}; a broadcast here would pair the wrong rows"
        )

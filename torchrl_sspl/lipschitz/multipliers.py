r"""Multipliers :math:`\Lambda` with which the matrix of a Lipschitz certificate is positive definite."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchrl_sspl.functional import lmi_matrix
from torchrl_sspl.lipschitz.network import Slope, layer_weights, slope_interval


def norm_product(weights: Sequence[Tensor], slope: Slope = (0.0, 1.0)) -> float:
    r"""Crude Lipschitz bound, :math:`\max(|\alpha|, |\beta|)^l \prod_k \|W_k\|_2`, from weights ``(out, in)``.

    Example:
        >>> norm_product([torch.eye(2), torch.tensor([[3.0, 4.0]])])
        5.0
    """
    steepest = max(abs(slope[0]), abs(slope[1]))
    return steepest ** (len(weights) - 1) * math.prod(float(torch.linalg.matrix_norm(w.detach(), 2)) for w in weights)


def start_multipliers(weights: Sequence[Tensor], lipschitz_bound: float, slope: Slope = (0.0, 1.0)) -> list[float]:
    r"""Multiples of the identity, one per hidden layer, that are feasible for a bound above the product of the norms.

    .. math::
        \Lambda_{k+1} = \frac{a_{k+1}}{1 - \alpha / \beta} I, \quad a_0 = L^2, \quad
        a_{k+1} = a_k \frac{\rho^{2 / (l + 1)}}{(\beta \|W_k\|)^2}, \quad \rho = \beta^l \prod_k \|W_k\| / L < 1

    for :math:`\alpha < \beta`, :math:`|\alpha| \le \beta`; slopes that are steeper below zero are reflected.

    Source: none (Pauli et al. 2021 give no start).
    """
    alpha, beta = slope if slope[1] >= -slope[0] else (-slope[1], -slope[0])
    # A layer without weights costs nothing; a tiny norm in its place keeps the numbers finite.
    norms = [max(float(torch.linalg.matrix_norm(w.detach(), 2)), 1e-6) for w in weights]
    ratio = (beta ** (len(weights) - 1) * math.prod(norms) / lipschitz_bound) ** (2.0 / len(weights))
    levels, level = [], lipschitz_bound**2
    for norm in norms[:-1]:
        level *= ratio / (beta * norm) ** 2
        levels.append(level / (1.0 - alpha / beta))
    return levels


def minimise_bound(
    weights: Sequence[Tensor], slope: Slope = (0.0, 1.0), *, target: float = 0.0, accuracy: float = 1e-7
) -> tuple[list[Tensor], float]:
    r"""Smallest provable bound, by Newton's method on :math:`t L^2 - \log\det M - \sum \log \lambda` for growing t.

    M is linear in the multipliers and in :math:`L^2`, every multiplier entering with rank two, so that the Hessian is a
    product of small matrices. Every iterate is feasible. The weights are float64, at least two; it stops below the
    target, or where :math:`L^2` has this relative accuracy. Returns a vector per hidden layer, and the bound that they
    prove.

    Source: Fazlyab et al. 2019 (LipSDP-Neuron); the method is none of theirs.
    """
    weights, units = _balanced(weights)
    sizes = [weights[0].shape[1], *(w.shape[0] for w in weights)]
    total, inputs, hidden = sum(sizes), sizes[0], sum(sizes[1:-1])
    pairs, kernel, constant, first = _pencil(weights, slope)
    bound = 1.05 * max(norm_product(weights, slope), 1e-6)
    levels = start_multipliers(weights, bound, slope)
    lams = torch.cat([torch.full((n,), v, dtype=torch.float64) for n, v in zip(sizes[1:-1], levels, strict=True)])
    # Unknowns relative to the start; a small cost keeps the multiplier of a unit without input from growing for ever.
    scale = torch.cat([lams, torch.tensor([bound**2], dtype=torch.float64)])
    cost = torch.cat([torch.full_like(lams, 1e-3), torch.zeros(1, dtype=torch.float64)])
    x = torch.ones_like(scale)

    def part(point: Tensor) -> Tensor:
        """What the unknowns contribute to M."""
        weighted = pairs * (point[:-1] * scale[:-1])[:, None, None]
        return torch.einsum("iak,ab,ibl->kl", weighted, kernel, pairs) + torch.diag(first * point[-1] * scale[-1])

    factor, info = torch.linalg.cholesky_ex(constant + part(x))
    if int(info):
        return [torch.ones_like(d) for d in units], math.inf
    weight, limit = float(total), 2.0 * (total + hidden) / accuracy
    while weight < limit and math.sqrt(float(x[-1] * scale[-1])) >= target:
        cost[-1] = weight
        for _ in range(30):
            inverse = torch.cholesky_inverse(factor)
            seen = torch.einsum("iak,kl,jbl->iajb", pairs, inverse, pairs)  # (hidden, 2, hidden, 2)
            own = torch.einsum("iaib->iab", seen)
            gradient, hessian = cost.clone(), torch.empty(hidden + 1, hidden + 1, dtype=torch.float64)
            gradient[:-1] -= (own * kernel).sum((1, 2)) * scale[:-1] + 1.0 / x[:-1]
            gradient[-1] -= inverse.diagonal()[:inputs].sum() * scale[-1]
            across = torch.einsum("ab,ibjc->iajc", kernel, seen)
            hessian[:-1, :-1] = torch.einsum("iajb,jbia->ij", across, across)
            left = torch.einsum("iak,kl->ial", pairs, inverse[:, :inputs])
            hessian[:-1, -1] = hessian[-1, :-1] = torch.einsum("ial,ab,ibl->i", left, kernel, left)
            hessian[-1, -1] = inverse[:inputs, :inputs].square().sum()
            hessian = hessian * scale[:, None] * scale + torch.diag(torch.cat([x[:-1] ** -2, x.new_zeros(1)]))
            spread = hessian.diagonal().rsqrt()
            root, info = torch.linalg.cholesky_ex(hessian * spread[:, None] * spread)
            step = -spread * torch.cholesky_solve((spread * gradient)[:, None], root)[:, 0]
            if int(info) or not float(-(gradient @ step)) > 1e-2:
                break  # as accurate as float64 allows, or as is worth it
            # Along the step the function is linear minus logarithms of 1 + s e: its minimum is found exactly. No step
            # goes near the boundary of the cone, where Newton's method would creep.
            half = torch.linalg.solve_triangular(factor, part(step), upper=False)
            rates = torch.linalg.eigvalsh(torch.linalg.solve_triangular(factor, half.mT, upper=False))
            rates = torch.cat([rates, step[:-1] / x[:-1]])
            size = min(_line_minimum(float(cost @ step), rates), 0.6 / max(-float(rates.min()), 1e-3))
            moved = x + size * step
            trial, info = torch.linalg.cholesky_ex(constant + part(moved))
            if int(info):
                break
            x, factor = moved, trial
        weight *= 4.0
    found = (x[:-1] * scale[:-1]).split(sizes[1:-1])
    return [m * d**2 for m, d in zip(found, units, strict=True)], math.sqrt(float(x[-1] * scale[-1]))


def _balanced(weights: Sequence[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
    r"""Weights in units of the hidden states in which what enters a unit is as large as what leaves it.

    M in these units is congruent to M, with multipliers :math:`\Lambda / d^2`: only the numbers get better.
    """
    weights = list(weights)
    units = [torch.ones(w.shape[0], dtype=w.dtype) for w in weights[:-1]]
    for _ in range(10):
        for k, d in enumerate(units):
            into, out = weights[k].norm(dim=1), weights[k + 1].norm(dim=0)
            ratio = torch.where((into > 0) & (out > 0), (out / into).sqrt(), torch.ones_like(d))
            weights[k], weights[k + 1], units[k] = weights[k] * ratio[:, None], weights[k + 1] / ratio, d * ratio
    return weights, units


def _pencil(weights: Sequence[Tensor], slope: Slope) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    r"""Parts of the matrix, :math:`M = C + L^2 \operatorname{diag}(e) + \sum_i \lambda_i U_i K U_i^\top`: U, K, C and e."""
    alpha, beta = slope
    sizes = [weights[0].shape[1], *(w.shape[0] for w in weights)]
    total, inputs, hidden = sum(sizes), sizes[0], sum(sizes[1:-1])
    # U_i = [row i of the weights, unit vector i].
    before = torch.block_diag(*weights[:-1], weights[0].new_zeros(0, sizes[-2] + sizes[-1]))
    pairs = torch.stack([before, torch.eye(total, dtype=torch.float64)[inputs : inputs + hidden]], 1)
    kernel = torch.tensor([[2 * alpha * beta, -(alpha + beta)], [-(alpha + beta), 2.0]], dtype=torch.float64)
    constant = torch.zeros(total, total, dtype=torch.float64)
    constant[-sizes[-1] :, -sizes[-1] - sizes[-2] : -sizes[-1]] = -weights[-1]
    constant = constant + constant.mT
    constant[-sizes[-1] :, -sizes[-1] :] = torch.eye(sizes[-1], dtype=torch.float64)
    first = torch.zeros(total, dtype=torch.float64)
    first[:inputs] = 1.0
    return pairs, kernel, constant, first


def _line_minimum(slope: float, rates: Tensor) -> float:
    r"""Minimum over s > 0 of :math:`c s - \sum_i \log(1 + s e_i)`, convex, by bisection of its derivative."""
    low, high = 0.0, 1.0 / max(-float(rates.min()), 1e-3)
    for _ in range(50):
        middle = 0.5 * (low + high)
        if slope < float((rates / (1.0 + middle * rates)).sum()):
            low = middle
        else:
            high = middle
    return low


def solve_multipliers(
    network: nn.Module | Sequence[Tensor], slope: Slope | None = None, *, lipschitz_bound: float | None = None
) -> list[Tensor] | None:
    """Multipliers with which the matrix of a claimed bound is positive definite, or None.

    A barrier that knows its own is believed after a look; for other networks an interior-point method finds them.

    Args:
        network: plain network or its weights.
        slope: smallest and largest slope of the activation; read from the network if not given.
        lipschitz_bound: the claimed constant; without it, the multipliers of the smallest provable one.

    Returns:
        One positive vector per hidden layer, float64; None if the claimed constant has none.

    Source: paper Lemma 2.

    Example:
        >>> weights = [torch.tensor([[0.5], [0.5]]), torch.tensor([[1.0, 1.0]])]
        >>> solve_multipliers(weights, lipschitz_bound=0.9) is None, len(solve_multipliers(weights))
        (True, 1)
    """
    slope = slope_interval(network, slope)
    weights = [w.double() for w in layer_weights(network)]
    if lipschitz_bound is not None and callable(getattr(network, "multipliers", None)):
        own = [m.detach().cpu().double() for m in network.multipliers()]  # type: ignore[union-attr, operator]
        if not int(torch.linalg.cholesky_ex(lmi_matrix(weights, own, lipschitz_bound, slope)).info):
            return own
    if len(weights) == 1:
        return []
    target = 0.0 if lipschitz_bound is None else lipschitz_bound * (1 - 1e-9)
    found, bound = minimise_bound(weights, slope, target=target)
    return found if lipschitz_bound is None or bound <= lipschitz_bound else None

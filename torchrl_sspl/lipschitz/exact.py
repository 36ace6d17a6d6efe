r"""Proofs of Lipschitz bounds in exact integer arithmetic, and estimates of the constant from both sides.

A network :math:`x_{k+1} = \phi(W_k x_k + b_k)`, :math:`y = W_l x_l + b_l` with slopes of :math:`\phi` in
:math:`[\alpha, \beta]` is L-Lipschitz if :math:`M(\theta, \Lambda) \succeq 0` for some diagonal
:math:`\Lambda > 0`. Its weights are dyadic numbers, so M is known exactly. The proof is a factor F of about
Cholesky's: :math:`M = F F^\top + R` holds exactly, :math:`F F^\top \succeq 0` for any F, and :math:`R \succeq 0`
because it is diagonally dominant, which is decided in integers.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError, NonFiniteError, ShapeError

_FACTOR_BITS = 44  # bits after the point of the factor F; its rounding is far below the slack of R
_MULTIPLIER_BITS = 24


@dataclass
class LipschitzProof:
    """Outcome of a proof.

    Attributes:
        bound: the claimed Lipschitz constant.
        proved: whether it was proved.
        method: "exact", or "none" where no multipliers were found.
        seconds: time of the proof.
        slack: smallest margin of diagonal dominance, relative to the largest diagonal entry of M.
        reason: why the claim was not proved.
        multipliers: per hidden layer, the diagonal of Lambda that was used.
    """

    bound: float
    proved: bool
    method: str
    seconds: float
    slack: float
    reason: str = ""
    multipliers: list[Tensor] | None = None


def layer_weights(network: nn.Module | Sequence[Tensor]) -> list[Tensor]:
    """Weight matrices of a plain network, in order.

    Args:
        network: ``nn.Sequential`` of linear layers and activations, a module with a ``collapse()`` method, or the
            weights themselves.

    Returns:
        One ``(out, in)`` matrix per linear layer.

    Raises:
        ShapeError: if the shapes do not follow each other.
        NonFiniteError: if a weight is NaN or infinite.

    Source: none.

    Example:
        >>> [tuple(w.shape) for w in layer_weights(nn.Sequential(nn.Linear(2, 8), nn.ReLU(), nn.Linear(8, 1)))]
        [(8, 2), (1, 8)]
    """
    if isinstance(network, nn.Module):
        plain = network.collapse() if hasattr(network, "collapse") else network  # type: ignore[operator]
        weights = [m.weight.detach() for m in plain.modules() if isinstance(m, nn.Linear)]
    else:
        weights = [w.detach() for w in network]
    for first, second in zip(weights[:-1], weights[1:], strict=True):
        if second.shape[1] != first.shape[0]:
            raise ShapeError(
                f"expected weights whose sizes follow each other, received {tuple(first.shape)} then "
                f"{tuple(second.shape)}; pass the layers in order"
            )
    if not weights:
        raise ShapeError("expected at least one linear layer, received none; pass a network or its weights")
    if not all(bool(w.isfinite().all()) for w in weights):
        raise NonFiniteError("expected finite weights, received NaN or infinity; the network cannot be certified")
    return weights


def _integers(matrix: np.ndarray) -> tuple[np.ndarray, int]:
    """Dyadic float64 matrix as ``integers * 2**-shift``, exactly."""
    mantissa, exponent = np.frexp(matrix)
    used = mantissa != 0
    shift = int(53 - exponent[used].min()) if used.any() else 0
    whole = [[0 if m == 0 else int(m * 2**53) << (shift + int(e) - 53) for m, e in zip(ms, es, strict=True)]
             for ms, es in zip(mantissa.tolist(), exponent.tolist(), strict=True)]
    return np.array(whole, dtype=object).reshape(matrix.shape), shift


def prove_lipschitz(
    network: nn.Module | Sequence[Tensor],
    lipschitz_bound: float,
    slope: tuple[float, float] = (0.0, 1.0),
    *,
    multipliers: Sequence[Tensor] | None = None,
) -> LipschitzProof:
    r"""Proves, in exact arithmetic on the deployed weights, that a network is L-Lipschitz.

    .. math:: M(\theta, \Lambda) = F F^\top + R, \quad R_{ii} \ge \sum_{j \ne i} |R_{ij}| \;\Rightarrow\; M \succeq 0

    Args:
        network: plain network or its weights; float32 weights are taken as they are.
        lipschitz_bound: the claimed constant L, Euclidean norm to Euclidean norm.
        slope: smallest and largest slope of the activation.
        multipliers: diagonals of Lambda; searched for if not given. They are a witness: no choice of them can make
            a false claim pass.

    Returns:
        The proof, or the reason why the claim was not proved.

    Raises:
        ConfigError: if the bound is not positive or the slopes are not ordered.
        ShapeError: if the shapes of weights and multipliers do not fit.
        NonFiniteError: if a weight is NaN or infinite.

    Source: paper Lemma 2; deviation: decided exactly, the paper takes the sign of a log-determinant.

    Example:
        >>> weights = [torch.tensor([[0.5], [0.5]]), torch.tensor([[1.0, 1.0]])]
        >>> prove_lipschitz(weights, 1.01).proved, prove_lipschitz(weights, 0.99).proved
        (True, False)
    """
    start = time.perf_counter()
    alpha, beta = slope
    if not (math.isfinite(lipschitz_bound) and lipschitz_bound > 0) or not alpha <= beta:
        raise ConfigError(
            f"expected lipschitz_bound > 0 and slope (low, high) in order, received {lipschitz_bound} and {slope}"
        )
    weights = layer_weights(network)
    if multipliers is None:
        multipliers = solve_multipliers(weights, slope, lipschitz_bound=lipschitz_bound)
        if multipliers is None:
            return LipschitzProof(
                lipschitz_bound, False, "none", time.perf_counter() - start, 0.0,
                f"no multipliers make the matrix positive definite at L = {lipschitz_bound}; the bound may be false",
            )
    sizes = [w.shape[0] for w in weights[:-1]]
    if [len(m) for m in multipliers] != sizes:
        raise ShapeError(f"expected multipliers of sizes {sizes}, received {[len(m) for m in multipliers]}")
    # Few bits keep the integers short; any positive values are as valid.
    scale = 2.0**_MULTIPLIER_BITS
    lams = [np.maximum(np.round(m.detach().double().numpy() * scale), 1.0) / scale for m in multipliers]
    exact, shift = _exact_lmi([w.double().numpy() for w in weights], lams, lipschitz_bound, alpha, beta)
    size = exact.shape[0]
    approximate = np.array([[int(v) / 2**shift for v in row] for row in exact], dtype=np.float64)
    seconds = lambda: time.perf_counter() - start  # noqa: E731
    lowest = np.linalg.eigvalsh(approximate)[0]
    try:
        factor = np.linalg.cholesky(approximate - 0.5 * max(lowest, 0.0) * np.eye(size))
    except np.linalg.LinAlgError:
        return LipschitzProof(
            lipschitz_bound, False, "exact", seconds(), float(lowest),
            f"the matrix has the eigenvalue {lowest:.3g} < 0 with these multipliers", list(multipliers),
        )
    # F in integers of 2**-44; F F^T is then a multiple of 2**-88, and so is M after a shift of its own.
    rounded = np.round(factor * 2.0**_FACTOR_BITS)
    whole = np.array([[int(v) for v in row] for row in rounded.tolist()], dtype=object)
    common = max(shift, 2 * _FACTOR_BITS)
    product = whole.dot(whole.T)
    rest = exact * (1 << (common - shift)) - product * (1 << (common - 2 * _FACTOR_BITS))
    diagonal = rest.diagonal()
    off = np.abs(rest).sum(axis=1) - np.abs(diagonal)
    margin = min(d - o for d, o in zip(diagonal.tolist(), off.tolist(), strict=True))
    slack = float(margin / 2**common / max(1e-300, float(approximate.diagonal().max())))
    reason = "" if margin >= 0 else f"the remainder is not diagonally dominant, it misses by {-slack:.3g}"
    return LipschitzProof(lipschitz_bound, margin >= 0, "exact", seconds(), slack, reason, list(multipliers))


def _exact_lmi(
    weights: list[np.ndarray], lams: list[np.ndarray], bound: float, alpha: float, beta: float
) -> tuple[np.ndarray, int]:
    """The matrix of paper Lemma 2 as ``integers * 2**-shift``, exactly."""
    sizes = [weights[0].shape[1], *(w.shape[0] for w in weights)]
    edges = np.concatenate([[0], np.cumsum(sizes)])
    blocks: dict[tuple[int, int], tuple[np.ndarray, int]] = {}
    whole_bound, shift_bound = _integers(np.array([[bound]]))
    eye = np.array([[int(i == j) for j in range(sizes[0])] for i in range(sizes[0])], dtype=object)
    blocks[0, 0] = (eye * int(whole_bound[0, 0]) ** 2, 2 * shift_bound)
    (a_int, a_shift), (b_int, b_shift) = (_integers(np.array([[v]])) for v in (alpha + beta, alpha * beta))
    added: list[tuple[tuple[int, int], np.ndarray, int]] = []
    for k, lam in enumerate(lams):
        w, w_shift = _integers(weights[k])
        d, d_shift = _integers(lam[:, None])
        blocks[k + 1, k + 1] = (np.diag(2 * d[:, 0]), d_shift)
        scaled = d * w
        blocks[k + 1, k] = (-int(a_int[0, 0]) * scaled, d_shift + w_shift + a_shift)
        if alpha * beta != 0:
            added.append(((k, k), 2 * int(b_int[0, 0]) * w.T.dot(scaled), 2 * w_shift + d_shift + b_shift))
    last, last_shift = _integers(weights[-1])
    blocks[len(weights), len(weights) - 1] = (-last, last_shift)
    out = sizes[-1]
    blocks[len(weights), len(weights)] = (
        np.array([[int(i == j) for j in range(out)] for i in range(out)], dtype=object), 0)
    shift = max([s for _, s in blocks.values()] + [s for _, _, s in added])
    matrix = np.zeros((edges[-1], edges[-1]), dtype=object)
    for (i, j), (value, s) in blocks.items():
        value = value * (1 << (shift - s))
        matrix[edges[i] : edges[i + 1], edges[j] : edges[j + 1]] = value
        if i != j:
            matrix[edges[j] : edges[j + 1], edges[i] : edges[i + 1]] = value.T
    for (i, j), value, s in added:
        matrix[edges[i] : edges[i + 1], edges[j] : edges[j + 1]] += value * (1 << (shift - s))
    return matrix, shift


def _feasible_start(weights: list[Tensor], beta: float) -> tuple[Tensor, float]:
    """Multipliers and a bound (1.05 times the product of norms) at which the matrix is positive definite."""
    norms = [max(float(torch.linalg.matrix_norm(w, 2)), 1e-12) for w in weights]
    # phi(x) = beta * phi'(x) with slopes in [0, 1]: only the product of the norms matters.
    bound = 1.05 * math.prod(norms) * beta ** (len(weights) - 1)
    ratio = (1.0 / 1.05) ** (2.0 / len(weights))
    level, parts = bound**2, []
    for w, norm in zip(weights[:-1], norms[:-1], strict=True):
        level = level * ratio / norm**2 / beta**2
        parts.append(torch.full((w.shape[0],), level, dtype=torch.float64))
    return torch.cat(parts), bound


def _minimise_bound(
    weights: list[Tensor], alpha: float, beta: float, target: float = 0.0, accuracy: float = 1e-7
) -> tuple[Tensor, float]:
    r"""Newton's method on the barrier of the cone, :math:`t L^2 - \log\det M - \sum \log \lambda`, for growing t.

    M is linear in the multipliers and in L^2, every multiplier entering with rank two, so that the Hessian is a
    product of small matrices. Steps are shortened until they stay inside the cone: every iterate is feasible.
    """
    sizes = [weights[0].shape[1], *(w.shape[0] for w in weights)]
    total, inputs, hidden = sum(sizes), sizes[0], sum(sizes[1:-1])
    # M = constant + L^2 I at the input + sum_i lambda_i U_i K U_i^T, U_i = [row i of the weights, unit vector i].
    before = torch.block_diag(*weights[:-1], weights[0].new_zeros(0, sizes[-2] + sizes[-1]))
    pairs = torch.stack([before, torch.eye(total, dtype=torch.float64)[inputs : inputs + hidden]], 1)
    kernel = torch.tensor([[2 * alpha * beta, -(alpha + beta)], [-(alpha + beta), 2.0]], dtype=torch.float64)
    constant = torch.zeros(total, total, dtype=torch.float64)
    constant[-sizes[-1] :, -sizes[-1] - sizes[-2] : -sizes[-1]] = -weights[-1]
    constant = constant + constant.mT
    constant[-sizes[-1] :, -sizes[-1] :] = torch.eye(sizes[-1], dtype=torch.float64)
    first = torch.zeros(total, dtype=torch.float64)
    first[:inputs] = 1.0

    lams, bound = _feasible_start(weights, beta)
    # Unknowns relative to the start; a small cost keeps the multiplier of a unit without input from growing for ever.
    scale = torch.cat([lams, torch.tensor([bound**2], dtype=torch.float64)])
    cost = torch.cat([torch.full_like(lams, 1e-3), torch.zeros(1, dtype=torch.float64)])
    x = torch.ones_like(scale)

    def factor_at(point: Tensor) -> Tensor | None:
        weighted = pairs * (point[:-1] * scale[:-1])[:, None, None]
        matrix = constant + torch.diag(first * point[-1] * scale[-1])
        matrix = matrix + torch.einsum("iak,ab,ibl->kl", weighted, kernel, pairs)
        factor, info = torch.linalg.cholesky_ex(matrix)
        return None if int(info) or not bool((point > 0).all()) else factor

    def value_at(point: Tensor, factor: Tensor) -> float:
        return float(cost @ point - 2.0 * factor.diagonal().log().sum() - point[:-1].log().sum())

    factor = factor_at(x)
    if factor is None:
        return lams, math.inf
    weight, limit = float(total), 2.0 * (total + hidden) / accuracy
    while weight < limit and math.sqrt(float(x[-1]) * scale[-1]) >= target:
        cost[-1] = weight
        for _ in range(50):
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
            root, info = torch.linalg.cholesky_ex(hessian)
            if int(info):
                break
            step = -torch.cholesky_solve(gradient[:, None], root)[:, 0]
            decrement = float(-(gradient @ step))
            if not decrement > 1e-2:
                break
            size, value = 1.0, value_at(x, factor)
            while size > 1e-8:
                trial = factor_at(x + size * step)
                if trial is not None and value_at(x + size * step, trial) < value - 0.1 * size * decrement:
                    x, factor = x + size * step, trial
                    break
                size *= 0.5
            else:
                break  # as accurate as float64 allows
        weight *= 8.0
    return x[:-1] * scale[:-1], math.sqrt(float(x[-1] * scale[-1]))


def solve_multipliers(
    network: nn.Module | Sequence[Tensor], slope: tuple[float, float] = (0.0, 1.0), *, lipschitz_bound: float
) -> list[Tensor] | None:
    """Multipliers with which the matrix of a claimed bound is positive definite, or None.

    A sandwich barrier brings its own; for other networks an interior-point method looks for them.

    Args:
        network: plain network or its weights.
        slope: smallest and largest slope of the activation.
        lipschitz_bound: the claimed constant.

    Returns:
        One positive vector per hidden layer; None if none was found.

    Source: paper Lemma 2.

    Example:
        >>> weights = [torch.tensor([[0.5], [0.5]]), torch.tensor([[1.0, 1.0]])]
        >>> solve_multipliers(weights, lipschitz_bound=0.9) is None
        True
    """
    alpha, beta = slope
    own = getattr(network, "multipliers", None)
    if callable(own):
        return own()
    weights = [w.double() for w in layer_weights(network)]
    if len(weights) == 1:
        return []
    lams, bound = _minimise_bound(weights, alpha, beta, target=lipschitz_bound * (1 - 1e-9))
    return None if bound > lipschitz_bound else list(lams.split([w.shape[0] for w in weights[:-1]]))


def lipschitz_upper(network: nn.Module | Sequence[Tensor], slope: tuple[float, float] = (0.0, 1.0)) -> float:
    """Smallest Lipschitz bound that can be proved for a network (within the accuracy of an interior-point method).

    Args:
        network: plain network or its weights.
        slope: smallest and largest slope of the activation.

    Returns:
        A bound that :func:`prove_lipschitz` accepts.

    Source: paper Lemma 2; Fazlyab et al. 2019 (LipSDP-Neuron).

    Example:
        >>> round(lipschitz_upper([torch.tensor([[0.5], [0.5]]), torch.tensor([[1.0, 1.0]])]), 2)
        1.0
    """
    weights = [w.double() for w in layer_weights(network)]
    if len(weights) == 1:
        return float(torch.linalg.matrix_norm(weights[0], 2)) * (1 + 1e-9)
    found, bound = _minimise_bound(weights, *slope)
    lams = list(found.split([w.shape[0] for w in weights[:-1]]))
    while not prove_lipschitz(weights, bound, slope, multipliers=lams).proved:
        bound *= 1 + 1e-4
    return bound


def lipschitz_lower(
    function: Callable[[Tensor], Tensor],
    low: float | Tensor,
    high: float | Tensor,
    n: int = 20000,
    generator: torch.Generator | None = None,
    *,
    dim: int | None = None,
) -> float:
    """Largest slope of a scalar function that was seen in samples: no Lipschitz constant can be smaller.

    Args:
        function: ``(n, p) -> (n, 1)``.
        low: lower corner of the box, number or ``(p,)``.
        high: upper corner.
        n: number of gradients.
        generator: random numbers.
        dim: p; taken from the first linear layer if not given.

    Returns:
        The largest gradient norm.

    Source: none.

    Example:
        >>> round(lipschitz_lower(nn.Linear(2, 1), -1.0, 1.0, n=10) / 1.0, 3) > 0
        True
    """
    if dim is None:
        low_t = torch.as_tensor(low)
        first = next((m for m in function.modules() if isinstance(m, nn.Linear)), None) if isinstance(function, nn.Module) else None
        dim = low_t.numel() if low_t.ndim else (first.in_features if first is not None else 0)
    if not dim:
        raise ConfigError("expected dim, the size of the input, for a function without linear layers; pass dim=")
    low_t, high_t = torch.as_tensor(low, dtype=torch.float32), torch.as_tensor(high, dtype=torch.float32)
    x = low_t + (high_t - low_t) * torch.rand(n, dim, generator=generator)
    # Gradients of a piecewise linear function: climbing towards the steepest pieces beats more samples.
    best = 0.0
    with torch.enable_grad():
        for _ in range(3):
            x = x.detach().requires_grad_()
            slope = torch.autograd.grad(function(x).sum(), x)[0]
            norm = slope.norm(dim=-1)
            best = max(best, float(norm.max()))
            top = x.detach()[norm.topk(max(1, n // 20)).indices]
            spread = 0.05 * (high_t - low_t) * torch.randn(n, dim, generator=generator)
            x = torch.minimum(torch.maximum(top.repeat(20, 1)[:n] + spread[: len(top) * 20], low_t), high_t)
    return best

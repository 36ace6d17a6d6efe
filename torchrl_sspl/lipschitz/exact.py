r"""Proofs of Lipschitz bounds in exact integer arithmetic.

A network :math:`x_{k+1} = \phi(W_k x_k + b_k)`, :math:`y = W_l x_l + b_l` with slopes of :math:`\phi` in
:math:`[\alpha, \beta]` is L-Lipschitz if :math:`M(\theta, \Lambda) \succeq 0` for some diagonal
:math:`\Lambda > 0`. Its weights are dyadic numbers, so M is known exactly. The proof is a factor F of about
Cholesky's: :math:`D M D = F F^\top + R` holds exactly, :math:`F F^\top \succeq 0` for any F, and :math:`R \succeq 0`
because it is diagonally dominant, which is decided in integers. D holds powers of two, so that entries of every size
keep their accuracy.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.lipschitz.multipliers import solve_multipliers
from torchrl_sspl.lipschitz.network import Slope, layer_weights, slope_interval

_FACTOR_BITS = 44  # bits after the point of the factor F; its rounding is far below the slack of R
_MULTIPLIER_BITS = 40  # of each multiplier, ahead of the slack that an interior-point method leaves


@dataclass
class LipschitzProof:
    """Outcome of a proof.

    Attributes:
        bound: the claimed Lipschitz constant.
        proved: whether it was proved.
        method: "exact", or "none" where no multipliers were found.
        seconds: time of the proof.
        slack: smallest margin of diagonal dominance; the diagonal of the scaled matrix lies between 1/4 and 1.
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


def prove_lipschitz(
    network: nn.Module | Sequence[Tensor],
    lipschitz_bound: float,
    slope: Slope | None = None,
    *,
    multipliers: Sequence[Tensor] | None = None,
) -> LipschitzProof:
    r"""Proves, in exact arithmetic on the deployed weights, that a network is L-Lipschitz, or says why it could not.

    .. math:: D M(\theta, \Lambda) D = F F^\top + R, \quad R_{ii} \ge \sum_{j \ne i} |R_{ij}| \;\Rightarrow\; M \succeq 0

    Args:
        network: plain network or its weights; float32 weights are taken as they are.
        lipschitz_bound: the claimed constant L, Euclidean norm to Euclidean norm.
        slope: smallest and largest slope of the activation; read from the network if not given.
        multipliers: diagonals of Lambda; searched for if not given. They are a witness: no choice of them can make
            a false claim pass.

    Raises:
        ConfigError: if the bound is not positive, the slopes do not contain those of the network, or it is no plain
            network.
        ShapeError: if the shapes of weights and multipliers do not fit.
        NonFiniteError: if a weight is NaN or infinite.

    Source: paper Lemma 2; deviation: decided exactly, the paper takes the sign of a log-determinant.

    Example:
        >>> import torch
        >>> weights = [torch.tensor([[0.5], [0.5]]), torch.tensor([[1.0, 1.0]])]
        >>> prove_lipschitz(weights, 1.01).proved, prove_lipschitz(weights, 0.99).proved
        (True, False)
    """
    start = time.perf_counter()
    slope = slope_interval(network, slope)
    if not (math.isfinite(lipschitz_bound) and lipschitz_bound > 0):
        raise ConfigError(f"expected lipschitz_bound > 0, received {lipschitz_bound}; pass the constant to prove")
    weights = layer_weights(network)
    if multipliers is None:
        multipliers = solve_multipliers(network, slope, lipschitz_bound=lipschitz_bound)
    method = "none" if multipliers is None else "exact"
    witness = None if multipliers is None else list(multipliers)

    def outcome(slack: float, reason: str = "") -> LipschitzProof:
        return LipschitzProof(lipschitz_bound, not reason, method, time.perf_counter() - start, slack, reason, witness)

    if witness is None:
        return outcome(0.0, f"no multipliers make the matrix positive definite at L = {lipschitz_bound}; the bound may be false")
    sizes = [w.shape[0] for w in weights[:-1]]
    if [tuple(m.shape) for m in witness] != [(n,) for n in sizes]:
        raise ShapeError(f"expected multipliers of sizes {sizes}, received shapes {[tuple(m.shape) for m in witness]}")
    lams = [_shortened(m.detach().cpu().double().numpy()) for m in witness]
    if not all(np.isfinite(v).all() and (v > 0).all() for v in lams):
        return outcome(-math.inf, "the multipliers are not all positive and finite")

    exact, shift = _scaled(*_exact_lmi([w.double().numpy() for w in weights], lams, lipschitz_bound, *slope))
    approximate = np.array([[v / 2**shift for v in row] for row in exact.tolist()], dtype=np.float64)
    lowest = float(np.linalg.eigvalsh(approximate)[0])
    try:
        factor = np.linalg.cholesky(approximate - 0.5 * max(lowest, 0.0) * np.eye(len(exact)))
    except np.linalg.LinAlgError:
        return outcome(lowest, f"the matrix, scaled, has the eigenvalue {lowest:.3g} < 0 with these multipliers")
    common = max(shift, 2 * _FACTOR_BITS)
    rest = exact * (1 << (common - shift)) - _exact_square(factor) * (1 << (common - 2 * _FACTOR_BITS))
    diagonal = rest.diagonal()
    margin = min((diagonal - (np.abs(rest).sum(axis=1) - np.abs(diagonal))).tolist())
    slack = margin / 2**common
    return outcome(slack, "" if margin >= 0 else f"the remainder is not diagonally dominant, it misses by {-slack:.3g}")


def _exact_square(factor: np.ndarray) -> np.ndarray:
    """``F F^T`` in units of ``2**(-2 * _FACTOR_BITS)``, exactly, of F rounded to ``_FACTOR_BITS``, entries up to 1."""
    half = _FACTOR_BITS // 2
    whole = np.round(factor * 2.0**_FACTOR_BITS).astype(np.int64)
    high, low = whole >> half, whole & ((1 << half) - 1)
    cross = high @ low.T
    parts = ((high @ high.T, 2 * half), (cross + cross.T, half), (low @ low.T, 0))
    return sum(part.astype(object) * (1 << digits) for part, digits in parts)  # type: ignore[return-value]


def _shortened(values: np.ndarray) -> np.ndarray:
    """The values with few bits each, which keeps the integers short; any positive values are as valid a witness."""
    mantissa, exponent = np.frexp(values)
    return np.ldexp(np.round(mantissa * 2.0**_MULTIPLIER_BITS), exponent - _MULTIPLIER_BITS)


def _integers(matrix: np.ndarray) -> tuple[np.ndarray, int]:
    """Dyadic float64 matrix as ``integers * 2**-shift``, exactly; shift >= 0."""
    pairs = [v.as_integer_ratio() for v in matrix.ravel().tolist()]
    shift = max((d.bit_length() - 1 for _, d in pairs), default=0)
    whole = np.empty(len(pairs), dtype=object)
    whole[:] = [n << (shift - d.bit_length() + 1) for n, d in pairs]
    return whole.reshape(matrix.shape), shift


def _exact_lmi(
    weights: list[np.ndarray], lams: list[np.ndarray], bound: float, alpha: float, beta: float
) -> tuple[np.ndarray, int]:
    """The matrix of paper Lemma 2 as ``integers * 2**-shift``, exactly."""
    sizes = [weights[0].shape[1], *(w.shape[0] for w in weights)]
    edges = np.concatenate([[0], np.cumsum(sizes)]).tolist()
    parts = [slice(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    terms: list[tuple[int, int, np.ndarray, int]] = []  # block row, block column, integers, shift

    def identity(n: int) -> np.ndarray:
        return np.array([[int(i == j) for j in range(n)] for i in range(n)], dtype=object)

    def dyadic(value: Fraction) -> tuple[int, int]:
        return value.numerator, value.denominator.bit_length() - 1

    square, square_shift = dyadic(Fraction(bound) ** 2)
    total, total_shift = dyadic(Fraction(alpha) + Fraction(beta))
    product, product_shift = dyadic(Fraction(alpha) * Fraction(beta))
    terms.append((0, 0, identity(sizes[0]) * square, square_shift))
    for k, lam in enumerate(lams):
        w, w_shift = _integers(weights[k])
        d, d_shift = _integers(lam)
        scaled = d[:, None] * w
        terms.append((k + 1, k + 1, identity(len(d)) * (2 * d), d_shift))
        terms.append((k + 1, k, -total * scaled, d_shift + w_shift + total_shift))
        if product:
            terms.append((k, k, 2 * product * w.T.dot(scaled), 2 * w_shift + d_shift + product_shift))
    last, last_shift = _integers(weights[-1])
    terms.append((len(weights), len(weights) - 1, -last, last_shift))
    terms.append((len(weights), len(weights), identity(sizes[-1]), 0))

    shift = max(s for *_, s in terms)
    matrix = np.zeros((edges[-1], edges[-1]), dtype=object)
    for i, j, value, s in terms:
        value = value * (1 << (shift - s))
        matrix[parts[i], parts[j]] += value
        if i != j:
            matrix[parts[j], parts[i]] += value.T
    return matrix, shift


def _scaled(matrix: np.ndarray, shift: int) -> tuple[np.ndarray, int]:
    """``D M D`` with powers of two in D, exactly; a positive diagonal comes to lie in [1/4, 1)."""
    exponents = [-((shift - v.bit_length()) // 2) if v > 0 else None for v in map(int, matrix.diagonal())]
    top = max((e for e in exponents if e is not None), default=0)
    rows = np.array([1 if e is None else 1 << (top - e) for e in exponents], dtype=object)
    return matrix * rows[:, None] * rows, shift + 2 * top

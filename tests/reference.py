"""The equations once more, in NumPy, slowly and row by row; nothing here imports the package."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np


def safe_hinge(barrier, margin):
    return np.array([[max(0.0, b + margin)] for b in barrier[:, 0]]).reshape(-1, 1)


def unsafe_hinge(barrier, margin):
    return np.array([[max(0.0, -b + margin)] for b in barrier[:, 0]]).reshape(-1, 1)


def squared_distance(first, second):
    return np.array([[sum((a - b) ** 2 for a, b in zip(x, y, strict=True))] for x, y in zip(first, second, strict=True)])


def distance(first, second):
    return np.sqrt(squared_distance(first, second))


def synthesis_violation(barrier, after, mode, psi, m, decay, decrement, floor, band):
    rows = []
    for b, n in zip(barrier[:, 0], after[:, 0], strict=True):
        if mode == "paper":
            rows.append(n + m - b + psi)
        elif mode == "R1":
            rows.append(n + m - (1 - decay) * b)
        elif mode == "R2":
            rows.append(n + m - max(b - decrement, -floor))
        else:
            rows.append(max(0.0, n + m) * max(0.0, band - b) / band)
    return np.array(rows).reshape(-1, 1)


def lmi_matrix(weights, multipliers, bound, slope):
    """Stacks A and C and multiplies, as the lemma is printed (with the selection [0 I 0])."""
    alpha, beta = slope
    sizes = [weights[0].shape[1]] + [w.shape[0] for w in weights]
    edges = np.cumsum([0, *sizes])
    n_hidden, total = sum(sizes[1:-1]), edges[-1]
    a = np.zeros((n_hidden, total))
    row = 0
    for k, w in enumerate(weights[:-1]):
        a[row : row + w.shape[0], edges[k] : edges[k + 1]] = w
        row += w.shape[0]
    c = np.zeros((n_hidden, total))
    c[:, sizes[0] : sizes[0] + n_hidden] = np.eye(n_hidden)
    lam = np.diag(np.concatenate(multipliers))
    middle = np.block([[2 * alpha * beta * lam, -(alpha + beta) * lam], [-(alpha + beta) * lam, 2 * lam]])
    stacked = np.vstack([a, c])
    matrix = stacked.T @ middle @ stacked
    matrix[: sizes[0], : sizes[0]] += bound**2 * np.eye(sizes[0])
    matrix[edges[-2] :, edges[-2] :] += np.eye(sizes[-1])
    matrix[edges[-2] :, edges[-3] : edges[-2]] -= weights[-1]
    matrix[edges[-3] : edges[-2], edges[-2] :] -= weights[-1].T
    return matrix


def minus_log_det(matrix):
    return -sum(math.log(v) for v in np.linalg.eigvalsh(matrix))


def covering_radius(points, samples):
    return max(min(math.dist(z, s) for s in samples) for z in points)


def is_positive_definite(weights, multipliers, bound, slope):
    """Decides M > 0 by the pivots of an exact LDL^T in fractions."""
    def to_fractions(m):
        return np.array([[Fraction(float(v)) for v in row] for row in m], dtype=object)

    alpha, beta = map(Fraction, slope)
    sizes = [weights[0].shape[1]] + [w.shape[0] for w in weights]
    edges = [sum(sizes[:k]) for k in range(len(sizes) + 1)]
    m = np.array([[Fraction(0)] * edges[-1] for _ in range(edges[-1])], dtype=object)
    for i in range(sizes[0]):
        m[i, i] += Fraction(bound) ** 2
    for i in range(edges[-2], edges[-1]):
        m[i, i] += 1
    for k, (w, lam) in enumerate(zip(weights[:-1], multipliers, strict=True)):
        w = to_fractions(w)
        for i, value in enumerate(lam):
            here, value, before = edges[k + 1] + i, Fraction(float(value)), slice(edges[k], edges[k + 1])
            m[here, here] += 2 * value
            m[here, before] -= (alpha + beta) * value * w[i]
            m[before, here] -= (alpha + beta) * value * w[i]
            m[before, before] += 2 * alpha * beta * value * np.outer(w[i], w[i])
    last, hidden, out = to_fractions(weights[-1]), slice(edges[-3], edges[-2]), slice(edges[-2], edges[-1])
    m[out, hidden] -= last
    m[hidden, out] -= last.T
    for i in range(len(m)):
        if m[i, i] <= 0:
            return False
        for j in range(i + 1, len(m)):
            m[j, i:] = m[j, i:] - m[j, i] / m[i, i] * m[i, i:]
    return True

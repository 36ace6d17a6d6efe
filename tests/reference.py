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


def with_worst(values, coeff, fraction):
    """Mean, and so much of the mean over the worst share of the rows."""
    if not len(values):
        return 0.0
    ordered = sorted(values, reverse=True)
    count = max(1, math.ceil(fraction * len(ordered)))
    return sum(ordered) / len(ordered) + coeff * sum(ordered[:count]) / count


def consistency_loss(predicted, actual, region, unsafe_weight, outlier, worst_coeff, worst_fraction):
    """Loss, mean and largest error of the dynamics."""
    errors = [math.sqrt(s) for s in squared_distance(predicted, actual)[:, 0]]
    counted = [e**2 if outlier is None or e <= outlier else 2 * outlier * e - outlier**2 for e in errors]
    weighted = [(unsafe_weight if r == 2 else 1.0) * c for c, r in zip(counted, region[:, 0], strict=True)]
    return with_worst(weighted, worst_coeff, worst_fraction), sum(errors) / len(errors), max(errors)


def target_loss(
    barrier, action, barrier_target, inside, action_target, action_weight, region, margin, action_scale, inside_coeff,
    outside_cap, scale, policy_coeff, safe_coeff, unsafe_coeff, worst_coeff, worst_fraction,
):  # fmt: skip
    fit, follow, safe, unsafe = [], [], [], []
    for k in range(len(barrier)):
        b, t = barrier[k, 0], barrier_target[k, 0]
        weight = math.exp(-abs(t) / scale) + 0.1
        fit.append(weight * (inside_coeff * (b - t) ** 2 if inside[k, 0] else max(0.0, min(t, outside_cap) - b) ** 2))
        gaps = [((u - v) / s) ** 2 for u, v, s in zip(action[k], action_target[k], action_scale, strict=True)]
        follow.append(action_weight[k, 0] * sum(gaps) / len(gaps))
        if region[k, 0] == 1:
            safe.append(max(0.0, b + margin))
        if region[k, 0] == 2:
            unsafe.append(max(0.0, margin - b))
    return {
        "loss_target": with_worst(fit, worst_coeff, worst_fraction),
        "loss_policy_target": policy_coeff * sum(follow) / len(follow),
        "loss_safe": safe_coeff * with_worst(safe, worst_coeff, worst_fraction),
        "loss_unsafe": unsafe_coeff * with_worst(unsafe, worst_coeff, worst_fraction),
    }


def multilinear(table, action, action_scale, points):
    """One dimension after the other, the last one varying fastest."""
    values = np.asarray(table).reshape([points] * len(action))
    for u, scale in zip(action, action_scale, strict=True):
        place = min(max((u / scale + 1) / 2 * (points - 1), 0.0), points - 1.0)
        low = min(int(place), points - 2)
        values = values[low] + (place - low) * (values[low + 1] - values[low])
    return float(values)

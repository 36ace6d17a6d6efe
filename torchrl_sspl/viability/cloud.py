r"""Robust invariant sets of a cloud of latents: what the barrier and the policy are taught.

With frozen encoder and dynamics the encoded data is a point cloud :math:`\{z_i\}`. The largest subset
:math:`K` such that every :math:`z_i \in K` has an action :math:`u` whose predicted successor stays in :math:`K`,
whichever of the errors observed nearby is added, is a viability kernel of the learned model that tolerates these
errors. The barrier is taught :math:`L_B` times the signed distance to :math:`K`, the deepest
:math:`L_B`-Lipschitz function with that zero level. Only the labels "unsafe"
enter; no state is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchrl_sspl.errors import EmptyRegionError, ShapeError

_SMOOTHING = 0.02  # latent units, added to distances before they are inverted
_RIDGE = 0.01  # of the spread of the neighbours, below which they tell no slope
_PART = 100_000  # latents that are interpolated at a time


def _tree(points: Tensor):
    # Imported here: scipy is a dependency, but importing the library stays light without it.
    from scipy.spatial import cKDTree

    return cKDTree(points.detach().cpu().numpy())


def _nearest(queries: Tensor, points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Distances ``(n, count)`` float32 to the nearest points, and which these are."""
    distance, index = _tree(points).query(queries.detach().cpu().numpy(), k=range(1, count + 1))
    return torch.as_tensor(distance, dtype=torch.float32), torch.as_tensor(index)


def _mixture(queries: Tensor, points: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Nearest points ``(n, count)``, fewer where there are fewer, weights of an interpolation between them, and the distance ``(n,)`` to the nearest.

    The weights are those of a plane fitted to the values of the neighbours, near ones counting more: a mean of neighbours that lie
    to one side of the query would say what is true over there, and a search for the best of many actions finds just those errors.
    """
    distance, index = _nearest(queries, points, min(count, len(points)))
    parts = zip(queries.split(_PART), distance.split(_PART), index.split(_PART), strict=True)
    return index, torch.cat([_plane_weights(points[rows] - q[:, None], d) for q, d, rows in parts]), distance[:, 0]


def _plane_weights(off: Tensor, distance: Tensor) -> Tensor:
    """Weights ``(n, k)`` of neighbours at offsets ``(n, k, p)``."""
    weight = 1.0 / (distance + _SMOOTHING)
    weight = weight / weight.sum(1, keepdim=True)
    centre = (weight[..., None] * off).sum(1)
    off = off - centre[:, None]
    spread = off.mT @ (weight[..., None] * off)
    ridge = _RIDGE * spread.diagonal(dim1=1, dim2=2).sum(1) + 1e-9  # across the data nothing is known of a slope
    tilt = torch.linalg.solve(spread + ridge[:, None, None] * torch.eye(off.shape[2]), centre)
    return weight * (1.0 - (off @ tilt[..., None])[..., 0])


def _mixed(value: Tensor, index: Tensor, weight: Tensor) -> Tensor:
    """Interpolated values, within those of the neighbours."""
    around = value[index]
    return (around * weight).sum(-1).clamp(around.amin(-1), around.amax(-1))


def nearest_distance(queries: Tensor, points: Tensor) -> Tensor:
    """Euclidean distance ``(n,)`` float32 of every query ``(n, p)`` to the nearest of points ``(m, p)``.

    No points are an EmptyRegionError. Source: none.

    Example:
        >>> nearest_distance(torch.tensor([[0.0, 3.0]]), torch.tensor([[0.0, 0.0], [0.0, 1.0]]))
        tensor([2.])
    """
    if points.shape[0] == 0:
        raise EmptyRegionError("expected at least one point to measure distances to, received 0; collect more data")
    return _nearest(queries, points, 1)[0][:, 0]


def normal_projectors(points: Tensor, reference: Tensor, *, neighbours: int = 24, threshold: float = 0.05) -> Tensor:
    r"""Projectors ``(n, p, p)`` onto the directions in which the data manifold has no extent, at every point.

    .. math:: N_i = \sum_{j: \lambda_j < \tau \lambda_{\max}} v_j v_j^\top

    with eigenpairs of the covariance of the nearest neighbours (local principal components); zero where the data has
    extent in every direction. Source: none.

    Args:
        points: ``(n, p)`` latents.
        reference: ``(m, p)`` latents that sample the manifold.
        neighbours: number of neighbours per point.
        threshold: eigenvalue ratio below which a direction counts as normal.

    Example:
        >>> line = torch.stack([torch.linspace(-1, 1, 100), torch.zeros(100)], -1)
        >>> normal_projectors(line[:1], line).tolist()
        [[[0.0, 0.0], [0.0, 1.0]]]
    """
    local = reference[_nearest(points, reference, min(neighbours, len(reference)))[1]]
    local = local - local.mean(1, keepdim=True)
    values, vectors = torch.linalg.eigh(local.transpose(1, 2) @ local)
    normal = (values < threshold * values[:, -1:]).to(vectors.dtype)
    return (vectors * normal[:, None]) @ vectors.transpose(1, 2)


@dataclass
class InvariantSet:
    """A robust invariant subset of a cloud of latents.

    The clearance is the distance from the successor under each action, the worst of its errors, to the nearest point
    outside; zero for candidates outside and for actions that leave the set.
    """

    inside: Tensor  # (n,) bool, which candidates belong to the set
    clearance: Tensor  # (n, k)
    removed: Tensor  # (n,) int64, sweep in which a candidate was removed; 0 for those inside
    iterations: int  # sweeps until nothing more was removed


def robust_invariant_set(
    successors: Tensor,
    candidates: Tensor,
    outside: Tensor,
    *,
    residuals: Tensor | None = None,
    absorbing: Tensor | None = None,
    max_iterations: int = 1000,
) -> InvariantSet:
    r"""Largest subset of the candidates that can be kept, whatever the latent error among the given ones.

    .. math:: K_0 = \{ z_i : \forall e: \operatorname{nn}(z_i + e - \bar e) \notin \text{outside} \}, \qquad
        K_{j+1} = \{ z_i \in K_j : \exists u \; \forall e: \operatorname{nn}(d(z_i, u) + e) \in K_j \}

    with nn the nearest of all candidates and outside points: the cloud is its own grid. What looks unsafe within the
    error of its own encoding is outside from the start. The error e runs over the residuals that were observed near
    :math:`z_i`, with mean :math:`\bar e`: the error of a model from pixels is far from round (a velocity is
    seen less well than a position), and a ball as large as its longest axis would cost most of the set.
    Source: none (the paper leaves the growth of the safe set to its losses).

    Args:
        successors: ``(n, k, p)`` predicted successors of every candidate under every action.
        candidates: ``(n, p)`` latents that carry no "unsafe" label; sizes that differ are a ShapeError.
        outside: ``(m, p)`` latents of the unsafe label; none are an EmptyRegionError.
        residuals: ``(n, j, p)`` observed errors of the dynamics near every candidate; none if not given.
        absorbing: ``(n,)`` bool, candidates that belong to the set whatever follows (an episode that has ended
            safely); none if not given.
        max_iterations: bound on the number of sweeps.

    Example:
        >>> z = torch.linspace(-1, 1, 21)[:, None]
        >>> step = torch.stack([z - 0.2, z + 0.2], 1)
        >>> int(robust_invariant_set(step, z, torch.tensor([[-1.1], [1.1]])).inside.sum())
        21
    """
    n, k, p = successors.shape
    if candidates.shape != (n, p) or (residuals is not None and (residuals.shape[0], residuals.shape[2]) != (n, p)):
        raise ShapeError(
            f"expected candidates of shape ({n}, {p}) and residuals of shape ({n}, j, {p}) for successors "
            f"{tuple(successors.shape)}, received {tuple(candidates.shape)} and "
            f"{None if residuals is None else tuple(residuals.shape)}; pass one row per candidate"
        )
    if outside.shape[0] == 0:
        raise EmptyRegionError("expected at least one unsafe latent, received 0; label some observations unsafe")
    errors = np.zeros((n, 1, p), np.float32) if residuals is None else residuals.detach().cpu().numpy()
    ends = successors.detach().cpu().numpy()[:, :, None] + errors[:, None]  # (n, k, j, p)
    tree = _tree(torch.cat([candidates, outside]))
    nearest = tree.query(ends)[1]
    seen = candidates.detach().cpu().numpy()[:, None] + errors - errors.mean(1, keepdims=True)
    kept = np.zeros(n, dtype=bool) if absorbing is None else absorbing.detach().cpu().numpy().astype(bool)
    member = np.zeros(n + len(outside), dtype=bool)
    member[:n] = (tree.query(seen)[1] < n).all(1) | kept
    possible = np.ones((n, k), dtype=bool)
    removed = np.where(member[:n], 0, 1)
    iteration = 0
    for iteration in range(1, max_iterations + 1):
        # An action that has failed once never comes back: the set only shrinks.
        row, action = np.nonzero(possible & member[:n, None])
        possible[row, action] = member[nearest[row, action]].all(1)
        lost = member[:n] & ~possible.any(1) & ~kept
        if not lost.any():
            break
        member[:n][lost] = False
        removed[lost] = iteration
    inside = torch.as_tensor(member[:n])
    clearance = np.zeros((n, k), np.float32)
    row, action = np.nonzero(possible & member[:n, None])
    if len(row):
        distance = _tree(torch.cat([candidates[~inside], outside])).query(ends[row, action])[0]
        clearance[row, action] = distance.min(1)
    return InvariantSet(inside, torch.as_tensor(clearance), torch.as_tensor(removed), iteration)


def nearby_residuals(
    latent: Tensor, reference: Tensor, residual: Tensor, *, count: int, spread: float, neighbours: int = 64
) -> tuple[Tensor, Tensor]:
    r"""Errors of the dynamics near every latent: some, and the mean and the ends of the principal axis ``(n, 3, p)``.

    .. math:: \{ \mu, \mu + s \sqrt{\lambda} v, \mu - s \sqrt{\lambda} v \}

    with the mean and the leading eigenpair of the covariance of the residuals of the nearest neighbours. The axis
    varies smoothly with the latent, which a handful of sampled errors would not: an invariant set that has to
    tolerate it has a smooth border. What lies across the axis is left to the radius of the set. Source: none.

    Args:
        latent: ``(n, p)``.
        reference: ``(m, p)`` latents at which errors were observed.
        residual: ``(m, p)`` errors, next latent minus predicted next latent.
        count: sampled errors per latent, ``(n, count, p)``.
        spread: s, in standard deviations.
        neighbours: errors that make the covariance.

    Example:
        >>> z = torch.linspace(0, 1, 100)[:, None]
        >>> [e.shape for e in nearby_residuals(z[:2], z, 0.1 * torch.ones(100, 1), count=4, spread=2.0)]
        [torch.Size([2, 4, 1]), torch.Size([2, 3, 1])]
    """
    k = min(neighbours, len(reference))
    local = residual[_nearest(latent, reference, k)[1]]
    mean = local.mean(1, keepdim=True)
    centred = local - mean
    values, vectors = torch.linalg.eigh(centred.mT @ centred / k)
    axes = (vectors * values.clamp_min(0.0).sqrt()[:, None]).mT[:, -1:] * spread
    return local[:, :count], torch.cat([mean, mean + axes, mean - axes], dim=1)


def barrier_targets(
    queries: Tensor, inside: Tensor, outside: Tensor, *, tube_radius: float, lipschitz_bound: float
) -> tuple[Tensor, Tensor]:
    r"""Target ``(n,)`` of the barrier at any latent, the Lipschitz bound times a signed distance, and who is inside.

    .. math::
        B^\star(z) = \begin{cases} -L_B \operatorname{dist}(z, \text{outside}) & z \text{ in the tube around the set} \\
        L_B \operatorname{dist}(z, \text{tube}) & \text{else} \end{cases}

    Source: none; at the set's boundary the target meets paper eq. (3)-(4) with the largest margin.

    Args:
        queries: ``(n, p)`` latents.
        inside, outside: latents of the invariant set and outside it, off-manifold ones included; none is an
            EmptyRegionError.
        tube_radius: distance from the inside latents up to which a latent off the manifold belongs to the set.
        lipschitz_bound: Lipschitz bound of the barrier.

    Example:
        >>> inside, outside = torch.tensor([[0.0], [0.1]]), torch.tensor([[0.5], [0.9]])
        >>> barrier_targets(torch.tensor([[0.0], [0.9]]), inside, outside, tube_radius=0.2, lipschitz_bound=2.0)
        (tensor([-1.0000,  1.2000]), tensor([ True, False]))
    """
    near_inside = nearest_distance(queries, inside)
    near_outside = nearest_distance(queries, outside)
    member = (near_inside < tube_radius) & (near_inside < near_outside)
    off_tube = torch.where(near_inside > tube_radius, (near_inside - tube_radius).clamp_min(0.02), near_inside)
    return lipschitz_bound * torch.where(member, -near_outside, off_tube), member


def reach_times(
    successors: Tensor,
    starts: Tensor,
    goal: Tensor,
    *,
    horizon: int = 120,
    neighbours: int = 3,
    known_within: float | None = None,
) -> Tensor:
    r"""Steps ``(n, k)`` to a goal set under every action, by dynamic programming on the cloud of latents.

    .. math:: T(z_i, u) = 1 + \overline{T}(d(z_i, u)), \quad
        \overline T(z) = \operatorname{mean}_{j \in nn(z)} \min_u T(z_j, u)

    Source: none (the paper claims that unsafe starts return, and does not say how).

    Args:
        successors: ``(n, k, p)`` predicted successors of the starts.
        starts: ``(n, p)`` latents outside the goal.
        goal: ``(m, p)`` latents of the goal, where the time is zero.
        horizon: time given to what cannot reach the goal; no time is above it by more than 1.
        neighbours: latents over which the time of a successor is averaged.
        known_within: successors farther than this from every latent are taken for a dead end: where there is no data
            the model says nothing, and a way that leads there may not lead back.

    Example:
        >>> z = torch.linspace(0, 0.9, 10)[:, None]
        >>> reach_times(torch.stack([z, z + 0.1], 1), z, torch.tensor([[1.0]]), neighbours=1)[0].tolist()
        [11.0, 10.0]
    """
    n, k, p = successors.shape
    cloud = torch.cat([starts, goal])
    distance, found = _nearest(successors.reshape(-1, p), cloud, neighbours)
    index, nearest = found.reshape(n, k, -1), distance[:, 0].reshape(n, k)
    unknown = torch.zeros(n, k, dtype=torch.bool) if known_within is None else nearest > known_within
    times = torch.cat([torch.full((n,), float(horizon)), torch.zeros(len(goal))])
    per_action = torch.full((n, k), float(horizon))
    for _ in range(4 * horizon):
        per_action = torch.where(unknown, float(horizon), times[index].mean(-1)) + 1.0
        best = per_action.min(1).values.clamp(max=float(horizon))
        if float((best - times[:n]).abs().max()) < 1e-2:
            break
        times[:n] = best
    return per_action


def safety_values(
    successors: Tensor,
    latent: Tensor,
    margin: Tensor,
    *,
    residuals: Tensor | None = None,
    neighbours: int = 8,
    horizon: int = 60,
) -> Tensor:
    r"""Least margin ``(n, k)`` that an action leaves on all that follows, whatever the error among the given ones.

    .. math:: Q(z_i, u) = \min_e \overline V(d(z_i, u) + e), \qquad V(z_i) = \min(m_i, \max_u Q(z_i, u))

    with :math:`\overline V` interpolated linearly between the nearest latents. Unlike the
    clearance of one step it tells actions apart long before the border of what can be kept is reached. Source: none
    (the paper trains its policy on the condition alone); it is Hamilton-Jacobi reachability on a cloud of latents.

    Args:
        successors: ``(n, k, p)`` predicted successors of every latent under every action.
        latent: ``(n, p)`` latents; sizes that differ are a ShapeError.
        margin: ``(n,)`` how far a latent is from what it must not become; negative there.
        residuals: ``(n, j, p)`` observed errors of the dynamics near every latent; none if not given.
        neighbours: latents between which the value of a successor is interpolated.
        horizon: steps looked ahead.

    Example:
        >>> z = torch.linspace(-1, 1, 21)[:, None]
        >>> value = safety_values(torch.stack([z - 0.1, z + 0.1], 1), z, 1 - z.abs()[:, 0], neighbours=1)
        >>> bool(value[5, 1] > value[5, 0]), bool(value[15, 0] > value[15, 1])
        (True, True)
    """
    n, k, p = successors.shape
    if latent.shape != (n, p) or margin.shape != (n,) or (residuals is not None and residuals.shape[0] != n):
        raise ShapeError(
            f"expected latents ({n}, {p}), margins ({n},) and residuals ({n}, j, {p}) for successors "
            f"{tuple(successors.shape)}, received {tuple(latent.shape)}, {tuple(margin.shape)} and "
            f"{None if residuals is None else tuple(residuals.shape)}; pass one row per latent"
        )
    errors = torch.zeros(n, 1, p) if residuals is None else residuals
    ends = (successors[:, :, None] + errors[:, None]).reshape(-1, p)
    index, weight = (found.reshape(n, k, errors.shape[1], -1) for found in _mixture(ends, latent, neighbours)[:2])
    value = margin
    for _ in range(horizon):
        per_action = _mixed(value, index, weight).amin(-1)
        best = torch.minimum(margin, per_action.amax(1))
        change, value = float((best - value).abs().max()), best
        if change < 1e-3:
            break
    return per_action


def signed_margin(latent: Tensor, unsafe: Tensor) -> Tensor:
    """Distance ``(n,)`` to the nearest unsafe latent; for unsafe ones minus that to the nearest of the others.

    Args:
        latent: ``(n, p)`` latents.
        unsafe: ``(n,)`` bool; all or none are an EmptyRegionError.

    Source: none.

    Example:
        >>> signed_margin(torch.tensor([[0.0], [1.0], [3.0]]), torch.tensor([True, False, False]))
        tensor([-1.,  1.,  3.])
    """
    margin = torch.empty(len(latent))
    margin[~unsafe] = nearest_distance(latent[~unsafe], latent[unsafe])
    margin[unsafe] = -nearest_distance(latent[unsafe], latent[~unsafe])
    return margin


def value_targets(
    queries: Tensor,
    latent: Tensor,
    value: Tensor,
    *,
    tube_radius: float,
    lipschitz_bound: float,
    neighbours: int = 8,
) -> Tensor:
    r"""Target ``(n,)`` of the barrier at any latent: minus the margin that a policy keeps, rising off the data.

    .. math:: B^\star(z) = \max(-\overline V(z), \; L_B (\operatorname{dist}(z, \text{data}) - r))

    The margin V never falls along the policy's own steps, errors included, so every level set of this target is kept; a
    signed distance promises that of its zero level alone, and there nothing is left for what a network does not fit.
    Source: none; at the set's boundary the target meets paper eq. (3)-(4).

    Args:
        queries: ``(n, p)`` latents.
        latent: ``(m, p)`` latents of the data.
        value: ``(m,)`` margins V, see :func:`safety_values`, for ``neighbours`` too.
        tube_radius: distance r from the data up to which a latent may belong to the set.
        lipschitz_bound: Lipschitz bound of the barrier.

    Example:
        >>> data, value = torch.tensor([[0.0], [1.0]]), torch.tensor([0.2, -0.1])
        >>> value_targets(torch.tensor([[0.0], [0.5]]), data, value, tube_radius=0.3, lipschitz_bound=1.0, neighbours=1)
        tensor([-0.2000,  0.2000])
    """
    index, weight, distance = _mixture(queries, latent, neighbours)
    return torch.maximum(-_mixed(value, index, weight), lipschitz_bound * (distance - tube_radius))

"""What barrier and policy are taught on frozen latents: targets on the cloud of the data or on a grid, computed once a round."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_sspl.configs.schema import RESIDUALS
from torchrl_sspl.direction import charted, lifted, within
from torchrl_sspl.journal import journal, kept
from torchrl_sspl.modules.networks import mlp
from torchrl_sspl.sets import SAFE, UNSAFE
from torchrl_sspl.trainers.phases import InnerLoop, Workspace, action_grid
from torchrl_sspl.viability import ViabilityKernel, viability_kernel
from torchrl_sspl.viability.cloud import (
    barrier_targets,
    nearby_residuals,
    nearest_distance,
    normal_projectors,
    reach_times,
    robust_invariant_set,
    safety_values,
    signed_margin,
    value_targets,
)
from torchrl_sspl.viability.grid import Grid, one_step_value

_KNOWN_WITHIN = 0.06  # distance from the data beyond which a way back is not looked for
_SPREADS = (1.0, 0.75, 0.5, 0.25, 0.0)  # shares of the errors that are tolerated, the first that keeps S
_KEPT_OF_SAFE = 0.9
_ROOM = 1.25  # of what is to be tolerated, that the invariant set of the data tolerates
_GRID_ROOM = 4.0  # ... that the one on a grid tolerates
_MEMORY = 17  # ... per entry that no picture shows, on the finer grid
_SEPARATE = 8000  # steps in which U is told from the rest: a border that is not sharp costs volume
_UNSAFE_FIRST = 3.0  # how much more a picture of U counts there
_SLOPE = 0.9  # of the targets on a grid, of the barrier's Lipschitz constant
_PART = 1 << 17  # nodes that are looked at together
_DEPTH = 0.25  # barrier value up to which the targets on a grid go


@torch.no_grad()
def off_manifold(work: Workspace, latent: Tensor, radius: float, salt: int) -> tuple[Tensor, Tensor]:
    """Latents moved off the data manifold along its normals, and the rows that they came from."""
    g = torch.Generator().manual_seed(work.seed + 77_000 + salt)
    cloud = _cloud(work, g)
    normal = normal_projectors(latent, cloud[:20000])
    direction = (normal @ torch.randn(*latent.shape, 1, generator=g))[..., 0]
    length = direction.norm(dim=-1, keepdim=True)
    moved = radius * torch.rand(len(latent), 1, generator=g)
    points = within(latent + moved * direction / length.clamp_min(1e-6), work.direction)
    # Where another sheet of the manifold is nearer than the one it came from, a point says nothing.
    kept = (length[:, 0] > 1e-3) & (nearest_distance(points, cloud) > 0.85 * moved[:, 0])
    rows = kept.nonzero()[:, 0]
    return points[rows], rows


def uniform(work: Workspace, n: int, generator: torch.Generator) -> Tensor:
    """``(n, p)`` latents of the whole domain."""
    turns = work.direction
    z = torch.rand(n, work.latent_dim - (turns is not None), generator=generator) * 2 - 1
    if turns is not None:
        z[:, turns.first] *= math.pi * turns.radius
    z = lifted(z, turns)
    return z if work.seen_dim is None else remembered(work, z, generator)


def remembered(work: Workspace, latent: Tensor, generator: torch.Generator) -> Tensor:
    """Latents ``(n, p)`` with other actions in their memory: anywhere in the domain, or from what the policy chooses from.

    What is chosen lies on the rim of the domain, which is never drawn uniformly.
    """
    seen, n = work.seen_dim or work.latent_dim, len(latent)
    hidden = torch.rand(n, work.latent_dim - seen, generator=generator) * 2 - 1
    if work.config.choices:
        table = action_grid([1.0] * hidden.shape[1], work.config.choices)
        drawn = table[torch.randint(len(table), (n,), generator=generator)]
        hidden = torch.where(torch.rand(n, 1, generator=generator) < 0.5, drawn, hidden)
    return torch.cat([latent[:, :seen], hidden], -1)


def _cloud(work: Workspace, generator: torch.Generator) -> Tensor:
    cloud = torch.cat([work.latents["latent"], work.latents["next_latent"]])
    return cloud[torch.randperm(len(cloud), generator=generator)[:80000]]


def observed_errors(work: Workspace, latent: Tensor, generator: torch.Generator, spread: float) -> tuple[Tensor, Tensor]:
    """Errors of the dynamics observed near latents: a sample of them, and their principal axis."""
    data = work.latents
    z = data["latent"]
    with torch.no_grad():
        residual = data["next_latent"] - work.dynamics(z, data["action"])
    sample = torch.randperm(len(z), generator=generator)[:30000]
    tolerated = work.config.tolerated_error
    spread = spread or float(tolerated > 0)  # of that the direction is needed, whatever its length
    near, axes = nearby_residuals(latent, z[sample], residual[sample], count=work.config.residuals, spread=spread, neighbours=RESIDUALS)
    if tolerated > 0:
        # The direction is what was observed, the length what is to be tolerated, and room for what a network does not fit.
        mean, ends = axes[:, :1], axes[:, 1:] - axes[:, :1]
        either_way = torch.eye(1, ends.shape[-1]) * torch.tensor([[1.0], [-1.0]])  # where nothing was observed
        ends = torch.where(ends.norm(dim=-1, keepdim=True) > 0.0, ends, either_way)
        length = _ROOM * tolerated / ends.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        axes = torch.cat([mean, mean + length * ends], dim=1)
    return near, axes


@torch.no_grad()
def successors(work: Workspace, latent: Tensor, actions: Tensor) -> Tensor:
    """``(n, k, p)`` next latents under every action of a table."""
    k = len(actions)
    parts = [
        work.dynamics(part.repeat_interleave(k, 0), actions.repeat(len(part), 1)).reshape(len(part), k, -1)
        for part in latent.split(4096)
    ]
    return torch.cat(parts)


def targets(work: Workspace, number: int) -> tuple[TensorDict, TensorDict]:
    """Latents with the targets of barrier and policy, and the latents on which the condition is asked; computed once a round."""
    if "targets" not in work.cache:
        with journal(None, "targets", number):
            found = kept(lambda: _targets(work, number))
        said = found.pop("said")
        work.kept_share = said["inside_of_allowed"]
        work.log_once({"step": 0, **said})
        work.cache["targets"] = tuple(TensorDict(v, batch_size=[len(v["latent"])]) for v in found.values())
    return work.cache["targets"]


def _targets(work: Workspace, number: int) -> dict[str, dict[str, Any]]:
    """Both, and what is worth a line in the log."""
    s, data = work.config, work.latents
    g = torch.Generator().manual_seed(work.seed + 88_000 + number)
    z, region = data["latent"], data["region"]
    if work.seen_dim is not None:  # a label is about a picture, whatever the memory holds beside it
        z, region = torch.cat([z, remembered(work, data["seen"], g)]), torch.cat([torch.zeros_like(region), region])
    unsafe = region[:, 0] == UNSAFE
    zc = z[~unsafe]
    near, axes = observed_errors(work, zc, g, s.residual_spread)
    stray = uniform(work, 60000, g)
    tube, _ = off_manifold(work, z, 2 * s.tube_radius, 1000 + number)
    rim, rows = off_manifold(work, zc, 1.2 * s.tube_radius, 2000 + number)
    queries = torch.cat([z, data["next_latent"], tube, stray])
    if s.grid:
        target, member, best, weight, said = _grid_targets(work, z, unsafe, queries)
    elif s.teacher == "value":
        target, member, best, weight, said = _value_targets(work, z, region, queries, axes)
    else:
        target, member, best, weight, said = _clearance_targets(work, z, unsafe, queries, stray, axes, g)
    rest = len(queries) - len(z)
    table = {
        "latent": queries,
        "barrier_target": target[:, None],
        "inside": member[:, None],
        "action_target": torch.cat([best, torch.zeros(rest, best.shape[1])]),
        "action_weight": torch.cat([weight, torch.zeros(rest)])[:, None],
        "region": torch.cat([region, torch.zeros(rest, 1, dtype=torch.int64)]),
    }
    asked = {"latent": torch.cat([zc, rim]), "residual": torch.cat([near, near[rows]])}
    return {"table": table, "asked": asked, "said": said}


def _clearance_targets(
    work: Workspace, z: Tensor, unsafe: Tensor, queries: Tensor, stray: Tensor, errors: Tensor, generator: torch.Generator
) -> tuple[Any, ...]:
    """Signed distance to the robust invariant set; actions that keep the largest clearance, or lead back soonest."""
    s = work.config
    zc, actions = z[~unsafe], action_grid(work.action_scale, s.actions)
    found = robust_invariant_set(successors(work, zc, actions), zc, z[unsafe], residuals=errors)
    kept = found.inside
    if not bool(kept.any()):
        # Nothing can be kept under these errors: go on with what can be kept longest, and let the held-out
        # checks say what it is worth.
        kept = found.removed == found.removed.max()
    inside = torch.zeros(len(z), dtype=torch.bool)
    inside[(~unsafe).nonzero()[:, 0]] = kept
    far = nearest_distance(stray, _cloud(work, generator)) > s.tube_radius
    outer_points = torch.cat([z[~inside], stray[far]])
    bounds = {"tube_radius": s.tube_radius, "lipschitz_bound": work.lipschitz_bound}
    target, member = barrier_targets(queries, z[inside], outer_points, **bounds)
    best = torch.zeros(len(z), len(work.action_scale))
    best[inside] = torch.softmax(found.clearance[kept] / 0.01, 1) @ actions
    outer = (~inside).nonzero()[:, 0]
    times = reach_times(successors(work, z[outer], actions), z[outer], z[inside], known_within=_KNOWN_WITHIN)
    best[outer] = torch.softmax(-times / 0.1, 1) @ actions
    weight = torch.ones(len(z))
    weight[outer] = (times.min(1).values < 100).float()
    said = {"inside_of_allowed": float(found.inside.float().mean()), "sweeps": found.iterations}
    return target, member, best, weight, said


@torch.no_grad()
def _grid_targets(work: Workspace, z: Tensor, unsafe: Tensor, queries: Tensor) -> tuple[Any, ...]:
    """Signed distance to what some action of the table keeps, whatever error is added, on a grid over the latent domain; and the
    taught policy."""
    s, teacher, turns = work.config, work.teacher_policy or work.policy, work.direction
    seen, hidden = work.seen_dim or work.latent_dim, work.latent_dim - (work.seen_dim or work.latent_dim)
    looks_unsafe, room = z[unsafe][:, :seen], max(s.guard, 1.0 / (s.grid - 1))  # at least half of a cell
    low, sizes, period = [-1.0] * seen, [s.grid] * seen, [0.0] * seen
    if turns is not None:  # the grid is one of charts
        low, sizes, period = low[:-1], [*sizes[:-2], s.turns], [0.0] * (seen - 1)
        low[-1], period[-1] = -math.pi * turns.radius, 2.0 * math.pi * turns.radius
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * len(low)).reshape(-1, len(low))
    if len(low) > 2:  # the ends of the axes and the corners
        signs = signs[(signs.abs().sum(1) != 2)]
    length = signs.norm(dim=1, keepdim=True).clamp_min(1.0)
    errors = F.pad(_GRID_ROOM * s.tolerated_error * signs / length, (0, hidden))
    actions = action_grid(work.action_scale, s.choices or s.actions)
    held = [len(actions[:, k].unique()) for k in range(hidden)]  # the memory holds the last action: these are the nodes
    low, sizes, period = low + [-1.0] * hidden, sizes + held, period + [0.0] * hidden
    if turns is not None:
        margin = _unsafe_margin(work, z[:, :seen], unsafe)
    else:  # what lies in the middle between two samples is no tie
        margin = lambda x: nearest_distance(x[:, :seen], looks_unsafe) - 0.1 / (s.grid - 1)  # noqa: E731
    step = partial(_charted_step, work)
    system: dict[str, Any] = {"margin": lambda x: margin(lifted(x, turns)) - room, "actions": actions, "errors": errors}
    box: dict[str, Any] = {"low": low, "high": [-v for v in low], "resolution": sizes, "period": period}

    def kernel() -> dict[str, Any]:
        with journal(None, "kernel"):  # its own sweeps are numbered apart: when they are done nobody asks for them
            computed = viability_kernel(step, exit_is_safe=False, **box, **system)
        return {k: v for k, v in vars(computed).items() if k != "grid"}

    found = ViabilityKernel(grid=Grid(**box), **kept(kernel))
    if not bool((found.value > 0.0).any()):  # nothing can be kept under these errors; the checks will say what the rest is worth
        found = replace(found, value=found.margin)
    sizes = [2 * n - (not p) for n, p in zip(sizes, period, strict=True)]
    fine = Grid(low, [-v for v in low], sizes[: len(sizes) - hidden] + [_MEMORY] * hidden, period)
    inside = kept(lambda: _inside(found, fine, step, **system))
    distance = _signed_distance(fine, inside.numpy(), charted(queries, turns))
    target = (_SLOPE * work.lipschitz_bound * distance).clamp(-_DEPTH, _DEPTH)
    share = float((found.value > 0.0).float().sum() / (found.margin > 0.0).float().sum().clamp_min(1.0))
    said = {"inside_of_allowed": share, "sweeps": found.iterations}
    return target, target <= 0.0, teacher(z), torch.ones(len(z)), said


def _charted_step(work: Workspace, chart: Tensor, action: Tensor) -> Tensor:
    turns = work.direction
    return charted(work.dynamics(lifted(chart, turns), action), turns)


def _inside(found: ViabilityKernel, fine: Grid, step: Callable[[Tensor, Tensor], Tensor], **system: Any) -> Tensor:
    """Which nodes of a finer grid belong to a set on a grid: where its values are not cut, by one step from them.

    Between left and right of an obstacle the values have a valley, which interpolation fills up.
    """
    nodes, cut = fine.nodes(), float(found.value.abs().max())
    value = torch.cat([found.interpolate(part) for part in nodes.split(_PART)])
    for rows in (value.abs() < 0.99 * cut).nonzero()[:, 0].split(_PART):
        value[rows] = one_step_value(found, nodes[rows], step, **system)
    return (value > 0.0).reshape(fine.shape)


def _signed_distance(fine: Grid, inside: np.ndarray, queries: Tensor) -> Tensor:
    """Distance of queries ``(n, d)`` to a set of nodes, ``(n,)``, negative inside: exact at the nodes, and interpolated between them."""
    if inside.all() or not inside.any():
        return torch.full((len(queries),), -math.inf if inside.all() else math.inf)
    around = [bool(p) for p in fine.period]
    half = 0.5 * fine.step[0]  # the border lies between two nodes
    wide = [(n // 4, n // 4) if p else (0, 0) for n, p in zip(fine.shape, around, strict=True)]  # what lies behind the seam
    inside = np.pad(inside, wide, mode="wrap")
    outer, inner = (distance_transform_edt(part, sampling=fine.step) for part in (~inside, inside))
    distance = np.where(inside, half - inner, outer - half)
    distance = distance[tuple(slice(a, d - b) for (a, b), d in zip(wide, distance.shape, strict=True))]
    index, part, _ = fine.locate(queries)
    return fine.gather(fine.pad(torch.from_numpy(distance.copy()).float()), index, part)


@torch.enable_grad()
def _unsafe_margin(work: Workspace, seen: Tensor, unsafe: Tensor) -> Callable[[Tensor], Tensor]:
    """Distance to what looks unsafe, roughly, as a function of latents: a small network that tells pictures of U from others.

    In three dimensions and more, samples lie too far apart for the distance to the nearest of them.
    """
    s = work.config
    near = ~unsafe & (nearest_distance(seen, seen[unsafe]) < _DEPTH)
    rows = [part.nonzero()[:, 0] for part in (unsafe, near if bool(near.any()) else ~unsafe)]
    loop = InnerLoop(work.seed + 66_000)
    with torch.random.fork_rng():
        torch.manual_seed(work.seed + 66_001)
        net = mlp((seen.shape[1], 64, 64, 1), nn.SiLU)

        def step() -> dict[str, Tensor]:
            inner, outer = (net(seen[r[loop.pick(len(r), s.batch)]]) for r in rows)
            return {"loss_unsafe": _UNSAFE_FIRST * F.softplus(inner).mean(), "loss_rest": F.softplus(-outer).mean()}

        loop(max(_SEPARATE // 10, min(_SEPARATE, s.fit_steps)), {net: 5e-3}, step)
    net.requires_grad_(False)

    def margin(latent: Tensor) -> Tensor:
        with torch.enable_grad():
            z = latent[:, : seen.shape[1]].detach().requires_grad_()
            value = net(z)[:, 0]
            (slope,) = torch.autograd.grad(value.sum(), z)
        return (value / slope.norm(dim=1).clamp_min(1e-3)).detach().clamp(-1.0, 1.0)

    return margin


@torch.no_grad()
def _value_targets(work: Workspace, z: Tensor, region: Tensor, queries: Tensor, errors: Tensor) -> tuple[Any, ...]:
    """Minus the margin that the taught policy keeps, or the best of the actions to choose from; and the taught policy itself."""
    s, teacher = work.config, work.teacher_policy or work.policy
    unsafe, safe = region[:, 0] == UNSAFE, region[:, 0] == SAFE
    action = teacher(z)
    margin = signed_margin(z, unsafe)
    following, mean = work.dynamics(z, action)[:, None], errors[:, :1]
    if s.choices:
        following = successors(work, z, action_grid(work.action_scale, s.choices))
    for share in _SPREADS:
        # What looks unsafe ends there, whatever follows: no errors are needed for it.
        around = torch.zeros(len(z), *errors.shape[1:])
        around[~unsafe] = torch.lerp(mean, errors, share)
        value = safety_values(following, z, margin, residuals=around).amax(1).minimum(margin)
        # A set without S is worth nothing: rather tolerate less.
        if int((value[safe] > 0).sum()) >= _KEPT_OF_SAFE * int(safe.sum()):
            break
    target = value_targets(queries, z, value, tube_radius=s.tube_radius, lipschitz_bound=work.lipschitz_bound)
    said = {"inside_of_allowed": float((value[~unsafe] > 0).float().mean()), "spread": share * s.residual_spread}
    return target, target <= 0, action, torch.ones(len(z)), said


__all__ = ["observed_errors", "off_manifold", "remembered", "successors", "targets", "uniform"]

"""Measurements in full physics: the system with a body, in a simulator with contacts and falls."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchrl_sspl.configs.schema import EvaluationConfig
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.evaluation.controllers import Controller, as_controller, covered
from torchrl_sspl.evaluation.known import barrier_of
from torchrl_sspl.evaluation.measurements import Evaluation, share
from torchrl_sspl.evaluation.simulation import Episodes, simulate

_FROM_SET = {"walks_from_set_enter": "entered", "walks_from_set_hit": "hit", "walks_from_set_fall": "fallen"}
_FROM_SAFE = {"walks_from_safe_hit": "hit", "walks_from_safe_fall": "fallen"}


def evaluate_physics(
    agent: Any, env: SafetyEnv, config: EvaluationConfig | None = None, *, progress: bool = False
) -> tuple[Evaluation, list[Episodes]]:
    """Measures an agent, or anything else that acts, in the full physics of a system.

    Args:
        agent: frozen agent, or what ``as_controller`` takes. Without a barrier no episode starts in {B <= 0}.
        env: the system; ``env.physics()`` makes its world, ``env.known_twin()`` gives S, U, and the frames in which
            starts inside {B <= 0} are looked for.
        config: number (``walks``), length and seed of the episodes.
        progress: show progress bars.

    Returns:
        Measurements (shares of episodes with exact bounds; in ``arrays["walks"]`` all episodes, first the closest call,
        with its frames; in ``arrays["closest"]`` the pose that it was asked to start at, and its seed), and the episodes: those from S,
        then those from {B <= 0} where there are any.

    Raises:
        ConfigError: the system has no full physics.
        MissingDependencyError: the simulator is not installed.

    Source: none (the paper shows pictures).
    """
    acts, config, twin = as_controller(agent), config or EvaluationConfig(), env.known_twin()
    out, n, groups = Evaluation(), config.walks, list[Episodes]()
    starts = [("S", torch.zeros(0))] * 2
    if n:
        generator = torch.Generator().manual_seed(config.walk_seed)
        starts = [("S", twin.safe_set.sample(n, generator)), ("{B <= 0}", _starts_inside(acts, twin, n, generator))]
        world = _world(env)
        try:
            for where, start in starts:
                options: dict[str, Any] = {"horizon": _steps(twin, config), "seed": config.walk_seed}
                label = f"walks from {where}" if progress else None
                if len(start):
                    groups.append(simulate(acts, world, start=start, label=label, **options))
            out.arrays["walks"], out.arrays["closest"] = _closest_on_film(acts, world, groups, starts, options)
        finally:
            world.close()
    length = f"walks of at most {config.walk_seconds:g} s from"
    for k, (names, where) in enumerate(((_FROM_SAFE, "S, heading uniform"), (_FROM_SET, "{B <= 0} outside U"))):
        for name, event in names.items():
            happened = groups[k].events[event] if k < len(groups) else torch.zeros(0)
            if name == "walks_from_safe_hit" and groups:
                happened = happened | groups[k].events["entered"]
            out.add(share(name, int(happened.sum()), len(starts[k][1]), f"{length} {where}"))
    held = getattr(acts, "agent", None)
    if held is not None and held.tolerated_error > 0.0 and len(groups) > 1:
        k, note = int(covered(groups[1], held).sum()), "the premise of the proof is met at every step"
        out.add(share("walks_from_set_covered", k, len(groups[1]), f"{length} {where}; {note}"))
    return out, groups


def _world(env: SafetyEnv) -> Any:
    make = env.physics()
    if make is None:
        raise ConfigError(
            f"physics: expected a system with a full physics, received {type(env).__name__}, which has none; override "
            "physics()"
        )
    return make()


def _steps(env: SafetyEnv, config: EvaluationConfig) -> int:
    return max(1, round(config.walk_seconds / env.dt))  # type: ignore[operator]


def _closest_on_film(
    acts: Controller, world: Any, groups: list[Episodes], starts: list[tuple[str, Tensor]], options: dict[str, Any]
) -> tuple[Episodes, tuple[list[float], int]]:
    """All episodes as they were measured; first the one whose barrier came highest (the very first without one), walked once more
    for its film; its start and seed."""
    every, lengths = groups[0].joined(*groups[1:]), [len(group) for group in groups]
    chosen = 0
    if every.barrier is not None:
        chosen = int(torch.where(every.alive, every.barrier, -torch.inf).amax(0).argmax())
    number = chosen if chosen < lengths[0] else chosen - lengths[0]  # each group counts its seeds anew
    # A reset takes a step of its own: the same walk begins at the pose that was asked for, not at the first state that was seen.
    start = torch.cat([asked for _, asked in starts])[chosen][None]
    seed = options["seed"] + number
    film = simulate(acts, world, start=start, film=1, **(options | {"seed": seed})).frames
    rest = [k for k in range(len(every)) if k != chosen]
    return replace(every.select([chosen, *rest]), frames=film), (start[0].tolist(), seed)


def _starts_inside(acts: Controller, twin: SafetyEnv, n: int, generator: torch.Generator) -> Tensor:
    """Up to n uniform states outside U with B <= 0."""
    outside_unsafe = twin.state_space - twin.unsafe_set
    found = torch.zeros(0, twin.state_dim)
    for _ in range(20):
        states = outside_unsafe.sample(max(4 * n, 200), generator)
        value = barrier_of(acts, twin, states)
        if value is None:
            break
        found = torch.cat([found, states[value <= 0]])
        if len(found) >= n:
            break
    return found[:n]

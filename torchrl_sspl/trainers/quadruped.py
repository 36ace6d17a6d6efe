"""The quadruped's evaluation: on the Dubins car against its true kernel, and as a robot that walks in full physics."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from torchrl_sspl.certification.ground_truth import ViabilityKernel, viability_kernel
from torchrl_sspl.envs.dubins import DubinsEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.modules.agent import Agent, hosted
from torchrl_sspl.trainers.config import EvaluationConfig
from torchrl_sspl.trainers.evaluation import Evaluation, Measurement, encode_states, evaluate, share
from torchrl_sspl.trainers.requirements import Requirement

KERNEL_GRID = (101, 101, 72)
STATE_GRID = (61, 61, 36)

QUADRUPED = (
    Requirement("walks_from_safe_hit", "walks from S that hit the obstacle or enter U", "<=", 0.0, 0.0),
    Requirement("walks_from_safe_fall", "walks from S that fall", "<=", 0.0, 0.0),
    Requirement("walks_from_set_enter", "walks from {B <= 0} that enter U", "<=", 0.01, 0.0),
    Requirement("safe_rollouts_touch_unsafe", "Dubins episodes from {B <= 0} that enter U", "<=", 0.001, 0.0),
    Requirement("volume_over_kernel", "volume of {B <= 0} over the true kernel", ">=", 0.7, 0.95),
    Requirement("false_safe_of_doomed", "doomed states outside U with B <= 0", "<=", 0.2, 0.01),
    Requirement("unsafe_called_safe", "grid of U with B <= 0", "<=", 0.0, 0.0),
    Requirement("training_minutes", "training time [min]", "<=", 60.0, 25.0),
    Requirement("latency_p99", "policy latency per frame, 99th percentile [ms]", "<=", 10.0, 5.0),
)


@dataclass
class WalkConfig:
    """Size of the evaluation in full physics.

    Attributes:
        episodes: walks that start in S, and as many that start in {B <= 0} outside U; 0: none.
        seconds: longest walk.
        seed: seed of the starts.
    """

    episodes: int = 200
    seconds: float = 8.0
    seed: int = 20260102


@dataclass
class Walk:
    """One walk of the robot in full physics under the agent's policy.

    Attributes:
        poses: ``(T + 1, 3)`` x, y in m, heading in rad.
        actions: ``(T, 1)`` commanded yaw rates in rad/s.
        barrier: ``(T + 1,)`` barrier value of what the camera showed.
        entered: the middle of the robot was in U at some step.
        hit: a foot or the body touched the obstacle.
        fallen: the robot fell.
        left: it left the arena, which ends a walk safely.
        frames: ``(T + 1, 3, H, W)`` uint8 what the camera showed, where asked for.
    """

    poses: Tensor
    actions: Tensor
    barrier: Tensor
    entered: bool
    hit: bool
    fallen: bool
    left: bool
    frames: Tensor | None = None


def kernel_of(env: DubinsEnv) -> ViabilityKernel:
    """True kernel of the Dubins car on the grid of all evaluations, about ten seconds on one core.

    Args:
        env: without a yaw lag.

    Returns:
        The kernel; robots that have left the arena belong to it.

    Raises:
        ConfigError: the environment has a yaw lag: its kernel has one dimension more.

    Source: none (the paper has no ground truth).
    """
    if env.yaw_lag is not None:
        raise ConfigError(
            f"kernel: expected an environment without a yaw lag, received yaw_lag={env.yaw_lag}; evaluate on the "
            "Dubins car, or call viability_kernel with a grid of four dimensions"
        )
    return viability_kernel(env, resolution=KERNEL_GRID)


def evaluate_dubins(
    agent: Agent, env: DubinsEnv, config: EvaluationConfig, *, kernel: ViabilityKernel | None = None, progress: bool = False
) -> Evaluation:
    """Evaluation on the Dubins car: that of ``evaluate``, with U on a grid of its own and the latency of the policy.

    Args:
        agent: frozen agent.
        env: the Dubins car without yaw lag.
        config: sizes and seed; ``grid`` is the number of positions per axis, headings are as many as ``STATE_GRID``
            has.
        kernel: true kernel; computed if not given.
        progress: show progress bars.

    Returns:
        The measurements.

    Source: none.
    """
    agent = hosted(agent)
    headings = min(STATE_GRID[2], config.grid) + 1  # the last is the first again
    grid: Any = (config.grid, config.grid, headings)
    out = evaluate(agent, env, config, kernel=kernel or kernel_of(env), grid=grid, progress=progress)
    half = env.unsafe_half_size
    axes = [torch.linspace(c - half, c + half, config.grid) for c in env.obstacle_centre]
    axes.append(torch.linspace(-math.pi, math.pi, headings)[:-1])
    states = torch.cartesian_prod(*axes)
    states = states[env.unsafe_set.contains(states)]
    barrier = agent.barrier(encode_states(agent, env, states))[:, 0]
    note = f"grid of {config.grid} x {config.grid} x {headings - 1} states over U"
    out.add(share("unsafe_called_safe", int((barrier <= 0).sum()), len(states), note))
    out.add(Measurement("worst_unsafe_barrier", float(-barrier.min()), "barrier", len(states), note="q2: largest -B on U"))
    out.add(latency(agent, env))
    return out


def latency(agent: Agent, env: DubinsEnv, frames: int = 400) -> Measurement:
    """Time from two frames to action and barrier value, one frame after the other.

    Args:
        agent: frozen agent.
        env: gives the pictures.
        frames: how many.

    Returns:
        The 99th percentile in ms.

    Source: none.
    """
    agent = hosted(agent)
    pixels = env.observe(env.sample_states(20, torch.Generator().manual_seed(0)))
    seconds = []
    for k in range(frames + 20):
        start = time.perf_counter()
        agent.act(pixels[k % 20 : k % 20 + 1])
        seconds.append(time.perf_counter() - start)
    ordered = sorted(seconds[20:])
    value = 1e3 * ordered[math.ceil(0.99 * frames) - 1]
    note = f"{torch.get_num_threads()} thread(s), encoder, policy and barrier"
    return Measurement("latency_p99", value, "ms", frames, note=note)


@torch.no_grad()
def walk(
    agent: Agent,
    env: Any,
    start: Sequence[float],
    steps: int,
    *,
    seed: int | None = None,
    keep_frames: bool = False,
) -> Walk:
    """Let the robot walk in full physics under the agent's policy.

    Args:
        agent: frozen agent.
        env: ``QuadrupedEnv``.
        start: x, y in m and heading in rad.
        steps: longest walk, in steps of the policy.
        seed: of the phase of the gait at the start.
        keep_frames: keep what the camera showed.

    Returns:
        The walk, up to the first of: steps are over, the arena is left, the robot fell.

    Source: paper Section IV-B (the learned policy on the quadruped).
    """
    agent = hosted(agent)
    pixels, info = env.reset(seed=seed, options={"pose": [float(v) for v in start]})
    poses, actions, values, frames = [info["pose"]], [], [], [pixels[3:]]
    entered, hit, fallen, left = bool(info["unsafe"]), False, False, False
    for _ in range(steps):
        action, barrier = agent.act(torch.as_tensor(pixels)[None])
        values.append(float(barrier))
        pixels, _, terminated, _, info = env.step(action[0].numpy())
        actions.append(action[0])
        poses.append(info["pose"])
        frames.append(pixels[3:])
        entered, hit = entered or bool(info["unsafe"]), hit or bool(info["contact"])
        fallen, left = bool(info["fallen"]), bool(info["left"])
        if terminated or fallen or left:
            break
    values.append(float(agent.act(torch.as_tensor(pixels)[None])[1]))
    return Walk(
        torch.as_tensor(np.stack(poses), dtype=torch.float32),
        torch.stack(actions),
        torch.tensor(values),
        entered,
        hit,
        fallen,
        left,
        torch.as_tensor(np.stack(frames)) if keep_frames else None,
    )


def evaluate_walks(
    agent: Agent,
    model: DubinsEnv,
    make_env: Callable[[], Any],
    config: WalkConfig | None = None,
    *,
    progress: bool = False,
) -> tuple[Evaluation, list[Walk]]:
    """Measure the agent on the robot that walks in full physics.

    Args:
        agent: frozen agent.
        model: the Dubins car, which gives S, U and the frames in which starts inside {B <= 0} are looked for.
        make_env: makes a ``QuadrupedEnv`` with the same obstacle and regions.
        config: number and length of the walks.
        progress: show a progress bar.

    Returns:
        Measurements (shares of walks with exact bounds), and the walks: first those from S, then those from
        {B <= 0}.

    Source: none (the paper shows pictures).
    """
    agent, config = hosted(agent), config or WalkConfig()
    generator = torch.Generator().manual_seed(config.seed)
    n, steps = config.episodes, max(1, round(config.seconds / model.dt))
    out = Evaluation()
    starts = [model.safe_set.sample(n, generator), _starts_inside(agent, model, n, generator)] if n else []
    env = make_env() if n else None
    groups: list[list[Walk]] = []
    try:
        for name, group in zip(("S", "{B <= 0}"), starts, strict=False):
            bar = tqdm(group.tolist(), desc=f"walks from {name}", disable=not progress, leave=False)
            groups.append([walk(agent, env, state, steps, seed=config.seed + k) for k, state in enumerate(bar)])
    finally:
        if env is not None:
            env.close()
    first, second = groups or ([], [])
    note = f"walks of at most {config.seconds:g} s from S, heading uniform"
    out.add(share("walks_from_safe_hit", sum(w.hit or w.entered for w in first), len(first), note))
    out.add(share("walks_from_safe_fall", sum(w.fallen for w in first), len(first), note))
    note = f"walks of at most {config.seconds:g} s from {{B <= 0}} outside U"
    out.add(share("walks_from_set_enter", sum(w.entered for w in second), len(second), note))
    out.add(share("walks_from_set_hit", sum(w.hit for w in second), len(second), note))
    out.add(share("walks_from_set_fall", sum(w.fallen for w in second), len(second), note))
    return out, [*first, *second]


def _starts_inside(agent: Agent, model: DubinsEnv, n: int, generator: torch.Generator) -> Tensor:
    """Up to n uniform states outside U with B <= 0."""
    outside_unsafe = model.state_space - model.unsafe_set
    found = torch.zeros(0, model.state_dim)
    for _ in range(20):
        states = outside_unsafe.sample(max(4 * n, 200), generator)
        inside = agent.barrier(encode_states(agent, model, states))[:, 0] <= 0
        found = torch.cat([found, states[inside]])
        if len(found) >= n:
            break
    return found[:n]


__all__ = [
    "KERNEL_GRID",
    "QUADRUPED",
    "STATE_GRID",
    "Walk",
    "WalkConfig",
    "evaluate_dubins",
    "evaluate_walks",
    "kernel_of",
    "latency",
    "walk",
]

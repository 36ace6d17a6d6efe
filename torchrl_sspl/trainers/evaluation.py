"""Measurements of a frozen agent on fresh data: every figure with its sample size and a 95 % bound."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from torchrl_sspl import functional
from torchrl_sspl.certification.ground_truth import ViabilityKernel, recoverable_set, viability_kernel
from torchrl_sspl.certification.statistics import clopper_pearson
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.lipschitz import lipschitz_lower
from torchrl_sspl.modules.agent import Agent, hosted
from torchrl_sspl.sets import SAFE, Region
from torchrl_sspl.trainers.config import EvaluationConfig

CONFIDENCE = 0.95
_CHUNK = 1000

Draw = Callable[[Tensor], Tensor]


@dataclass
class Measurement:
    """One figure of an evaluation.

    Attributes:
        name: what was measured.
        value: the figure.
        unit: "share", "latent", "barrier", ...
        n: sample size (None: not a sample).
        events: number of events among the n (shares only).
        lower: lower end of the two-sided 95 % Clopper-Pearson interval (shares only).
        upper: upper end of it; with no event, the one-sided 95 % bound.
        note: how it was measured.
    """

    name: str
    value: float | None
    unit: str
    n: int | None = None
    events: int | None = None
    lower: float | None = None
    upper: float | None = None
    note: str = ""


def share(name: str, events: int, n: int, note: str = "") -> Measurement:
    """Measurement of a share with its exact confidence bounds.

    Args:
        name: what was measured.
        events: number of events.
        n: number of independent trials.
        note: how it was measured.

    Returns:
        The measurement; value and bounds are None when there was no trial.

    Source: Clopper and Pearson (1934).

    Example:
        >>> round(share("leaves", 0, 3000).upper, 4)
        0.001
    """
    if n == 0:
        return Measurement(name, None, "share", 0, 0, None, None, note)
    lower, upper = clopper_pearson(events, n, confidence=CONFIDENCE)
    return Measurement(name, events / n, "share", n, events, lower, upper, note)


@dataclass
class Evaluation:
    """All measurements of one agent, and what is needed to draw them.

    Attributes:
        measurements: by name.
        arrays: tensors for figures (grid values, trajectories); not written to ``metrics.json``.
    """

    measurements: dict[str, Measurement] = field(default_factory=dict)
    arrays: dict[str, Any] = field(default_factory=dict)

    def add(self, measurement: Measurement) -> None:
        """Keep a measurement under its name."""
        self.measurements[measurement.name] = measurement

    def __getitem__(self, name: str) -> float | None:
        return self.measurements[name].value

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {name: asdict(m) for name, m in self.measurements.items()}


@torch.no_grad()
def encode_states(agent: Agent, env: SafetyEnv, state: Tensor, *, draw: Draw | None = None) -> Tensor:
    """Latents of true states, seen through two frames, in chunks that fit the memory.

    Args:
        agent: frozen agent.
        env: gives the state one step earlier, and the pictures.
        state: ``(n, state_dim)``.
        draw: states ``(n, state_dim)`` -> frames ``(n, 3, H, W)`` uint8; default ``env.draw``.

    Returns:
        ``(n, p)`` latents.

    Source: none.
    """
    agent, draw = hosted(agent), draw or env.draw
    if not len(state):
        return torch.zeros(0, agent.latent_dim)
    return torch.cat(
        [agent.encode(torch.cat([draw(env.previous_state(x)), draw(x)], dim=-3)) for x in state.split(_CHUNK)]
    )


class _Observer:
    """Latents along closed-loop episodes; each frame is drawn and, where the encoder can, encoded once."""

    def __init__(self, agent: Agent, env: SafetyEnv, draw: Draw) -> None:
        self.agent, self.draw = agent, draw
        self.split = hasattr(agent.encoder, "frames") and hasattr(agent.encoder, "head")

    def _see(self, state: Tensor) -> Tensor:
        frames = (self.draw(part) for part in state.split(_CHUNK))
        return torch.cat([self.agent.encoder.frames(f) if self.split else f for f in frames])  # type: ignore[operator, union-attr]

    def start(self, previous: Tensor, state: Tensor) -> Tensor:
        self.memory = self._see(previous)
        return self.next(state)

    def next(self, state: Tensor, rows: Tensor | slice = slice(None)) -> Tensor:
        """Latents of the states ``(k, state_dim)`` of k of the episodes, by default of all."""
        seen = self._see(state)
        memory = self.memory[rows]
        if self.split:
            latent = self.agent.encoder.head(memory, seen)  # type: ignore[operator, union-attr]
        else:
            latent = torch.cat(
                [
                    self.agent.encode(torch.cat([a, b], dim=-3))
                    for a, b in zip(memory.split(_CHUNK), seen.split(_CHUNK), strict=True)
                ]
            )
        self.memory[rows] = seen
        return latent


@dataclass
class Rollouts:
    """Closed-loop episodes of an agent on the true dynamics.

    Attributes:
        states: ``(T + 1, n, state_dim)`` true states.
        actions: ``(T, n, m)``.
        barrier: ``(T + 1, n)`` barrier value of the observed latent.
        prediction_error: ``(T, n)`` norm of E(o_{t+1}) - d(z_t, u_t).
        barrier_error: ``(T, n)`` B(E(o_{t+1})) - B(d(z_t, u_t)).
    """

    states: Tensor
    actions: Tensor
    barrier: Tensor
    prediction_error: Tensor
    barrier_error: Tensor


@torch.no_grad()
def rollout(
    agent: Agent,
    env: SafetyEnv,
    start: Tensor,
    horizon: int,
    *,
    draw: Draw | None = None,
    progress: bool = False,
    label: str = "rollouts",
) -> Rollouts:
    """Runs the agent's policy from given states, all episodes side by side.

    Where leaving the state space counts as safe, whoever has left it stands still from then on, with barrier value
    -1 and without error: nothing is asked of it any more.

    Args:
        agent: frozen agent.
        env: gives dynamics and pictures.
        start: ``(n, state_dim)`` initial states.
        horizon: number of steps.
        draw: states -> frames ``(n, 3, H, W)`` uint8; default ``env.draw``.
        progress: show a progress bar.
        label: its title.

    Returns:
        States, actions, barrier values and prediction errors of every step.

    Source: paper Section V (trajectories from the learned policy).
    """
    agent = hosted(agent)
    observer = _Observer(agent, env, draw or env.draw)
    state = start
    latent = observer.start(env.previous_state(start), start)
    states, actions, barrier, errors, barrier_errors = [start], [], [agent.barrier(latent)[:, 0]], [], []
    exit_is_safe = env.exit_region == SAFE
    for _ in tqdm(range(horizon), desc=label, disable=not progress, leave=False):
        action = agent.policy(latent)
        moved = env.wrap(env.dynamics(state, action))
        if exit_is_safe:
            moved = torch.where(env.state_space.contains(state)[:, None], moved, state)
        state = moved
        predicted = agent.dynamics(latent, action)
        if exit_is_safe:
            # Nobody looks at whoever is gone.
            here = env.state_space.contains(state).nonzero()[:, 0]
            if len(here):
                latent = latent.index_copy(0, here, observer.next(state[here], here))
        else:
            latent = observer.next(state)
        value = agent.barrier(latent)[:, 0]
        error, barrier_error = (predicted - latent).norm(dim=-1), value - agent.barrier(predicted)[:, 0]
        if exit_is_safe:
            gone = ~env.state_space.contains(state)
            value = value.masked_fill(gone, -1.0)
            error, barrier_error = error.masked_fill(gone, 0.0), barrier_error.masked_fill(gone, 0.0)
        errors.append(error)
        barrier_errors.append(barrier_error)
        states.append(state)
        actions.append(action)
        barrier.append(value)
    return Rollouts(*(torch.stack(x) for x in (states, actions, barrier, errors, barrier_errors)))


def _state_grid(env: SafetyEnv, resolution: int) -> Tensor:
    return env.state_space.grid(resolution)  # type: ignore[attr-defined]


def _sample_where(
    keep: Callable[[Tensor], Tensor], space: Region, n: int, generator: torch.Generator, draws: int = 60
) -> Tensor:
    """Up to n states of a region for which a condition holds, uniformly, by rejection."""
    kept: list[Tensor] = []
    found = 0
    for _ in range(draws):
        state = space.sample(max(n, 2000), generator=generator)
        state = state[keep(state)]
        kept.append(state)
        found += len(state)
        if found >= n:
            break
    return torch.cat(kept)[:n]


@torch.no_grad()
def evaluate(
    agent: Agent,
    env: SafetyEnv,
    config: EvaluationConfig | None = None,
    *,
    kernel: ViabilityKernel | None = None,
    draw: Draw | None = None,
    rollouts: int | None = None,
    grid: int | None = None,
    progress: bool = False,
) -> Evaluation:
    r"""Measures a frozen agent on fresh data against the true system.

    Args:
        agent: frozen agent.
        env: the true system: dynamics, pictures, regions.
        config: sizes and seed of the evaluation.
        kernel: true viability kernel; computed if not given.
        draw: states -> frames ``(n, 3, H, W)`` uint8; default ``env.draw``. Another renderer measures how the agent
            does on foreign frames.
        rollouts: number of episodes, in place of the configuration's.
        grid: states per dimension of the state grid, in place of the configuration's.
        progress: show progress bars.

    Returns:
        The measurements: sets on a grid, one-step errors, episodes, Lipschitz constants.

    Source: paper Section V shows figures only; the measurements are this library's.
    """
    agent, config = hosted(agent), config or EvaluationConfig()
    n_rollouts = config.rollouts if rollouts is None else rollouts
    generator = torch.Generator().manual_seed(config.seed)
    kernel = kernel or viability_kernel(env, resolution=config.kernel_grid)
    out = Evaluation()

    def see(state: Tensor) -> Tensor:
        return encode_states(agent, env, state, draw=draw)

    def inside(state: Tensor) -> Tensor:
        return agent.barrier(see(state))[:, 0] <= 0

    # Sets, on a grid over the state space.
    states = _state_grid(env, grid or config.grid)
    latent = see(states)
    barrier = agent.barrier(latent)[:, 0]
    unsafe = env.unsafe_set.contains(states)
    member, viable = barrier <= 0, kernel.contains(states)
    n_member, n_viable = int(member.sum()), int(viable.sum())
    on_grid = f"{grid or config.grid} states per dimension"
    out.add(share("unsafe_called_safe", int((member & unsafe).sum()), int(unsafe.sum()), f"grid of U, {on_grid}"))
    safe_grid = env.safe_set.sample(10000, generator=generator)
    safe_barrier = agent.barrier(see(safe_grid))[:, 0]
    out.add(share("safe_called_unsafe", int((safe_barrier > 0).sum()), len(safe_barrier), "uniform samples of S"))
    out.add(share("volume_over_kernel", int((member & viable).sum()), n_viable, f"true kernel, {on_grid}"))
    out.add(
        share("false_safe", int((member & ~viable).sum()), n_member, f"{{B<=0}} outside the true kernel, {on_grid}")
    )
    doomed = ~unsafe & ~viable
    out.add(
        share(
            "false_safe_of_doomed",
            int((member & doomed).sum()),
            int(doomed.sum()),
            f"states outside U and the kernel, {on_grid}",
        )
    )
    out.add(
        Measurement(
            "worst_safe_barrier", float(safe_barrier.max()), "barrier", len(safe_barrier), note="q1: largest B on S"
        )
    )
    out.add(
        Measurement(
            "worst_unsafe_barrier",
            float(-barrier[unsafe].min()),
            "barrier",
            int(unsafe.sum()),
            note="q2: largest -B on U",
        )
    )
    out.add(Measurement("barrier_depth", float(-barrier.min()), "barrier", note="|min B| on the grid"))
    out.arrays.update(states=states, latent=latent, barrier=barrier, viability=kernel.interpolate(states), unsafe=unsafe)

    # Lipschitz constants.
    lower = lipschitz_lower(agent.barrier, -1.0, 1.0, n=20000, generator=generator)
    out.add(
        Measurement(
            "lipschitz_certified", agent.lipschitz_bound, "barrier / latent", note="proved for the deployed weights"
        )
    )
    out.add(Measurement("lipschitz_sampled", lower, "barrier / latent", 20000, note="largest gradient or secant found"))
    out.add(Measurement("lipschitz_ratio", lower / agent.lipschitz_bound, "ratio", note="sampled over certified"))

    # Random actions: latent consistency on held-out transitions.
    start = env.sample_states(5000, generator=generator)
    action = (2 * torch.rand(len(start), env.action_dim, generator=generator) - 1) * env.max_action
    end = env.wrap(env.dynamics(start, action))
    observer = _Observer(agent, env, draw or env.draw)
    z, z_next = observer.start(env.previous_state(start), start), observer.next(end)
    _quantiles(
        out,
        "random_action_error",
        (agent.dynamics(z, action) - z_next).norm(dim=-1),
        "latent",
        "uniform states and actions",
    )

    # The paper's margins, and how far the conditions hold with them.
    fresh = see(env.sample_states(5000, generator=generator))
    nearest = torch.cat([torch.cdist(part, latent).amin(1) for part in fresh.split(_CHUNK)])
    note = f"fresh latents to the nearest of {len(latent)} latents of the grid; not a covering radius of all observations"
    _quantiles(out, "covering_radius", nearest, "latent", note)
    error = _held_out_error(agent, env, observer, inside, generator)
    psi = functional.safety_margin(agent.lipschitz_bound, float(nearest.max()), mode="paper").q1
    eta = functional.dynamics_margin(agent.lipschitz_bound, float(error.max()) if len(error) else math.nan)
    out.add(Measurement("safety_margin", psi, "barrier", len(fresh), note="psi* = L_B eps-bar"))
    out.add(Measurement("dynamics_margin", eta, "barrier", len(error), note="eta* = L_B delta, held-out steps of the policy"))
    q3 = agent.barrier(agent.dynamics(latent, agent.policy(latent)))[:, 0][member]
    for name, met, what in (
        ("q1_with_margin", safe_barrier + psi <= 0, "B + psi* <= 0 on S"),
        ("q2_with_margin", barrier[unsafe] - psi >= 0, "B - psi* >= 0 on U"),
        ("q3_with_margin", q3 + psi + eta <= 0, "B(d(z, pi(z))) + psi* + eta* <= 0 on {B<=0}"),
    ):
        out.add(share(name, int(met.sum()), len(met), what))

    # Episodes from the learned safe set.
    starts = _sample_where(inside, env.state_space, n_rollouts, generator)
    if len(starts):
        episodes = rollout(
            agent, env, starts, config.horizon, draw=draw, progress=progress, label="episodes from {B<=0}"
        )
        touched = env.unsafe_set.contains(episodes.states).any(0)
        left = (episodes.barrier > 0).any(0)
        note = f"episodes of {config.horizon} steps from {{B<=0}}"
        out.add(share("safe_rollouts_touch_unsafe", int(touched.sum()), len(starts), note))
        out.add(share("safe_rollouts_leave", int(left.sum()), len(starts), note))
        _quantiles(out, "on_policy_error", episodes.prediction_error.amax(0), "latent", "largest error of an episode")
        _quantiles(out, "on_policy_step_error", episodes.prediction_error.flatten(), "latent", "error of a step")
        _quantiles(
            out,
            "barrier_error",
            episodes.barrier_error.amax(0),
            "barrier",
            "largest B(E(o')) - B(d(z,u)) of an episode",
        )
        one_step = episodes.barrier[1][episodes.barrier[0] <= 0]
        out.add(
            Measurement(
                "worst_next_barrier",
                float(one_step.max()),
                "barrier",
                len(one_step),
                note="R3: largest B after one step from {B<=0}",
            )
        )
        out.arrays.update(
            trajectories=episodes.states[:, :64], torques=episodes.actions[:, :64], traces=episodes.barrier[:, :64]
        )
    else:
        for name in ("safe_rollouts_touch_unsafe", "safe_rollouts_leave"):
            out.add(share(name, 0, 0, "{B<=0} is empty"))

    # Episodes from U, where a return is possible at all.
    recoverable = recoverable_set(env, kernel)
    n_back = max(1, n_rollouts // 5)
    unsafe_starts = _sample_where(
        lambda x: env.unsafe_set.contains(x) & recoverable.contains(x), env.state_space, n_back, generator
    )
    episodes = rollout(agent, env, unsafe_starts, config.horizon, draw=draw, progress=progress, label="episodes from U")
    back = (episodes.barrier[-1] <= 0) & ~env.unsafe_set.contains(episodes.states[-1])
    out.add(
        share(
            "unsafe_rollouts_return",
            int(back.sum()),
            len(unsafe_starts),
            "recoverable starts in U that end in {B<=0} and outside U",
        )
    )
    out.arrays.update(recovery=episodes.states[:, :32], recovery_torques=episodes.actions[:, :32], recovery_traces=episodes.barrier[:, :32])
    safe_starts = env.sample_states(n_back, generator=generator, region=env.safe_set)
    episodes = rollout(agent, env, safe_starts, config.horizon, draw=draw, progress=progress, label="episodes from S")
    touched = env.unsafe_set.contains(episodes.states).any(0)
    out.add(
        share(
            "labelled_safe_rollouts_touch_unsafe",
            int(touched.sum()),
            len(safe_starts),
            f"episodes of {config.horizon} steps from S",
        )
    )
    return out


def _held_out_error(
    agent: Agent, env: SafetyEnv, observer: _Observer, inside: Callable[[Tensor], Tensor], generator: torch.Generator
) -> Tensor:
    """Errors of the latent dynamics on single steps of the policy from the set, ``(n,)``."""
    start = _sample_where(inside, env.state_space, 5000, generator)
    if not len(start):
        return torch.zeros(0)
    z = observer.start(env.previous_state(start), start)
    action = agent.policy(z)
    return (agent.dynamics(z, action) - observer.next(env.wrap(env.dynamics(start, action)))).norm(dim=-1)


def _quantiles(out: Evaluation, name: str, values: Tensor, unit: str, note: str) -> None:
    """Mean, 99 %, 99.9 % and maximum of a sample, as measurements of their own."""
    ordered = values.double().sort().values
    for label, q in (("q99", 0.99), ("q999", 0.999)):
        rank = min(len(ordered) - 1, math.ceil(q * len(ordered)) - 1)
        out.add(Measurement(f"{name}_{label}", float(ordered[rank]), unit, len(values), note=note))
    out.add(Measurement(f"{name}_mean", float(ordered.mean()), unit, len(values), note=note))
    out.add(Measurement(f"{name}_max", float(ordered[-1]), unit, len(values), note=note))

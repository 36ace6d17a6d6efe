"""Measurements on a system with known dynamics: against its true kernel, on a grid and on fresh episodes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchrl_sspl import functional
from torchrl_sspl.configs.schema import EvaluationConfig
from torchrl_sspl.data.augmentation import Augmentation
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.evaluation.controllers import CHUNK, AgentController, Camera, Controller, as_controller
from torchrl_sspl.evaluation.measurements import Draw, Evaluation, Measurement, lipschitz, quantiles, refutes, share
from torchrl_sspl.evaluation.simulation import Episodes, looked_at, simulate
from torchrl_sspl.journal import kept_parts
from torchrl_sspl.modules.agent import Agent, on_host
from torchrl_sspl.sets import UNSAFE, Region
from torchrl_sspl.viability.grid import ViabilityKernel, recoverable_set, viability_kernel


@torch.no_grad()
def encode_states(
    agent: Agent, env: SafetyEnv, state: Tensor, *, draw: Draw | None = None, augmentation: Augmentation | None = None
) -> Tensor:
    """Latents ``(n, p)`` of true states ``(n, state_dim)``, seen through two frames. Source: none.

    Args:
        agent: frozen agent.
        env: gives the state one step earlier, and the pictures.
        state: ``(n, state_dim)``.
        draw: states ``(n, state_dim)`` -> frames ``(n, 3, H, W)`` uint8; default ``env.draw``.
        augmentation: changes these frames, both of a state as seen by one camera.
    """
    agent, draw = on_host(agent), draw or env.draw

    def latent(numbered: tuple[int, Tensor]) -> Tensor:
        position, part = numbered
        frames = torch.cat([draw(env.previous_state(part)), draw(part)])
        if augmentation is not None:
            frames = augmentation(frames, torch.arange(len(part)).repeat(2), position)
        return agent.encode(torch.cat(frames.chunk(2), dim=-3))

    parts = enumerate(state.split(CHUNK) if len(state) else ())
    return torch.cat([torch.zeros(0, agent.latent_dim), *kept_parts(latent, parts, "latents of states", state)])


def barrier_of(acts: Any, env: SafetyEnv, state: Tensor, *, draw: Draw | None = None) -> Tensor | None:
    """Barrier values ``(n,)`` of true states, of anything that acts; None without a barrier. Source: none.

    Args:
        acts: see ``as_controller``; its memory is reset.
        env, state, draw: as for :func:`encode_states`.
    """
    acts = as_controller(acts)
    if isinstance(acts, AgentController):
        return acts.agent.barrier(encode_states(acts.agent, env, state, draw=draw))[:, 0]
    values = []
    for part in state.split(CHUNK):
        acts.reset()
        camera = Camera(draw or env.draw, part, env.previous_state(part))
        seen = part if acts.reads == "state" else torch.cat(list(camera.pixels()))
        value = getattr(acts, "watch", acts.step)(seen).barrier
        if value is None:
            return None
        values.append(value)
    return torch.cat(values) if values else torch.zeros(0)


def states_where(
    keep: Callable[[Tensor], Tensor], space: Region, n: int, generator: torch.Generator, draws: int = 60
) -> Tensor:
    """Up to n states of a region for which a condition holds, uniformly, by rejection. Source: none.

    Args:
        keep: states ``(k, state_dim)`` -> bool ``(k,)``.
        space: where they are drawn from.
        n: how many are wanted.
        generator: of the draws.
        draws: how often at least 2000 are drawn at most.

    Example:
        >>> from torchrl_sspl.sets import Box
        >>> states_where(lambda x: x[:, 0] > 0, Box([-1.0], [1.0]), 5, torch.Generator()).shape
        torch.Size([5, 1])
    """
    kept: list[Tensor] = []
    found = 0
    for drawn in range(1, draws + 1):
        state = space.shuffled(max(n, 2000), generator=generator)
        state = state[keep(state)]
        kept.append(state)
        found += len(state)
        if found >= n or (drawn == 5 and not found):  # of five times as many none: as good as empty
            break
    return torch.cat(kept)[:n]


@dataclass
class _Run:
    """What all parts of one evaluation share."""

    acts: Controller
    agent: Agent | None
    env: SafetyEnv
    config: EvaluationConfig
    kernel: ViabilityKernel
    draw: Draw | None
    n: int
    grid: int
    progress: bool
    generator: torch.Generator
    out: Evaluation = field(default_factory=Evaluation)

    @property
    def samples(self) -> int:
        """Fresh states of a measurement without episodes: 5,000, fewer where few episodes are asked for."""
        return min(5000, 25 * max(1, self.config.episodes))

    def barrier(self, state: Tensor) -> Tensor | None:
        return barrier_of(self.acts, self.env, state, draw=self.draw)

    def inside(self, state: Tensor) -> Tensor:
        value = self.barrier(state)
        return torch.zeros(len(state), dtype=torch.bool) if value is None else value <= 0

    def episodes(self, start: Tensor, where: str) -> Episodes:
        label = f"episodes from {where}" if self.progress else None
        return simulate(self.acts, self.env, start=start, horizon=self.config.horizon, draw=self.draw, label=label)

    def sizes(self, own: int | tuple[int, ...], n: int) -> int | tuple[int, ...]:
        """Of a grid: the system's own, or n along its finest coordinate and the others in proportion."""
        if isinstance(own, int) or not n:
            return n or own
        return tuple(max(2, round(k * n / max(own))) for k in own)


@torch.no_grad()
def evaluate(
    agent: Any,
    env: SafetyEnv,
    config: EvaluationConfig | None = None,
    *,
    kernel: ViabilityKernel | None = None,
    draw: Draw | None = None,
    episodes: int | None = None,
    grid: int | None = None,
    progress: bool = False,
) -> Evaluation:
    """Measures an agent, or anything else that acts, on fresh data against the true system.

    Measured are sets on a grid, one-step errors, episodes, Lipschitz constants, latency. Source: paper Section V shows
    figures only; the measurements are this library's.

    Args:
        agent: frozen agent, or what ``as_controller`` takes: a bare policy, a policy of another library. What needs a
            barrier (or an encoder, or a model) is not measured without one.
        env: the true system: dynamics, pictures, regions; measured is ``env.known_twin()``.
        config: sizes and seed of the evaluation; sizes of grids that are 0 are those of ``env.system``.
        kernel: true viability kernel of the twin; computed if not given.
        draw: states -> frames ``(n, 3, H, W)`` uint8; default ``env.draw``. Another renderer measures how the agent
            does on foreign frames.
        episodes, grid: number of episodes, states per dimension of the state grid, in place of the configuration's.
        progress: show progress bars.

    Example:
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> sizes = EvaluationConfig(episodes=10, horizon=60, kernel_grid=51)
        >>> found = evaluate(lambda pixels: torch.zeros(len(pixels)), PendulumEnv(), sizes)
        >>> found["labelled_safe_rollouts_touch_unsafe"], found["volume_over_kernel"]
        (1.0, None)
    """
    acts, config, twin = as_controller(agent), config or EvaluationConfig(), env.known_twin()
    generator = torch.Generator().manual_seed(config.seed)
    known = acts.agent if isinstance(acts, AgentController) and acts.driver is None else None
    n, size = config.episodes if episodes is None else episodes, grid or config.grid
    run = _Run(acts, known, twin, config, kernel, draw, n, size, progress, generator)  # type: ignore[arg-type]
    run.kernel = kernel or viability_kernel(twin, resolution=run.sizes(twin.system.kernel_grid, config.kernel_grid))
    safe_barrier = _sets(run)
    if known is not None:
        _lipschitz(run, known)
        seen = twin.sample_states(run.samples, generator=generator)
        action = (2 * torch.rand(len(seen), twin.action_dim, generator=generator) - 1) * twin.max_action
        error = _step_errors(run, known, seen, action)
        quantiles(run.out, "random_action_error", error, "latent", "uniform states and actions")
        _margins(run, known, safe_barrier)
    _from_the_set(run)
    _from_unsafe(run)
    start = twin.sample_states(max(1, n // 5), generator=generator, region=twin.safe_set)
    note = f"episodes of {config.horizon} steps from S"
    run.out.count("labelled_safe_rollouts_touch_unsafe", _touched(run.episodes(start, "S")), note)
    run.out.add(latency(acts, twin))
    return run.out


def _sets(run: _Run) -> Tensor | None:
    """The sets on a grid over the state space; returns the barrier values on samples of S."""
    env, out, sizes = run.env, run.out, run.sizes(run.env.system.state_grid, run.grid)
    states: Tensor = env.state_space.grid(sizes)  # type: ignore[attr-defined]
    unsafe, viable = env.unsafe_set.contains(states), run.kernel.contains(states)
    out.arrays.update(states=states, viability=run.kernel.interpolate(states), unsafe=unsafe)
    latent = None if run.agent is None else encode_states(run.agent, env, states, draw=run.draw)
    barrier = run.barrier(states) if run.agent is None else run.agent.barrier(latent)[:, 0]
    safe_barrier = run.barrier(env.safe_set.sample(2 * run.samples, generator=run.generator))
    names = ("unsafe_called_safe", "safe_called_unsafe", "volume_over_kernel", "false_safe", "false_safe_of_doomed")
    if barrier is None or safe_barrier is None:
        out.missing(*names)
        out.missing("worst_safe_barrier", "worst_unsafe_barrier", "barrier_depth", unit="barrier")
        return None
    member, doomed = barrier <= 0, ~unsafe & ~viable
    on_grid = f"{sizes} states per dimension" if isinstance(sizes, int) else f"{_times(sizes)} states"
    out.count(names[1], ~(safe_barrier <= 0), "uniform samples of S")  # NaN is an error of either kind
    for name, events, of, note in (
        (names[2], member & viable, viable, f"true kernel, {on_grid}"),
        (names[3], member & ~viable, member, f"{{B<=0}} outside the true kernel, {on_grid}"),
        (names[4], member & doomed, doomed, f"states outside U and the kernel, {on_grid}"),
    ):
        if run.kernel.converged or name == names[2]:  # one that is too large hides false claims, and makes the share of it smaller
            out.count(name, events, note, of, independent=False)
        else:
            out.missing(name, note="the true kernel has not converged, and is too large")
    note = "q1: largest B on S"
    out.add(Measurement("worst_safe_barrier", float(safe_barrier.max()), "barrier", len(safe_barrier), note=note))
    out.add(Measurement("barrier_depth", float(-barrier.min()), "barrier", note="|min B| on the grid"))
    out.arrays.update(barrier=barrier, **({} if latent is None else {"latent": latent}))
    in_unsafe, note = _unsafe_barrier(run, barrier[unsafe], on_grid)
    note += "" if len(in_unsafe) else ", of which none lies in U"
    out.count("unsafe_called_safe", ~(in_unsafe > 0), note, independent=False)
    if len(in_unsafe):
        worst = float(-in_unsafe.min())
        out.add(Measurement("worst_unsafe_barrier", worst, "barrier", len(in_unsafe), note="q2: largest -B on U"))
    else:
        out.missing("worst_unsafe_barrier", unit="barrier", note=note)
    return safe_barrier


def _times(sizes: Sequence[int]) -> str:
    return " x ".join(str(k) for k in sizes)


def _unsafe_barrier(run: _Run, on_state_grid: Tensor, on_grid: str) -> tuple[Tensor, str]:
    """Barrier values on U: on the state grid, or on a grid of U's own where the system has one."""
    env, own = run.env, run.env.system.unsafe_grid
    if own is None:
        return on_state_grid, f"grid of U, {on_grid}"
    sizes: Any = run.sizes(own, run.grid)
    bounds: Any = env.unsafe_set  # a region with the corners of the box around it
    turns = env.state_space.period.tolist()  # type: ignore[attr-defined]
    axes = [
        torch.linspace(float(a), float(b), k + bool(turn))[:k]
        for a, b, k, turn in zip(bounds.low, bounds.high, sizes, turns, strict=True)
    ]
    states = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(axes))
    value: Any = run.barrier(states[env.unsafe_set.contains(states)])
    return value, f"grid of {_times(sizes)} states over U"


def _lipschitz(run: _Run, agent: Agent) -> None:
    lower = lipschitz(run.out, agent, run.generator)
    if refutes(lower, agent):
        run.out.missing("lipschitz_ratio", unit="ratio", note="the bound that is claimed is none")
        return
    run.out.add(Measurement("lipschitz_ratio", lower / agent.lipschitz_bound, "ratio", note="sampled over the bound"))


def _margins(run: _Run, agent: Agent, safe_barrier: Any) -> None:
    """The paper's margins, and how far the conditions hold with them."""
    env, out, latent, barrier = run.env, run.out, run.out.arrays["latent"], run.out.arrays["barrier"]
    fresh = encode_states(agent, env, env.sample_states(run.samples, generator=run.generator), draw=run.draw)
    nearest = torch.cat([torch.cdist(part, latent).amin(1) for part in fresh.split(CHUNK)])
    note = f"fresh latents to the nearest of {len(latent)} latents of the grid"
    quantiles(out, "covering_radius", nearest, "latent", f"{note}; not a covering radius of all observations")
    error = _step_errors(run, agent, states_where(run.inside, env.state_space, run.samples, run.generator))
    psi = functional.safety_margin(agent.lipschitz_bound, float(nearest.max()), mode="paper").q1
    out.add(Measurement("safety_margin", psi, "barrier", len(fresh), note="psi* = L_B eps-bar"))
    out.count("q1_with_margin", safe_barrier + psi <= 0, "B + psi* <= 0 on S")
    out.count("q2_with_margin", barrier[out.arrays["unsafe"]] - psi >= 0, "B - psi* >= 0 on U, on the grid", independent=False)
    if not len(error):
        out.missing("dynamics_margin", unit="barrier", note="{B<=0} is empty")
        out.missing("q3_with_margin", note="{B<=0} is empty")
        return
    eta = functional.dynamics_margin(agent.lipschitz_bound, float(error.max()))
    note = "eta* = L_B delta, held-out steps of the policy"
    out.add(Measurement("dynamics_margin", eta, "barrier", len(error), note=note))
    q3 = agent.barrier(agent.dynamics(latent, agent.policy(latent)))[:, 0][barrier <= 0]
    note = "B(d(z, pi(z))) + psi* + eta* <= 0 on {B<=0}, on the grid"
    out.count("q3_with_margin", q3 + psi + eta <= 0, note, independent=False)


def _step_errors(run: _Run, agent: Agent, start: Tensor, action: Tensor | None = None) -> Tensor:
    """Errors ``(n,)`` of the latent dynamics on single steps under given actions, or those of the policy."""
    env = run.env
    if not len(start):
        return torch.zeros(0)
    eyes, camera = AgentController(agent), Camera(run.draw or env.draw, start, env.previous_state(start))
    latent = eyes.watch(camera).latent
    action = agent.policy(latent) if action is None else action
    camera.move(env.wrap(env.dynamics(start, action)))
    return (agent.dynamics(latent, action) - eyes.watch(camera).latent).norm(dim=-1)


def _from_the_set(run: _Run) -> None:
    """Episodes from the learned safe set."""
    env, out, horizon = run.env, run.out, run.config.horizon
    start = states_where(run.inside, env.state_space, run.n, run.generator, draws=60 if "barrier" in out.arrays else 1)
    note = f"episodes of {horizon} steps from {{B<=0}}"
    if not len(start):
        empty = "{B<=0} is empty" if run.n else "no episodes were asked for"
        note = empty if "barrier" in out.arrays else "no barrier"
        for name in ("safe_rollouts_touch_unsafe", "safe_rollouts_leave"):
            out.add(share(name, 0, 0, note))
        out.missing("worst_next_barrier", unit="barrier", note=note)
        return
    found = run.episodes(start, "{B<=0}")
    barrier = found.barrier
    out.count("safe_rollouts_touch_unsafe", _touched(found), note)
    out.count("safe_rollouts_leave", (~(barrier <= 0)).any(0), note)
    stepped = looked_at(found, env)[1:]
    if run.agent is not None and run.agent.held_error > 0:  # of the memory it is proved; what is seen may lie outside
        out.count("safe_rollouts_seen_outside", (~(found.seen <= 0)).any(0), f"{note}, B > 0 for an observation by itself")
        out.count("corrections_cut", found.cut[1:] & stepped, f"steps of {note}, correction that would leave the set", stepped, independent=False)
    error, barrier_error = found.prediction_error, found.barrier_error
    if error is not None and barrier_error is not None:
        quantiles(out, "on_policy_error", error.amax(0), "latent", "largest error of an episode")
        quantiles(out, "on_policy_step_error", error[stepped], "latent", "error of a step")
        what = "largest B(E(o')) - B(d(z,u)) of an episode"
        quantiles(out, "barrier_error", barrier_error.amax(0), "barrier", what)
    next_one = barrier[1][barrier[0] <= 0]
    what = "R3: largest B after one step from {B<=0}"
    out.add(Measurement("worst_next_barrier", float(next_one.max()), "barrier", len(next_one), note=what))
    out.arrays.update(trajectories=found.states[:, :64], actions=found.actions[:, :64], traces=barrier[:, :64])


def _touched(found: Episodes) -> Tensor:
    """Which episodes ``(n,)`` enter U; where leaving the state space counts as that, by leaving it, too."""
    return ((found.region == UNSAFE) & found.alive).any(0)


def _from_unsafe(run: _Run) -> None:
    """Episodes from U, where a return is possible at all."""
    env, out = run.env, run.out
    recoverable = recoverable_set(env, run.kernel)

    def keep(state: Tensor) -> Tensor:
        return env.unsafe_set.contains(state) & recoverable.contains(state)

    start = states_where(keep, env.state_space, max(1, run.n // 5), run.generator)
    name, note = "unsafe_rollouts_return", "recoverable starts in U that end in {B<=0} and outside U"
    if not len(start):
        out.add(share(name, 0, 0, note))
        return
    found = run.episodes(start, "U")
    if found.barrier is None:
        home = run.kernel.contains(found.states[-1])
        note = "recoverable starts in U that end in the true kernel (no barrier)"
    else:
        home = found.barrier[-1] <= 0
        out.arrays.update(recovery_traces=found.barrier[:, :32])
    back = home & (found.region[-1] != UNSAFE)
    out.count(name, back, note)
    out.arrays.update(recovery=found.states[:, :32], recovery_actions=found.actions[:, :32])


def latency(acts: Any, env: SafetyEnv, frames: int = 400) -> Measurement:
    """99th percentile of the time in ms from an observation to the action (and the barrier value), one after the other.

    Source: none.

    Args:
        acts: see ``as_controller``; of an agent two frames to action and barrier value.
        env: gives the pictures.
        frames: how many.
    """
    acts = as_controller(acts)
    state = env.sample_states(20, torch.Generator().manual_seed(0))
    seen = state if acts.reads == "state" else env.observe(state)
    acts.reset()
    ask = acts.agent.act if isinstance(acts, AgentController) else acts.step
    seconds = []
    for k in range(frames + 20):
        start = time.perf_counter()
        ask(seen[k % 20 : k % 20 + 1])
        seconds.append(time.perf_counter() - start)
    ordered = sorted(seconds[20:])
    value = 1e3 * ordered[math.ceil(0.99 * frames) - 1]
    what = "encoder, policy and barrier" if isinstance(acts, AgentController) else "whatever it does"
    return Measurement("latency_p99", value, "ms", frames, note=f"{torch.get_num_threads()} thread(s), {what}")

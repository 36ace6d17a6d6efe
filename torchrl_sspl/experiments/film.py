"""What a film shows: an agent from chosen starts, and the same starts without protection; in full physics where there are."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.envs.system import Opening
from torchrl_sspl.errors import CheckpointError
from torchrl_sspl.evaluation.controllers import AgentController, Camera, Decision
from torchrl_sspl.evaluation.known import barrier_of
from torchrl_sspl.evaluation.simulation import Episodes, simulate
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.runtime import Calibration, Monitor, Shield, Verdict
from torchrl_sspl.runtime.monitor import SIGNALS
from torchrl_sspl.seeds import spawn
from torchrl_sspl.sets import SAFE, UNSAFE
from torchrl_sspl.viz.animation import VIEW, Scene, Take

MARGIN = 0.02  # of the filter, for an agent without a proof
_SECONDS = {True: 10.0, False: 5.0}  # longest scene, in full physics and elsewhere
_AFTER = 1.2  # s, for which what went wrong is still looked at
_COLOURS = {"S": (205, 236, 205), "U": (250, 220, 215), "buffer": (255, 255, 255)}
_GRID = {2: (81, 81), 3: (31, 31, 25)}  # nodes on which B is computed for its zero level
_TOLD = {
    Verdict.PROOF_APPLIES: ("in the set, the proof applies", "good"),
    Verdict.INSIDE: ("inside the set", "good"),
    Verdict.OUTSIDE: ("outside of the set", "fair"),
    Verdict.UNKNOWN_PICTURE: ("alarm: unknown picture", "fair"),
}
_NOTHING = "without protection"


@dataclass
class Film:
    """Who acts where, and how it is filmed.

    Args:
        agent: frozen agent, or anything else that acts; without a barrier there is no filter and no verdict.
        env: the system, its own known twin.
        calibration: of the agent's monitor, which then gives the verdicts; None: the sign of B does.
        fps: pictures per second, in full physics; elsewhere there is one per step.
        world: full physics of the system; None: its dynamics.

    Source: none.
    """

    agent: Any
    env: SafetyEnv
    calibration: Calibration | None = None
    fps: int = 25
    world: Any = None

    @property
    def rate(self) -> int:
        """Pictures per second."""
        return self.fps if hasattr(self.world, "motion") else max(1, round(1 / getattr(self.env, "dt", 0.05)))

    def scenes(self, openings: Iterable[Opening]) -> Iterator[Scene]:
        """The scenes of some openings, each simulated when it is asked for."""
        for k, opening in enumerate(openings):
            yield self.scene(opening, seed=spawn(0, "report", k))

    def scene(self, opening: Opening, *, seed: int) -> Scene:
        """The same start twice: without protection, and with it."""
        nominal = opening.nominal or (lambda: lambda state: torch.zeros(len(state), self.env.action_dim))
        alone, name = _NOTHING, "the learned policy"
        takes = [self._take(alone, opening.start, seed, driver=nominal())]
        if opening.nominal is None:
            takes.append(self._take(name, opening.start, seed))
        elif isinstance(self.agent, Agent):
            shield = Shield(self.agent, margin=None if self.agent.tolerated_error > 0.0 else MARGIN)
            takes.append(self._take("behind the safety filter", opening.start, seed, driver=nominal(), shield=shield))
        return Scene(opening.title, takes)

    def levels(self, arrays: dict[str, Any]) -> tuple[Tensor, dict[str, Tensor]] | None:
        """Grid states, B on them, and the true kernel where it was computed; None without a barrier."""
        states, barrier = arrays.get("states"), arrays.get("barrier")
        if states is not None and barrier is not None:
            return states, {"B": barrier, "kernel": -arrays["viability"].clamp(-10.0, 10.0)}
        if self.env.state_dim not in _GRID:
            return None
        states = self.env.state_space.grid(_GRID[self.env.state_dim])
        barrier = barrier_of(self.agent, self.env, states)
        return None if barrier is None else (states, {"B": barrier})

    def _take(self, name: str, start: Sequence[float], seed: int, *, driver: Any = None, shield: Any = None) -> Take:
        recorder = None if self.world is None else _Recorder(self.world)
        acts: Any = self.agent
        if driver is not None:
            acts = _Driver(driver, None if recorder is None else recorder.pose)
            acts = AgentController(self.agent, acts, shield) if isinstance(self.agent, Agent) else acts
        steps = max(1, round(_SECONDS[recorder is not None] / getattr(self.env, "dt", 0.05)))
        options: dict[str, Any] = {} if recorder is None else {"seed": seed}
        where: Any = self.env if recorder is None else recorder
        episodes = simulate(acts, where, start=torch.tensor([start]), horizon=steps, film=1, **options)
        said = self._said(episodes, recorder, ends=driver is not None and shield is None)
        if recorder is None or not hasattr(self.world, "motion"):
            return take_of(name, episodes, said, None if recorder is not None else self.env.portrait)
        return self._in_physics(name, episodes, said, recorder)

    def _in_physics(self, name: str, episodes: Episodes, said: list[tuple[str, str]], recorder: _Recorder) -> Take:
        """A take with pictures between the steps."""
        dt = self.world.physics_dt
        bodies = recorder.bodies[: round((len(said) - 1) * self.env.dt / dt) + 1]  # type: ignore[operator]
        stage = self.world.stage(VIEW, _COLOURS)
        moments = [min(round(k / self.fps / dt), len(bodies) - 1) for k in range(round((len(bodies) - 1) * dt * self.fps) + 1)]
        step = [min(round(i * dt / self.env.dt - 0.499), len(said) - 1) for i in moments]  # type: ignore[operator]
        poses = [[*bodies[i].position[:2], bodies[i].roll_pitch_yaw[2]] for i in moments]
        shown = episodes.frames[step, 0].permute(0, 2, 3, 1)
        values = None if episodes.barrier is None else episodes.barrier[step, 0]
        pictures = stage.follow([bodies[i] for i in moments], 1 / self.fps)
        return Take(name, pictures, [said[t] for t in step], torch.tensor(poses), values, shown)

    def _said(self, episodes: Episodes, recorder: _Recorder | None, ends: bool) -> list[tuple[str, str]]:
        """What is known at every step: of the true state, or by the monitor or the sign of B.

        ``ends``: whether the take ends some time after something went wrong.
        """
        n = int(episodes.alive[:, 0].sum())
        told = self._verdicts(episodes, recorder, n)
        infos = [{}] * n if recorder is None else recorder.infos
        over, wrong = None, None
        for t in range(n):
            info, there = infos[t], int(episodes.region[t, 0])
            over = over or ("hits the obstacle" if info.get("contact") else "falls" if info.get("fallen") else None)
            wrong = wrong if wrong is not None or not (over or there == UNSAFE) else t
            if over or there == UNSAFE:
                told[t] = (over or "in the unsafe set U", "bad")
            elif info.get("left") or not bool(self.env.state_space.contains(episodes.states[t, :1, : self.env.state_dim])):
                told[t] = ("has left the arena: safe", "good") if self.env.exit_region == SAFE else ("has left the space", "bad")
            if ends and wrong is not None and (t - wrong) * self.env.dt >= _AFTER:  # type: ignore[operator]
                return told[: t + 1]
        return told

    def _verdicts(self, episodes: Episodes, recorder: _Recorder | None, n: int) -> list[tuple[str, str]]:
        if episodes.barrier is None:
            return [("", "fair")] * n
        if self.calibration is None:
            return [_TOLD[Verdict.INSIDE if float(b) <= 0.0 else Verdict.OUTSIDE] for b in episodes.barrier[:n, 0]]
        # A simulator's camera has no noise: at rest it shows the same picture again and again.
        monitor, found = Monitor(self.agent, self.calibration, signals=[s for s in SIGNALS if s != "still"]), []
        before = self.env.draw(self.env.previous_state(episodes.states[0])) if recorder is None else recorder.first
        for t in range(n):
            frame = episodes.frames[t]
            found.append(_TOLD[Verdict(int(monitor.step(torch.cat([before, frame], 1)).verdict))])
            before = frame
            if t < len(episodes.actions):
                monitor.took(episodes.actions[t])
        return found


def take_of(
    name: str, episodes: Episodes, said: Sequence[tuple[str, str]], portrait: Callable[[Tensor], Tensor] | None = None
) -> Take:
    """The first of some episodes as a take: with its frames, and with pictures for people if ``portrait`` draws them."""
    n, frames = len(said), episodes.frames[: len(said), 0].permute(0, 2, 3, 1)
    states = None if episodes.states is None else episodes.states[:n, 0]
    values = None if episodes.barrier is None else episodes.barrier[:n, 0]
    if portrait is None or states is None:
        return Take(name, frames.numpy(), said, states, values)
    pictures = (portrait(x[None])[0].permute(1, 2, 0).numpy() for x in states)
    return Take(name, pictures, said, states, values, frames)


def calibration_beside(name: str | Path, agent: Any) -> Calibration | None:
    """The calibration of a monitor that lies beside an agent; None without one."""
    with contextlib.suppress(CheckpointError):
        return Calibration.load(name, agent)
    return None


class _Recorder:
    """A world of which every moment of an episode is kept."""

    def __init__(self, world: Any) -> None:
        self.world = world
        self.infos: list[dict[str, Any]] = []
        self.bodies: list[Any] = []
        self.first: Tensor = torch.zeros(0)

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = self.world.reset(**options)
        self.infos, self.bodies = [info], list(getattr(self.world, "motion", ()))[-1:]
        self.first = torch.as_tensor(observation[:3])[None].clone()
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        out = self.world.step(action)
        self.infos.append(out[-1])
        self.bodies += getattr(self.world, "motion", ())
        return out

    def pose(self) -> Tensor:
        """The present state ``(1, s)``."""
        return torch.as_tensor(self.infos[-1]["pose"], dtype=torch.float32)[None]


class _Driver:
    """A policy on true states that acts while an agent watches pictures."""

    reads, streams = "pixels", True

    def __init__(self, policy: Callable[[Tensor], Tensor], state: Callable[[], Tensor] | None) -> None:
        self.policy, self.state = policy, state

    def reset(self, rows: Tensor | None = None) -> None:
        """It has no memory."""

    def step(self, observation: Tensor | Camera, rows: Tensor | None = None) -> Decision:
        """Actions for the true states."""
        state = observation.state if isinstance(observation, Camera) else self.state() if self.state else observation
        return Decision(self.policy(state))


__all__ = ["Film", "calibration_beside", "take_of"]

"""What a film shows: an agent from chosen starts, and the same starts without protection; in full physics where there are."""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.envs.system import Opening
from torchrl_sspl.evaluation.controllers import AgentController, Camera, Decision
from torchrl_sspl.evaluation.known import barrier_of
from torchrl_sspl.evaluation.simulation import Episodes, simulate
from torchrl_sspl.journal import Entry
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.modules.controller import meets_premise
from torchrl_sspl.runtime import Shield
from torchrl_sspl.runtime.filter import UNPROVED_MARGIN
from torchrl_sspl.seeds import spawn
from torchrl_sspl.sets import SAFE, UNSAFE
from torchrl_sspl.viz.animation import VIEW, Scene, Take

_AFTER = 1.2  # s, for which what went wrong is still looked at
_COLOURS = {"S": (205, 236, 205), "U": (250, 220, 215), "buffer": (255, 255, 255)}
_GRID = {2: (61, 61), 3: (25, 25, 13)}  # nodes on which B is computed for its zero level
_PROVED, _INSIDE, _OUTSIDE = ("inside: the proof applies", "good"), ("inside the safe set", "good"), ("outside the safe set", "fair")


@dataclass
class Film:
    """Who acts where, and how it is filmed.

    Args:
        agent: frozen agent, or anything else that acts; without a barrier there is no filter and no verdict.
        env: the system, its own known twin.
        fps: pictures per second, in full physics; elsewhere there is one per step.
        world: full physics of the system; None: its dynamics.
        seconds: of the longest scene.

    Source: none.
    """

    agent: Any
    env: SafetyEnv
    fps: int = 25
    world: Any = None
    seconds: float = 5.0

    @property
    def rate(self) -> int:
        """Pictures per second."""
        return self.fps if hasattr(self.world, "motion") else max(1, round(1 / self._dt))

    @property
    def _dt(self) -> float:
        return float(getattr(self.env, "dt", 0.05))

    @functools.cached_property
    def _stage(self) -> Any:
        """Where the pictures of all takes are drawn; to paint its ground takes most of a second."""
        return self.world.stage(VIEW, _COLOURS)

    @functools.cached_property
    def _shield(self) -> Shield:
        """What protects all takes; its margin takes a second to prove."""
        return Shield(self.agent, margin=None if self.agent.tolerated_error > 0.0 else UNPROVED_MARGIN)

    def close(self) -> None:
        """End the full physics."""
        for ended in (self.__dict__.pop("_stage", None), self.world):
            if ended is not None:
                ended.close()

    def scenes(self, openings: Iterable[Opening], last: tuple[Opening, int] | None = None) -> Iterator[Scene]:
        """The scenes of some openings, and of a last one with its seed; each simulated while those before it are drawn."""
        seeded = [(opening, spawn(0, "report", k)) for k, opening in enumerate(openings)] + ([last] if last else [])
        made = (self.scene(opening, seed=seed) for opening, seed in seeded)
        ahead = next(made, None)
        for following in made:
            yield ahead  # type: ignore[misc]
            ahead = following
        if ahead is not None:
            yield ahead

    def scene(self, opening: Opening, *, seed: int) -> Scene:
        """The same start twice: without protection, and with it."""
        nominal = opening.nominal or (lambda: lambda state: torch.zeros(len(state), self.env.action_dim))
        takes = [self._take("without protection", opening.start, seed, driver=nominal())]
        if opening.nominal is None:
            takes.append(self._take("the learned policy", opening.start, seed))
        elif isinstance(self.agent, Agent):
            takes.append(self._take("behind the safety filter", opening.start, seed, driver=nominal(), shield=self._shield))
        return Scene(opening.title, takes)

    def levels(self, arrays: dict[str, Any]) -> tuple[Tensor, dict[str, Tensor]] | None:
        """Grid states, B on them, and the true kernel where it was computed; None without a barrier."""
        states, barrier = arrays.get("states"), arrays.get("barrier")
        if states is not None and barrier is not None:
            return states, {"B": barrier, "kernel": -arrays["viability"].clamp(-10.0, 10.0)}
        if self.env.state_dim not in _GRID:
            return None
        states = self.env.state_space.grid(_GRID[self.env.state_dim])  # type: ignore[attr-defined]
        barrier = barrier_of(self.agent, self.env, states)
        return None if barrier is None else (states, {"B": barrier})

    def _take(self, name: str, start: Sequence[float], seed: int, *, driver: Any = None, shield: Any = None) -> Take:
        alone = driver is not None and shield is None
        recorder = None if self.world is None else _Recorder(self.world, round(_AFTER / self._dt) if alone else None)
        acts: Any = self.agent
        if driver is not None:
            acts = _Driver(driver, None if recorder is None else recorder.pose)
            change = None if shield is None else lambda latent, wanted: shield(latent, wanted).action
            acts = AgentController(self.agent, acts, change) if isinstance(self.agent, Agent) else acts
        steps = max(1, round(self.seconds / self._dt))
        options: dict[str, Any] = {} if recorder is None else {"seed": seed}
        where: Any = self.env if recorder is None else recorder
        episodes = simulate(acts, where, start=torch.tensor([start]), horizon=steps, film=1, **options)
        said = self._said(episodes, recorder, ends=alone)
        if recorder is None or not hasattr(self.world, "motion"):
            return take_of(name, episodes, said, None if recorder is not None else self.env.portrait)
        return self._in_physics(name, episodes, said, recorder)

    def _in_physics(self, name: str, episodes: Episodes, said: list[tuple[str, str]], recorder: _Recorder) -> Take:
        """A take with pictures between the steps."""
        dt = self.world.physics_dt
        bodies = recorder.bodies[: round((len(said) - 1) * self._dt / dt) + 1]
        moments = [min(round(k / self.fps / dt), len(bodies) - 1) for k in range(round((len(bodies) - 1) * dt * self.fps) + 1)]
        step = [min(round(i * dt / self._dt - 0.499), len(said) - 1) for i in moments]
        poses = [[*bodies[i].position[:2], bodies[i].roll_pitch_yaw[2]] for i in moments]
        shown = episodes.frames[step, 0].permute(0, 2, 3, 1)
        values = None if episodes.barrier is None else episodes.barrier[step, 0]
        where = torch.tensor(poses)
        pictures = self._drawn([bodies[i] for i in moments], name, where)
        return Take(name, pictures, [said[t] for t in step], where, values, shown)

    def _drawn(self, bodies: list[Any], *about: Any) -> Iterator[NDArray[np.uint8]]:
        """Pictures of a robot, drawn while what follows is simulated; those that an interrupted report has drawn are in its journal."""
        entry = Entry("pictures", *about)
        saved = entry.saved()
        if saved is not None:
            content = np.frombuffer(zlib.decompress(saved["content"].numpy().tobytes()), np.uint8)
            return iter(content.reshape(saved["shape"]))
        return _kept(self._stage.follow(bodies, 1 / self.fps), entry)

    def _said(self, episodes: Episodes, recorder: _Recorder | None, ends: bool) -> list[tuple[str, str]]:
        """What is known at every step: what the true state says, or else B.

        ``ends``: whether nothing protects; the take then ends some time after something went wrong.
        """
        n = int(episodes.alive[:, 0].sum())
        told = self._verdicts(episodes, n, proved=not ends)
        infos = [{}] * n if recorder is None else recorder.infos
        over, wrong = None, None
        for t in range(n):
            info, there = infos[t], int(episodes.region[t, 0])
            over = over or ("hits the obstacle" if info.get("contact") else "falls" if info.get("fallen") else None)
            wrong = wrong if wrong is not None or not (over or there == UNSAFE) else t
            if over or there == UNSAFE:
                told[t] = (over or "in the unsafe set U", "bad")
            elif ends and wrong is not None:
                told[t] = ("has been in the unsafe set", "bad")
            elif info.get("left") or not bool(self.env.state_space.contains(episodes.states[t, :1, : self.env.state_dim])):
                told[t] = ("has left the arena: safe", "good") if self.env.exit_region == SAFE else ("has left the space", "bad")
            if ends and wrong is not None and (t - wrong) * self._dt >= _AFTER:
                return told[: t + 1]
        return told

    def _verdicts(self, episodes: Episodes, n: int, proved: bool) -> list[tuple[str, str]]:
        """What the barrier says at every step; ``proved``: whether what acts is what the proof is about."""
        barrier, seen = episodes.barrier, episodes.seen
        if barrier is None:
            return [("", "fair")] * n
        inside = barrier[:n, 0] <= 0.0
        applies = torch.zeros(n, dtype=torch.bool)
        if proved and getattr(self.agent, "held_error", 0.0) > 0.0 and seen is not None:  # every picture so far has to agree
            met = meets_premise(self.agent, barrier[:n, 0], seen[:n, 0], torch.zeros(n))
            applies = met.cumprod(0).bool()
        return [_PROVED if p else _INSIDE if i else _OUTSIDE for p, i in zip(applies.tolist(), inside.tolist(), strict=True)]


def _kept(pictures: Iterator[NDArray[np.uint8]], entry: Entry) -> Iterator[NDArray[np.uint8]]:
    """The same pictures, which are saved behind the last."""
    shown = []
    for picture in pictures:
        yield picture
        if entry.open:
            shown.append(picture)
    if shown:
        content = zlib.compress(np.stack(shown).tobytes(), 1)
        saved = {"shape": [len(shown), *shown[0].shape], "content": torch.frombuffer(bytearray(content), dtype=torch.uint8)}
        entry.save(saved, complete=True)


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


class _Recorder:
    """A world of which every moment of an episode is kept; ``patience``: steps that it goes on after something went wrong."""

    def __init__(self, world: Any, patience: int | None) -> None:
        self.world, self.patience = world, patience
        self.infos: list[dict[str, Any]] = []
        self.bodies: list[Any] = []

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = self.world.reset(**options)
        self.infos, self.bodies = [info], list(getattr(self.world, "motion", ()))[-1:]
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        out = self.world.step(action)
        self.infos.append(out[-1])
        self.bodies += getattr(self.world, "motion", ())
        wrong = [k for k, info in enumerate(self.infos) if info.get("unsafe") or info.get("contact") or info.get("fallen")]
        if self.patience is not None and wrong and len(self.infos) - 1 - wrong[0] >= self.patience:
            return (*out[:3], True, out[-1])
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


__all__ = ["Film", "take_of"]

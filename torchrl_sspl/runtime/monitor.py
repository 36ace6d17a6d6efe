r"""The monitor: what an agent knows at every step, and an alarm where its pictures or their order are not what it knows."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional as F
from tqdm import tqdm

from torchrl_sspl.certification.certificate import weights_digest
from torchrl_sspl.devices import compiled
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import CheckpointError, ConfigError, DTypeError, ShapeError
from torchrl_sspl.evaluation.controllers import Decision
from torchrl_sspl.evaluation.simulation import simulate
from torchrl_sspl.files import write
from torchrl_sspl.modules.agent import Agent, agent_directory
from torchrl_sspl.modules.controller import Controller, Step
from torchrl_sspl.modules.networks import mlp
from torchrl_sspl.runtime.faults import CameraFault
from torchrl_sspl.seeds import spawn

FILE = "monitor.safetensors"
#: What is watched besides the premise of the proof and the barrier.
SIGNALS = ("innovation", "picture", "place", "texture", "order", "still")
TWO_SIDED = ("texture",)
FALLBACKS = ("policy", "stop")
_SIDE = 16  # of the pictures that are expected
_ROOM = 1.05  # beyond the largest value that was seen
_LEAST = {"order": 0.5 / 255}  # limits that rounding alone must not exceed
_LATE = 0.5  # of the period, by which a picture may come early or late


class Verdict(IntEnum):
    """What is known about a step. Source: none."""

    PROOF_APPLIES = 0
    INSIDE = 1  # in the set, but the premise of the proof was not met
    OUTSIDE = 2
    UNKNOWN_PICTURE = 3  # an alarm: nothing is believed


@dataclass
class Watched:
    """One step of n systems: what is done, and what is known."""

    action: Tensor  # (n, m) physical units, of the agent or of the fallback
    verdict: Tensor  # (n,) int64, see Verdict
    alarm: Tensor  # (n,) bool
    applies: Tensor  # (n,) bool, whether the premise of the proof has held since the reset, during an alarm too, under actions that keep it
    barrier: Tensor  # (n,) B of the memory
    signals: dict[str, Tensor]  # (n,) by name; NaN where there is nothing to compare
    reasons: list[list[str]]  # of every row, the signals beyond their limits in this step
    latent: Tensor  # (n, p)


class PictureModel(nn.Module):
    r"""The picture that belongs to a latent, small: :math:`(n, p) \mapsto (n, 3, 16, 16)` in [0, 1]. Source: none.

    Example:
        >>> PictureModel(3)(torch.zeros(2, 3)).shape
        torch.Size([2, 3, 16, 16])
    """

    def __init__(self, latent_dim: int) -> None:
        super().__init__()
        self.net = mlp((latent_dim, 64, 96, 3 * _SIDE**2))

    def forward(self, latent: Tensor) -> Tensor:
        """Pictures of latents ``(n, p)``."""
        return torch.sigmoid(self.net(latent)).unflatten(-1, (3, _SIDE, _SIDE))

    def fit(self, latent: Tensor, picture: Tensor, *, steps: int = 3000, seed: int = 0, progress: bool = False) -> None:
        """Regress on latents ``(n, p)`` and small pictures ``(n, 3, 16, 16)``."""
        from torchrl_sspl.trainers.phases import InnerLoop

        loop = InnerLoop(seed)

        def step() -> dict[str, Tensor]:
            rows = loop.pick(len(latent), 256)
            return {"loss": (self(latent[rows]) - picture[rows]).square().mean()}

        with tqdm(total=steps, desc="pictures", disable=not progress, leave=False) as bar, torch.random.fork_rng(), torch.enable_grad():
            loop.tick = bar.update
            loop(steps, {self: 3e-3}, step)
        self.requires_grad_(False)


@dataclass
class Calibration:
    """What clean pictures of an agent's system look like, and the limits of the signals."""

    model: PictureModel
    limits: dict[str, tuple[float, float]]  # by signal, what is still clean
    episodes: int  # from which the limits were taken
    steps: int  # in each of them
    weights: str  # digest of the agent

    @property
    def false_alarms(self) -> float:
        r"""Largest expected share of clean episodes with an alarm: :math:`k / (n + 1)`.

        One of n + 1 exchangeable episodes has the largest value of a signal; there are k one-sided limits.
        """
        return min(1.0, (len(SIGNALS) + len(TWO_SIDED)) / (self.episodes + 1))

    def save(self, directory: str | Path) -> Path:
        """Write ``monitor.safetensors`` beside an agent; returns the file. Raises OutputError if that cannot be done."""
        path = Path(directory) / FILE
        about = {"limits": self.limits, "episodes": self.episodes, "steps": self.steps, "weights": self.weights}
        state = {k: v.contiguous() for k, v in self.model.state_dict().items()}
        return write(path, save(state, {k: json.dumps(v) for k, v in about.items()}))

    @classmethod
    def load(cls, name: str | Path, agent: Agent) -> Calibration:
        """Read it from beside an agent; a CheckpointError if there is none, or one of another agent."""
        path = agent_directory(name) / FILE
        if not path.is_file():
            raise CheckpointError(f"expected a calibration in '{path}', received none; make one: sspl.calibrate(agent, env).save(...)")
        try:
            with safe_open(path, "pt") as file:
                about = {k: json.loads(v) for k, v in (file.metadata() or {}).items()}
                state = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118
            model = PictureModel(agent.latent_dim)
            model.load_state_dict(state)
            model.requires_grad_(False)
            limits = {k: (float(a), float(b)) for k, (a, b) in about["limits"].items()}
            found = cls(model, limits, int(about["episodes"]), int(about["steps"]), str(about["weights"]))
            if found.episodes < 1 or found.steps < 1 or not all(low <= high for low, high in limits.values()):
                raise ValueError("counts below one, or limits that nothing is within")
        except (SafetensorError, RuntimeError, KeyError, TypeError, ValueError, AttributeError) as error:
            raise CheckpointError(f"expected a calibration in '{path}', received {type(error).__name__}: {str(error)[:200]}") from error
        if found.weights != weights_digest(agent.state_dict()) or set(limits) != set(SIGNALS):
            raise CheckpointError(f"expected a calibration of this agent in '{path}', received one of other weights; calibrate again")
        return found


class Monitor:
    r"""Runs an agent, and says at every step what is known: proof applies, inside, outside, or unknown picture.

    Watched are, besides the barrier and the premise of the proof: ``innovation`` (distance of what is seen from what was expected,
    latent units), ``picture`` and ``place`` (mean and largest difference of the frame from the one that belongs to its latent,
    of 1, on 16 x 16), ``texture`` (mean difference of neighbouring pixels, of 1: blur and noise), ``order`` (difference of a
    frame from itself one step later, of 1), ``still`` (steps during which not one pixel changed). A signal
    beyond its limit is an alarm, which ends after so many clean steps. Frames of another size or kind, missing frames and times that do not fit are alarms at once; the memory then goes on with
    what it expects. Limits lie 5 % beyond the largest values of clean episodes (:func:`calibrate`), so that a clean episode has an
    alarm with a probability of at most :attr:`Calibration.false_alarms`, while the agent itself acts and for as many steps as were calibrated. Source: none (novelty by reconstruction; limits by
    exchangeability, as in conformal prediction).

    Args:
        agent: frozen agent.
        calibration: of this agent.
        batch_size: n.
        fallback: what is done during an alarm: ``"policy"`` (the agent goes on), ``"stop"`` (zero action), or a function
            ``(Watched) -> (n, m)`` of which the rows with an alarm are taken.
        period: time between two pictures, in the unit of the times given to :meth:`step`.
        clear_after: clean steps that end an alarm.
        signals: which of :data:`SIGNALS` are watched.
        compile: as for :class:`~torchrl_sspl.modules.Controller`.

    Raises:
        ConfigError: for options that are not valid.
        CheckpointError: for a calibration of other weights.

    Example:
        >>> black = torch.zeros(1, 6, 64, 64, dtype=torch.uint8)
        >>> Verdict(int(Monitor.load("pendulum").step(black).verdict)).name
        'UNKNOWN_PICTURE'
    """

    def __init__(
        self,
        agent: Agent,
        calibration: Calibration,
        *,
        batch_size: int = 1,
        fallback: str | Callable[[Watched], Tensor] = "policy",
        period: float | None = None,
        clear_after: int = 10,
        signals: Sequence[str] = SIGNALS,
        compile: bool = False,
    ) -> None:
        if isinstance(signals, str) or not set(signals) <= set(SIGNALS):
            raise ConfigError(f"expected signals among {', '.join(SIGNALS)}, received {signals!r}")
        if batch_size < 1 or clear_after < 1 or not (callable(fallback) or fallback in FALLBACKS) or not (period is None or period > 0):
            raise ConfigError(
                f"expected batch_size >= 1, clear_after >= 1, fallback in {FALLBACKS} or a function, and a positive period or None, "
                f"received {batch_size}, {clear_after}, {fallback!r} and {period}"
            )
        weights = agent.state_dict()
        if calibration.weights not in (weights_digest(weights), weights_digest({k: v.float() for k, v in weights.items()})):
            raise CheckpointError("expected a calibration of this agent, received one of other weights; make one: sspl.calibrate(agent, env)")
        own = copy.deepcopy(calibration.model).to(agent.gain)  # another monitor's calibration may be this one
        self.agent, self.calibration, self.batch_size, self._model = agent, calibration, batch_size, own
        self.fallback, self.period, self.clear_after, self.signals = fallback, period, clear_after, tuple(signals)
        self._controller = Controller(agent, batch_size)
        self._look = compiled(self._looked) if compile else self._looked
        self.reset()

    @classmethod
    def load(cls, name: str | Path, **options: Any) -> Monitor:
        """The monitor of a shipped agent, or of a run directory, by its calibration there; options and errors as above."""
        agent = Agent.load(agent_directory(name))
        return cls(agent, Calibration.load(name, agent), **options)

    def reset(self, rows: Tensor | None = None) -> None:
        """Begin new episodes: all n, or those of some rows (indices or a mask); a ShapeError for others."""
        n, device = self.batch_size, self.agent.gain.device
        self._controller.reset(rows)
        index = slice(None) if rows is None else torch.arange(n, device=device)[rows]
        if rows is None:
            self._quiet, self._still = torch.zeros(n, dtype=torch.int64, device=device), torch.zeros(n, device=device)
            self._frame: Tensor | None = None
            self._time: Tensor | None = None
        self._quiet[index], self._still[index] = self.clear_after, 0.0

    @torch.no_grad()
    def step(self, pixels: Tensor | None, time: float | Tensor | None = None) -> Watched:
        """What to do and what is known.

        Args:
            pixels: ``(n, 6, H, W)`` uint8, frames t-1 and t; ``None`` if no picture came.
            time: when the pictures were taken, a number or ``(n,)``; with a ``period``, and not without.

        Raises ShapeError for another number of pictures, DTypeError for what is no tensor, ConfigError for a time without a period or
        pictures without the time that is to be compared with it.
        """
        n, fresh = self.batch_size, self._controller.begins
        if pixels is not None and not isinstance(pixels, Tensor):
            raise DTypeError(f"expected pixels as a tensor of dtype torch.uint8, received {type(pixels).__name__}; torch.as_tensor(pixels) makes one of numpy")
        if pixels is not None and (pixels.ndim < 1 or len(pixels) != n):
            raise ShapeError(f"expected pictures of {n} systems, received {tuple(pixels.shape)}; make a monitor for them")
        late = self._late(pixels, time, fresh)
        reasons = [[] for _ in range(n)] if late is None else [["time"] if one else [] for one in late.tolist()]
        fault = self._unreadable(pixels)
        if fault or pixels is None:  # the memory goes on with what it expects, and the proof no longer applies
            step = self._controller.step(None)
            signals = {name: torch.full_like(step.barrier, math.nan) for name in SIGNALS}
            return self._decided(step, signals, [[fault, *found] for found in reasons])
        pixels = pixels.to(fresh.device)
        step, predicted, signals = self._look(pixels, *self._controller.expected())
        self._controller.remember(step, predicted)
        signals |= self._compared(pixels, fresh)
        for k in (~(step.latent.isfinite().all(1) & step.action.isfinite().all(1))).nonzero()[:, 0].tolist():
            reasons[k].append("nan")
        if self.signals:
            value = torch.stack([signals[name] for name in self.signals], 1)
            low, high = value.new_tensor([self.calibration.limits[name] for name in self.signals]).unbind(1)
            for k, which in ((value > high) | (value < low) | value.isinf()).nonzero().tolist():
                reasons[k].append(self.signals[which])
        return self._decided(step, signals, reasons)

    def took(self, action: Tensor, predicted: Tensor | None = None) -> Tensor:
        """Say what was really done after a step, ``(n, m)`` physical units, where it was not the action that was told, and what a safety
        filter with the proved margin has found to follow ``(n, p)``; else that is computed. Returns ``(n,)`` bool, whether the proof still
        applies: other actions than the agent's own and a filter's end it until the next reset.

        A ConfigError before the first step, a ShapeError for actions or latents of another shape, a NonFiniteError for NaN among them.
        """
        return self._controller.took(action, predicted)

    def _looked(self, pixels: Tensor, prior: Tensor, begins: Tensor) -> tuple[Step, Tensor, dict[str, Tensor]]:
        """The controller's look, and the signals of the newest frame; nothing is remembered, so that it can be compiled."""
        step, predicted = self._controller.looked(pixels, prior, begins)
        frame = pixels[:, 3:].to(step.seen.dtype) / 255.0
        off = (small(frame) - self._model(step.seen)).abs().mean(1)
        texture = (frame.diff(dim=-1).abs().mean((1, 2, 3)) + frame.diff(dim=-2).abs().mean((1, 2, 3))) / 2
        innovation = step.innovation.masked_fill(begins, math.nan)
        return step, predicted, {"innovation": innovation, "picture": off.mean((1, 2)), "place": off.amax((1, 2)), "texture": texture}

    def _compared(self, pixels: Tensor, fresh: Tensor) -> dict[str, Tensor]:
        """The signals of frames beside frames, and what is remembered of them; bytes are compared faster than a graph does it."""
        before, frame = pixels[:, :3], pixels[:, 3:].clone()
        known = torch.full_like(self._still, math.nan) if self._frame is None else _apart(before, self._frame)
        same = (before == frame).flatten(1).all(1)
        self._frame, self._still = frame, torch.where(same & ~fresh, self._still + 1.0, 0.0)
        return {"order": known.masked_fill(fresh, math.nan), "still": self._still.clone()}

    def _unreadable(self, pixels: Tensor | None) -> str:
        """Why pictures cannot be looked at; "" if they can."""
        if pixels is None:
            return "missing"
        size = getattr(self.agent.encoder, "image_size", None)
        size = size if size is not None or self._frame is None else self._frame.shape[2:]
        wrong = pixels.ndim != 4 or pixels.shape[1] != 6 or (size is not None and tuple(pixels.shape[2:]) != tuple(size))
        return "kind" if pixels.dtype != torch.uint8 else "size" if wrong else ""

    def _late(self, pixels: Tensor | None, time: float | Tensor | None, fresh: Tensor) -> Tensor | None:
        """``(n,)`` bool, which pictures came too early or too late; None where nobody looks."""
        if (self.period is None and time is not None) or (self.period is not None and time is None and pixels is not None):
            raise ConfigError(
                f"expected a time with every picture of a monitor that has a period, and none without, received period={self.period} and "
                f"time={time}; Monitor(..., period=dt) and step(pixels, time=t) go together"
            )
        if time is None or self.period is None:
            return None
        now = torch.as_tensor(time, dtype=torch.float64, device=fresh.device).expand(self.batch_size).clone()
        before, self._time = self._time, now
        if before is None:
            return ~now.isfinite()
        fits = ((now - before - self.period).abs() <= _LATE * self.period) | fresh
        return ~(fits & now.isfinite())

    def _decided(self, step: Step, signals: dict[str, Tensor], reasons: list[list[str]]) -> Watched:
        """The verdict, and the action that belongs to it."""
        strange = torch.tensor([bool(r) for r in reasons], device=step.barrier.device)
        self._quiet = torch.where(strange, 0, self._quiet + 1)
        alarm = self._quiet < self.clear_after
        verdict = torch.where(step.applies, Verdict.PROOF_APPLIES, Verdict.INSIDE)
        verdict = torch.where(step.inside, verdict, Verdict.OUTSIDE).masked_fill(alarm, Verdict.UNKNOWN_PICTURE)
        told = Watched(step.action, verdict, alarm, step.applies, step.barrier, signals, reasons, step.latent)
        if bool(alarm.any()) and self.fallback != "policy":
            action = step.action
            other = torch.zeros_like(action) if self.fallback == "stop" else self.fallback(told)  # type: ignore[operator]
            if not isinstance(other, Tensor) or other.shape != action.shape:
                raise ShapeError(f"expected a fallback that returns actions {tuple(action.shape)}, received {getattr(other, 'shape', other)}")
            told.action = torch.where(alarm[:, None], other, action)
            self._controller.took(told.action)
        return told


def small(frame: Tensor) -> Tensor:
    """Frames ``(n, 3, H, W)`` in [0, 1], averaged to 16 x 16."""
    return F.adaptive_avg_pool2d(frame, _SIDE)


def _apart(a: Tensor, b: Tensor) -> Tensor:
    """Mean difference of frames uint8, of 1."""
    if torch.equal(a, b):  # as it is with every camera that works
        return torch.zeros(len(a), device=a.device)
    return (a.float() - b.float()).abs().mean((1, 2, 3)) / 255.0


class Watching:
    """A monitor as what acts in :func:`~torchrl_sspl.evaluation.simulate`; keeps every step's signals and alarms.

    Source: none.

    Args:
        agent, calibration: of the monitor.
        change: ``(pixels, t) -> pixels`` between the camera and the monitor, such as a fault; ``None``: nothing.
        driver: what acts in place of the agent.
        **options: of the monitor.
    """

    reads = "pixels"

    def __init__(
        self,
        agent: Agent,
        calibration: Calibration,
        *,
        change: Callable[[Tensor, int], Tensor] | None = None,
        driver: Any = None,
        **options: Any,
    ) -> None:
        self.agent, self.calibration, self.change, self.driver, self.options = agent, calibration, change, driver, options
        self.monitor: Monitor | None = None
        self.chunks: list[list[tuple[Watched, Tensor]]] = []  # what was told, and of which rows, by chunk and step

    def reset(self, rows: Tensor | None = None) -> None:
        """Forget everything, or some episodes."""
        if rows is not None and self.monitor is not None:
            self.monitor.reset(rows)
            return
        self.monitor = None
        self.chunks.append([])
        if self.driver is not None:
            self.driver.reset()

    def step(self, observation: Tensor, rows: Tensor | None = None) -> Decision:
        """Actions for what is shown."""
        steps = self.chunks[-1]
        if self.monitor is None:
            self.monitor = Monitor(self.agent, self.calibration, batch_size=len(observation), **self.options)
        n, index = self.monitor.batch_size, torch.arange(len(observation)) if rows is None else rows
        shown = observation
        if len(observation) < n:  # whoever is gone is shown nothing; it is looked at no more
            shown = torch.zeros(n, *observation.shape[1:], dtype=torch.uint8).index_copy(0, index, observation)
        out = self.monitor.step(shown if self.change is None else self.change(shown, len(steps)))
        steps.append((out, index))
        action = out.action[index]
        if self.driver is not None:
            action = self.driver.step(observation, rows).action
            self.monitor.took(out.action.index_copy(0, index, action))
        return Decision(action=action, barrier=out.barrier[index], seen=out.barrier[index])

    def alarms(self) -> Tensor:
        """``(T + 1, n)`` bool, of all episodes, T steps being the longest."""
        return self._over_time("alarm")

    def applies(self) -> Tensor:
        """Whether the premise of the proof has held so far, likewise."""
        return self._over_time("applies")

    def _over_time(self, name: str) -> Tensor:
        """An entry of what was told, false of episodes that are over."""
        longest, parts = max(map(len, self.chunks)), []
        for chunk in filter(None, self.chunks):
            part = torch.zeros(longest, len(chunk[0][0].alarm), dtype=torch.bool)
            for t, (out, rows) in enumerate(chunk):
                part[t, rows] = getattr(out, name)[rows]
            parts.append(part)
        return torch.cat(parts, 1)

    def extremes(self) -> dict[str, Tensor]:
        """Smallest and largest value of every signal in every episode, ``(2, n)``."""
        found: dict[str, list[Tensor]] = {name: [] for name in SIGNALS}
        for chunk in self.chunks:
            for name in SIGNALS if chunk else ():
                low = torch.full((len(chunk[0][0].alarm),), math.inf)
                high = -low
                for out, rows in chunk:
                    value = out.signals[name][rows]
                    low[rows] = torch.minimum(low[rows], value.nan_to_num(nan=math.inf))
                    high[rows] = torch.maximum(high[rows], value.nan_to_num(nan=-math.inf))
                found[name].append(torch.stack([low, high]))
        return {name: torch.cat(parts, 1) for name, parts in found.items()}


@torch.no_grad()
def calibrate(
    agent: Agent,
    env: Any,
    *,
    episodes: int = 1000,
    horizon: int = 200,
    noise: float = 1.0,
    pictures: int = 20_000,
    steps: int = 3000,
    seed: int = 0,
    progress: bool = False,
) -> Calibration:
    """What clean pictures look like: a model of them, and limits from episodes of the agent.

    The model is fitted to pictures of uniform states; the limits lie 5 % beyond the largest values (of the texture, beyond the smallest,
    too) of episodes that start in {B <= 0}. What is shown here is never called strange. Cameras have noise: one that shows the very same frame twice is frozen. A simulator without
    noise does that at rest, and a frozen camera cannot be told from it in time; calibrate with ``noise=0`` for it.

    Args:
        agent: frozen agent.
        env: a ``SafetyEnv``, whose states are known; it is asked for pictures and starts, and the agent acts in it.
        episodes: for the limits; the false alarms are as rare as there are many.
        horizon: steps of each.
        noise: standard deviation of the camera's noise, grey levels, added to every frame.
        pictures: for the model.
        steps: of its fit.
        seed: root of everything drawn.
        progress: show progress bars.

    Raises ConfigError for a noise that is negative or not finite, a system that is no ``SafetyEnv``, or if no start lies in the set.
    Source: none.
    """
    camera = CameraFault("dark", 1.0, noise=noise, seed=spawn(seed, "monitor", 3))
    if not isinstance(env, SafetyEnv):
        raise ConfigError(
            f"expected a SafetyEnv, which draws its pictures from states, received {type(env).__name__}; write your system as one "
            "(docs/extend.md, Your own system with known dynamics), or run the agent without alarms: agent.controller() says at every step whether it is in the set "
            "and whether the proof applies"
        )
    agent = copy.deepcopy(agent).cpu()  # where the system is
    g = torch.Generator().manual_seed(spawn(seed, "monitor", 0))
    with torch.random.fork_rng():
        torch.manual_seed(spawn(seed, "monitor", 1))
        model = PictureModel(agent.latent_dim)
    latents, shown = [], []
    for part in env.sample_states(pictures, g).split(1000):
        now, before = env.draw(part), env.draw(env.previous_state(part))
        latents.append(agent.encode(torch.cat([before, now], 1)).float())
        shown.append(small(now.float() / 255.0))
    model.fit(torch.cat(latents), torch.cat(shown), steps=steps, seed=spawn(seed, "monitor", 2), progress=progress)
    wide = {name: (-math.inf, math.inf) for name in SIGNALS}
    calibration = Calibration(model, wide, episodes, horizon, weights_digest(agent.state_dict()))
    start = starts(agent, env, episodes, g)
    watching = Watching(agent, calibration, change=camera)
    simulate(watching, env, start=start, horizon=horizon, label="clean episodes" if progress else None)
    for name, (low, high) in watching.extremes().items():
        most, least = float(high.max()), float(low.min())
        limit = max(most * _ROOM, _LEAST.get(name, 0.0))
        calibration.limits[name] = (least / _ROOM if name in TWO_SIDED else -math.inf, limit)
    return calibration


@torch.no_grad()
def starts(agent: Agent, env: Any, n: int, generator: torch.Generator) -> Tensor:
    """``(n, s)`` uniform states outside U whose pictures lie in the set; a ConfigError if there are none."""
    found: list[Tensor] = []
    for _ in range(50):
        for part in env.sample_states(1000, generator, region=env.state_space - env.unsafe_set).split(1000):
            seen = agent.encode(torch.cat([env.draw(env.previous_state(part)), env.draw(part)], 1))
            found.append(part[agent.barrier(seen)[:, 0] <= 0.0])
        if sum(map(len, found)) >= n:
            return torch.cat(found)[:n]
    raise ConfigError(f"expected {n} states whose pictures lie in the set, received {sum(map(len, found))}; is the set empty?")


__all__ = ["Calibration", "Monitor", "PictureModel", "Verdict", "Watched", "Watching", "calibrate", "starts"]

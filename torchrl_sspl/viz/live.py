"""A live view: picture, barrier, verdict and interventions of an agent at work, on a page served from this machine, and as a film."""

from __future__ import annotations

import base64
import io
import itertools
import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from torchrl_sspl.configs.reader import EnvFactory, compose
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.evaluation.blocks import described_system
from torchrl_sspl.evaluation.controllers import Decision
from torchrl_sspl.evaluation.simulation import simulate
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.runtime import CameraFault, Monitor, Shield, Verdict, Watched
from torchrl_sspl.runtime.filter import UNPROVED_MARGIN
from torchrl_sspl.runtime.monitor import starts
from torchrl_sspl.seeds import spawn
from torchrl_sspl.sets import UNSAFE
from torchrl_sspl.viz.animation import HEIGHT, WIDTH, mp4_writer
from torchrl_sspl.viz.pages import render
from torchrl_sspl.viz.plane import require
from torchrl_sspl.viz.server import Feed, served
from torchrl_sspl.viz.training import training_directory, watch_training

POLICIES = ("own", "random")
PHYSICS = "physics"
_STARTS, _HORIZON, _HELD = 32, 200, 0.2  # starts that are taken in turn, longest episode, chance of a new random action
#: What verdicts are called, and their colours in a film.
VERDICTS = {
    Verdict.PROOF_APPLIES: ("Proof applies", "#13702f"),
    Verdict.INSIDE: ("Inside, premise not met", "#7a5200"),
    Verdict.OUTSIDE: ("Outside the set", "#b3261e"),
    Verdict.UNKNOWN_PICTURE: ("Unknown picture", "#7b2d8e"),
}


class _Over(Exception):
    """All steps that were asked for are done."""


def watch(
    name: str,
    *,
    env: str | None = None,
    video: str | Path | None = None,
    policy: str = "own",
    protect: bool = False,
    record: str | Path | None = None,
    host: str = "127.0.0.1",
    port: int = 8000,
    steps: int | None = None,
    fps: float | None = None,
    noise: float = 1.0,
    seed: int = 0,
    ready: Callable[[str], Any] = print,
) -> dict[str, int]:
    """Runs an agent behind its monitor, and shows it on a page until the steps are over or it is interrupted.

    The directory of a run that is being trained, or has no calibrated agent, shows its training instead: phase, losses, volume kept
    so far, held-out checks, time left. Episodes begin in {B <= 0} where the system's states are known. Whoever reaches ``host`` and
    ``port`` can see the page. Source: none.

    Args:
        name: shipped agent, run directory with a calibration, or that of a training.
        env: a system as in ``sspl train env=...``, or ``"physics"``: the agent's own one in full physics; default: the agent's own one.
        video: film file in place of a system; nothing can be done there, so that what happens is not
            what the agent expects of its own actions, and no proof applies.
        policy: ``"own"``, or ``"random"``: uniform actions, each held for five steps on average.
        protect: put the safety filter behind the policy; the margin of an agent without a proof is .02.
        record: an .mp4 file to write.
        host, port: where the page is served; port 0: any that is free.
        steps: after so many (of a training: changes that were shown) it ends; None: it goes on.
        fps: steps per second; None: as fast as the system itself, or the film; ``inf``: as fast as possible.
        noise: of the camera of a system, standard deviation in grey levels; shipped calibrations suppose one.
        seed: of all that is drawn.
        ready: called with the page's address.

    Returns how many ``steps``, ``interventions``, ``alarms`` (steps) and ``entered`` (episodes into U) there were; of a training how
    many ``changes`` and ``rounds``. Raises ConfigError for arguments that are not valid, a port that is taken or a film that cannot be
    read; CheckpointError without a calibration and without a log; MissingDependencyError without the extra ``viz``.
    """
    _check(env, video, policy, protect, record, port, steps, fps, noise)
    training = training_directory(name)
    if training is not None:
        _check_training(training, env, video, policy, protect, record)
        return watch_training(training, host=host, port=port, changes=steps, ready=ready)
    monitor = Monitor.load(name)
    agent = monitor.agent
    shield = Shield(agent, margin=None if agent.tolerated_error > 0.0 else UNPROVED_MARGIN) if protect else None
    if video is None:
        run, pace = _of_system(agent, env, seed)
    else:
        run, pace = _of_film(Path(video), _size(agent))
    where = "a film" if video is not None else {None: "its own system", PHYSICS: "full physics"}.get(env, env)
    about = f"{where}; {'random actions' if policy == 'random' else 'its own actions'}; safety filter {'on' if protect else 'off'}"
    feed, page = Feed(), render("watch.html", title=name, facts=about)
    film, period, due = None, 1.0 / (fps or pace), time.monotonic()

    def show(event: dict[str, Any], frame: NDArray[np.uint8]) -> None:
        nonlocal due
        if film is not None:
            film.add(event, frame)
        feed.publish(event, picture_data(frame))
        due = max(due + period, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))

    camera = CameraFault("dark", 1.0, noise=noise if video is None else 0.0, seed=seed)
    view = _View(monitor, shield, camera, show, steps, random=policy == "random", seed=seed, film=video is not None)
    try:
        with served(host, port, feed, lambda: page) as address:
            film = None if record is None else _Film(Path(record), min(fps or pace, 60.0), f"{name}: {about}")
            ready(address)
            due = time.monotonic()
            run(view)
    except (_Over, KeyboardInterrupt):
        pass
    finally:
        if film is not None:
            film.close()
    return view.counts


def _check_training(
    directory: Path, env: str | None, video: str | Path | None, policy: str, protect: bool, record: str | Path | None
) -> None:
    """A ConfigError if something is asked for that an agent would have to do."""
    if env is not None or video is not None or policy != "own" or protect or record is not None:
        raise ConfigError(
            f"expected no env, video, policy, filter or record with a training, received one; '{directory}' has no calibrated agent that "
            "could act yet: `sspl calibrate` makes one of a run that has ended"
        )


def _check(
    env: str | None, video: str | Path | None, policy: str, protect: bool, record: str | Path | None, port: int,
    steps: int | None, fps: float | None, noise: float,
) -> None:  # fmt: skip
    """A ConfigError for arguments that are not valid."""
    wrong = (steps is not None and steps < 1) or (fps is not None and not fps > 0.0) or not 0.0 <= noise < math.inf
    if policy not in POLICIES or not 0 <= port <= 65535 or wrong:
        raise ConfigError(
            f"expected policy in {POLICIES}, port in 0..65535, steps >= 1, fps > 0 and noise >= 0, received {policy!r}, {port}, {steps}, "
            f"{fps} and {noise}"
        )
    if video is not None and (env is not None or policy != "own" or protect):
        raise ConfigError("expected a video alone, received env, policy=random or a filter with it; nothing can be done in a film")
    if video is not None and not Path(video).is_file():
        raise ConfigError(f"expected a film file, received '{video}', which is none")
    if record is not None and Path(record).suffix != ".mp4":
        raise ConfigError(f"expected a file that ends in .mp4 to record to, received '{record}'")
    if record is not None:
        require("imageio_ffmpeg")
    require("PIL.Image")


def _size(agent: Agent) -> tuple[int, int]:
    size: Any = getattr(agent.encoder, "image_size", None) or (64, 64)
    return int(size[0]), int(size[1])


def _of_system(agent: Agent, env: str | None, seed: int) -> tuple[Callable[[_View], None], float]:
    """What lets a view act in a system, episode after episode, and the steps per second of the system."""
    factory = described_system(agent.description) if env in (None, PHYSICS) else EnvFactory(compose([f"env={env}"]).env)
    if factory is None:
        raise ConfigError("expected an agent that names a system of this library, received another one; name one: --env")
    made = factory(batch_size=[1], seed=seed)
    if env == PHYSICS and hasattr(made, "physics"):
        made = made.known_twin()
    m = agent.policy.action_scale.numel()  # type: ignore[operator, union-attr]
    shown, dim = tuple(made.observation_spec["pixels"].shape[-2:]), made.action_spec.shape[-1]
    if shown != _size(agent) or dim != m:
        raise ConfigError(
            f"expected a system with pictures of {_size(agent)} pixels and {m} actions, as this agent's, received {shown} and {dim}"
        )
    known, world = hasattr(made, "dynamics"), made
    begin = starts(agent, made, _STARTS, torch.Generator().manual_seed(seed)) if known else None
    if env == PHYSICS:
        make = made.physics() if known else None
        if make is None:
            raise ConfigError(f"expected a system with a full physics, received {type(made).__name__}, which has none; leave --env physics out")
        world = make()

    def run(view: _View) -> None:
        with closing(world) if env == PHYSICS else nullcontext():
            for k in itertools.count():
                where: dict[str, Any] = {"episodes": 1} if begin is None else {"start": begin[k % len(begin)][None]}
                simulate(view, world, horizon=_HORIZON - 1, seed=spawn(seed, "physics", k), watch=view.tell, **where)

    return run, 1.0 / float(getattr(made, "dt", 0.05))


def _of_film(path: Path, size: tuple[int, int]) -> tuple[Callable[[_View], None], float]:
    """What shows a view the pairs of frames of a film, the middle square of each averaged to a size, and its frames per second."""
    ffmpeg = require("imageio_ffmpeg")
    frames = ffmpeg.read_frames(str(path), pix_fmt="rgb24")
    try:
        about = next(frames)
    except (OSError, RuntimeError, StopIteration) as error:
        raise ConfigError(f"expected a film that can be read, received '{path}': {str(error).strip().splitlines()[-1:]}") from error
    width, height = about["size"]
    side = min(width, height)
    top, left = (height - side) // 2, (width - side) // 2

    def run(view: _View) -> None:
        before = None
        view.reset()
        for data in frames:
            picture = torch.frombuffer(bytearray(data), dtype=torch.uint8).reshape(height, width, 3)
            square = picture[top : top + side, left : left + side].permute(2, 0, 1)[None].float()
            frame = F.interpolate(square, size=size, mode="area").round().to(torch.uint8)
            if before is not None:
                view.tell(view.step(torch.cat([before, frame], 1)), None)
            before = frame

    return run, float(about.get("fps") or 20.0)


class _View:
    """Monitor, policy and filter at work on what a camera shows, as what acts; counts what happens, and shows it."""

    reads = "pixels"

    def __init__(
        self, monitor: Monitor, shield: Shield | None, camera: CameraFault, show: Callable[[dict[str, Any], NDArray[np.uint8]], None],
        steps: int | None, *, random: bool, seed: int, film: bool = False,
    ) -> None:  # fmt: skip
        self.film = film  # nobody knows what acts there
        self.monitor, self.shield, self.camera, self.show, self.steps, self.random = monitor, shield, camera, show, steps, random
        self.proved = monitor.agent.tolerated_error > 0.0
        self.checked = shield is not None and shield.proved
        self.scale: Tensor = monitor.agent.policy.action_scale.flatten()  # type: ignore[operator, union-attr, assignment]
        self.generator, self.held = torch.Generator().manual_seed(seed), torch.zeros(1, len(self.scale))
        self.counts = {"steps": 0, "interventions": 0, "alarms": 0, "entered": 0}
        self.episode, self.t, self.was_unsafe, self.missed = 0, 0, False, 0
        self.news: tuple[dict[str, Any], NDArray[np.uint8]] | None = None  # what is not shown yet

    def reset(self, rows: Tensor | None = None) -> None:
        """An episode begins."""
        self.monitor.reset()
        self.episode, self.t, self.was_unsafe, self.missed = self.episode + 1, 0, False, 0

    def step(self, observation: Tensor, rows: Tensor | None = None) -> Decision:
        """The action for pictures ``(1, 6, H, W)``."""
        pixels = self.camera(observation, self.t)
        out, counts = self.monitor.step(pixels), self.counts
        if self.random and float(torch.rand(1, generator=self.generator)) < _HELD:
            self.held = (torch.rand(1, len(self.scale), generator=self.generator) * 2 - 1) * self.scale
        wanted = self.held if self.random else out.action
        made = None if self.shield is None else self.shield(out.latent, wanted)
        taken = wanted if made is None else made.action
        applies = self.monitor.took(taken, made.predicted if made is not None and self.checked else None)
        intervened = made is not None and bool(made.intervened)
        counts["steps"] += 1
        counts["interventions"] += intervened
        counts["alarms"] += bool(out.alarm)
        if self.film or not bool(applies):  # what acts is neither the agent nor the filter, and nothing is proved of it
            out.verdict = torch.where(out.verdict == Verdict.PROOF_APPLIES, Verdict.INSIDE, out.verdict)
        self.missed += int(out.verdict) == Verdict.INSIDE
        label, colour = VERDICTS[Verdict(int(out.verdict))]
        event = {
            "step": counts["steps"], "episode": self.episode, "begins": self.t == 0,
            "barrier": _number(out.barrier), "verdict": Verdict(int(out.verdict)).name, "label": label, "colour": colour,
            "why": self._why(out), "alarm": bool(out.alarm), "intervened": intervened, "protected": made is not None,
            "wanted": [_number(u) for u in wanted[0]], "taken": [_number(u) for u in taken[0]],
        }  # fmt: skip
        self.t, self.news = self.t + 1, (event, pixels[0, 3:].permute(1, 2, 0).numpy())
        return Decision(taken)

    def tell(self, decision: Decision, region: Tensor | None) -> None:
        """Shows what a step has brought, and whether the true state lies in U, where it is known."""
        if self.news is None:  # nobody looked: whoever has left is not shown
            return
        (event, frame), self.news = self.news, None
        unsafe = None if region is None else bool((region == UNSAFE).any())
        self.counts["entered"] += bool(unsafe) and not self.was_unsafe
        self.was_unsafe |= bool(unsafe)
        self.show(self.counts | event | {"unsafe": unsafe}, frame)
        if self.counts["steps"] == self.steps:
            raise _Over

    def _why(self, out: Watched) -> str:
        """The number behind a verdict."""
        limits, value = self.monitor.calibration.limits, float(out.signals["innovation"])
        if bool(out.alarm):
            beyond = [f"{name} {self._beyond(name, out)}" for name in out.reasons[0]]
            return "; ".join(beyond) or f"clean again; the alarm ends after {self.monitor.clear_after} such steps"
        if int(out.verdict) == Verdict.OUTSIDE:
            return f"B = {float(out.barrier):+.3f} > 0"
        if int(out.verdict) == Verdict.INSIDE:
            why = f"not met for {self.missed} steps"
            if not self.proved:
                why = "nothing is proved of this agent"
            elif self.film or (self.random and not self.checked):
                why = "nothing is proved of what acts here"
            return f"B = {float(out.barrier):+.3f} <= 0; {why}"
        seen = "the first picture" if math.isnan(value) else f"innovation {value:.3f} of at most {limits['innovation'][1]:.3f}"
        return f"B = {float(out.barrier):+.3f} <= 0; {seen}"

    def _beyond(self, name: str, out: Watched) -> str:
        """A signal and its limit; "" of a fault that has no number."""
        if name not in out.signals or math.isnan(float(out.signals[name])):
            return ""
        value, (low, high) = float(out.signals[name]), self.monitor.calibration.limits[name]
        return f"{value:.3g} > {high:.3g}" if value > high else f"{value:.3g} < {low:.3g}"


def _number(value: Tensor) -> float | None:
    """For JSON, which has no NaN."""
    number = float(value)
    return round(number, 5) if math.isfinite(number) else None


def picture_data(frame: NDArray[np.uint8]) -> str:
    """A frame ``(H, W, 3)`` uint8 as an address that a page can show. Source: none."""
    file = io.BytesIO()
    require("PIL.Image").fromarray(frame).save(file, "PNG")
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()


class _Film:
    """An MP4 of what the page shows, written while it happens."""

    def __init__(self, path: Path, fps: float, title: str) -> None:
        self.path, self.title = path, title
        path.parent.mkdir(parents=True, exist_ok=True)
        self.writer = mp4_writer(path, (WIDTH, HEIGHT), fps, preset="veryfast")  # while it happens
        self.recent: deque[dict[str, Any]] = deque(maxlen=_HORIZON)
        fonts = require("PIL.ImageFont")
        self.large, self.small = fonts.load_default(24), fonts.load_default(15)

    def add(self, event: dict[str, Any], frame: NDArray[np.uint8]) -> None:
        """One more picture."""
        self.recent.append(event)
        image = require("PIL.Image").new("RGB", (WIDTH, HEIGHT), "white")
        draw = require("PIL.ImageDraw").Draw(image)
        draw.text((16, 12), self.title, "#5b6470", self.small)
        image.paste(require("PIL.Image").fromarray(frame).resize((352, 352), 0), (16, 48))
        draw.text((388, 48), event["label"], event["colour"], self.large)
        draw.text((388, 82), event["why"][:52], "#1a1f27", self.small)
        told = f"step {event['step']}   episode {event['episode']}   interventions {event['interventions']}"
        draw.text((388, 106), told, "#5b6470", self.small)
        self._curve(draw, (388, 140, 752, 400))
        self.writer.send(np.asarray(image))

    def _curve(self, draw: Any, box: tuple[int, int, int, int]) -> None:
        """The barrier over the last steps, the set below its zero line, interventions under it."""
        left, top, right, bottom = box
        values = [0.0 if e["barrier"] is None else e["barrier"] for e in self.recent]
        low, high = min([*values, -0.1]), max([*values, 0.1])

        def place(k: int, value: float) -> tuple[float, float]:
            return left + (right - left) * k / (_HORIZON - 1), bottom - (bottom - top) * (value - low) / (high - low)

        zero = place(0, 0.0)[1]
        draw.rectangle((left, zero, right, bottom), fill="#e3f4e6")
        draw.rectangle((left, zero, right, zero + 1), fill="#1a1f27")
        draw.text((left + 4, zero - 19), "B = 0", "#1a1f27", self.small)
        for k, event in enumerate(self.recent):
            x = place(k, 0.0)[0]
            if event["begins"]:
                draw.line((x, top, x, bottom), "#dde1e7", 1)
            if event["intervened"]:
                draw.line((x, bottom + 4, x, bottom + 12), "#d55e00", 2)
            if k and not event["begins"]:
                draw.line((*place(k - 1, values[k - 1]), *place(k, values[k])), "#0072b2", 2)

    def close(self) -> None:
        """The file is complete."""
        self.writer.close()


__all__ = ["POLICIES", "picture_data", "watch"]

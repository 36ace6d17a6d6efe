"""The closed loop: anything that acts, on known dynamics, in an environment's own episodes, or in full physics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.evaluation.controllers import (
    _NONE,
    CHUNK,
    AgentController,
    Camera,
    Controller,
    Decision,
    as_controller,
)
from torchrl_sspl.evaluation.measurements import Draw
from torchrl_sspl.journal import kept
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE

Watch = Callable[[Decision, Tensor], None]
_PART = 250  # episodes of an agent that are kept together in a journal
#: Events of an episode in full physics, and the entry of ``info`` that tells each.
EVENTS = {"entered": "unsafe", "hit": "contact", "fallen": "fallen", "left": "left"}


@dataclass
class Episodes:
    """Episodes side by side, time first; behind an episode's end nothing is ``alive``, and values mean nothing.

    Attributes:
        actions: ``(T, n, m)``.
        region: ``(T + 1, n)`` int64 labels of the true states.
        alive: ``(T + 1, n)`` whether the observation belongs to the episode; the one in which it ends does.
        states: ``(T + 1, n, s)`` true states, where the environment tells them.
        barrier: ``(T + 1, n)`` barrier value B(z_t) of the latent; None without a barrier, as what follows.
        seen: ``(T + 1, n)`` B(E(o_t)), of what was observed by itself.
        latent: ``(T + 1, n, p)``.
        outside: ``(T + 1, n)`` bool, where E(o_t) lies outside the domain or is no number.
        innovation: ``(T + 1, n, p)`` E(o_t) less what was expected; zero where an episode begins.
        cut: ``(T + 1, n)`` bool, where a correction was cut so that the set is not left.
        prediction_error: ``(T, n)`` norm of z_{t+1} - d(z_t, u_t), of which without an observer z_{t+1} = E(o_{t+1}).
        barrier_error: ``(T, n)`` B(z_{t+1}) - B(d(z_t, u_t)).
        frames: ``(T + 1, k, 3, H, W)`` uint8 what the first k episodes showed, where asked for.
        events: ``(n,)`` bool by name: what happened in an episode, such as "left" or "hit".
    """

    actions: Tensor
    region: Tensor
    alive: Tensor
    states: Tensor = _NONE
    barrier: Tensor = _NONE
    seen: Tensor = _NONE
    latent: Tensor = _NONE
    outside: Tensor = _NONE
    innovation: Tensor = _NONE
    cut: Tensor = _NONE
    prediction_error: Tensor = _NONE
    barrier_error: Tensor = _NONE
    frames: Tensor = _NONE
    events: dict[str, Tensor] = field(default_factory=dict)

    def __len__(self) -> int:
        return self.alive.shape[1]

    def joined(self, *others: Episodes) -> Episodes:
        """These episodes and others of the same length; a film of those first in the row."""
        every = (self, *others)
        columns: dict[str, Any] = {}
        for name in [f.name for f in fields(self) if f.name not in ("frames", "events")]:
            values = [getattr(e, name) for e in every]
            columns[name] = None if any(v is None for v in values) else torch.cat(values, 1)
        films = []
        for e in every:
            films += [] if e.frames is None else [e.frames]
            if e.frames is None or e.frames.shape[1] < len(e):
                break
        columns["frames"] = torch.cat(films, 1) if films else None
        known = [name for name in self.events if all(name in e.events for e in others)]
        events = {name: torch.cat([e.events[name] for e in every]) for name in known}
        return Episodes(**columns, events=events)

    def select(self, index: Any) -> Episodes:
        """Some of the episodes, by a mask, indices or a slice; with their film if there is one of all."""
        columns: dict[str, Any] = {}
        for name in [f.name for f in fields(self) if f.name != "events"]:
            value = getattr(self, name)
            filmed = name != "frames" or (value is not None and value.shape[1] == len(self))
            columns[name] = value[:, index] if value is not None and filmed else None
        return Episodes(**columns, events={name: value[index] for name, value in self.events.items()})


def looked_at(found: Episodes, env: Any) -> Tensor:
    """Observations ``(T + 1, n)``, bool, of which anything was asked: where leaving counts as safe nobody looks at whoever is gone."""
    if getattr(env, "exit_region", UNSAFE) != SAFE or found.states is None:
        return found.alive
    return found.alive & env.state_space.contains(found.states)


@torch.no_grad()
def simulate(
    controller: Any,
    env: Any,
    *,
    horizon: int,
    start: Tensor | None = None,
    episodes: int | None = None,
    seed: int | None = None,
    draw: Draw | None = None,
    film: int = 0,
    label: str | None = None,
    watch: Watch | None = None,
) -> Episodes:
    """Lets anything act on a system, episode by episode or side by side.

    From given states of a system with known dynamics, all episodes run side by side, on its dynamics and pictures; who
    leaves its state space stands still from then on where this counts as safe (barrier value -1, no error: nothing is
    asked of it any more), and goes on where it counts as unsafe. Any other TorchRL environment runs from its own
    resets. A world of gymnasium (full physics) runs one episode after the other, from its own resets or from given
    poses. Source: paper Section V (trajectories from the learned policy).

    Args:
        controller: what acts, see ``as_controller``.
        env: a ``SafetyEnv``; another TorchRL environment of batch size ``[k]`` with ``"region"``; or a gymnasium
            environment whose ``info`` may tell ``"pose"``, ``"safe"`` and the entries of ``EVENTS``.
        horizon: longest episode, in steps.
        start: ``(n, s)`` first states, or poses for ``reset(options={"pose": ...})``.
        episodes: how many from the environment's own resets.
        seed: of the resets; in a gymnasium environment of the first, the others count on. Default: as the environment
            is.
        draw: states -> frames uint8 ``(n, 3, H, W)`` in place of ``env.draw``.
        film: of how many episodes the frames are kept.
        label: title of a progress bar; none without.
        watch: called as it happens, after every observation of some episodes, with what was decided and the labels of
            the true states ``(k,)``; what it raises ends the simulation.

    Raises:
        ConfigError: if it is not clear what to run, or the controller reads what the environment does not show.

    Example:
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> falls = simulate(lambda pixels: torch.zeros(len(pixels)), PendulumEnv(), start=torch.zeros(1, 2), horizon=3)
        >>> falls.actions.shape, falls.states.shape, falls.barrier
        (torch.Size([3, 1, 1]), torch.Size([4, 1, 2]), None)
    """
    acts = as_controller(controller)
    if horizon < 1 or (start is None and (episodes is None or episodes < 1)):
        raise ConfigError(
            f"simulate: expected horizon >= 1, and start or episodes >= 1, received horizon={horizon}, "
            f"episodes={episodes} and no start"
        )
    if start is not None and hasattr(env, "dynamics"):
        return _from_states(acts, env, start, horizon, draw or env.draw, film, label, watch)
    if isinstance(env, EnvBase):
        if start is not None or draw is not None:
            raise ConfigError(f"simulate: expected no start and no draw: {type(env).__name__} runs from its own resets")
        if seed is not None:
            env.set_seed(seed)
        return _from_resets(acts, env, int(episodes or 0), horizon, film, label, watch)
    poses: Sequence[Any] = [None] * int(episodes or 0) if start is None else torch.as_tensor(start).tolist()
    bar = tqdm(poses, desc=label, unit="episode", disable=label is None, leave=False)
    seeds = [None if seed is None else seed + k for k in range(len(poses))]
    found = []
    for k, pose in enumerate(bar):
        walk = partial(_in_world, acts, env, pose, horizon, seeds[k], k < film, watch)
        # Without a seed the world goes on from where the episode before has left it.
        found.append(walk() if seeds[k] is None else _kept(acts, watch, walk, pose, seeds[k], horizon, k < film))
    return found[0].joined(*found[1:])


class _Record:
    """What the steps of some episodes leave behind."""

    def __init__(self, watch: Watch | None) -> None:
        self.columns: dict[str, list[Tensor]] = {}
        self.watch = watch

    def add(self, **values: Tensor | None) -> None:
        for name, value in values.items():
            if value is not None:
                self.columns.setdefault(name, []).append(value)

    def judge(self, decision: Decision, region: Tensor, alive: Tensor, gone: Tensor | None = None) -> None:
        """An observation, and what is thought of it; of whoever is gone nothing."""
        if self.watch is not None:
            self.watch(decision, region)
        values = {"barrier": decision.barrier, "seen": decision.seen}
        if gone is not None:
            values = {k: None if v is None else v.masked_fill(gone, -1.0) for k, v in values.items()}
        kept = {k: getattr(decision, k) for k in ("latent", "outside", "innovation", "cut")}
        self.add(region=region, alive=alive.clone(), **kept, **values)

    def compare(self, before: Decision, after: Decision, gone: Tensor | None = None) -> None:
        """How far a step led from where it was expected to."""
        errors: dict[str, Tensor] = {}
        if before.predicted is not None and after.latent is not None:
            errors["prediction_error"] = (before.predicted - after.latent).norm(dim=-1)
        if before.predicted_barrier is not None and after.barrier is not None:
            errors["barrier_error"] = after.barrier - before.predicted_barrier
        self.add(**{k: v if gone is None else v.masked_fill(gone, 0.0) for k, v in errors.items()})

    def episodes(self, horizon: int, events: dict[str, Tensor]) -> Episodes:
        """All of it stacked, and filled up to the horizon with what is not alive."""
        stacked: dict[str, Tensor] = {}
        missing = horizon + 1 - len(self.columns["alive"])
        for name, rows in self.columns.items():
            rows = rows + [torch.zeros_like(rows[-1]) if name == "alive" else rows[-1]] * missing
            stacked[name] = torch.stack(rows).cpu()
        return Episodes(**stacked, events=events)  # type: ignore[arg-type]


def _asked(acts: Controller, last: bool) -> Callable[..., Decision]:
    """How it is asked: about the last observation of an episode it need not decide."""
    return getattr(acts, "watch", acts.step) if last else acts.step


def _from_states(
    acts: Controller, env: Any, start: Tensor, horizon: int, draw: Draw, film: int, label: str | None, watch: Watch | None
) -> Episodes:
    # Others that stream hold few pictures at a time by themselves.
    size = _PART if _alone(acts, watch) else len(start) if getattr(acts, "streams", False) else CHUNK
    if len(start) <= size:
        run = partial(_side_by_side, acts, env, start, horizon, draw, film, label, watch)
        return _kept(acts, watch, run, start, horizon, film)
    found = list[Episodes]()
    with tqdm(total=len(start), desc=label, unit="episode", disable=label is None, leave=False) as bar:
        for k, part in enumerate(start.split(size)):
            found.append(_from_states(acts, env, part, horizon, draw, film - k * size, None, watch))
            bar.update(len(part))
    return found[0].joined(*found[1:])


def _alone(acts: Controller, watch: Watch | None) -> bool:
    """Whether an agent acts by itself: no episode depends on others then."""
    return watch is None and isinstance(acts, AgentController) and acts.driver is None


def _kept(acts: Controller, watch: Watch | None, simulated: Callable[[], Episodes], *about: Any) -> Episodes:
    """Episodes, from the open journal where it has them."""
    if not _alone(acts, watch):
        return simulated()
    return Episodes(**kept(lambda: vars(simulated()), "episodes", *about))


def _side_by_side(
    acts: Controller, env: Any, start: Tensor, horizon: int, draw: Draw, film: int, label: str | None, watch: Watch | None
) -> Episodes:
    streams = getattr(acts, "streams", False)
    if acts.reads not in ("pixels", "state"):
        raise ConfigError(
            f"controller.reads: expected 'pixels' or 'state' on {type(env).__name__}, received '{acts.reads}'"
        )
    camera = Camera(draw, start, env.previous_state(start))

    def shown() -> Any:
        if acts.reads == "state":
            return camera.state
        return camera if streams else torch.cat(list(camera.pixels()))

    acts.reset()
    state, exit_is_safe, record = start, env.exit_region == SAFE, _Record(watch)
    alive = torch.ones(len(start), dtype=torch.bool)
    left = ~env.state_space.contains(start)
    decision = acts.step(shown())
    record.add(states=state, frames=draw(state[:film]) if film > 0 else None)
    record.judge(decision, env.region(state)[:, 0], alive)
    for t in tqdm(range(horizon), desc=label, disable=label is None, leave=False):
        ask, before, last, gone = _asked(acts, t == horizon - 1), decision, state, None
        state = env.wrap(env.dynamics(state, decision.action))
        if exit_is_safe:
            inside = env.state_space.contains(last)
            state, alive = torch.where(inside[:, None], state, last), alive & inside
            gone = ~env.state_space.contains(state)
            here = (~gone).nonzero()[:, 0]
            if len(here):  # nobody looks at whoever is gone
                camera.move(state[here], here)
                decision = before.put(here, ask(shown(), here))
        else:
            camera.move(state)
            decision = ask(shown())
        left = left | ~env.state_space.contains(state)
        record.add(states=state, actions=before.action, frames=draw(state[:film]) if film > 0 else None)
        record.judge(decision, env.region(state)[:, 0], alive, gone)
        record.compare(before, decision, gone)
    return record.episodes(horizon, {"left": left})


def _from_resets(
    acts: Controller, env: EnvBase, n: int, horizon: int, film: int, label: str | None, watch: Watch | None
) -> Episodes:
    k = env.batch_size[0]
    bar = tqdm(total=n, desc=label, unit="episode", leave=False, disable=label is None)
    parts: list[Episodes] = []
    while len(parts) * k < n:
        parts.append(_one_batch(acts, env, k, horizon, film - len(parts) * k, watch))
        bar.update(k)
    bar.close()
    found = parts[0].joined(*parts[1:])
    cut = found.select(slice(n))
    cut.frames = None if found.frames is None else found.frames[:, :n]
    return cut


def _one_batch(acts: Controller, env: EnvBase, k: int, horizon: int, film: int, watch: Watch | None) -> Episodes:
    record, alive = _Record(watch), torch.ones(k, dtype=torch.bool)

    def shown(data: Any) -> Tensor:
        if acts.reads not in data:
            raise ConfigError(f"controller.reads: expected a key of the environment, received '{acts.reads}'")
        return data[acts.reads]

    def keep(data: Any, decision: Decision) -> None:
        frames = data["pixels"][:film, -3:] if film > 0 and "pixels" in data else None
        record.add(states=data.get("state", None), frames=frames)
        record.judge(decision, data["region"][:, 0], alive)

    data = env.reset()
    acts.reset()
    decision = acts.step(shown(data))
    keep(data, decision)
    for t in range(horizon):
        before = decision
        acted = data.set("action", decision.action.to(env.device))
        # Whoever comes to the end with the last step needs no other beginning.
        stepped, data = env.step_and_maybe_reset(acted) if t < horizon - 1 else (env.step(acted), acted)
        following = stepped["next"]
        ended = following["done"][:, 0].cpu()
        over = t == horizon - 1 or not bool((alive & ~ended).any())
        decision = _asked(acts, over)(shown(following))
        record.add(actions=before.action)
        record.compare(before, decision)
        keep(following, decision)
        if over:
            break
        alive = alive & ~ended
        if ended.any():  # reset already; what follows does not count
            rows = ended.nonzero()[:, 0]
            acts.reset(rows)
            decision = decision.put(rows, acts.step(shown(data)[ended], rows))
    return record.episodes(horizon, {})


def _in_world(
    acts: Controller, env: Any, pose: Iterable[float] | None, horizon: int, seed: int | None, film: bool, watch: Watch | None
) -> Episodes:
    """One episode in a gymnasium environment, up to the first of: steps are over, it terminates, falls, or leaves."""
    record, alive = _Record(watch), torch.ones(1, dtype=torch.bool)

    def shown(observation: Any, info: dict[str, Any]) -> Tensor:
        return torch.as_tensor(info["pose"] if acts.reads == "state" else observation)[None]

    def keep(observation: Any, info: dict[str, Any], decision: Decision) -> None:
        code = UNSAFE if info.get("unsafe") else SAFE if info.get("safe") else UNLABELLED
        states = torch.as_tensor(info["pose"], dtype=torch.float32)[None].clone() if "pose" in info else None
        record.add(states=states, frames=torch.as_tensor(observation[-3:])[None].clone() if film else None)
        record.judge(decision, torch.tensor([code]), alive)

    acts.reset()
    options = {} if pose is None else {"options": {"pose": [float(v) for v in pose]}}
    observation, info = env.reset(seed=seed, **options)
    decision = acts.step(shown(observation, info))
    keep(observation, info, decision)
    events = {name: bool(info.get(entry)) for name, entry in EVENTS.items()}  # the reset walks a step, too
    for t in range(horizon):
        before = decision
        observation, _, terminated, truncated, info = env.step(decision.action[0].numpy())
        events = {name: seen or bool(info.get(EVENTS[name])) for name, seen in events.items()}
        over = bool(terminated or truncated or events["fallen"] or events["left"]) or t == horizon - 1
        decision = _asked(acts, over)(shown(observation, info))
        record.add(actions=before.action)
        record.compare(before, decision)
        keep(observation, info, decision)
        if over:
            break
    told = {name: torch.tensor([seen]) for name, seen in events.items() if EVENTS[name] in info}
    return record.episodes(horizon, told)

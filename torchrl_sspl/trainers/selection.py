"""The phases that end a round: held-out checks, and the level at which the set is what was asked for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchrl_sspl.configs.schema import LOWEST_LEVEL
from torchrl_sspl.evaluation.certify import premise
from torchrl_sspl.evaluation.controllers import AgentController, RandomController, covered
from torchrl_sspl.evaluation.episodes import separating_level
from torchrl_sspl.evaluation.known import encode_states
from torchrl_sspl.evaluation.simulation import Episodes, simulate
from torchrl_sspl.modules import ChoosingPolicy
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.seeds import spawn
from torchrl_sspl.sets import UNSAFE
from torchrl_sspl.trainers.phases import Check, Phase, Workspace

_HIGHEST_LEVEL = 0.08  # to which the barrier may be shifted by the held-out checks
_MOST_OF_MARGIN = 0.6  # of the condition's margin that the level may take away from what the set tolerates
_UNSAFE_DRAWS = 128_000  # fresh observations of U, at most
_STEP, _TRIED = 2, 6  # levels between two for which a proof is tried, and how many of these
_BACK = (1000, 80)  # episodes from U, at most, and their steps, at least
_STARTED = 20  # the most of this many episodes of which one has to start in the set
_Count = tuple[str, int, float]  # of what, how many, and how many there may be


@dataclass
class _Pictures:
    """Latents of fresh observations, and the states that episodes start from."""

    unsafe: Tensor
    changed: Tensor | None  # the same of U, as the cameras of the training see them
    safe: Tensor
    anywhere: Tensor
    states: Tensor  # of ``anywhere``
    back: Tensor  # of U


@dataclass
class _HeldOut:
    """What a round is judged by: barrier values of fresh observations, and fresh episodes."""

    unsafe: Tensor
    safe: Tensor
    anywhere: Tensor
    episodes: Episodes
    back: Episodes
    drift: Tensor  # (n,) norm of the mean innovation of an episode
    largest_innovation: float  # of single steps under random actions
    changed: Tensor | None = None  # of U, where training changes its pictures


class CheckRound(Phase):
    """Held-out checks of a round; the level is moved to the largest set that passes them.

    The environment knows its sets: fresh observations of S and U and fresh episodes start in them. Eight observations
    of U for every episode, 128,000 at most, all drawn uniformly: no state is searched for; and where the training changes
    its pictures, as many more, changed as these are. A set is left from its rim, in the first steps, so many short episodes
    say more than few long ones. Where a proof is asked for, a level passes if the weights say that its set tolerates an
    error (branch and bound), the checks are made with the memory held in the set, and the proof applies to enough of the
    episodes. A policy that chooses is simulated at the level at which it will run. An observer that believes itself more than
    what it sees keeps a constant innovation; a set is refused where the mean innovation of an episode is larger than single ones
    under random actions ever are.
    Source: none; the paper stops at a total loss of zero.
    """

    name = "check"
    _seen: _Pictures | None = None

    def run(self, work: Workspace) -> None:
        """Appends to ``work.checks``; keeps the networks if they are the best that has passed."""
        self._seen = None
        agent = work.agent(0.0)
        held_out = self._held_out(work, agent)
        if held_out is None:
            found = Check(self.number, 0.0, 0, 0, 0, 0, 0.0, 0.0, False, "the set is empty")
        else:
            levels = torch.linspace(LOWEST_LEVEL, _HIGHEST_LEVEL, 57).flip(0).tolist()
            lowest = work.config.lowest_level
            if lowest is None:
                lowest = -_MOST_OF_MARGIN * work.config.margin  # below it the condition says nothing of the level
            tried = [level for level in levels if level >= lowest - 1e-6]
            checks = (self._check(work, held_out, level) for level in tried)
            passed = (c for c in checks if c.passed)
            found = (self._as_it_runs(work, [*passed]) if isinstance(agent.policy, ChoosingPolicy) else next(passed, None)) or self._missed(work, held_out, tried[-1])
            if work.config.cover_share > 0:
                found = self._proved(work, held_out, levels) or found
        work.checks.append(found)
        work.log({"step": self.number, **vars(found)})
        # Of the sets that passed, one into which starts in U return counts first, then the largest.
        sound = found.covered >= work.config.cover_share
        rank = [float(sound), float(found.returned >= work.config.return_share), found.size]
        if found.passed and (work.best is None or rank >= list(work.best["rank"])):
            work.keep(rank, self.number, found.level)

    def _as_it_runs(self, work: Workspace, passed: list[Check]) -> Check | None:
        """Of levels that pass with the policy of level 0 the highest that passes with its own, among a few and 0; else what the last was refused for.

        A policy that chooses asks the barrier, which a level moves.
        """
        last = None
        for check in [*passed[::_STEP][:_TRIED], *(c for c in passed if abs(c.level) < 1e-6)]:
            if abs(check.level) < 1e-6:
                return check
            held_out = self._held_out(work, work.agent(check.level))
            if held_out is not None:
                last = self._moved(work, held_out, check.level)
                if last.passed:
                    return last
        return last

    def _moved(self, work: Workspace, held_out: _HeldOut, level: float) -> Check:
        """The check of an agent whose barrier was moved by a level: its set is the one of level 0."""
        check = self._check(work, held_out, 0.0)
        check.level = level
        return check

    def _missed(self, work: Workspace, held_out: _HeldOut, lowest: float) -> Check:
        """The check at level 0, with what was found at the lowest level, too, as its reason: no level between them keeps both U out and S in."""
        found, last = (self._check(work, held_out, level) for level in (0.0, lowest))
        if not found.passed and lowest < -1e-6:
            found.reason = f"{found.reason or 'the set is empty'}; at level {lowest:.2g}: {last.reason or 'the set is empty'}"
        return found

    def _proved(self, work: Workspace, held_out: _HeldOut, levels: list[float]) -> Check | None:
        """The largest set that is proved to be kept and passes, with its memory held in it, among a few levels; or None."""
        s = work.config
        apart = [v for v in levels if all(found <= most for _, found, most in self._mixed(work, held_out, v))]
        for level in apart[::_STEP][:_TRIED]:
            agent = work.agent(level)
            agent.tolerated_error = tolerated = premise(agent)
            fresh = self._held_out(work, agent) if tolerated > 0 else None
            if fresh is None:
                continue
            check = self._moved(work, fresh, level)
            check.tolerated, check.covered = tolerated, self._covered(fresh.episodes, agent)
            if check.passed and check.covered >= s.cover_share:
                return check
        return None

    @staticmethod
    def _mixed(work: Workspace, held_out: _HeldOut, level: float) -> list[_Count]:
        """Observations of U inside the set, and of S outside; and changed ones of U inside, where training changes them."""
        s = work.config
        inside, outside = held_out.unsafe <= level + s.guard, held_out.safe > level
        counts = [("unsafe inside", int(inside.sum()), 0.0), ("safe outside", int(outside.sum()), s.safe_share * len(outside))]
        if held_out.changed is not None:
            changed = held_out.changed <= level + s.guard
            counts.append(("unsafe inside as changed", int(changed.sum()), 0.0))
        return counts

    @staticmethod
    def _covered(run: Episodes, agent: Agent) -> float:
        """Share of the episodes from the set that meet the premise of the proof at every step."""
        assert run.barrier is not None
        return float(covered(run, agent)[run.barrier[0] <= 0].float().mean())

    def _pictures(self, work: Workspace, agent: Agent) -> _Pictures:
        """Drawn and encoded once in a round: a level moves the barrier alone."""
        if self._seen is None:
            source, n = work.source, work.config.check_episodes
            env, generator = source.env, torch.Generator().manual_seed(spawn(work.seed, "checks", self.number))
            in_unsafe = env.sample_states(min(8 * n, _UNSAFE_DRAWS), generator, region=env.unsafe_set)
            unsafe, changed = encode_states(agent, env, in_unsafe), None
            if source.changes is not None:
                cameras = source.changes.with_seed(spawn(work.seed, "checks", 2000 + self.number))
                changed = encode_states(agent, env, in_unsafe, augmentation=cameras)
            safe = encode_states(agent, env, env.sample_states(n, generator, region=env.safe_set))
            states = env.sample_states(3 * n, generator, region=source.outside_unsafe)
            back = env.sample_states(min(max(1, n // 4), _BACK[0]), generator, region=env.unsafe_set)
            source.count_held_out(len(in_unsafe) + n)
            self._seen = _Pictures(unsafe, changed, safe, encode_states(agent, env, states), states, back)
        return self._seen

    def _held_out(self, work: Workspace, agent: Agent) -> _HeldOut | None:
        s, env, n = work.config, work.source.env, work.config.check_episodes
        seen = self._pictures(work, agent)
        unsafe = agent.least_barrier(seen.unsafe)
        changed = None if seen.changed is None else agent.least_barrier(seen.changed)
        safe, anywhere = (agent.barrier(latent)[:, 0] for latent in (seen.safe, seen.anywhere))
        start = seen.states[anywhere <= _HIGHEST_LEVEL][:n]
        if not len(start):
            return None
        episodes = simulate(agent, env, start=start, horizon=s.check_horizon)
        back = simulate(agent, env, start=seen.back, horizon=max(2 * s.check_horizon, _BACK[1]))
        runs = [episodes, back]
        drift, largest = episodes.innovation[1:].mean(0).norm(dim=-1), math.inf
        if work.observing:
            chance = AgentController(agent, driver=RandomController.within(env, spawn(work.seed, "checks", 1000 + self.number)))
            at_random = simulate(chance, env, start=start[: max(1, n // 10)], horizon=s.check_horizon)
            largest = float(at_random.innovation.norm(dim=-1).max())
            runs.append(at_random)
        work.source.count_held_out(0, *runs)
        return _HeldOut(unsafe, safe, anywhere, episodes, back, drift, largest, changed)

    def _check(self, work: Workspace, held_out: _HeldOut, level: float) -> Check:
        s, run, back = work.config, held_out.episodes, held_out.back
        assert run.barrier is not None
        assert back.barrier is not None
        late = (run.region == UNSAFE).flip(0).cumsum(0).flip(0) > 0  # in U now or later
        inside = run.barrier[0] <= level
        left = int((inside & (run.barrier[1:] > level).any(0)).sum())
        touched = int(((run.barrier <= level) & late).any(0).sum())
        mixed = self._mixed(work, held_out, level)
        returned = float(((back.barrier[-1] <= level) & (back.region[-1] != UNSAFE)).float().mean())
        counts = (*mixed, ("left", left, s.leave_share * int(inside.sum())), ("touched U", touched, 0))
        faults = [f"{name} {found}" for name, found, most in counts if found > most]
        started, size = int(inside.sum()), float((held_out.anywhere <= level).float().mean())
        if size > 0 and started < max(1, len(run) // _STARTED):  # of a set that nothing starts in nothing was seen
            faults.append(f"{started} of {len(run)} episodes start in the set, too few to tell")
        drift = held_out.drift[inside]
        if bool((drift > held_out.largest_innovation).any()):
            faults.append(f"innovations with a mean of up to {float(drift.max()):.2g}")
        passed = not faults and size > 0
        bad, out = (found for _, found, _ in mixed[:2])
        return Check(self.number, level, bad, out, left, touched, returned, size, passed, ", ".join(faults), started=started)


class PlaceLevel(Phase):
    """The zero level between held-out observations of U and S, for systems that are known by being run only.

    They come from as many ``episodes`` of ``horizon`` steps under the policy as under random actions. Source: none.
    """

    name = "level"

    def __init__(self, number: int = 0, *, episodes: int = 200, horizon: int = 50, envs: int = 20, progress: bool = False) -> None:
        super().__init__(number)
        self.episodes, self.horizon, self.envs, self.progress = episodes, horizon, envs, progress

    def run(self, work: Workspace) -> None:
        work.source.count_stored()  # a run that goes on after this phase has no pictures any more
        work.level = self.place(work)
        work.log({"step": self.number, "level": work.level})

    def place(self, work: Workspace) -> float:
        """The level."""
        s, source = work.config, work.source
        seed, agent = spawn(work.seed, "level", self.number), work.agent(0.0)
        device = next(work.encoder.parameters()).device
        env = source.make_env(batch_size=[self.envs], seed=seed)
        label = "zero level" if self.progress else None
        agent = agent.to(device)
        chance = AgentController(agent, driver=RandomController.within(env, spawn(work.seed, "level", 1000 + self.number)))
        try:
            run: dict[str, Any] = {"episodes": self.episodes, "horizon": self.horizon, "label": label}
            held_out = [simulate(acts, env, **run) for acts in (agent, chance)]
        finally:
            env.close()
        source.count_held_out(0, *held_out)
        level = separating_level(held_out, s.guard, 0.0 if work.skip else s.margin)
        first = held_out[0].barrier
        if level < 0.0 and first is not None and not bool((first[0] <= level).any()):
            work.warnings.append(
                f"no held-out reset lies in the set: its level was lowered to {level:.3g} to leave out every held-out observation "
                "of U. Some of these look like S to the encoder: collect more data (trainer.total_frames), above all in U "
                "(reset_options), show more of the motion (image_size), or try another seed"
            )
        return level


__all__ = ["CheckRound", "PlaceLevel"]

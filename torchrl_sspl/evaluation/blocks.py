"""Fresh episodes behind a certificate: of which system, block by block, and what is counted on them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchrl_sspl.certification.loop import closed_loop_lipschitz
from torchrl_sspl.certification.record import NOTHING, RIMS, Counts, Record
from torchrl_sspl.certification.statistics import fingerprint, largest_error_bound, paper_numbers
from torchrl_sspl.configs.reader import EnvFactory, resolve
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import ConfigError, NonFiniteError, SSPLError
from torchrl_sspl.evaluation.controllers import CHUNK, AgentController, RandomController
from torchrl_sspl.evaluation.measurements import MakeEnv
from torchrl_sspl.evaluation.simulation import Episodes, looked_at, simulate
from torchrl_sspl.functional import covering_radius
from torchrl_sspl.modules.agent import Agent, on_host
from torchrl_sspl.modules.controller import premise_met
from torchrl_sspl.seeds import spawn
from torchrl_sspl.sets import SAFE, UNSAFE, Union

_LATE = 200  # one step in so many may be another on another machine, where episodes end early
_COVERED = 4000  # observations of which a covering radius is computed, from an environment's own resets
_BARELY = 2.0**-14  # of what values near the level are: a decision closer than this may be rounded to the other side elsewhere
_CLOSE = 2  # starts in a block that may be, at most
_COMPARED = 20  # steps in which two environments are compared
_EVENTS = ("left", "entered", "aliased", "undefined", "events", "exceeding", "uncovered", "mistaken", "outside")
_GRID = 2.0**-19  # below which two trajectories are the same: networks round differently in different batches


def described_system(description: Mapping[str, Any], *, trust: bool = False) -> EnvFactory | None:
    """Maker of the system that an agent's description names; None if it names none, or one that is not to be trusted.

    Args:
        description: of an agent: ``config.env`` with an import path ``_target_`` and its arguments, or the name of an
            environment of this library.
        trust: import what is not of this library, too. An import path runs code: trust whom the agent comes from.

    Source: none.

    Example:
        >>> described_system({"environment": "PendulumEnv"})(batch_size=[2], seed=0).batch_size
        torch.Size([2])
        >>> described_system({"config": {"env": {"_target_": "os.abort"}}}) is None
        True
    """
    config = description.get("config")
    spec = config.get("env") if isinstance(config, Mapping) else None
    if not isinstance(spec, Mapping) or "_target_" not in spec:
        named = description.get("environment")
        spec = {"_target_": f"torchrl_sspl.envs.{named}"} if isinstance(named, str) and named.isidentifier() else None
    if spec is None or not isinstance(spec["_target_"], str):
        return None
    try:
        if not trust:
            found = re.fullmatch(r"torchrl_sspl\.envs[.:](\w+)", spec["_target_"])
            kind = resolve(spec["_target_"]) if found else None
            if not (isinstance(kind, type) and issubclass(kind, SafetyEnv)):
                return None
        return EnvFactory(spec)
    except (SSPLError, TypeError, ValueError):
        return None


#: What building and running a system of somebody else's description may raise.
_UNBUILDABLE = (SSPLError, RuntimeError, TypeError, ValueError, LookupError, AttributeError)


def same_system(env: SafetyEnv, factory: MakeEnv) -> bool:
    """Whether a system moves, looks and is labelled as the one that a maker gives, on a sample; not if that cannot be built."""
    try:
        twin = factory(batch_size=[1], seed=0)
    except _UNBUILDABLE:
        return False
    if type(env) is not type(twin) or (env.state_dim, env.action_dim) != (twin.state_dim, twin.action_dim):
        return False
    g = torch.Generator().manual_seed(0)
    state = env.sample_states(64, g, region=env.state_space)
    action = _random_actions(env, 64, g)

    def seen(system: SafetyEnv) -> list[Tensor]:
        moved, bounds = system.wrap(system.dynamics(state, action)), [system.exit_region, system.max_action]
        told = [moved, system.region(state), system.region(moved), system.action_low, system.action_high]
        return [*told, torch.tensor(bounds), system.draw(state[:16]), system.draw(system.previous_state(state)[:16])]

    return all(a.shape == b.shape and torch.equal(a, b) for a, b in zip(seen(env), seen(twin), strict=True))


def _random_actions(env: SafetyEnv, n: int, g: torch.Generator) -> Tensor:
    return env.action_low + torch.rand(n, env.action_dim, generator=g) * (env.action_high - env.action_low)


def same_resets(make_env: MakeEnv, factory: MakeEnv, horizon: int = _COMPARED) -> bool:
    """Whether two makers give environments that begin, go on and end the same in so many steps, on a sample."""

    def seen(make: MakeEnv) -> list[Tensor]:
        env = make(batch_size=[2], seed=0)
        try:
            data, chance, space = env.reset(), RandomController.within(env, 0), env.action_spec_unbatched.space
            last = torch.tensor(min(horizon, getattr(env, "horizon", None) or horizon))
            found = [last, space.low, space.high, data["pixels"], data["region"]]
            for _ in range(min(horizon, _COMPARED)):
                stepped, data = env.step_and_maybe_reset(data.set("action", chance.step(data["pixels"]).action.to(env.device)))
                found += [stepped["next", k] for k in ("pixels", "region", "done")]
            return found
        finally:
            env.close()

    try:
        pairs = zip(seen(make_env), seen(factory), strict=True)
        return all(a.shape == b.shape and torch.equal(a, b) for a, b in pairs)
    except _UNBUILDABLE:
        return False


@dataclass
class Block:
    """What a block of episodes showed: counts for the record, and samples for the numbers beside them."""

    counts: Counts
    least: Counts  # without events that are so close that another machine may round them away
    close: int  # starts that it may round out of the set or into it
    error: Tensor  # (n,) largest of each episode
    steps: Tensor  # (n,) of each episode
    prints: list[str]  # of the episodes
    labelled: list[str]  # of the labelled states
    rims: dict[str, tuple[int, float]]
    inside: Tensor  # (n, p) latents of the set
    safe: Tensor  # barrier values of S
    unsafe: Tensor  # of U
    latent: Tensor  # latents whose distance to others is asked for
    reference: Tensor  # these others


def counted(
    e: Episodes, level: float, tolerated: float | None, slack: float = 0.0, held: bool = False
) -> tuple[dict[str, int], Tensor]:
    """Events by name, by more than a share of what values near the level are, and the largest error of each episode ``(n,)``;
    ``held``: what would leave the set is cut to what it tolerates."""
    alive, barrier, unsafe = e.alive, e.barrier.double(), (e.region == UNSAFE) & e.alive
    seen = e.seen.double()
    error = torch.where(alive[1:], e.prediction_error.double(), 0.0)
    worst = torch.where(error.isnan(), math.inf, error).amax(0)
    margin = slack * _scale(barrier[alive], level)
    events = {
        "left": ((barrier > level + margin) & alive).any(0),
        "entered": unsafe.any(0),
        "aliased": (unsafe & (torch.minimum(barrier, seen) <= level - margin)).any(0),
        "undefined": (~barrier.isfinite() & alive).any(0) | ~worst.isfinite(),
    }
    events["events"] = torch.stack(list(events.values())).any(0)
    limit = 0.0 if tolerated is None else tolerated
    met = premise_met(barrier[1:], seen[1:], error, limit * (1 + slack), held=held, level=level + margin)
    missing = ~met & alive[1:]
    # An episode without a step has nothing to show but its first observation.
    exceeding = missing.any(0) | ~premise_met(seen[0], seen[0], torch.zeros_like(seen[0]), limit, held=held, level=level + margin)
    sums = events | {"exceeding": exceeding, "uncovered": missing}
    return {k: int(v.sum()) for k, v in sums.items()}, worst


def holds_at(agent: Agent, level: float) -> bool:
    """Whether corrections are held in {B <= s}; an agent holds them at level zero."""
    return agent.held_error > 0.0 and level == 0.0


def _scale(barrier: Tensor, level: float) -> float:
    """Size of barrier values near the level, which rounding is relative to: values far above it have no say."""
    values = (barrier[barrier.isfinite()] - level).abs()
    return min(float(values.max()), max(1.0, abs(level))) if values.numel() else 0.0


def _rims(e: Episodes, level: float) -> dict[str, tuple[int, float]]:
    """Steps and largest error, by where in the set a step began."""
    rims, before = {}, e.barrier[:-1] - level
    for name, (lower, upper) in RIMS.items():
        here = e.prediction_error[e.alive[1:] & (before > lower) & (before <= upper)]
        if len(here) and bool(here.isfinite().all()):
            rims[name] = (len(here), float(here.max()))
    return rims


class StateBlocks:
    """Blocks of episodes on a system whose states are known."""

    def __init__(
        self, agent: Agent, env: SafetyEnv, record: Record, level: float, tolerated: float | None = None
    ) -> None:
        self.agent, self.env, self.record, self.level, self.tolerated = on_host(agent), env, record, level, tolerated
        self.held = holds_at(agent, level)

    @torch.no_grad()
    def __call__(self, index: int) -> Block:
        agent, env, n = self.agent, self.env, self.record.size(index)
        g = torch.Generator().manual_seed(spawn(self.record.seed, "certificate", index))
        start, inside = self._from_set(n, g)
        uniform = env.sample_states(n - n // 2, g, region=env.unsafe_set)
        before, after = self._entering(n // 2, g)
        unsafe_state = torch.cat([uniform, after])
        unsafe_latent = self._see(torch.cat([env.previous_state(uniform), before]), unsafe_state)
        safe_state = env.sample_states(n, g, region=env.safe_set)
        safe_latent, reference_state = self._see(None, safe_state), env.sample_states(4 * n, g)
        unsafe, safe = agent.least_barrier(unsafe_latent), agent.barrier(safe_latent)[:, 0]
        latent = torch.cat([inside, unsafe_latent, safe_latent])
        beyond = ~(latent.abs() <= 1.0).all(1)
        run = self._run(start) if len(start) else None
        counts = least = NOTHING
        worst, steps, rims = torch.zeros(0), torch.zeros(0, dtype=torch.int64), dict[str, tuple[int, float]]()
        if run is not None:
            steps, rims = run.alive.sum(0) - 1, _rims(run, self.level)
            found, worst = counted(run, self.level, self.tolerated, held=self.held)
            sure = counted(run, self.level, self.tolerated, _BARELY, self.held)[0]
            counts, least = (replace(NOTHING, episodes=len(start), steps=int(steps.sum()), **k) for k in (found, sure))
        elif len(start):
            k = len(start)
            counts = least = replace(NOTHING, episodes=k, undefined=k, events=k, exceeding=k)
            worst, steps = torch.full((k,), math.inf), torch.zeros(k, dtype=torch.int64)
        margin = _BARELY * _scale(unsafe, self.level)
        mistaken, surely = (int((~(unsafe > self.level - m)).sum()) for m in (0.0, margin))
        seen = {"shown": len(unsafe), "seen": len(latent), "outside": int(beyond.sum())}
        return Block(
            replace(counts, mistaken=mistaken, **seen), replace(least, mistaken=surely, **seen), 0, worst, steps,
            fingerprint(start), fingerprint(unsafe_state), rims, inside, safe, unsafe, latent,
            self._see(None, reference_state),
        )  # fmt: skip

    def _run(self, start: Tensor) -> Episodes | None:
        """Episodes from the set; None where the policy gives no number, so that there are none."""
        try:
            run = simulate(AgentController(self.agent), self.env, start=start, horizon=self.record.horizon)
        except NonFiniteError:
            return None
        run.alive = looked_at(run, self.env)
        return run

    def _see(self, before: Tensor | None, state: Tensor) -> Tensor:
        """Latents of states."""
        env, agent = self.env, self.agent
        before = env.previous_state(state) if before is None else before
        parts = zip(before.split(CHUNK), state.split(CHUNK), strict=True)
        seen = [agent.encode(torch.cat([env.draw(a), env.draw(b)], dim=-3)) for a, b in parts if len(b)]
        return torch.cat(seen) if seen else torch.zeros(0, agent.latent_dim)

    def _from_set(self, n: int, g: torch.Generator) -> tuple[Tensor, Tensor]:
        """Uniform states whose observation lies in the set, and their latents."""
        states, latents, found = [], [], 0
        for tried in range(1, 61):
            state = self._anywhere(2 * n, g)
            latent = self._see(None, state)
            kept = self.agent.barrier(latent)[:, 0] <= self.level
            states.append(state[kept])
            latents.append(latent[kept])
            found += int(kept.sum())
            if found >= n or (tried == 10 and found == 0):  # of 20 n states none: the set is as good as empty
                break
        return torch.cat(states)[:n], torch.cat(latents)[:n]

    def _anywhere(self, n: int, g: torch.Generator) -> Tensor:
        """States of the state space, of which a part is a sample, too: those of a union are not grouped."""
        state = self.env.sample_states(n, g, region=self.env.state_space)
        return state[torch.randperm(n, generator=g)] if isinstance(self.env.state_space, Union) else state

    def _entering(self, n: int, g: torch.Generator) -> tuple[Tensor, Tensor]:
        """States of U that one step under a uniform random action leads into, and the states before it."""
        env, before, after, found = self.env, [], [], 0
        for _ in range(60):
            state = self._anywhere(max(4 * n, 2000), g)
            moved = env.wrap(env.dynamics(state, _random_actions(env, len(state), g)))
            enters = (env.region(state) != UNSAFE)[:, 0] & (env.region(moved) == UNSAFE)[:, 0]
            before.append(state[enters])
            after.append(moved[enters])
            found += int(enters.sum())
            if found >= n:
                break
        return torch.cat(before)[:n], torch.cat(after)[:n]


class ResetBlocks:
    """Blocks of episodes from an environment's own resets; steps behind their end do not count."""

    def __init__(
        self, agent: Agent, make_env: MakeEnv, record: Record, level: float, tolerated: float | None = None
    ) -> None:
        self.agent, self.make_env, self.record, self.level, self.tolerated = agent, make_env, record, level, tolerated
        self.held = holds_at(agent, level)

    @torch.no_grad()
    def __call__(self, index: int) -> Block:
        record, level = self.record, self.level
        n, root = record.size(index), record.seed
        env = self.make_env(batch_size=[record.envs], seed=spawn(root, "certificate", index))
        try:
            own = simulate(AgentController(self.agent), env, episodes=n, horizon=record.horizon)
            chance = RandomController.within(env, spawn(root, "certificate actions", index))
            at_random = simulate(AgentController(self.agent, chance), env, episodes=n, horizon=record.horizon)
        except NonFiniteError:  # the policy gives no number
            return _undefined(n, self.agent.latent_dim)
        finally:
            env.close()
        both = own.joined(at_random)
        barrier, own_barrier = both.barrier, own.barrier
        looks = torch.minimum(barrier, both.seen)  # a picture alone may look safe where the memory knows better
        start = own.select(~(own_barrier[0] > level))  # a start that is no number counts, as an event
        shown, margin = (both.region == UNSAFE) & both.alive, _BARELY * _scale(barrier[both.alive], level)
        outside = both.outside[both.alive]
        counts, least = (
            replace(
                NOTHING, episodes=len(start), steps=int(start.alive[1:].sum()),
                **counted(start, level, self.tolerated, s, self.held)[0],
                shown=int(shown.any(0).sum()), mistaken=int((shown & ~(looks > level - m)).any(0).sum()),
                seen=len(outside), outside=int(outside.sum()),
            )
            for s, m in ((0.0, 0.0), (_BARELY, margin))
        )  # fmt: skip
        near = min(int(((own_barrier[0] - level).abs() <= margin).sum()), _CLOSE)
        worst = counted(start, level, self.tolerated)[1]
        mine, inside = own.latent[own.alive], own_barrier[own.alive] <= level
        safe = barrier[(both.region == SAFE) & both.alive]
        return Block(
            counts, least, near, worst, start.alive.sum(0) - 1, _trajectories(start), [], _rims(start, level),
            mine[inside], safe, looks[shown], mine, at_random.latent[at_random.alive],
        )  # fmt: skip


def _undefined(n: int, p: int) -> Block:
    """Episodes that there are none of, as the policy gives no number: every one of them is an event."""
    counts = replace(NOTHING, episodes=n, undefined=n, events=n, exceeding=n, shown=n, mistaken=n)
    lost, none, nowhere = torch.full((n,), math.inf), torch.zeros(0), torch.zeros(0, p)
    steps, prints = torch.zeros(n, dtype=torch.int64), [str(k) for k in range(n)]
    return Block(counts, counts, 0, lost, steps, prints, [], {}, nowhere, none, none, nowhere, nowhere)


def _trajectories(e: Episodes) -> list[str]:
    """Fingerprints of where episodes begin, go on and end: of true states, or of latents where those are not told."""
    if not len(e):
        return []
    path = e.latent if e.states is None else e.states
    last = e.alive.sum(0) - 1
    picked = [path[torch.minimum(last, torch.tensor(k)), torch.arange(len(e))] for k in (0, 1, 2)]
    ends = [path[last, torch.arange(len(e))], last[:, None].to(path.dtype)]
    return fingerprint(torch.cat([*picked, *ends], 1), grid=_GRID)


def _trained_on(agent: Agent) -> set[str]:
    """Fingerprints of the labelled states that the agent says it was trained with."""
    named = agent.description.get("trained_on")
    return {str(p) for p in named} if isinstance(named, list) else set()


def compared_labels(agent: Agent, record: Record) -> int:
    """With how many labelled states of the training those of the episodes are compared; from resets no states are told."""
    return len(_trained_on(agent)) if record.kind == "states" else 0


def summarise(record: Record, blocks: Sequence[Block], agent: Agent) -> None:
    """Fills in what needs all blocks: lengths, repetitions, errors, and the samples of the paper's conditions."""
    agent = on_host(agent)
    steps = torch.cat([b.steps for b in blocks])
    error, prints = torch.cat([b.error.double() for b in blocks]), [p for b in blocks for p in b.prints]
    known = _trained_on(agent)
    g = torch.Generator().manual_seed(spawn(record.seed, "certificate", 2**24 - 1))

    def some(rows: Tensor) -> Tensor:  # the covering radius compares all pairs
        return rows[torch.randperm(len(rows), generator=g)[:_COVERED]] if record.kind == "resets" else rows

    inside, safe, unsafe, latent, reference = (
        torch.cat([getattr(b, k) for b in blocks]) for k in ("inside", "safe", "unsafe", "latent", "reference")
    )
    try:
        constant = closed_loop_lipschitz(agent.dynamics, agent.policy)
    except ConfigError:
        constant = math.inf
    with torch.no_grad():
        following = agent.barrier(agent.dynamics(inside, agent.policy(inside)))[:, 0]
    finite = bool(latent.isfinite().all()) and bool(reference.isfinite().all())
    radius = covering_radius(some(latent), some(reference)) if finite and len(latent) and len(reference) else math.nan
    sizes, numbers = paper_numbers(
        safe=safe,
        unsafe=unsafe,
        following=following,
        lipschitz_bound=agent.lipschitz_bound,
        covering_radius=radius,
        dynamics_error=float(error.max()) if len(error) else math.nan,
        closed_loop_constant=constant,
    )
    n = len(steps)
    lengths = {"shortest": int(steps.min()), "median": int(steps.median()), "longest": int(steps.max())} if n else {}
    leaked = sum(p in known for b in blocks for p in b.labelled)
    sizes |= lengths | {"repeated": n - len(set(prints)), "trained_on": compared_labels(agent, record), "leaked": leaked}
    record.sizes |= sizes
    different = dict(zip(prints, error.tolist(), strict=True))  # of episodes that repeat another one
    bound = largest_error_bound(list(different.values()), record.confidence) if n else math.nan
    numbers |= {"episode_error": bound}
    record.numbers |= {k: v if math.isfinite(v) else None for k, v in numbers.items()}
    record.rims = []
    for name in RIMS:
        found = [b.rims[name] for b in blocks if name in b.rims]
        if found:
            record.rims.append((name, sum(k for k, _ in found), max(e for _, e in found)))


def block_changes(claimed: Counts, block: Block, resets: bool) -> str:
    """Counts that are better than those measured again, but for what another machine may round away."""
    found, least, close = asdict(block.counts), asdict(block.least), block.close
    longest = int(block.steps.max()) if len(block.steps) else 0
    # A pixel that is rounded elsewhere may lead an episode along another path, out of the domain a step earlier or later.
    late = math.ceil(int(block.steps[block.steps < longest].sum()) / _LATE)
    moved = close * (longest + 1) + (2 * late if resets else 0)
    slack = {"episodes": close, "shown": close, "steps": close * longest + late, "seen": moved}
    wrong = [k for k, most in slack.items() if abs(getattr(claimed, k) - found[k]) > most]
    wrong += [k for k, missing in _fewer(claimed, block.counts).items() if missing > min(found[k] - least[k], 1)]
    return ", ".join(f"{k} claimed {getattr(claimed, k)}, measured {found[k]}" for k in wrong)


def changes_together(claimed: Sequence[Counts], blocks: Mapping[int, Block]) -> str:
    """Events that several blocks claim fewer of: of each kind, rounding takes one from a certificate, not from every block."""
    missing = [_fewer(claimed[index], block.counts) for index, block in blocks.items()]
    wrong = {k: sum(one[k] for one in missing) for k in _EVENTS}
    return ", ".join(f"{k}: {n} fewer than measured" for k, n in wrong.items() if n > 1)


def _fewer(claimed: Counts, found: Counts) -> dict[str, int]:
    """Of each kind of event, how many fewer are claimed than measured."""
    short = {k: getattr(found, k) - getattr(claimed, k) for k in _EVENTS}
    short["uncovered"] -= max(found.steps - claimed.steps, 0)  # a step less is no step covered more
    return {k: max(n, 0) for k, n in short.items()}


def _not_smaller(claimed: float, found: float) -> bool:
    """Whether a number is what was found, or a little larger, which is worse; what is smaller is rounding."""
    return -1e-6 * max(1.0, abs(found)) <= claimed - found <= max(1e-6, 1e-2 * abs(found))


def summary_changes(claimed: Record, found: Record, close: int) -> str:
    """Numbers beside the counts that are not those measured again."""
    wrong = []
    for name, value in claimed.sizes.items():
        few = name in ("repeated", "leaked")
        slack = close + (2 if few else max(2, found.sizes[name] // 500))
        if not value >= found.sizes[name] - slack or (not few and value > found.sizes[name] + slack):
            wrong.append(f"{name} claimed {value}, measured {found.sizes[name]}")
    for key, number in claimed.numbers.items():
        other = found.numbers[key]
        if (number is None) != (other is None) or (number is not None and other is not None and not _not_smaller(number, other)):
            wrong.append(f"{key} claimed {number}, measured {other}")
    if [r[0] for r in claimed.rims] != [r[0] for r in found.rims] or any(
        abs(a[1] - b[1]) > close * claimed.horizon + max(3, b[1] // 100)
        or not _not_smaller(a[2], b[2])
        for a, b in zip(claimed.rims, found.rims, strict=True)
    ):
        wrong.append("errors by part of the set")
    return "; ".join(wrong)

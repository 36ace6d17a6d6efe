"""Certificates of trained agents: issue one, and check one again from the weights and from fresh episodes."""

from __future__ import annotations

import json
import math
import random
import re
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from enum import IntEnum
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from torchrl_sspl.certification.branch_and_bound import Budget
from torchrl_sspl.certification.certificate import (
    TOLERATED,
    Certificate,
    Layer,
    Reason,
    differences,
    effort,
    weights_digest,
)
from torchrl_sspl.certification.conditions import tolerates
from torchrl_sspl.certification.floating import UNITS
from torchrl_sspl.certification.layers import deterministic_layer, level_that_holds
from torchrl_sspl.certification.loop import closed_loop
from torchrl_sspl.certification.record import Counts, Record
from torchrl_sspl.certification.rounding import LOWER_BOUNDS, line_of, printable
from torchrl_sspl.certification.statistics import paper_layer, run_time_layer, statistical_layer
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import CertificationError, CheckpointError, ConfigError, SSPLError
from torchrl_sspl.evaluation.beside import CERTIFICATE_FILE, configuration_of
from torchrl_sspl.evaluation.blocks import (
    Block,
    MakeEnv,
    ResetBlocks,
    StateBlocks,
    block_changes,
    changes_together,
    compared_labels,
    described_system,
    holds_at,
    same_resets,
    same_system,
    summarise,
    summary_changes,
)
from torchrl_sspl.interrupts import TimeUp, time_limit
from torchrl_sspl.journal import journal, kept
from torchrl_sspl.modules.agent import Agent, agent_directory
from torchrl_sspl.modules.choosing import ChoosingPolicy
from torchrl_sspl.modules.observer import CUT

_BROKEN = (SSPLError, ImportError, RuntimeError, TypeError, ValueError)
#: How far beyond the Lipschitz argument a tolerated error is looked for, in how many steps, and with how many boxes each.
_FARTHEST, _HALVINGS, _PATIENCE = 1.7, 4, 50_000
_ROUNDINGS = ("barrier_rounding", "step_rounding")
_SAMPLE = 20.0  # seconds of episodes that are measured again where not all are asked for


class Exit(IntEnum):
    """Exit codes of ``sspl verify``."""

    HOLDS = 0  # everything that was checked was found again, whatever it says
    REFUSED = 1  # something is claimed that is not so
    USAGE = 2  # no such agent, or a wrong argument
    MALFORMED = 3  # there is no certificate, or the file is none
    AGENT = 4  # the agent cannot be read
    TIME = 5  # nothing was found wrong, but not everything was found again in the time
    UNMEASURED = 6  # all episodes were to be measured again, and none could be


def certify(
    agent: Agent,
    env: SafetyEnv | None,
    *,
    name: str = "agent",
    level: float | None = None,
    episodes: int = 3000,
    horizon: int = 200,
    seed: int | None = None,
    used_seeds: Sequence[int] = (),
    confidence: float = 0.95,
    acceptable: float = 0.01,
    budget: Budget | None = None,
    progress: bool = False,
) -> Certificate:
    """Certifies a frozen agent: the set {B <= s} with the largest s <= 0 that is proved to be kept.

    Args:
        agent: frozen agent.
        env: the true system, for the layers that are measured; without one, only what the weights prove.
        name: name of the agent.
        level: s, barrier units; searched for if not given; 0 of an agent that tolerates errors, which keeps {B <= 0} as it runs.
        episodes: number of fresh episodes from the set, and of fresh observations of U.
        horizon: steps per episode.
        seed: root of the seeds of the fresh data, which are drawn in a purpose of their own; default: that of the
            agent's configuration.
        used_seeds: seeds with which anything was trained, chosen or tuned, beside those that the agent itself names.
        confidence: of the two bounds of the statistical layer together, and of that of the run-time layer by itself.
        acceptable: risk per episode, and per observation of U, above which a bound does not hold.
        budget: of each search of the deterministic layer.
        progress: show progress bars.

    Raises:
        ConfigError: if a setting is out of range.

    Source: paper Theorem 1; deviation: proved on the whole latent domain, and measured on fresh episodes.

    Example:
        >>> from torchrl_sspl.modules.agent import load
        >>> certificate = certify(load("pendulum"), None, level=0.0, budget=Budget(boxes=100))  # 40,000 boxes prove all of it
        >>> {s.name: s.holds for s in certificate.layers["deterministic"].statements if s.name in ("Lipschitz constant", "invariance")}
        {'Lipschitz constant': True, 'invariance': False}
    """
    if env is None:
        return _proved(agent, name, level, budget)
    factory = described_system(agent.description)
    system = "described" if factory is not None and same_system(env, factory) else "given"
    root, used = _root_seed(agent) if seed is None else seed, _used(agent, used_seeds)
    record = Record("states", system, root, episodes, horizon, 1, confidence, acceptable, used, among=env.among)
    certificate = _proved(agent, name, level, budget)
    return _measured(certificate, agent, StateBlocks(agent, env, record, certificate.level), progress)


def certify_on_episodes(
    agent: Agent,
    make_env: MakeEnv,
    *,
    name: str = "agent",
    level: float | None = None,
    episodes: int = 1000,
    horizon: int = 50,
    envs: int = 20,
    seed: int | None = None,
    used_seeds: Sequence[int] = (),
    confidence: float = 0.95,
    acceptable: float = 0.01,
    budget: Budget | None = None,
    progress: bool = False,
) -> Certificate:
    """Certifies a frozen agent for an environment that is known only by being run.

    What the weights prove is the same as with :func:`certify`. What is measured are episodes from the environment's own
    resets, half under the policy, half under random actions: those under the policy that start in the set, and of all
    that show U, whether one observation of it has B <= s. Episodes are drawn in blocks, each from a newly made and
    seeded environment, until enough begin in the set; when to stop depends on that number alone, never on what
    happened in them. Source: paper Theorem 1; deviation: as for :func:`certify`.

    Args:
        agent: frozen agent.
        make_env: ``(batch_size=[k], seed=...) -> environment`` with ``"pixels"`` and ``"region"``.
        episodes: number of fresh episodes from the set. At least as many are drawn under the policy, and under random actions,
            and at most three times as many.
        envs: environments stepped together.
        name, level, horizon, seed, used_seeds, confidence, acceptable, budget, progress: as for :func:`certify`.

    Example:
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> from torchrl_sspl.modules.agent import load
        >>> short = {"episodes": 4, "horizon": 3, "envs": 4, "budget": Budget(boxes=10)}  # nothing is proved with so little effort
        >>> certificate = certify_on_episodes(load("pendulum"), PendulumEnv, **short)
        >>> sorted(certificate.layers)
        ['deterministic', 'paper', 'run-time', 'statistical']
    """
    factory = described_system(agent.description)
    system = "described" if factory is not None and same_resets(make_env, factory, horizon) else "given"
    root, used = _root_seed(agent) if seed is None else seed, _used(agent, used_seeds)
    record = Record("resets", system, root, episodes, horizon, envs, confidence, acceptable, used)
    certificate = _proved(agent, name, level, budget)
    return _measured(certificate, agent, ResetBlocks(agent, make_env, record, certificate.level), progress)


def issue(path: str | Path, env: SafetyEnv | MakeEnv | None = None, **settings: Any) -> Certificate:
    """Certifies the agent of a directory anew, and keeps the certificate beside it. Source: none.

    Args:
        path: name of a shipped agent, a run directory or the directory of an agent.
        env: the true system, or a maker of environments; default: as the agent's description says.
        **settings: those of :func:`certify` or :func:`certify_on_episodes`; default: those of the present certificate.

    Raises:
        CheckpointError: if the agent cannot be read.
    """
    directory = agent_directory(path)
    agent, envs = Agent.load(directory), dict[str, Any]()
    try:
        before = Certificate.load(directory / CERTIFICATE_FILE)
        same = {"level": before.level} if before.weights == weights_digest(agent.state_dict()) else {}
        settings = {"name": before.agent} | same | settings
        if before.record is not None:
            names = ("episodes", "horizon", "seed", "confidence", "acceptable")
            used = {"used_seeds": before.record.used or ()}  # what was said to be used is used for ever
            settings = {k: getattr(before.record, k) for k in names} | used | _of_changed(before, agent) | settings
            envs = {"envs": before.record.envs} if before.record.kind == "resets" else {}
    except CertificationError:
        settings = {"name": directory.parent.name if directory.name == "agent" else directory.name} | settings
    if env is None:
        factory = described_system(agent.description, trust=True)
        made = None if factory is None else factory([1], 0)
        env = made if isinstance(made, SafetyEnv) else factory
    if env is None or isinstance(env, SafetyEnv):
        certificate = certify(agent, env, **settings)
    else:
        certificate = certify_on_episodes(agent, env, **(envs | settings))
    certificate.save(directory / CERTIFICATE_FILE)
    return certificate


def _of_changed(before: Certificate, agent: Agent) -> dict[str, Any]:
    """For an agent that may have been changed by what its certificate says: another seed, and the old ones as used."""
    record = before.record
    if record is None or before.weights == weights_digest(agent.state_dict()):
        return {}
    return {"seed": record.seed + 1, "used_seeds": [*(record.used or ()), record.seed, *record.seeds()]}


def _root_seed(agent: Agent) -> int:
    """Seed of the agent's own configuration, from which every other purpose of the run is drawn, too."""
    for section in ("config", "training"):
        seed = (agent.description.get(section) or {}).get("seed")
        if type(seed) is int and seed >= 0:
            return seed
    return 20260707


def _used(agent: Agent, more: Sequence[int]) -> list[int] | None:
    """Every seed with which the agent was trained, chosen or tuned; None where nobody says."""
    recorded = agent.description.get("seeds")
    if not isinstance(recorded, list) or not all(type(s) is int for s in recorded):
        return sorted({int(s) for s in more}) or None
    return sorted({*recorded, *(int(s) for s in more)})


def _proved(agent: Agent, name: str, level: float | None, budget: Budget | None) -> Certificate:
    """A certificate with what the weights prove."""
    budget = budget or Budget(seconds=300.0)
    if agent.tolerated_error:
        if level:
            raise ConfigError(f"level: expected 0 of an agent that tolerates errors, since its controller and its filter keep {{B <= 0}}, received {level:g}")
        level = 0.0
    if level is None:
        level = level_that_holds(**_loop(agent), budget=budget)
    label = re.sub(r"[^\w .,()+-]", "_", name)[:80] or "agent"
    layers = {"deterministic": _proof(agent, level, budget)}
    return Certificate(label, weights_digest(agent.state_dict()), configuration_of(agent), level, layers)


def _loop(agent: Agent) -> dict[str, Any]:
    """What the proofs are about."""
    sizes = {"latent_dim": agent.latent_dim, "lipschitz_bound": agent.lipschitz_bound}
    return {"barrier": agent.barrier, "dynamics": agent.dynamics, "policy": agent.policy, **sizes}


def _proof(agent: Agent, level: float, budget: Budget, required: float | None = None) -> Layer:
    """What the weights prove; the error that the agent's run-time monitor tolerates is required to be tolerated."""
    required = agent.tolerated_error if required is None else required
    return deterministic_layer(
        **_loop(agent), level=level, required_error=required, multipliers=_witness(agent), budget=budget
    )


def premise(agent: Agent, *, budget: Budget | None = None) -> float:
    """Error per step that {B <= 0} is proved to tolerate, by the numbers that the agent computes; 0 where it is not kept.

    This is what an agent's run-time monitor compares with: set ``agent.tolerated_error`` to it. It is a
    thousandth smaller than what was found, so that another machine finds it, too, and by what computing a correction of this
    length may round off. Source: none.

    Args:
        agent: frozen agent.
        budget: of each search; 700,000 boxes by default, the same on every machine that bounds them within 15 minutes.

    Example:
        >>> from torchrl_sspl.modules.agent import load
        >>> premise(load("pendulum"), budget=Budget(boxes=1))  # nothing is proved with so little effort
        0.0
    """
    budget = budget or Budget(boxes=700_000)
    layer = _proof(agent, 0.0, budget, required=0.0)
    found = next((s.value for s in layer.statements if s.name in ("float32", "float64")), None)
    if not layer.holds or found is None:
        return 0.0
    system, unit = closed_loop(**_loop(agent)), UNITS[next(agent.barrier.parameters()).dtype]
    rounding: dict[str, Any] = dict(zip(_ROUNDINGS, system.rounding(unit, level=0.0), strict=True))
    low, high = 0.999 * found, _FARTHEST * found
    budget = replace(budget, boxes=min(budget.boxes, _PATIENCE))
    for _ in range(0 if system.chooses else _HALVINGS):  # the Lipschitz constant says too little where the barrier rises slowly
        middle = math.sqrt(low * high)
        if tolerates(system, middle, budget=budget, **rounding).status == "proved":
            low = middle
        else:
            high = middle
    return max(0.0, 0.999 * low - CUT)


def _witness(agent: Agent) -> list[Tensor] | None:
    """Multipliers that travel with the agent, as a witness of its Lipschitz constant."""
    lipschitz = agent.description.get("lipschitz") or {}
    rows = lipschitz.get("multipliers") if isinstance(lipschitz, Mapping) else lipschitz
    if rows is None:
        return None
    plain = isinstance(rows, list) and all(isinstance(r, list) for r in rows)
    if not plain or not all(type(v) in (int, float) and math.isfinite(v) for row in rows for v in row):
        raise CheckpointError(
            "expected the agent's Lipschitz multipliers to be lists of finite numbers; restore agent.json"
        )
    return [torch.tensor(row, dtype=torch.float64) for row in rows]


def _measured(certificate: Certificate, agent: Agent, source: Any, progress: bool) -> Certificate:
    """The certificate with the layers that follow from blocks, drawn until there are enough."""
    source.tolerated = _tolerated(certificate, agent)
    record, blocks = source.record, list[Block]()
    about = certificate.weights, certificate.level, source.tolerated, repr(record)  # which has no blocks yet
    with tqdm(desc="certificate", unit="block", disable=not progress, leave=False) as bar:
        while not record.complete():
            blocks.append(_kept_block(source, len(blocks), about))
            record.blocks.append(blocks[-1].counts)
            bar.update()
    summarise(record, blocks, agent)
    record.check()
    certificate.record = record
    certificate.layers |= _measured_layers(record, certificate, agent)
    return certificate


def _kept_block(source: Any, index: int, about: Any) -> Block:
    """A block of episodes, from the open journal where it has it: each is drawn with a seed of its own."""
    def plain() -> dict[str, Any]:
        block: Block = source(index)
        return vars(block) | {name: vars(getattr(block, name)) for name in ("counts", "least")}

    with journal(None, f"block{index}", about):
        found = kept(plain)
    return Block(**found | {name: Counts(**found[name]) for name in ("counts", "least")})


def _tolerated(certificate: Certificate, agent: Agent) -> float | None:
    """Error above which the proof does not apply: that of the agent's monitor, or what is proved of the computed numbers where it has none."""
    proof = certificate.layers["deterministic"]
    if not proof.holds:
        return None
    return agent.tolerated_error or next((s.value for s in proof.statements if s.name in LOWER_BOUNDS and s.name != TOLERATED), None)


def _measured_layers(record: Record, certificate: Certificate, agent: Agent) -> dict[str, Layer]:
    return {
        "statistical": statistical_layer(record, names_seeds=_used(agent, ()) is not None),
        "run-time": run_time_layer(record, _tolerated(certificate, agent), holds_at(agent, certificate.level), agent.tolerated_error > 0.0),
        "paper": paper_layer(record, agent.lipschitz_bound, chooses=isinstance(agent.policy, ChoosingPolicy)),
    }


class _Stop(Exception):
    """A verification ends with a reason and an exit code."""

    def __init__(self, code: Exit, *lines: str) -> None:
        super().__init__(*lines)
        self.code, self.lines = code, lines


def verify_run(
    name: str | Path,
    *,
    env: SafetyEnv | MakeEnv | None = None,
    measure: bool | None = None,
    trust: bool = False,
    seconds: float = 900.0,
    report: Callable[[str], None] = print,
) -> int:
    """Checks a certificate again: every number and word of it, from the weights and from the same episodes.

    Digest, weights, configuration and every measured statement (which follow from the counts) are compared first, then
    the proofs are found again, then blocks of episodes are measured again, in an order that nobody can foresee, as many
    as 20 s allow (a third of the time, if that is less). What is not checked again is printed as claimed. Source: none.

    Args:
        name: name of a shipped agent, a run directory or the directory of an agent.
        env: the true system, or a maker of environments, where the agent does not say how to build it.
        measure: True: measure all blocks again, whatever time it takes; False: none; default: as above.
        trust: import networks and a system that are not of this library, where the agent names such. That runs code, which could
            print anything: trust whom the agent comes from.
        seconds: time for everything (without ``measure=True``); proofs that are found sooner end sooner.
        report: called with every line that a person should read, the reasons of a failure among them.

    Returns:
        An exit code: 0 if everything was found again, 1 if something is claimed that is not so, 3 if there is no
        certificate or the file is none, 4 if the agent cannot be read, 5 if the time was too short, 6 if all episodes were to be
        measured again and none could be.

    Raises:
        CheckpointError: if there is no such agent. ConfigError: for a time that is negative or NaN.

    Example:
        >>> verify_run("pendulum", measure=False, seconds=3600, report=lambda line: None)  # on a busy machine too
        0
    """
    if not seconds >= 0.0:
        raise ConfigError(f"expected seconds >= 0, received {seconds}")
    directory = agent_directory(name)

    def say(line: str) -> None:
        report(printable(line))  # an agent's own words could steer a terminal

    try:
        with time_limit(math.inf if measure else seconds):
            _verify(directory, env, measure, trust, seconds, say)
        return int(Exit.HOLDS)
    except TimeUp:
        say(f"FAILED {Reason.UNDECIDED.name}: not checked within {seconds:g} s; give it more (seconds)")
        return int(Exit.TIME)
    except _Stop as stop:
        for line in stop.lines:
            say(line)
        return int(stop.code)
    except (*_BROKEN, AttributeError, ArithmeticError, LookupError, MemoryError) as error:
        say(f"FAILED the agent cannot be checked: {type(error).__name__}: {str(error)[:300]}")
        return int(Exit.AGENT)


def _verify(
    directory: Path,
    env: SafetyEnv | MakeEnv | None,
    measure: bool | None,
    trust: bool,
    seconds: float,
    report: Callable[[str], None],
) -> None:
    try:
        claimed = Certificate.load(directory / CERTIFICATE_FILE)
    except CertificationError as error:
        raise _Stop(Exit.MALFORMED, f"FAILED {Reason.SCHEMA_UNKNOWN.name}: {error}") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that weights were changed is said here
            agent = Agent.load(directory, trust=trust)
        _witness(agent)
    except CheckpointError as error:
        raise _Stop(Exit.AGENT, f"FAILED the agent cannot be read: {error}") from error
    began = time.monotonic()
    if agent.tolerated_error and claimed.level:
        _refuse({Reason.LEVEL: f"expected 0, at which its controller and its filter keep the set, found {claimed.level:g}"})
    again = Certificate(claimed.agent, weights_digest(agent.state_dict()), configuration_of(agent), claimed.level, {})
    again.layers["deterministic"] = claimed.layers["deterministic"]  # first what takes no time
    if claimed.record is not None:
        again.layers |= _measured_layers(claimed.record, claimed, agent)
    found = differences(claimed, again, required=agent.tolerated_error) | _history(claimed, agent)
    if agent.of_other_weights:
        found = {Reason.WEIGHTS_CHANGED: "agent.json says what was proved of others"} | found
    _refuse(found)
    budget = Budget(seconds=seconds / 3)

    def proved(boxes: int) -> Layer:
        return _proof(agent, claimed.level, replace(budget, boxes=boxes))

    def compared(layer: Layer) -> dict[Reason, str]:
        again.layers["deterministic"] = layer
        return differences(
            claimed, again, confirm=lambda name, delta: _is_proved(agent, claimed.level, name, delta, budget), repeat=proved, required=agent.tolerated_error,
        )

    # Where a search is said to have given up, as much effort is enough to see that nothing more is claimed.
    given_up = effort(claimed.layers["deterministic"])
    found = compared(proved(given_up)) if given_up else {Reason.UNDECIDED: ""}
    if set(found) == {Reason.UNDECIDED}:
        found = compared(_proof(agent, claimed.level, budget))
    _refuse(found)
    left = math.inf if measure else min(_SAMPLE, seconds / 3, seconds - (time.monotonic() - began))
    unmeasured, blocks = _measured_again(claimed, agent, env, measure, trust, left)
    _print(claimed, agent, unmeasured, blocks, report)
    if measure and not blocks:
        raise _Stop(Exit.UNMEASURED, f"FAILED {Reason.NOT_MEASURED.name}: {unmeasured}")


def _refuse(found: Mapping[Reason, str]) -> None:
    if found:
        code = Exit.TIME if set(found) == {Reason.UNDECIDED} else Exit.REFUSED
        raise _Stop(code, *(f"FAILED {reason.name}: {reason.value} ({detail})" for reason, detail in found.items()))


def _history(claimed: Certificate, agent: Agent) -> dict[Reason, str]:
    """Whether the record names every seed that the agent names, and as many labelled states."""
    if claimed.record is None:
        return {}
    said, labels = claimed.record.sizes["trained_on"], compared_labels(agent, claimed.record)
    if said != labels:
        return {Reason.RECORD_CHANGED: f"trained_on claimed {said}, the agent names {labels} labelled states"}
    named, record = _used(agent, ()), claimed.record.used
    missing = set(named or ()) - set(record or ())
    if missing or (named is not None and record is None):
        return {Reason.RECORD_CHANGED: f"expected the seeds of the training, {len(missing)} are missing"}
    return {}


def _is_proved(agent: Agent, level: float, name: str, delta: float, budget: Budget) -> bool | None:
    """Whether the set is kept with errors of delta, by real numbers or by those of a dtype; None: not decided."""
    system = closed_loop(**_loop(agent))
    rounding = (0.0, 0.0) if name == TOLERATED else system.rounding(UNITS[getattr(torch, name)], level=level)
    of: dict[str, Any] = dict(zip(_ROUNDINGS, rounding, strict=True))
    status = tolerates(system, delta, level=level, every_way=False, budget=budget, **of).status
    if status != "proved" and delta == agent.tolerated_error:  # what is required is looked for in every direction, as when it was issued
        status = tolerates(system, delta, level=level, budget=budget, **of).status
    return {"proved": True, "refuted": False}.get(status)


def _measured_again(
    claimed: Certificate, agent: Agent, env: SafetyEnv | MakeEnv | None, measure: bool | None, trust: bool, seconds: float
) -> tuple[str, int]:
    """Blocks of the same episodes; says what was checked, "" if everything, and how many were measured again."""
    record = claimed.record
    if record is None:
        return "nothing was measured", 0
    if measure is False:
        return "not asked for", 0
    if env is None:
        factory = described_system(agent.description, trust=trust)
        if record.system == "given":
            other = "" if factory is None else ", not the one that the agent names"
            return f"its system was given in code{other}; give it to verify_run(env=...)", 0
        if factory is None:
            return "its system is built by code of its own; --trust runs it", 0
        try:
            env = factory([1], 0)
        except _BROKEN as error:
            return f"its system cannot be built here: {type(error).__name__}: {str(error)[:200]}", 0
        env = env if record.kind == "states" else factory
    kind: Any = StateBlocks if record.kind == "states" else ResetBlocks
    if (record.kind == "states") != isinstance(env, SafetyEnv):
        raise _Stop(Exit.REFUSED, f"FAILED {Reason.RECORD_CHANGED.name}: the episodes are of another kind of system")
    if isinstance(env, SafetyEnv) and record.among != env.among:
        _refuse({Reason.RECORD_CHANGED: f"claimed of states {record.among!r}, the system draws states {env.among!r}"})
    source = kind(agent, env, record, claimed.level, _tolerated(claimed, agent))
    order, began = list(range(len(record.blocks))), time.monotonic()
    random.SystemRandom().shuffle(order)
    blocks: dict[int, Block] = {}
    try:
        for index in order:
            blocks[index] = source(index)
            changes = block_changes(record.blocks[index], blocks[index], record.kind == "resets") or changes_together(record.blocks, blocks)
            if changes:
                _refuse({Reason.RECORD_CHANGED: f"block {index}: {changes}"})
            if (time.monotonic() - began) * (1 + 1 / len(blocks)) > seconds:
                break
    except TimeUp:
        if not blocks:
            raise
    if len(blocks) < len(order):
        return f"{len(blocks)} of {len(order)} blocks of episodes, drawn at random", len(blocks)
    fresh = replace(record, blocks=list(record.blocks), sizes={}, numbers={}, rims=[])
    summarise(fresh, [blocks[k] for k in sorted(blocks)], agent)
    changes = summary_changes(record, fresh, sum(b.close for b in blocks.values()))
    if changes:
        _refuse({Reason.RECORD_CHANGED: changes})
    return "", len(blocks)


def _print(claimed: Certificate, agent: Agent, unmeasured: str, blocks: int, report: Callable[[str], None]) -> None:
    """Every statement, with what was done about it; ``blocks`` were measured again."""
    config = agent.description.get("config")
    system = config.get("env") if isinstance(config, Mapping) else agent.description.get("environment")
    report(f"The set {{B <= s}} has s = {claimed.level:g}; the agent names the system {json.dumps(system, sort_keys=True)}")
    for layer in claimed.layers.values():
        proof = layer.name == "deterministic"
        checked = "checked again" if proof or not unmeasured else f"not checked again ({unmeasured})"
        if layer.name in ("statistical", "run-time") and unmeasured and blocks:
            checked = f"checked again on {unmeasured}"
        report(f"{layer.name:14s} {checked}: {layer.verdict}")
        for s in layer.statements:
            report(line_of(s, proof or not unmeasured))
    if claimed.record is not None:
        limits = 100 * claimed.record.acceptable, 100 * claimed.record.confidence
        report(f"A bound on a risk holds here if it is at most {limits[0]:g} %: the two of the statistical layer together, and that of the run-time layer by itself, with {limits[1]:g} % confidence")
    report(f"OK: the weights are {claimed.weights[:12]}..., and the certificate says what they prove")
    if unmeasured and claimed.record is not None:
        report("What is printed as claimed was not checked again; that its words and bounds follow from its counts was")
    absent = [name for name in ("deterministic", "statistical", "run-time") if name not in claimed.layers]
    if absent:
        report(f"It says nothing of these layers: {', '.join(absent)}")
    open_layers = [layer.name for layer in claimed.layers.values() if not layer.holds]
    if open_layers:
        report(f"What it says is that these layers are not certified: {', '.join(open_layers)}")


if __name__ == "__main__":
    import sys

    for argument in sys.argv[1:]:
        print(json.dumps({argument: {k: v.verdict for k, v in issue(argument).layers.items()}}, indent=1))

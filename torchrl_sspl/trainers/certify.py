"""Certificates of trained agents: issue one, and check one again from the weights."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_sspl.certification.branch_and_bound import Budget
from torchrl_sspl.certification.certificate import (
    Certificate,
    Layer,
    Reason,
    configuration_digest,
    differences,
    weights_digest,
)
from torchrl_sspl.certification.conditions import closed_loop_lipschitz
from torchrl_sspl.certification.layers import (
    Sample,
    deterministic_layer,
    fingerprint,
    level_that_holds,
    paper_layer,
    statistical_layer,
)
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import CertificationError, ConfigError
from torchrl_sspl.functional import covering_radius
from torchrl_sspl.modules.agent import Agent, agent_directory, hosted
from torchrl_sspl.sets import SAFE, UNSAFE
from torchrl_sspl.trainers.episodes import Act, Episodes, random_actions, run_episodes
from torchrl_sspl.trainers.evaluation import encode_states, rollout

CERTIFICATE_FILE = "certificate.json"
_COVERED = 4000  # observations of which a covering radius is computed
#: What a certificate is about; everything else in the description (the certificate's own traces, notes) may change.
_CERTIFIED_KEYS = ("networks", "training", "lipschitz")


def certify(
    agent: Agent,
    env: SafetyEnv | None,
    *,
    name: str = "agent",
    level: float | None = None,
    episodes: int = 3000,
    horizon: int = 200,
    seed: int = 20260707,
    budget: Budget | None = None,
    progress: bool = False,
) -> Certificate:
    r"""Certifies a frozen agent: the set {B <= s} with the largest s <= 0 that is proved to be kept.

    Args:
        agent: frozen agent.
        env: the true system, for the layers that are measured; without one, only what the weights prove.
        name: name of the agent.
        level: s, barrier units; searched for if not given.
        episodes: number of fresh episodes from the set, and of fresh observations of U.
        horizon: steps per episode.
        seed: seed of the fresh data; must not have been used for anything else.
        budget: of each search of the deterministic layer.
        progress: show progress bars.

    Returns:
        The certificate.

    Source: paper Theorem 1; deviation: proved on the whole latent domain, and measured on fresh episodes.

    Example:
        >>> from torchrl_sspl.modules.agent import load
        >>> certify(load("pendulum"), None, name="pendulum").layers["deterministic"].holds
        True
    """
    certificate = _proved(agent, name, level, budget)
    if env is not None:
        sample, conditions = _measure(hosted(agent), env, certificate.level, episodes, horizon, seed, progress)
        _add_measured(certificate, sample, conditions)
    return certificate


def certify_on_episodes(
    agent: Agent,
    make_env: Callable[..., EnvBase],
    *,
    name: str = "agent",
    level: float | None = None,
    episodes: int = 1000,
    horizon: int = 50,
    envs: int = 20,
    seed: int = 20260708,
    used_seeds: Sequence[int] = (),
    budget: Budget | None = None,
    progress: bool = False,
) -> Certificate:
    r"""Certifies a frozen agent for an environment that is known only by being run.

    What the weights prove is the same as with :func:`certify`. What is measured are episodes from the environment's own
    resets: those that start in the set, and one observation of U, the lowest, of every episode that shows any. Episodes are
    drawn until there are enough of both; when to stop depends on their numbers alone, never on what happened in them.

    Args:
        agent: frozen agent.
        make_env: ``(batch_size=[k], seed=...) -> environment`` with ``"pixels"`` and ``"region"``.
        name: name of the agent.
        level: s, barrier units; searched for if not given.
        episodes: number of fresh episodes from the set, and of fresh episodes that show U. At least as many are drawn
            under the policy, and under random actions, and at most three times as many.
        horizon: steps per episode.
        envs: environments stepped together.
        seed: seed of the fresh episodes; must not have been used for anything else.
        used_seeds: seeds with which anything was trained, chosen or tuned.
        budget: of each search of the deterministic layer.
        progress: show progress bars.

    Returns:
        The certificate.

    Source: paper Theorem 1; deviation: as for :func:`certify`.

    Example:
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> from torchrl_sspl.modules.agent import load
        >>> certificate = certify_on_episodes(load("pendulum"), PendulumEnv, episodes=4, horizon=3, envs=4)
        >>> sorted(certificate.layers)
        ['deterministic', 'paper', 'statistical']
    """
    certificate = _proved(agent, name, level, budget)
    env = make_env(batch_size=[envs], seed=seed)
    try:
        label, level = "certificate" if progress else None, certificate.level

        def draw(n: int, act: Act | None = None) -> Episodes:
            return run_episodes(agent, env, n, horizon, act, label=label)

        own = _until(draw, episodes, lambda e: e.barrier[0] <= level)
        at_random = partial(draw, act=random_actions(env, seed + 1))
        chance = _until(at_random, episodes, _shows_unsafe, int(_shows_unsafe(own).sum()))
    finally:
        env.close()
    sample, conditions = _measure_episodes(hosted(agent), own, chance, certificate.level, seed, used_seeds)
    _add_measured(certificate, sample, conditions)
    return certificate


def _shows_unsafe(episodes: Episodes) -> Tensor:
    return ((episodes.region == UNSAFE) & episodes.alive).any(0)


def _until(
    draw: Callable[[int], Episodes], n: int, counted: Callable[[Episodes], Tensor], already: int = 0
) -> Episodes:
    """Episodes, at least n and at most 3 n, until n are counted; where none is, n."""
    found = draw(n)
    while 0 < int(counted(found).sum()) < n - already and found.alive.shape[1] < 3 * n:
        found = found.joined(draw(max(1, n // 4)))
    return found


def _proved(agent: Agent, name: str, level: float | None, budget: Budget | None) -> Certificate:
    """A certificate with what the weights prove."""
    budget = budget or Budget(seconds=300.0)
    parts = (agent.barrier, agent.dynamics, agent.policy)
    bound, p = agent.lipschitz_bound, agent.latent_dim
    if level is None:
        level = level_that_holds(*parts, latent_dim=p, lipschitz_bound=bound, budget=budget)
    witness = agent.description.get("lipschitz", {}).get("multipliers")
    proof = deterministic_layer(
        *parts,
        latent_dim=p,
        lipschitz_bound=bound,
        level=level,
        multipliers=None if witness is None else [torch.tensor(m) for m in witness],
        budget=budget,
    )
    certified = {k: agent.description.get(k) for k in _CERTIFIED_KEYS} | {"lipschitz_bound": bound}
    return Certificate(
        name, weights_digest(agent.state_dict()), configuration_digest(certified), level, {"deterministic": proof}
    )


def _add_measured(certificate: Certificate, sample: Sample, conditions: Layer) -> None:
    proof = certificate.layers["deterministic"]
    tolerated = next((s.value for s in proof.statements if s.name == "tolerated error"), None)
    certificate.layers["statistical"] = statistical_layer(sample, level=certificate.level, tolerated_error=tolerated)
    certificate.layers["paper"] = conditions


@torch.no_grad()
def _measure(
    agent: Agent, env: SafetyEnv, level: float, episodes: int, horizon: int, seed: int, progress: bool
) -> tuple[Sample, Layer]:
    """Fresh episodes and observations, and the paper's conditions on them."""
    generator = torch.Generator().manual_seed(seed)
    training = agent.description.get("training", {})
    used = [training.get("seed", -1), training.get("evaluation", {}).get("seed", -1)]

    def draw(n: int, keep: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """Uniform states for whose latents a condition holds, and these latents."""
        states, latents, count = [], [], 0
        for tried in range(1, 61):
            state = env.sample_states(2 * n, generator, region=env.state_space)
            latent = encode_states(agent, env, state)
            kept = keep(latent)
            states.append(state[kept])
            latents.append(latent[kept])
            count += int(kept.sum())
            if count >= n or (tried == 10 and count == 0):  # of 20 n states none: the set is as good as empty
                break
        return torch.cat(states)[:n], torch.cat(latents)[:n]

    start, inside = draw(episodes, lambda z: agent.barrier(z)[:, 0] <= level)
    unsafe_state = env.sample_states(episodes, generator, region=env.unsafe_set)
    safe_state = env.sample_states(episodes, generator, region=env.safe_set)
    unsafe_latent = encode_states(agent, env, unsafe_state)
    safe_latent = encode_states(agent, env, safe_state)
    unsafe, safe = (agent.barrier(z)[:, 0] for z in (unsafe_latent, safe_latent))
    if len(start):
        run = rollout(agent, env, start, horizon, progress=progress, label="fresh episodes")
        error, barrier = run.prediction_error, run.barrier
    else:
        error, barrier = torch.zeros(1, 0), torch.zeros(2, 0)
    latent = torch.cat([inside, unsafe_latent, safe_latent])
    sample = Sample(
        error.amax(0) if error.shape[1] else torch.zeros(0),
        (barrier > level).any(0),
        unsafe,
        latent,
        horizon,
        seed,
        used_seeds=used,
        fingerprints=fingerprint(torch.cat([start, unsafe_state, safe_state])),
        rims=_rims(error, barrier[:-1], level),
    )
    reference = encode_states(agent, env, env.sample_states(4 * episodes, generator=generator))
    return sample, _conditions(agent, inside, safe, unsafe, latent, reference, error)


@torch.no_grad()
def _measure_episodes(
    agent: Agent, own: Episodes, chance: Episodes, level: float, seed: int, used_seeds: Sequence[int]
) -> tuple[Sample, Layer]:
    """The same of episodes from an environment's own resets, of which some steps lie behind their end."""
    start = own.barrier[0] <= level
    alive, error = own.alive[:, start], own.prediction_error[:, start]
    barrier = torch.where(alive, own.barrier[:, start], -math.inf)  # behind the end nothing counts
    error = torch.where(alive[1:], error, 0.0)
    both = {k: torch.cat([getattr(own, k), getattr(chance, k)], 1) for k in ("barrier", "region", "alive", "latent")}
    shown = (both["region"] == UNSAFE) & both["alive"]
    lowest = torch.where(shown, both["barrier"], math.inf).amin(0)
    seen = own.latent[own.alive]
    generator = torch.Generator().manual_seed(seed)

    def some(rows: Tensor) -> Tensor:  # the covering radius compares all pairs
        return rows[torch.randperm(len(rows), generator=generator)[:_COVERED]]

    sample = Sample(
        error.amax(0),
        (barrier > level).any(0),
        lowest[shown.any(0)],
        both["latent"][both["alive"]],
        max(int(own.alive.sum(0).max()) - 1, 0),  # the environment may end them before
        seed,
        used_seeds=used_seeds,
        rims=_rims(error, barrier[:-1], level),
        starts="from those of the environment's resets that lie in the set",
    )
    safe = both["barrier"][(both["region"] == SAFE) & both["alive"]]
    inside = seen[own.barrier[own.alive] <= level]
    reference = some(chance.latent[chance.alive])
    return sample, _conditions(agent, inside, safe, both["barrier"][shown], some(seen), reference, error)


def _rims(error: Tensor, before: Tensor, level: float) -> list[tuple[str, int, float, float]]:
    """Errors of steps, by where in the set they began."""
    rims = []
    for name, lower, upper in (
        ("deep in the set", -math.inf, level - 0.3),
        ("half way", level - 0.3, level - 0.1),
        ("at the rim", level - 0.1, level),
    ):
        here = error[(before > lower) & (before <= upper)].sort().values
        if len(here):
            rank = min(len(here) - 1, math.ceil(0.999 * len(here)) - 1)
            rims.append((name, len(here), float(here[rank]), float(here[-1])))
    return rims


def _conditions(
    agent: Agent, inside: Tensor, safe: Tensor, unsafe: Tensor, latent: Tensor, reference: Tensor, error: Tensor
) -> Layer:
    """The paper's conditions on fresh observations."""
    following = agent.barrier(agent.dynamics(inside, agent.policy(inside)))[:, 0]
    try:
        constant = closed_loop_lipschitz(agent.dynamics, agent.policy)
    except ConfigError:
        constant = math.inf
    return paper_layer(
        safe=safe,
        unsafe=unsafe,
        following=following,
        lipschitz_bound=agent.lipschitz_bound,
        covering_radius=covering_radius(latent, reference),
        dynamics_error=float(error.max()) if error.numel() else math.nan,
        closed_loop_constant=constant,
    )


def verify_run(name: str | Path, *, env: SafetyEnv | None = None, report: Callable[[str], None] = print) -> int:
    """Checks a certificate again: hashes, and everything that the weights prove.

    Args:
        name: name of a shipped agent, a run directory or the directory of an agent.
        env: the true system, to measure the statistical layer again with the same seed too.
        report: called with every line that a person should read.

    Returns:
        0 if everything was found again, 1 if not; the reasons are reported.

    Raises:
        CertificationError: if there is no certificate.
        CheckpointError: if the agent cannot be read.

    Source: none.

    Example:
        >>> verify_run("pendulum", report=lambda line: None)
        0
    """
    directory = agent_directory(name)
    if not (directory / CERTIFICATE_FILE).is_file():
        raise CertificationError(
            f"expected {CERTIFICATE_FILE} beside the agent in '{directory}', found none; certify(agent, env) issues one"
        )
    try:
        claimed = Certificate.load(directory / CERTIFICATE_FILE)
    except CertificationError as error:
        report(f"FAILED {Reason.SCHEMA_UNKNOWN.name}: {error}")
        return 1
    again = certify(Agent.load(directory), env, name=claimed.agent, level=claimed.level)
    layers = ["deterministic"] + (["statistical", "paper"] if env is not None else [])
    found = differences(claimed, again, layers=layers)
    for reason, detail in found.items():
        report(f"FAILED {reason.name}: {reason.value} ({detail})")
    if found:
        return 1
    for layer in claimed.layers.values():
        checked = "checked again" if layer.name in layers else "not checked again"
        report(f"{layer.name:14s} {checked}: {layer.verdict}")
        for s in layer.statements:
            value = "" if s.value is None else f" {s.value:.4g} {s.unit}"
            sample = (
                ""
                if s.n is None
                else f" (n = {s.n:,}" + (")" if s.confidence is None else f", {100 * s.confidence:g} %)")
            )
            status = "FAILS" if s.holds is False else s.kind
            missed = "" if s.misses_by is None else f", misses by {s.misses_by:.3g} {s.unit}"
            report(f"    {status:9s} {s.text}{value}{sample}{missed}" + (f" [{s.detail}]" if s.detail else ""))
    report(f"OK: the weights are {claimed.weights[:12]}..., and the certificate of '{claimed.agent}' says what they prove")
    open_layers = [layer.name for layer in claimed.layers.values() if not layer.holds]
    if open_layers:
        report(f"What it says is that these layers are not certified: {', '.join(open_layers)}")
    return 0

r"""The three layers of a certificate: the paper's conditions, what the weights prove, what fresh episodes show."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_sspl.certification.branch_and_bound import SLACK, Budget
from torchrl_sspl.certification.certificate import ASSUMED, MEASURED, PROVED, Layer, Reason, Statement
from torchrl_sspl.certification.conditions import (
    closed_loop,
    decide_domain,
    decide_invariance,
    decide_vacuity,
    evaluation_rounding,
    largest_error,
    search_level,
)
from torchrl_sspl.certification.statistics import clopper_pearson
from torchrl_sspl.errors import ConfigError, NonFiniteError, ShapeError
from torchrl_sspl.lipschitz import prove_lipschitz


def deterministic_layer(
    barrier: nn.Module,
    dynamics: nn.Module,
    policy: nn.Module,
    *,
    latent_dim: int,
    lipschitz_bound: float,
    level: float = 0.0,
    required_error: float = 0.0,
    multipliers: Sequence[Tensor] | None = None,
    low: float | Tensor = -1.0,
    high: float | Tensor = 1.0,
    tolerance: float = 1e-3,
    budget: Budget | None = None,
) -> Layer:
    r"""What follows from the weights alone, on the whole latent domain.

    Args:
        barrier: plain network, p inputs, 1 output.
        dynamics: see :func:`~torchrl_sspl.certification.conditions.closed_loop`.
        policy: see there.
        latent_dim: p.
        lipschitz_bound: claimed Lipschitz constant of the barrier.
        level: s <= 0, barrier units.
        required_error: error of the latent dynamics that the set has to tolerate at least, latent units.
        multipliers: witness of the Lipschitz constant; searched for if not given.
        low: lower corner of the domain.
        high: upper corner.
        tolerance: accuracy of the tolerated error, barrier units.
        budget: of each search.

    Returns:
        The layer; nothing is raised for networks that are not certified.

    Source: paper Theorem 1 and Lemma 2; deviations: the set instead of everywhere, the whole domain instead of samples,
    a proof instead of the sign of a log-determinant.

    Example:
        >>> step = nn.Sequential(nn.Linear(2, 1, bias=False))  # z+ = z / 2
        >>> _ = step[0].weight.data.copy_(torch.tensor([[0.5, 0.0]]))
        >>> barrier = nn.Sequential(nn.Linear(1, 2), nn.ReLU(), nn.Linear(2, 1))  # |z| - 1/2
        >>> _ = barrier.load_state_dict({"0.weight": torch.tensor([[1.0], [-1.0]]), "0.bias": torch.zeros(2),
        ...                              "2.weight": torch.ones(1, 2), "2.bias": torch.tensor([-0.5])})
        >>> layer = deterministic_layer(barrier, step, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=2.0)
        >>> layer.holds, round(layer["tolerated error"].value, 2)
        (True, 0.12)
    """
    layer = Layer("deterministic")

    def state(name: str, text: str, holds: bool, reason: Reason | None = None, **more: Any) -> None:
        code = "" if holds or reason is None else reason.name
        layer.statements.append(Statement(name, text, PROVED, holds, reason=code, **more))

    if level > 0:
        state("level", "s <= 0", False, Reason.LEVEL, value=level, unit="barrier", misses_by=level)
        return layer
    try:
        system = closed_loop(
            barrier, dynamics, policy, latent_dim=latent_dim, lipschitz_bound=lipschitz_bound, low=low, high=high
        )
    except NonFiniteError as error:
        state("networks", "all weights are finite", False, Reason.NOT_FINITE, detail=str(error))
        return layer
    except (ConfigError, ShapeError) as error:
        state(
            "networks", "bounds can be propagated through the networks", False, Reason.NOT_UNDERSTOOD, detail=str(error)
        )
        return layer

    text = f"B is {lipschitz_bound:g}-Lipschitz (exact arithmetic on the deployed weights)"
    proof = prove_lipschitz(barrier, lipschitz_bound, multipliers=multipliers)
    state(
        "Lipschitz constant",
        text,
        proof.proved,
        Reason.LIPSCHITZ_NOT_PROVED,
        value=lipschitz_bound,
        unit="barrier / latent",
        detail=proof.reason,
    )
    if not proof.proved:
        return layer  # the searches below use the constant

    domain = decide_domain(system, budget=budget)
    reason = Reason.LEAVES_DOMAIN if domain.status == "refuted" else Reason.UNDECIDED
    miss = None if domain.status != "refuted" else domain.lower
    state(
        "domain",
        "d(z, pi(z)) stays in the latent domain",
        domain.status == "proved",
        reason,
        unit="latent",
        misses_by=miss,
    )

    vacuity = decide_vacuity(system, level=level, budget=budget)
    reasons = {"empty": Reason.EMPTY, "everything": Reason.EVERYTHING, "undecided": Reason.VACUITY_UNDECIDED}
    neither = vacuity.status == "neither"
    state("not vacuous", "{B <= s} is neither empty nor the whole domain", neither, reasons.get(vacuity.status))
    if vacuity.status == "empty":
        return layer

    kept = decide_invariance(system, level=level, budget=budget)
    reason = Reason.NOT_INVARIANT if kept.status == "refuted" else Reason.UNDECIDED
    detail = f"{kept.boxes} boxes"
    if kept.status == "refuted" and kept.witness is not None:
        detail = f"counterexample z = {[round(float(v), 6) for v in kept.witness]}"
    elif kept.status == "undecided":
        detail += f", {kept.remaining_volume:.2g} of the domain is left"
    state(
        "invariance",
        "B(z) <= s implies B(d(z, pi(z))) <= s, for every z of the domain",
        kept.status == "proved",
        reason,
        unit="barrier",
        misses_by=max(kept.lower, 0.0) if kept.status == "refuted" else None,
        detail=detail,
    )

    if kept.status == "proved":
        found = largest_error(system, level=level, tolerance=tolerance, budget=budget)
        enough = found.delta >= required_error and found.delta > 0.0
        state(
            "tolerated error",
            "the same, whatever error of at most this is added to d(z, pi(z))",
            enough,
            Reason.MARGIN_TOO_SMALL,
            value=found.delta,
            unit="latent",
            misses_by=None if enough else max(required_error - found.delta, 0.0),
            detail=f"for errors above {found.refuted_above:.4g} the argument fails",
        )
    rounding = evaluation_rounding(system)
    state(
        "rounding",
        "rounding of the float64 evaluation is far below the slack by which bounds decide",
        rounding < 0.1 * SLACK,
        Reason.UNDECIDED,
        value=rounding,
        unit="barrier",
        detail=f"slack {SLACK:g}",
    )
    return layer


def level_that_holds(
    barrier: nn.Module,
    dynamics: nn.Module,
    policy: nn.Module,
    *,
    latent_dim: int,
    lipschitz_bound: float,
    levels: Sequence[float] = (0.0, -0.01, -0.02, -0.05, -0.1, -0.15, -0.2, -0.3),
    budget: Budget | None = None,
) -> float:
    r"""The largest of several levels whose set is kept; the first of them if none is.

    Args:
        barrier: plain network.
        dynamics: see :func:`~torchrl_sspl.certification.conditions.closed_loop`.
        policy: see there.
        latent_dim: p.
        lipschitz_bound: proved Lipschitz constant of the barrier.
        levels: in the order in which they are tried.
        budget: of each.

    Returns:
        The level, barrier units.

    Source: none.

    Example:
        >>> step = nn.Sequential(nn.Linear(2, 1, bias=False))  # z+ = z / 2
        >>> _ = step[0].weight.data.copy_(torch.tensor([[0.5, 0.0]]))
        >>> barrier = nn.Sequential(nn.Linear(1, 2), nn.ReLU(), nn.Linear(2, 1))  # |z| - 1/2
        >>> _ = barrier.load_state_dict({"0.weight": torch.tensor([[1.0], [-1.0]]), "0.bias": torch.zeros(2),
        ...                              "2.weight": torch.ones(1, 2), "2.bias": torch.tensor([-0.5])})
        >>> level_that_holds(barrier, step, nn.Sequential(nn.Linear(1, 1)), latent_dim=1, lipschitz_bound=2.0)
        0.0
    """
    try:
        system = closed_loop(barrier, dynamics, policy, latent_dim=latent_dim, lipschitz_bound=lipschitz_bound)
    except (ConfigError, ShapeError, NonFiniteError):
        return levels[0]
    found = search_level(system, levels=levels, budget=budget)
    return levels[0] if found is None else found[0]


@dataclass
class Sample:
    """Fresh measurements of a frozen agent.

    Attributes:
        error: ``(n,)`` largest error of the latent dynamics in each episode from the set, latent units.
        left: ``(n,)`` bool, whether the episode left the set.
        unsafe: ``(m,)`` barrier values of fresh unsafe observations.
        latent: ``(k, p)`` latents of fresh observations, to see that they lie in the domain.
        horizon: steps per episode.
        seed: seed with which they were drawn.
        used_seeds: seeds with which anything was trained, chosen or tuned.
        fingerprints: of the labelled observations (see :func:`fingerprint`), to compare with those trained on.
        trained_on: fingerprints of the observations that were trained on, where they are at hand.
        rims: rows of a table: name of a part of the set, n steps, 99.9 % and largest error there.
        starts: where the episodes began.
    """

    error: Tensor
    left: Tensor
    unsafe: Tensor
    latent: Tensor
    horizon: int
    seed: int
    used_seeds: Sequence[int] = ()
    fingerprints: Sequence[str] = ()
    trained_on: Sequence[str] = ()
    rims: Sequence[tuple[str, int, float, float]] = ()
    starts: str = "uniformly in the set"


def fingerprint(observations: Tensor) -> list[str]:
    """A short hash of each observation, to find out whether two data sets share any.

    Args:
        observations: ``(n, ...)``.

    Returns:
        n hexadecimal strings.

    Source: none.

    Example:
        >>> a, b = fingerprint(torch.tensor([[1, 2], [1, 3]], dtype=torch.uint8))
        >>> a == b
        False
    """
    rows = observations.detach().cpu().contiguous().reshape(len(observations), -1).view(torch.uint8).numpy()
    return [hashlib.blake2b(row.tobytes(), digest_size=8).hexdigest() for row in rows]


def statistical_layer(
    sample: Sample,
    *,
    level: float = 0.0,
    tolerated_error: float | None = None,
    confidence: float = 0.95,
    acceptable: float = 0.01,
    low: float = -1.0,
    high: float = 1.0,
) -> Layer:
    r"""What holds for fresh episodes, with which confidence.

    The unit is the episode: steps of one episode are not independent. With k events among n,
    :math:`P \le \operatorname{Beta}^{-1}(c; k + 1, n - k)`; two statements together hold with the sum of their risks,
    each at confidence :math:`1 - (1 - c) / 2`.

    Args:
        sample: fresh measurements, drawn after the networks were frozen.
        level: s, barrier units.
        tolerated_error: proved, latent units; None where nothing was proved.
        confidence: c.
        acceptable: risk above which the layer does not hold, per episode and per unsafe observation together.
        low: lower end of the domain.
        high: upper end.

    Returns:
        The layer.

    Raises:
        ConfigError: if confidence or the acceptable risk is not between 0 and 1.

    Source: Clopper and Pearson (1934); the paper has no statistical statement.

    Example:
        >>> sample = Sample(torch.zeros(3000), torch.zeros(3000, dtype=torch.bool), torch.ones(3000), torch.zeros(9, 2), 200, 7)
        >>> layer = statistical_layer(sample, tolerated_error=0.1)
        >>> layer.holds, round(layer["risk"].value, 4)
        (True, 0.0025)
    """
    if not 0.0 < confidence < 1.0 or not 0.0 < acceptable < 1.0:
        raise ConfigError(f"expected confidence and acceptable in (0, 1), received {confidence} and {acceptable}")
    layer = Layer("statistical")
    add = layer.statements.append
    measured = [t.double() for t in (sample.error, sample.unsafe, sample.latent)]
    n, m = len(sample.error), len(sample.unsafe)

    def fails(name: str, text: str, reason: Reason, **more: Any) -> Layer:
        add(Statement(name, text, MEASURED, False, reason=reason.name, **more))
        return layer

    if not n or not m:
        return fails("sample", "fresh episodes and unsafe observations were measured", Reason.NOT_MEASURED, n=min(n, m))
    if not all(bool(t.isfinite().all()) for t in measured):
        return fails("sample", "all measured values are finite", Reason.NOT_FINITE, n=n)
    if sample.seed in sample.used_seeds or len(set(sample.fingerprints)) < len(sample.fingerprints):
        return fails("fresh", "the episodes are fresh and all different", Reason.CALIBRATION_REUSED, n=n)
    if set(sample.fingerprints) & set(sample.trained_on):
        return fails("fresh", "no labelled observation was trained on", Reason.LABELS_LEAKED, n=m)

    beyond = (
        (sample.latent.double() - 0.5 * (high + low)).abs().amax() - 0.5 * (high - low)
        if sample.latent.numel()
        else None
    )
    inside_domain = beyond is None or float(beyond) <= 0.0
    add(
        Statement(
            "encoder",
            "the latents of fresh observations lie in the domain",
            MEASURED,
            inside_domain,
            n=len(sample.latent),
            unit="latent",
            reason="" if inside_domain else Reason.OUTSIDE_DOMAIN.name,
            misses_by=None if inside_domain or beyond is None else float(beyond),
        )
    )
    each = 1.0 - 0.5 * (1.0 - confidence)
    left, aliased = int(sample.left.sum()), int((sample.unsafe <= level).sum())
    risk_left, risk_alias = _upper(left, n, each), _upper(aliased, m, each)
    add(
        Statement(
            "episodes",
            f"episodes of {sample.horizon} steps from {{B <= s}} that leave it: {left} of {n}; at most",
            MEASURED,
            risk_left <= acceptable,
            risk_left,
            "share",
            n,
            each,
            "" if risk_left <= acceptable else _why(left, n, acceptable, each, Reason.EPISODES_LEAVE),
            max(risk_left - acceptable, 0.0) or None,
        )
    )
    add(
        Statement(
            "unsafe observations",
            f"unsafe observations with B <= s: {aliased} of {m}; at most",
            MEASURED,
            risk_alias <= acceptable,
            risk_alias,
            "share",
            m,
            each,
            "" if risk_alias <= acceptable else _why(aliased, m, acceptable, each, Reason.UNSAFE_INSIDE),
            max(risk_alias - acceptable, 0.0) or None,
        )
    )
    total = risk_left + risk_alias
    both = "" if total <= acceptable or any(s.reason for s in layer.statements) else Reason.TOO_FEW.name
    add(
        Statement(
            "risk",
            "either of the two, by the union bound, at most",
            MEASURED,
            total <= acceptable,
            total,
            "share",
            min(n, m),
            confidence,
            both,
            max(total - acceptable, 0.0) or None,
        )
    )
    add(_theorem(sample, tolerated_error, confidence))
    for name, steps, high_quantile, largest in sample.rims:
        add(
            Statement(
                f"error {name}",
                "99.9 % of the errors of steps there are at most",
                MEASURED,
                True,
                high_quantile,
                "latent",
                steps,
                None,
                detail=f"largest {largest:.4g}",
            )
        )
    for name, text in (
        ("starts", f"episodes start as the measured ones did: {sample.starts}"),
        ("system", "camera, physics and appearance stay as they were"),
    ):
        add(Statement(name, text, ASSUMED, None))
    return layer


def _theorem(sample: Sample, tolerated_error: float | None, confidence: float) -> Statement:
    """Whether the deterministic statement carries over to real episodes: it does where errors are tolerated."""
    n = len(sample.error)
    name = "errors tolerated"
    if tolerated_error is None or tolerated_error <= 0:
        return Statement(
            name, "no error is proved to be tolerated, so the proof says nothing about episodes", ASSUMED, None, n=n
        )
    exceed = int((sample.error > tolerated_error).sum())
    worst = float(sample.error.double().quantile(0.999))
    # A remark, not a requirement: invariance of the episodes is measured directly above.
    return Statement(
        name,
        f"episodes with an error above the tolerated one of {tolerated_error:.3g}: {exceed} of {n}; at most",
        ASSUMED,
        None,
        _upper(exceed, n, confidence),
        "share",
        n,
        confidence,
        detail=("in all other episodes the proof applies; " if exceed < n else "the proof alone covers no episode: ")
        + f"99.9 % of the episodes' errors are at most {worst:.3g} latent, "
        + (
            f"{worst - tolerated_error:.3g} more than is tolerated" if worst > tolerated_error else "which is tolerated"
        ),
    )


def _upper(events: int, n: int, confidence: float) -> float:
    """One-sided upper bound."""
    return (
        1.0
        if events == n
        else clopper_pearson(events, n, confidence=confidence if events == 0 else 2 * confidence - 1)[1]
    )


def _why(events: int, n: int, acceptable: float, confidence: float, reason: Reason) -> str:
    """No event among so few that even none proves little is no fault of the agent."""
    return Reason.TOO_FEW.name if events == 0 and _upper(0, n, confidence) > acceptable else reason.name


def paper_layer(
    *,
    safe: Tensor,
    unsafe: Tensor,
    following: Tensor,
    lipschitz_bound: float,
    covering_radius: float,
    dynamics_error: float,
    closed_loop_constant: float,
) -> Layer:
    r"""The paper's conditions on held-out samples, with its margins, and with those that its proof would need.

    .. math:: \psi = L_B \bar\epsilon, \; \eta = L_B \delta; \quad
        q_1 = B(z) + \psi \le 0 \;(S), \quad q_2 = -B(z) + \psi \le 0 \;(U), \quad
        q_3 = B(d(z, \pi(z))) + \psi_3 + \eta \le 0 \;(B \le 0)

    Args:
        safe: ``(n,)`` barrier values of held-out observations of S.
        unsafe: ``(m,)`` of U.
        following: ``(k,)`` values of :math:`B(d(z, \pi(z)))` for held-out latents with B <= 0.
        lipschitz_bound: :math:`L_B`.
        covering_radius: :math:`\bar\epsilon`, latent units.
        dynamics_error: :math:`\delta`, latent units.
        closed_loop_constant: certified Lipschitz constant of :math:`z \mapsto d(z, \pi(z))`.

    Returns:
        The layer.

    Source: paper eq. (3)-(5) and Theorem 1; deviations: q1, q2, q3 are asked where they make sense (S, U, the set), and
    :math:`\psi_3` is given in both forms.

    Example:
        >>> layer = paper_layer(safe=torch.tensor([-1.0]), unsafe=torch.tensor([1.0]), following=torch.tensor([-0.1]),
        ...                     lipschitz_bound=2.0, covering_radius=0.1, dynamics_error=0.01, closed_loop_constant=1.5)
        >>> layer.holds, layer.verdict
        (False, "not certified: q3 (a condition does not hold on the held-out samples with the paper's margins, misses by 0.12 barrier)")
    """
    layer = Layer("paper")
    psi, eta = lipschitz_bound * covering_radius, lipschitz_bound * dynamics_error
    psi3 = psi * (closed_loop_constant + 1.0)
    for name, text, value in (
        ("safety margin", "psi* = L_B eps-bar, sampled", psi),
        ("dynamics margin", "eta* = L_B delta, sampled", eta),
        (
            "safety margin of q3",
            "psi* with the Lipschitz constant that the proof of q3 needs, L_B (L_cl + 1) eps-bar",
            psi3,
        ),
    ):
        layer.statements.append(Statement(name, text, ASSUMED, None, value, "barrier"))

    def condition(name: str, text: str, excess: Tensor) -> None:
        n = len(excess)
        if not n or not bool(excess.isfinite().all()):
            reason = Reason.NOT_FINITE if n else Reason.NOT_MEASURED
            layer.statements.append(Statement(name, text, MEASURED, False, n=n, reason=reason.name))
            return
        worst, met = float(excess.max()), 100 * float((excess <= 0).double().mean())
        layer.statements.append(
            Statement(
                name,
                f"{text}: worst excess",
                MEASURED,
                worst <= 0,
                worst,
                "barrier",
                n,
                reason="" if worst <= 0 else Reason.CONDITION_FAILS.name,
                misses_by=worst if worst > 0 else None,
                detail=f"holds on {met:.4g} % of the samples",
            )
        )

    condition("q1", "B + psi* <= 0 on held-out observations of S", safe.double() + psi)
    condition("q2", "-B + psi* <= 0 on held-out observations of U", psi - unsafe.double())
    condition("q3", "B(d(z, pi(z))) + psi* + eta* <= 0 on {B <= 0}", following.double() + psi + eta)
    condition(
        "q3 as its proof needs it", "the same with the margin that the proof needs", following.double() + psi3 + eta
    )
    return layer

"""What fresh episodes show: exact confidence bounds, and the layers of a certificate that follow from a record."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_sspl.certification.certificate import ASSUMED, MEASURED, REPORTED, Layer, Reason
from torchrl_sspl.certification.record import REPEATED, Counts, Record
from torchrl_sspl.certification.rounding import down
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.seeds import drawn_for, used_before

_QUANTILE = 0.99  # share of the episodes whose largest errors are bounded


def clopper_pearson(events: int, n: int, *, confidence: float = 0.95) -> tuple[float, float]:
    r"""Exact confidence interval of a share from independent trials, lower and upper bound.

    .. math:: \left[ \operatorname{Beta}^{-1}(a; k, n - k + 1), \operatorname{Beta}^{-1}(1 - a; k + 1, n - k) \right]

    with :math:`a = (1 - c) / 2`, or :math:`a = 1 - c` on the one side that is left when no (or every) trial was an
    event: 0 of 3000 gives an upper bound of 0.1 % at 95 %. Read either bound by itself: it holds with confidence c at
    least. Both at once may hold with less, since what is found decides on a.

    Args:
        events: k, number of events, 0 <= k <= n, else ``ConfigError``.
        n: number of trials, at least one.
        confidence: c in (0, 1).

    Source: Clopper and Pearson (1934).

    Example:
        >>> lower, upper = clopper_pearson(0, 1000)
        >>> lower, round(upper, 4)
        (0.0, 0.003)
    """
    if not 0 <= events <= n or n < 1 or not 0.0 < confidence < 1.0:
        raise ConfigError(
            f"expected 0 <= events <= n with n >= 1 and 0 < confidence < 1, received events={events}, n={n}, "
            f"confidence={confidence}"
        )
    from scipy.stats import beta

    tail = 1.0 - confidence
    if 0 < events < n:
        tail /= 2.0
    lower = 0.0 if events == 0 else float(beta.ppf(tail, events, n - events + 1))
    upper = 1.0 if events == n else float(beta.ppf(1.0 - tail, events + 1, n - events))
    return lower, upper


def share_upper(events: int, n: int, confidence: float) -> float:
    r"""One-sided exact upper bound :math:`P \le \operatorname{Beta}^{-1}(c; k + 1, n - k)` of a share, rounded upward.

    Of k events in n independent trials, with confidence c; 1 without any trial. Source: Clopper and Pearson (1934).
    """
    if n == 0 or events == n:
        return 1.0
    if not 0 <= events < n or not 0.0 < confidence < 1.0:
        raise ConfigError(f"expected 0 <= events <= n and a confidence in (0, 1), received {events}, {n}, {confidence}")
    from scipy.stats import beta

    # The incomplete beta function is good to some 1e-13: what it may be wrong by is added.
    return min(1.0, float(beta.ppf(confidence, events + 1, n - events)) * (1.0 + 1e-9))


def quantile_rank(n: int, share: float, confidence: float) -> int | None:
    r"""Rank, from 1, whose order statistic bounds a quantile of any distribution from above; None if n is too small.

    The smallest r with :math:`P(\operatorname{Bin}(n, q) \le r - 1) \ge c`: with confidence c at least a share q of the
    distribution is at most the r-th smallest of n independent values.

    Source: David and Nagaraja, Order Statistics (2003), section 7.1.

    Example:
        >>> quantile_rank(299, 0.99, 0.95), quantile_rank(298, 0.99, 0.95)
        (299, None)
    """
    from scipy.stats import binom

    if n < 1 or 1.0 - share**n < confidence:
        return None
    rank = int(binom.ppf(confidence, n, share)) + 1
    while rank > 1 and binom.cdf(rank - 2, n, share) >= confidence:
        rank -= 1
    return min(rank, n)


def fingerprint(rows: Tensor, *, grid: float | None = None) -> list[str]:
    """A hexadecimal hash of each row in full precision, to find out whether two data sets share any.

    Values are rounded to multiples of the grid before, where the last digits of a computation may differ.

    Example:
        >>> a, b = fingerprint(torch.tensor([[1, 2], [1, 3]], dtype=torch.uint8))
        >>> a == b
        False
    """
    if not len(rows):
        return []
    if grid is not None:
        rows = (rows.double() / grid).round()
    plain = (rows + 0 if rows.is_floating_point() else rows).detach().cpu().contiguous()  # -0.0 is 0.0
    flat = plain.reshape(len(rows), -1).view(torch.uint8).numpy()
    return [hashlib.blake2b(row.tobytes(), digest_size=16).hexdigest() for row in flat]


def statistical_layer(record: Record, *, names_seeds: bool = True) -> Layer:
    r"""What holds for fresh episodes, with which confidence; every word and number follows from the record.

    The unit is the episode: steps of one are not independent. An episode that leaves the set, enters U, shows an
    observation of U with B <= s or gives no number is one event; with k events among n independent episodes :math:`P
    \le \operatorname{Beta}^{-1}(c'; k + 1, n - k)`. Observations of U have a bound of their own. Both hold at once with
    confidence c, as each has :math:`c' = 1 - (1 - c) / 2`; a share of episodes and a share of observations are never
    added.

    Args:
        record: how the episodes were drawn, and what was counted.
        names_seeds: whether the agent itself names the seeds of its training; those that the record alone names cannot be checked.

    Source: Clopper and Pearson (1934); the paper has no statistical statement.

    Example:
        >>> counts = Counts(3000, 600000, 0, 0, 0, 0, 0, 0, 0, 3000, 0, 9000, 0)
        >>> layer = statistical_layer(Record("resets", "given", 7, 3000, 200, 3000, blocks=[counts]))
        >>> layer.holds, round(layer["episodes"].value, 5)
        (True, 0.00123)
    """
    layer, total, sizes = Layer("statistical"), record.total, record.sizes
    n, m = total.episodes - sizes["repeated"], total.shown - sizes["leaked"]
    if not total.episodes or not total.shown:
        text = "episodes from {B <= s} and observations of U were measured"
        layer.state(MEASURED, "sample", text, False, Reason.NOT_MEASURED, n=min(total.episodes, total.shown))
        return layer
    _fresh(layer, record, names_seeds)
    _within(layer, total)
    each = 1.0 - 0.5 * (1.0 - record.confidence)
    events = min(total.events, n)
    detail = (
        f"left {total.left}, entered U {total.entered}, showed U with B <= s {total.aliased}, no number {total.undefined}; "
        f"steps: shortest {sizes['shortest']}, median {sizes['median']}, longest {sizes['longest']}; acceptable {record.acceptable:g}"
    )
    reason = Reason.EPISODES_LEAVE if not total.entered else Reason.UNSAFE_ENTERED
    text = (
        f"episodes of at most {record.horizon} steps from {{B <= s}} that leave it, enter U, show U with B <= s or give no "
        f"number: {events} of {n}; at most"
    )
    _share(layer, "episodes", text, events, n, each, record.acceptable, reason, detail)
    if record.kind == "states":
        among = f", {record.among}" if record.among else ""
        uniform = min(sum(n - n // 2 for n in map(record.size, range(len(record.blocks)))), total.shown)
        what = f"observations of U with B <= s, {uniform} drawn uniformly in U and {total.shown - uniform} where one step under a random "
        what += f"action enters it{among}"
        started = f"uniformly (in a union: in equal shares of its parts) in the states whose observation lies in the set{among}"
    else:
        what = "episodes with an observation of U that show one with B <= s, half under the policy, half under random "
        what += "actions"
        started = "as those of the environment's resets that lie in the set"
    text, mistaken = f"{what}: {min(total.mistaken, m)} of {m}; at most", min(total.mistaken, m)
    detail = f"acceptable {record.acceptable:g}"
    _share(layer, "unsafe observations", text, mistaken, m, each, record.acceptable, Reason.UNSAFE_INSIDE, detail)
    text = "both bounds hold at once (each bounds a share of its own kind; they are not added)"
    layer.state(REPORTED, "together", text, confidence=record.confidence)
    _errors(layer, record)
    layer.state(ASSUMED, "seed", f"neither the seed of all this, {record.seed}, nor the agent was chosen by what was measured with it")
    layer.state(ASSUMED, "starts", f"episodes start as the measured ones did: {started}")
    layer.state(ASSUMED, "system", "camera, physics and appearance stay as they were")
    return layer


def _fresh(layer: Layer, record: Record, names_seeds: bool) -> None:
    """Whether nothing was seen before."""
    total, sizes = record.total, record.sizes
    used, own = record.used or (), ("", "certificate", "certificate actions")
    clash = any(used_before(seed, used) or any(drawn_for(seed, root) not in own for root in used) for seed in record.seeds())
    if record.used is None or not (names_seeds or clash):
        layer.state(ASSUMED, "fresh", "the episodes are fresh: the agent does not say which seeds it was trained with")
    else:
        text = "no seed of these episodes is one of the training, of what was chosen or tuned, or drawn from such a one for another purpose"
        layer.state(MEASURED, "fresh", text, not clash, Reason.CALIBRATION_REUSED, n=len(record.used))
    for name, what, known, found, n, reason in (
        ("different", "episodes that repeat another", 1, sizes["repeated"], total.episodes, Reason.CALIBRATION_REUSED),
        ("unseen", "labelled states that were trained on", sizes["trained_on"], sizes["leaked"], total.shown,
         Reason.LABELS_LEAKED),
    ):  # fmt: skip
        if not known:
            layer.state(ASSUMED, name, "no labelled state was trained on: the agent does not say which were")
            continue
        fails = found > REPEATED * n
        layer.state(MEASURED, name, f"{what}, which do not count: {found} of {n}", not fails, reason, n=n)


def _within(layer: Layer, total: Counts) -> None:
    """Whether everything is a number and lies in the domain."""
    for name, text, wrong, n, reason in (
        ("finite", "episodes with a barrier value or an error that is no number", total.undefined, total.episodes,
         Reason.NOT_FINITE),
        ("encoder", "latents of fresh observations outside the domain", total.outside, total.seen, Reason.OUTSIDE_DOMAIN),
    ):  # fmt: skip
        layer.state(MEASURED, name, f"{text}: {wrong}", not wrong, reason, n=n)


def _share(
    layer: Layer, name: str, text: str, events: int, n: int, each: float, acceptable: float, reason: Reason, detail: str
) -> None:
    """States a bound that has to be acceptable; few episodes without any event are no fault of the agent."""
    bound = share_upper(events, n, each)
    holds = bound <= acceptable
    why = Reason.TOO_FEW if events == 0 else reason
    of = {"value": bound, "unit": "share", "n": n, "confidence": each, "detail": detail}
    layer.state(MEASURED, name, text, holds, why, misses_by=None if holds else bound - acceptable, **of)


def run_time_layer(record: Record, tolerated_error: float | None, held: bool = False, watched: bool = True) -> Layer:
    r"""To how many real episodes the proof applies, whatever camera and physics did in them.

    The premise at a step: :math:`B(E(o_t)) \le s`, and, unless corrections are held in the set,
    :math:`|\hat z_t - d(\hat z_{t-1}, u_{t-1})| \le \delta`; in an episode: at every step of it. It is watched at run time
    (:class:`~torchrl_sspl.modules.controller.Controller`); with k episodes among n that do not meet it,
    :math:`P \le \operatorname{Beta}^{-1}(c; k + 1, n - k)`.

    Args:
        record: how the episodes were drawn, and what was counted.
        tolerated_error: :math:`\delta`, proved, latent units; None where nothing is.
        held: whether a correction that would leave the set is cut to :math:`\delta`.
        watched: whether the agent's monitor compares errors with :math:`\delta`; one that names no tolerated error has nothing to
            compare with.

    Source: Theorem F of ``docs/theory.md``; none in the paper.

    Example:
        >>> counts = Counts(3000, 600000, 0, 0, 0, 0, 0, 3, 5, 3000, 0, 9000, 0)
        >>> layer = run_time_layer(Record("resets", "given", 7, 3000, 200, 3000, blocks=[counts]), 0.01)
        >>> layer.holds, round(layer["covered"].value, 5)
        (True, 0.00258)
    """
    layer, total = Layer("run-time"), record.total
    n = total.episodes - record.sizes["repeated"]
    if not n:
        layer.state(MEASURED, "covered", "episodes from {B <= s} were measured", False, Reason.NOT_MEASURED, n=0)
        return layer
    if tolerated_error is None or not tolerated_error > 0:
        text = "the proof applies to episodes"
        layer.state(MEASURED, "covered", text, False, Reason.NOTHING_TOLERATED, n=n)
        return layer
    exceeding = min(total.exceeding, n)
    text = (
        f"episodes of at most {record.horizon} steps from {{B <= s}} to which the proof does not apply from the first step to "
        f"the last: {exceeding} of {n}; at most"
    )
    detail = f"acceptable {record.acceptable:g}"
    _share(layer, "covered", text, exceeding, n, record.confidence, record.acceptable, Reason.PREMISE_NOT_MET, detail)
    text = f"steps at which its premise is met: {total.steps - total.uncovered} of {total.steps}; steps are dependent, so no bound follows"
    layer.state(REPORTED, "steps covered", text, n=total.steps)
    limit = down(tolerated_error)
    premise = "the premise, watched at run time" if watched else "the premise, which nothing watches, as the agent names no error that it tolerates"
    if held:
        text = (
            f"{premise}: B <= s for every observation by itself; the memory keeps B <= s whatever is seen, "
            f"as a correction that would leave the set is cut to {limit}, which is proved to be tolerated"
        )
    else:
        text = (
            f"{premise}: no error of a step is above {limit}, and B <= s for every observation by "
            "itself; while it is met, B <= s whatever camera and physics do"
        )
    layer.state(ASSUMED, "premise", text)
    return layer


def _errors(layer: Layer, record: Record) -> None:
    """How large the errors are; reported, as nothing above rests on it."""
    total, numbers = record.total, record.numbers
    n = total.episodes - record.sizes["repeated"]
    of: dict[str, Any] = {"n": n, "confidence": record.confidence}
    if numbers["episode_error"] is not None:
        text = f"a share of at least {_QUANTILE:g} of the episodes has errors of at most"
        layer.state(REPORTED, "largest error", text, value=numbers["episode_error"], unit="latent", **of)
    for name, steps, largest in record.rims:
        text = f"largest error seen on steps that begin {name}; steps are dependent, so no bound follows"
        layer.state(REPORTED, f"error {name}", text, value=largest, unit="latent", n=steps)


def paper_numbers(
    *,
    safe: Tensor,
    unsafe: Tensor,
    following: Tensor,
    lipschitz_bound: float,
    covering_radius: float,
    dynamics_error: float,
    closed_loop_constant: float,
) -> tuple[dict[str, int], dict[str, float]]:
    r"""What the paper's conditions (eq. (3)-(5)) need of a sample: whole numbers and numbers of a record, by name.

    Args:
        safe: ``(n,)`` barrier values of held-out observations of S.
        unsafe: ``(m,)`` of U.
        following: ``(k,)`` values of :math:`B(d(z, \pi(z)))` for held-out latents of the set.
        lipschitz_bound: :math:`L_B`.
        covering_radius: :math:`\bar\epsilon`, latent units.
        dynamics_error: :math:`\delta`, latent units.
        closed_loop_constant: certified Lipschitz constant of :math:`z \mapsto d(z, \pi(z))`.
    """
    psi, eta = lipschitz_bound * covering_radius, lipschitz_bound * dynamics_error
    needed = psi * (closed_loop_constant + 1.0)
    signed = {"safe": safe.double(), "unsafe": -unsafe.double(), "following": following.double()}
    margins = {"safe": psi, "unsafe": psi, "following": psi + eta}
    sizes = {name: len(v) for name, v in signed.items()}
    sizes |= {f"{name}_met": int((v + margins[name] <= 0).sum()) for name, v in signed.items()}
    sizes["following_met_as_needed"] = int((signed["following"] + needed + eta <= 0).sum())
    numbers = {f"{name}_worst": float(v.max()) if len(v) else math.nan for name, v in signed.items()}
    own = {"covering_radius": covering_radius, "largest_error": dynamics_error}
    return sizes, numbers | own | {"closed_loop_constant": closed_loop_constant}


def paper_layer(record: Record, lipschitz_bound: float, *, chooses: bool = False) -> Layer:
    r"""The paper's conditions on held-out samples, with its margins, and with those that its proof would need.

    .. math:: \psi = L_B \bar\epsilon, \; \eta = L_B \delta; \quad
        q_1 = B(z) + \psi \le 0 \;(S), \quad q_2 = -B(z) + \psi \le 0 \;(U), \quad
        q_3 = B(d(z, \pi(z))) + \psi_3 + \eta \le 0 \;(B \le s)

    Args:
        record: with the entries of :func:`paper_numbers`.
        lipschitz_bound: :math:`L_B`.
        chooses: whether the policy chooses, so that its closed loop has no Lipschitz constant.

    Source: paper eq. (3)-(5) and Theorem 1; deviations: q1, q2, q3 are asked where they make sense (S, U, the set), and
    :math:`\psi_3` is given in both forms.

    Example:
        >>> value = torch.tensor([1.0])
        >>> sizes, numbers = paper_numbers(safe=-value, unsafe=value, following=-0.1 * value, lipschitz_bound=2.0,
        ...     covering_radius=0.1, dynamics_error=0.01, closed_loop_constant=1.5)
        >>> layer = paper_layer(Record("resets", "given", 7, 1, 200, sizes=sizes, numbers=numbers), 2.0)
        >>> [s.holds for s in layer.statements]
        [None, None, None, True, True, False, False]
    """
    layer, sizes = Layer("paper"), record.sizes
    number = {k: math.nan if v is None else v for k, v in record.numbers.items()}
    psi, eta = lipschitz_bound * number["covering_radius"], lipschitz_bound * number["largest_error"]
    psi3 = psi * (number["closed_loop_constant"] + 1.0)
    why = Reason.NO_LIPSCHITZ.value if chooses else ""
    for name, text, value in (
        ("safety margin", "psi* = L_B eps-bar, sampled", psi),
        ("dynamics margin", "eta* = L_B delta, sampled", eta),
        ("safety margin of q3", "psi* with the Lipschitz constant that the proof of q3 needs, L_B (L_cl + 1) eps-bar",
         psi3),
    ):  # fmt: skip
        layer.state(REPORTED, name, text, value=value, unit="barrier", detail=why if name == "safety margin of q3" else "")
    for name, text, kind, margin, met in (
        ("q1", "B + psi* <= 0 on held-out observations of S", "safe", psi, "safe_met"),
        ("q2", "-B + psi* <= 0 on held-out observations of U", "unsafe", psi, "unsafe_met"),
        ("q3", "B(d(z, pi(z))) + psi* + eta* <= 0 on {B <= s}", "following", psi + eta, "following_met"),
        ("q3 as its proof needs it", "the same with the margin that the proof needs", "following", psi3 + eta,
         "following_met_as_needed"),
    ):  # fmt: skip
        n, worst = sizes[kind], number[f"{kind}_worst"] + margin
        if not n or not math.isfinite(worst):
            discontinuous = chooses and name == "q3 as its proof needs it"
            reason = Reason.NOT_MEASURED if not n else Reason.NO_LIPSCHITZ if discontinuous else Reason.NOT_FINITE
            layer.state(MEASURED, name, text, False, reason, n=n)
            continue
        of = {"value": worst, "misses_by": None if worst <= 0 else worst, "unit": "barrier", "n": n}
        detail = f"holds on {100 * sizes[met] / n:.4g} % of the samples"
        layer.state(MEASURED, name, f"{text}: worst excess", worst <= 0, Reason.CONDITION_FAILS, detail=detail, **of)
    return layer


def largest_error_bound(errors: Sequence[float] | Tensor, confidence: float) -> float:
    """Upper confidence bound of the 99 % quantile of independent episodes' errors ``(n,)``; NaN where they are too few.

    Example:
        >>> largest_error_bound(torch.arange(1000.0), 0.95) >= 990.0
        True
    """
    ordered = torch.as_tensor(errors, dtype=torch.float64).sort().values  # NaN last
    rank = quantile_rank(len(ordered), _QUANTILE, confidence)
    return math.nan if rank is None else float(ordered[rank - 1])

"""What fresh episodes show: exact confidence bounds, and the layers of a certificate that are generated from a record."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_sspl.certification.certificate import ASSUMED, MEASURED, REPORTED, Layer, Reason, Statement
from torchrl_sspl.certification.record import REPEATED, Counts, Record
from torchrl_sspl.certification.rounding import down
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.seeds import used_before

#: Share and confidence of the statement about the largest error of an episode.
QUANTILE = 0.99


def clopper_pearson(events: int, n: int, *, confidence: float = 0.95) -> tuple[float, float]:
    r"""Exact confidence interval of a share from independent trials.

    .. math:: \left[ \operatorname{Beta}^{-1}(a; k, n - k + 1), \operatorname{Beta}^{-1}(1 - a; k + 1, n - k) \right]

    with :math:`a = (1 - c) / 2`, or :math:`a = 1 - c` on the one side that is left when no (or every) trial was an
    event: 0 of 3000 gives an upper bound of 0.1 % at 95 %.

    Args:
        events: k, number of events.
        n: number of trials.
        confidence: c.

    Returns:
        Lower and upper bound.

    Raises:
        ConfigError: if the numbers do not fit each other.

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
    r"""One-sided exact upper bound of a share from independent trials; 1 without any trial.

    .. math:: P \le \operatorname{Beta}^{-1}(c; k + 1, n - k)

    Args:
        events: k, number of events.
        n: number of trials.
        confidence: c.

    Returns:
        The bound, rounded upward.

    Raises:
        ConfigError: if the numbers do not fit each other.

    Source: Clopper and Pearson (1934).

    Example:
        >>> round(share_upper(0, 3000, 0.95), 6)
        0.000998
    """
    if n == 0 or events == n:
        return 1.0
    if not 0 <= events < n or not 0.0 < confidence < 1.0:
        raise ConfigError(f"expected 0 <= events <= n and a confidence in (0, 1), received {events}, {n}, {confidence}")
    from scipy.stats import beta

    # The incomplete beta function is good to some 1e-13: what it may be wrong by is added.
    return min(1.0, float(beta.ppf(confidence, events + 1, n - events)) * (1.0 + 1e-9))


def quantile_rank(n: int, share: float, confidence: float) -> int | None:
    r"""Rank whose order statistic bounds a quantile from above, whatever the distribution.

    The smallest r with :math:`P(\operatorname{Bin}(n, q) \le r - 1) \ge c`: with confidence c at least a share q of the
    distribution is at most the r-th smallest of n independent values.

    Args:
        n: number of independent values.
        share: q.
        confidence: c.

    Returns:
        r, counted from 1; None where n values are too few (:math:`1 - q^n < c`).

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
    """A hash of each row in full precision, to find out whether two data sets share any.

    Args:
        rows: ``(n, ...)``.
        grid: values are rounded to multiples of it before, where the last digits of a computation may differ.

    Returns:
        n hexadecimal strings.

    Source: none.

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


def statistical_layer(record: Record, *, level: float = 0.0, tolerated_error: float | None = None) -> Layer:
    r"""What holds for fresh episodes, with which confidence; every word and number follows from the record.

    The unit is the episode: steps of one are not independent. An episode that leaves the set, enters U, shows an observation
    of U with B <= s or gives no number is one event; with k events among n independent episodes
    :math:`P \le \operatorname{Beta}^{-1}(c'; k + 1, n - k)`. Observations of U have a bound of their own. Both hold at
    once with confidence c, as each has :math:`c' = 1 - (1 - c) / 2`; a share of episodes and a share of observations are
    never added.

    Args:
        record: how the episodes were drawn, and what was counted.
        level: s, barrier units.
        tolerated_error: proved, latent units; None where nothing was proved.

    Returns:
        The layer.

    Source: Clopper and Pearson (1934); the paper has no statistical statement.

    Example:
        >>> counts = Counts(3000, 600000, 0, 0, 0, 0, 0, 0, 3000, 0, 9000, 0)
        >>> layer = statistical_layer(Record("resets", "given", 7, 3000, 200, 3000, blocks=[counts]), tolerated_error=0.1)
        >>> layer.holds, round(layer["episodes"].value, 5)
        (True, 0.00123)
    """
    layer, total, sizes = Layer("statistical"), record.total, record.sizes
    add = layer.statements.append
    n, m = total.episodes - sizes["repeated"], total.shown - sizes["leaked"]
    if not total.episodes or not total.shown:
        text = "episodes from {B <= s} and observations of U were measured"
        add(Statement("sample", text, MEASURED, False, n=min(total.episodes, total.shown), reason=Reason.NOT_MEASURED.name))
        return layer
    _fresh(layer, record)
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
    add(_share("episodes", text, events, n, each, record.acceptable, reason, detail))
    what = (
        "observations of U with B <= s, drawn half uniformly in U and half where one step under a random action enters it"
        if record.kind == "states"
        else "episodes with an observation of U that show one with B <= s, half under the policy, half under random actions"
    )
    text, mistaken = f"{what}: {min(total.mistaken, m)} of {m}; at most", min(total.mistaken, m)
    detail = f"acceptable {record.acceptable:g}"
    add(_share("unsafe observations", text, mistaken, m, each, record.acceptable, Reason.UNSAFE_INSIDE, detail))
    text = "both bounds hold at once (each bounds a share of its own kind; they are not added)"
    add(Statement("together", text, REPORTED, None, confidence=record.confidence))
    _errors(layer, record, tolerated_error)
    started = (
        "uniformly in the states whose observation lies in the set"
        if record.kind == "states"
        else "as those of the environment's resets that lie in the set"
    )
    add(Statement("starts", f"episodes start as the measured ones did: {started}", ASSUMED, None))
    add(Statement("system", "camera, physics and appearance stay as they were", ASSUMED, None))
    return layer


def _fresh(layer: Layer, record: Record) -> None:
    """Whether nothing was seen before."""
    total, sizes = record.total, record.sizes
    if record.used is None:
        text = "the episodes are fresh: the agent does not say which seeds it was trained with"
        layer.statements.append(Statement("fresh", text, ASSUMED, None))
    else:
        clash = any(used_before(seed, record.used) for seed in record.seeds())
        text = "no seed of these episodes was used to train, choose or tune"
        reason = Reason.CALIBRATION_REUSED.name if clash else ""
        layer.statements.append(Statement("fresh", text, MEASURED, not clash, n=len(record.used), reason=reason))
    for name, what, known, found, n, reason in (
        ("different", "episodes that repeat another", 1, sizes["repeated"], total.episodes, Reason.CALIBRATION_REUSED),
        ("unseen", "labelled states that were trained on", sizes["trained_on"], sizes["leaked"], total.shown,
         Reason.LABELS_LEAKED),
    ):  # fmt: skip
        if not known:
            text = "no labelled state was trained on: the agent does not say which were"
            layer.statements.append(Statement(name, text, ASSUMED, None))
            continue
        fails = found > REPEATED * n
        text = f"{what}, which do not count: {found} of {n}"
        layer.statements.append(Statement(name, text, MEASURED, not fails, n=n, reason=reason.name if fails else ""))


def _within(layer: Layer, total: Counts) -> None:
    """Whether everything is a number and lies in the domain."""
    for name, text, wrong, n, reason in (
        ("finite", "episodes with a barrier value or an error that is no number", total.undefined, total.episodes,
         Reason.NOT_FINITE),
        ("encoder", "latents of fresh observations outside the domain", total.outside, total.seen, Reason.OUTSIDE_DOMAIN),
    ):  # fmt: skip
        layer.statements.append(
            Statement(name, f"{text}: {wrong}", MEASURED, not wrong, n=n, reason=reason.name if wrong else "")
        )


def _share(
    name: str, text: str, events: int, n: int, confidence: float, acceptable: float, reason: Reason, detail: str
) -> Statement:
    """A bound that has to be acceptable; no event among so few that even none proves little is no fault of the agent."""
    bound = share_upper(events, n, confidence)
    holds = bound <= acceptable
    why = Reason.TOO_FEW if events == 0 else reason
    missed = None if holds else bound - acceptable
    return Statement(
        name, text, MEASURED, holds, bound, "share", n, confidence, "" if holds else why.name, missed, detail
    )


def _errors(layer: Layer, record: Record, tolerated: float | None) -> None:
    """How the errors compare with what is proved to be tolerated; reported, as nothing above rests on it."""
    add, total, numbers = layer.statements.append, record.total, record.numbers
    n = total.episodes - record.sizes["repeated"]
    if tolerated is None or tolerated <= 0:
        text = "no error is proved to be tolerated, so the proof says nothing about episodes"
        add(Statement("errors tolerated", text, REPORTED, None, n=n))
    else:
        exceeding = min(total.exceeding, n)
        text = (
            f"episodes with an error above the tolerated one of {down(tolerated)}, to which Theorem A does not apply: "
            f"{exceeding} of {n}; at most"
        )
        bound = share_upper(exceeding, n, record.confidence)
        add(Statement("errors tolerated", text, REPORTED, None, bound, "share", n, record.confidence))
    if numbers["episode_error"] is not None:
        text = f"a share of at least {QUANTILE:g} of the episodes has errors of at most"
        add(Statement("largest error", text, REPORTED, None, numbers["episode_error"], "latent", n, record.confidence))
    for name, steps, largest in record.rims:
        text = f"largest error seen on steps that begin {name}; steps are dependent, so no bound follows"
        add(Statement(f"error {name}", text, REPORTED, None, largest, "latent", steps))


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
    r"""What the paper's conditions need of a sample, as entries of a record.

    Args:
        safe: ``(n,)`` barrier values of held-out observations of S.
        unsafe: ``(m,)`` of U.
        following: ``(k,)`` values of :math:`B(d(z, \pi(z)))` for held-out latents of the set.
        lipschitz_bound: :math:`L_B`.
        covering_radius: :math:`\bar\epsilon`, latent units.
        dynamics_error: :math:`\delta`, latent units.
        closed_loop_constant: certified Lipschitz constant of :math:`z \mapsto d(z, \pi(z))`.

    Returns:
        Whole numbers and numbers by name.

    Source: paper eq. (3)-(5).
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


def paper_layer(record: Record, lipschitz_bound: float) -> Layer:
    r"""The paper's conditions on held-out samples, with its margins, and with those that its proof would need.

    .. math:: \psi = L_B \bar\epsilon, \; \eta = L_B \delta; \quad
        q_1 = B(z) + \psi \le 0 \;(S), \quad q_2 = -B(z) + \psi \le 0 \;(U), \quad
        q_3 = B(d(z, \pi(z))) + \psi_3 + \eta \le 0 \;(B \le s)

    Args:
        record: with the entries of :func:`paper_numbers`.
        lipschitz_bound: :math:`L_B`.

    Returns:
        The layer.

    Source: paper eq. (3)-(5) and Theorem 1; deviations: q1, q2, q3 are asked where they make sense (S, U, the set), and
    :math:`\psi_3` is given in both forms.

    Example:
        >>> sizes, numbers = paper_numbers(safe=torch.tensor([-1.0]), unsafe=torch.tensor([1.0]), following=torch.tensor([-0.1]),
        ...     lipschitz_bound=2.0, covering_radius=0.1, dynamics_error=0.01, closed_loop_constant=1.5)
        >>> layer = paper_layer(Record("resets", "given", 7, 1, 200, sizes=sizes, numbers=numbers), 2.0)
        >>> layer.holds, layer.verdict
        (False, "not certified: q3 (a condition does not hold on the held-out samples with the paper's margins, misses by 0.12 barrier)")
    """
    layer, sizes = Layer("paper"), record.sizes
    number = {k: math.nan if v is None else v for k, v in record.numbers.items()}
    psi, eta = lipschitz_bound * number["covering_radius"], lipschitz_bound * number["largest_error"]
    psi3 = psi * (number["closed_loop_constant"] + 1.0)
    for name, text, value in (
        ("safety margin", "psi* = L_B eps-bar, sampled", psi),
        ("dynamics margin", "eta* = L_B delta, sampled", eta),
        (
            "safety margin of q3",
            "psi* with the Lipschitz constant that the proof of q3 needs, L_B (L_cl + 1) eps-bar",
            psi3,
        ),
    ):
        layer.statements.append(Statement(name, text, REPORTED, None, value, "barrier"))
    for name, text, kind, margin, met in (
        ("q1", "B + psi* <= 0 on held-out observations of S", "safe", psi, "safe_met"),
        ("q2", "-B + psi* <= 0 on held-out observations of U", "unsafe", psi, "unsafe_met"),
        ("q3", "B(d(z, pi(z))) + psi* + eta* <= 0 on {B <= s}", "following", psi + eta, "following_met"),
        (
            "q3 as its proof needs it",
            "the same with the margin that the proof needs",
            "following",
            psi3 + eta,
            "following_met_as_needed",
        ),
    ):
        n, worst = sizes[kind], number[f"{kind}_worst"] + margin
        if not n or not math.isfinite(worst):
            reason = Reason.NOT_FINITE if n else Reason.NOT_MEASURED
            layer.statements.append(Statement(name, text, MEASURED, False, n=n, reason=reason.name))
            continue
        holds = worst <= 0
        reason_name, missed = ("", None) if holds else (Reason.CONDITION_FAILS.name, worst)
        detail = f"holds on {100 * sizes[met] / n:.4g} % of the samples"
        layer.statements.append(
            Statement(name, f"{text}: worst excess", MEASURED, holds, worst, "barrier", n, None, reason_name, missed, detail)
        )
    return layer


def largest_error_bound(errors: Sequence[float] | Tensor, confidence: float) -> float:
    """Upper confidence bound of the 99 % quantile of independent episodes' largest errors.

    Args:
        errors: ``(n,)`` one of each episode.
        confidence: c.

    Returns:
        The bound; NaN where the episodes are too few.

    Source: see :func:`quantile_rank`.

    Example:
        >>> largest_error_bound(torch.arange(1000.0), 0.95) >= 990.0
        True
    """
    ordered = torch.as_tensor(errors, dtype=torch.float64).sort().values  # NaN last
    rank = quantile_rank(len(ordered), QUANTILE, confidence)
    return math.nan if rank is None else float(ordered[rank - 1])

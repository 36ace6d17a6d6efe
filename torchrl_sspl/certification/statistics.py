"""Exact confidence bounds for shares."""

from __future__ import annotations

from torchrl_sspl.errors import ConfigError


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

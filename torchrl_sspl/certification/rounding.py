"""Numbers of a certificate for people: rounded outward, so that what is printed is never more than what was found."""

from __future__ import annotations

import math
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from typing import Any

#: Statements whose value is a bound from below; every other value bounds something from above.
LOWER_BOUNDS = ("tolerated error", "float32", "float64")


def up(value: float, digits: int = 4) -> str:
    """The number with so many significant digits, rounded up: never less, for bounds from above.

    Example:
        >>> up(1.2345644, 6), up(-0.12349), up(2.0), up(5.17e-9, 2)
        ('1.23457', '-0.1234', '2', '5.2e-09')
    """
    return _rounded(value, digits, ROUND_CEILING)


def down(value: float, digits: int = 4) -> str:
    """The number with so many significant digits, rounded down: never more, for bounds from below.

    Example:
        >>> down(0.0110472), down(-1.00001)
        ('0.01104', '-1.001')
    """
    return _rounded(value, digits, ROUND_FLOOR)


def shown(statement: Any, digits: int = 4) -> str:
    """Value and unit of a statement, rounded to the side on which it is still true; "" without one, shares in per cent.

    Example:
        >>> from types import SimpleNamespace
        >>> shown(SimpleNamespace(name="tolerated error", value=0.0110472, unit="latent"))
        '0.01104 latent'
    """
    if statement.value is None:
        return ""
    return _with_unit(statement.value, statement.unit, digits, statement.name in LOWER_BOUNDS)


def line_of(statement: Any, checked: bool) -> str:
    """One statement for people, its numbers rounded to the side on which they are still true; ``checked`` now, or claimed. Source: none.

    Example:
        >>> from torchrl_sspl.certification.certificate import Statement
        >>> line_of(Statement("covered", "of them; at most", "measured", True, 0.0012, "share", n=3000, confidence=0.95), True)
        '    measured  of them; at most 0.12 % (n = 3,000, 95 %)'
    """
    s = statement
    size = "" if s.n is None else f"n = {s.n:,}"
    sample = ", ".join(x for x in (size, "" if s.confidence is None else f"{100 * s.confidence:g} %") if x)
    missing = f", misses by {missed(s)}" if missed(s) else ""
    status = "FAILS" if s.holds is False else s.kind if checked or s.kind == "assumed" else "claimed"
    text = f"{s.text} {shown(s)}".rstrip() + (f" ({sample})" if sample else "")
    return f"    {status:9s} {text}{missing}" + (f" [{s.detail}]" if s.detail else "")


def printable(text: str) -> str:
    r"""A line without what could steer a terminal or look like another line. Source: none.

    Example:
        >>> printable("a\nb")
        'a\\nb'
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def missed(statement: Any, digits: int = 3) -> str:
    """By how much a statement fails, at most, "" where unknown; what a search found may be exceeded elsewhere.

    Example:
        >>> from types import SimpleNamespace
        >>> missed(SimpleNamespace(misses_by=0.05081, unit="barrier"))
        '0.0509 barrier'
    """
    return "" if statement.misses_by is None else _with_unit(statement.misses_by, statement.unit, digits, False)


def _with_unit(value: float, unit: str, digits: int, lower: bool) -> str:
    share = unit == "share"
    text = _rounded(value, digits, ROUND_FLOOR if lower else ROUND_CEILING, 2 if share else 0)
    return f"{text} %" if share else f"{text} {unit}".rstrip()


def _rounded(value: float, digits: int, mode: str, shift: int = 0) -> str:
    if not math.isfinite(value):
        return f"{value:g}"
    exact = Context(prec=1000).scaleb(Decimal(value), shift)  # a float is a decimal number, of up to 770 digits
    rounded = Context(prec=digits, rounding=mode).plus(exact)
    text = f"{float(rounded):.{digits}g}"
    return text if Decimal(text) == rounded else f"{rounded:e}"

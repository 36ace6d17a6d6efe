"""What is printed is never more than what was found."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_sspl.certification.certificate import MEASURED, PROVED, Certificate, Layer, Statement
from torchrl_sspl.certification.rounding import LOWER_BOUNDS, down, missed, shown, up
from torchrl_sspl.viz.certificate import certificate_section
from torchrl_sspl.viz.verdict import first_screen

NUMBERS = st.floats(allow_nan=False, allow_infinity=False, min_value=-1e300, max_value=1e300)


@settings(max_examples=500, deadline=None, derandomize=True)
@given(NUMBERS, st.integers(1, 12))
def test_printed_numbers_lie_on_their_side_and_are_the_next_ones(value, digits):
    above, below = Fraction(up(value, digits)), Fraction(down(value, digits))
    assert below <= Fraction(value) <= above
    if value:
        step = Fraction(10) ** (math.floor(math.log10(abs(value))) + 3 - digits)
        assert above - below <= step


def test_the_numbers_that_were_printed_on_the_wrong_side():
    assert f"{1.2345644:g}" == "1.23456"  # less than the bound
    assert up(1.2345644, 6) == "1.23457"
    assert f"{0.0110472:.4g}" == "0.01105"  # more than was proved
    assert down(0.0110472) == "0.01104"
    assert up(0.1) == "0.1001"  # the float is above the decimal number
    assert (up(2.0), down(2.0), up(0.0), up(1e22)) == ("2", "2", "0", "1e+22")
    assert (up(math.inf), down(-math.inf), up(math.nan)) == ("inf", "-inf", "nan")


@pytest.mark.parametrize(
    ("name", "value", "unit", "text"),
    [
        ("tolerated error", 0.0110472, "latent", "0.01104 latent"),
        ("float32", 0.0103179, "latent", "0.01031 latent"),
        ("float64", 0.0103179, "latent", "0.01031 latent"),
        ("rounding", 5.16711e-9, "barrier", "5.168e-09 barrier"),
        ("risk", 0.0024561, "share", "0.2457 %"),
        ("episodes", 0.0, "share", "0 %"),
        ("q1", -0.12349, "barrier", "-0.1234 barrier"),
        ("Lipschitz constant", 1.2345644, "", "1.235"),
    ],
)
def test_values_are_rounded_to_the_side_on_which_they_are_true(name, value, unit, text):
    statement = Statement(name, "t", MEASURED, True, value, unit)
    assert shown(statement) == text
    assert shown(Statement(name, "t", PROVED, True)) == ""
    assert missed(Statement(name, "t", PROVED, False, misses_by=0.012341, unit="share")) == "1.24 %"
    assert missed(Statement(name, "t", PROVED, False)) == ""
    assert set(LOWER_BOUNDS) == {"tolerated error", "float32", "float64"}


def test_the_report_prints_no_bound_on_the_wrong_side():
    layer = Layer("deterministic", [
        Statement("Lipschitz constant", "B is L-Lipschitz", PROVED, True, 1.2345644, "barrier / latent"),
        Statement("tolerated error", "errors of at most this", PROVED, True, 0.0110472, "latent"),
        Statement("invariance", "kept", PROVED, False, unit="barrier", reason="NOT_INVARIANT", misses_by=0.050811),
    ])  # fmt: skip
    certificate = Certificate("demo", "0" * 64, "0" * 64, 0.0, {"deterministic": layer})
    text = certificate_section(certificate)
    for right, wrong in (("1.235", "1.234 "), ("0.01104 latent", "0.01105"), ("misses by 0.0509 barrier", "0.05081")):
        assert right in text
        assert wrong not in text
    assert "up to 0.01104 latent added" in " ".join(line for _, line in first_screen(certificate).proved)

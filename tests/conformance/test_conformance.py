"""Every loss passes the checks that TorchRL applies to its own, and every check can fail."""

from __future__ import annotations

import pytest

from .breaks import BREAKS
from .cases import CASES, Case
from .checks import CHECKS


def _runs() -> list:
    """Every check on every loss; capturing the parts of the total loss one by one takes its time."""
    fast = {"deviation", "lipschitz"}
    return [
        pytest.param(
            name,
            case,
            id=f"{name}-{case.name}",
            marks=pytest.mark.slow if name == "captures_as_one_graph" and case.name not in fast else (),
        )
        for name in CHECKS
        for case in CASES
    ]


@pytest.mark.parametrize(("name", "case"), _runs())
def test_loss_conforms(name: str, case: Case) -> None:
    CHECKS[name](case, case.loss)


def test_every_check_has_a_broken_copy() -> None:
    assert {name for name, _, _ in BREAKS} == set(CHECKS)


@pytest.mark.parametrize(("name", "case", "broken"), BREAKS, ids=lambda part: getattr(part, "__name__", None) or getattr(part, "name", part))
def test_check_notices_a_broken_copy(name: str, case: Case, broken: type) -> None:
    CHECKS[name](case, case.loss)
    with pytest.raises(AssertionError):
        CHECKS[name](case, broken)

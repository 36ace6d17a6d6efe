"""Every loss passes the checks that TorchRL applies to its own, and every check can fail."""

from __future__ import annotations

import pytest

from .breaks import BREAKS
from .cases import CASES, Case
from .checks import CHECKS


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
@pytest.mark.parametrize("name", CHECKS)
def test_loss_conforms(name: str, case: Case) -> None:
    CHECKS[name](case, case.loss)


def test_every_check_has_a_broken_copy() -> None:
    assert set(BREAKS) == set(CHECKS)


@pytest.mark.parametrize("name", CHECKS)
def test_check_notices_a_broken_copy(name: str) -> None:
    case, broken = BREAKS[name]
    CHECKS[name](case, case.loss)
    with pytest.raises(AssertionError):
        CHECKS[name](case, broken)

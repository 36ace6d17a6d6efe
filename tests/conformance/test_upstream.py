"""TorchRL's own base class of loss tests, unchanged, on every loss: from a checkout of TorchRL, as its package holds no tests.

    git clone --depth 1 --branch v0.14.1 https://github.com/pytorch/rl build/rl
    TORCHRL_TESTS=build/rl/test python -m pytest tests/conformance/test_upstream.py
"""

from __future__ import annotations

import importlib.util
import os
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import torchrl

from .breaks import BREAKS
from .cases import CASES, Case

FOLDER = os.environ.get("TORCHRL_TESTS")
FILE = Path(FOLDER or ".") / "objectives" / "_objectives_common.py"
# Those of our own checks that theirs are the model of.
THEIRS = ("parameters_can_be_reset", "unknown_key_is_a_value_error", "default_keys_are_the_documented_ones")

pytestmark = [
    pytest.mark.skipif(FOLDER is None, reason="TORCHRL_TESTS names no folder `test` of a checkout of TorchRL"),
    pytest.mark.filterwarnings("ignore:Class-scoped fixtures defined as instance methods"),  # theirs
]


def base() -> type[Any]:
    """Their class; what lies where it should be is a mistake, not a reason to skip."""
    spec = importlib.util.spec_from_file_location("torchrl_objectives_common", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.LossModuleTestBase


def minor(version: str) -> list[str]:
    return version.split(".")[:2]


def test_checkout_is_of_the_version_that_is_installed() -> None:
    theirs = (FILE.parents[2] / "version.txt").read_text().strip()
    assert minor(theirs) == minor(torchrl.__version__), f"a checkout of {theirs}, installed is {torchrl.__version__}"


def defaults(case: Case) -> dict[str, Any]:
    return {entry.name: entry.default for entry in fields(case.loss._AcceptedKeys)}


if FOLDER is not None:

    @pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
    class TestOurs(base()):  # type: ignore[misc]
        def test_reset_parameters_recursive(self, case: Case) -> None:
            self.reset_parameters_recursive_test(case.build())

        def test_tensordict_keys(self, case: Case) -> None:
            self.tensordict_keys_test(case.build(), defaults(case))

    @pytest.mark.parametrize(("case", "broken"), [b[1:] for b in BREAKS if b[0] in THEIRS], ids=lambda part: getattr(part, "name", None))
    def test_their_checks_notice_a_broken_copy(case: Case, broken: type) -> None:
        class Theirs(base()):  # type: ignore[misc]
            def test_reset_parameters_recursive(self) -> None:
                self.tensordict_keys_test(case.build(broken), defaults(case))
                self.reset_parameters_recursive_test(case.build(broken))

        with pytest.raises((AssertionError, pytest.fail.Exception)):
            Theirs().test_reset_parameters_recursive()

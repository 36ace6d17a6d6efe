"""The mutants fit the library as it is, and the command that runs them tells the living from the dead."""

from __future__ import annotations

import ast
import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

import torchrl_sspl

ROOT = Path(__file__).resolve().parent.parent
RUN = ROOT / "tests" / "mutants" / "run.py"
pytestmark = pytest.mark.skipif(Path(torchrl_sspl.__file__).parents[1] != ROOT, reason="mutants are of a checkout")
spec = importlib.util.spec_from_file_location("run_mutants", RUN)
assert spec is not None
assert spec.loader is not None
run = importlib.util.module_from_spec(spec)
spec.loader.exec_module(run)


@pytest.mark.parametrize("area", run.areas())
def test_every_mutant_changes_one_place_and_is_still_python(area):
    for mutant in run.read(area):
        assert len(mutant) in (4, 5), mutant
        source = (ROOT / mutant[0]).read_text()
        ast.parse(run.mutated(mutant, source))
        for test in mutant[3].split():
            file, _, name = test.partition("::")
            assert f"def {name}" in (ROOT / file).read_text()


def test_there_are_a_hundred_and_few_that_live():
    mutants = [m for area in run.areas() for m in run.read(area)]
    explained = [m for m in mutants if len(m) == 5]
    assert len(mutants) >= 100
    assert len(explained) <= 0.05 * len(mutants)
    assert all(len(m[4]) > 40 for m in explained)


@pytest.mark.slow
def test_the_command_kills_a_mutant_and_says_so():
    number = next(i for i, m in enumerate(run.read("statistics")) if m[3].endswith("test_seeds.py"))  # quick tests
    result = subprocess.run([sys.executable, RUN, "statistics", "--only", str(number)], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "1 of 1 killed (100.0 %)" in result.stdout


def test_a_text_that_is_not_there_is_an_error():
    with pytest.raises(ValueError, match="received 0"):
        run.mutated(("file.py", "nowhere", "somewhere", "tests"), "x = 1")
    with pytest.raises(ValueError, match="received 2"):
        run.mutated(("file.py", "x", "y", "tests"), "x = x")

"""Examples are run as a user runs them: as programs, with words."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="session")
def program():
    """``program(file, *words)`` runs an example and returns its exit code."""

    def run(name: str, *words: str) -> int:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", [name, *words])
            # Films have tests of their own; here they are short.
            patch.setattr("torchrl_sspl.experiments.report._FILM_SECONDS", 0.2)
            patch.setattr("torchrl_sspl.viz.animation._HOLD", 0.0)
            try:
                runpy.run_path(str(EXAMPLES / name), run_name="__main__")
            except SystemExit as end:
                return int(end.code or 0)
        return 0

    return run

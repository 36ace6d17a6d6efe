"""``import torchrl_sspl`` takes no longer than its users expect; what it may load is tested in test_floors.py."""

from __future__ import annotations

import subprocess
import sys
import time


def seconds(code: str) -> float:
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True)
    return time.perf_counter() - start


def test_import_takes_less_than_twice_the_time_of_torchrl():
    """Fastest of alternating runs, so that other work on the machine meets all."""
    codes = "import torchrl_sspl", "import torchrl_sspl as s; s.SSPLLoss", "import torchrl"
    runs = [[seconds(code) for code in codes] for _ in range(2)]
    *ours, theirs = (min(column) for column in zip(*runs, strict=True))
    assert max(ours) < 2 * theirs, f"expected less than {2 * theirs:.2f} s, took {max(ours):.2f} s"

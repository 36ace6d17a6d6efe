"""Public names: a change of them is deliberate.

Update: ``python tests/test_api_surface.py``
"""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path

SNAPSHOT = Path(__file__).with_name("api_surface.txt")


def surface() -> str:
    """One line per public name: ``package name``."""
    import torchrl_sspl

    packages = [m.name for m in pkgutil.iter_modules(torchrl_sspl.__path__, "torchrl_sspl.") if m.ispkg]
    lines = []
    for package in ("torchrl_sspl", *sorted(packages)):
        lines += [f"{package} {name}" for name in sorted(getattr(importlib.import_module(package), "__all__", []))]
    return "\n".join(lines) + "\n"


def test_public_names_are_those_of_the_snapshot():
    now, before = set(surface().split("\n")), set(SNAPSHOT.read_text().split("\n"))
    assert now == before, (
        f"new: {sorted(now - before)}; gone: {sorted(before - now)}; if that is meant: python tests/test_api_surface.py"
    )


def test_every_public_name_exists():
    for line in surface().splitlines():
        package, name = line.split()
        assert getattr(importlib.import_module(package), name, None) is not None, line


if __name__ == "__main__":
    SNAPSHOT.write_text(surface())

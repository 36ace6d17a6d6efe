"""The floors of the house: imports go downward, and importing the library is light."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import torchrl_sspl

PACKAGE = Path(torchrl_sspl.__file__).parent  # the checkout's, or that of an installed wheel
ROOT = PACKAGE.parent
FLOORS = {
    "errors": 0, "devices": 0, "sets": 0, "functional": 0,
    "lipschitz": 1,
    "modules": 2, "envs": 2, "certification": 2,
    "objectives": 3, "data": 3, "safety": 3,
    "trainers": 4, "viz": 4, "cli": 4, "__main__": 4,
}  # fmt: skip
HEAVY = ("pybullet", "wandb", "hydra", "ray", "matplotlib", "scipy", "torchrl")
FILES = sorted(PACKAGE.rglob("*.py"))


def part_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(path: Path, source: str) -> set[str]:
    """Names of the modules that a file imports, anywhere in it, relative imports resolved."""
    package = path.relative_to(ROOT).parent.parts
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = [*package[: len(package) - node.level + 1]] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            names |= {module} | {f"{module}.{alias.name}" for alias in node.names}
    return names


def breaches(path: Path, source: str) -> list[str]:
    part, found = part_of(path), []
    for name in sorted(imported(path, source)):
        pieces = name.split(".")
        if pieces[0] in ("examples", "tests", "benchmarks"):
            found.append(f"{name}: outside the package")
        if pieces[0] != "torchrl_sspl" or len(pieces) < 2 or pieces[1] not in FLOORS:
            continue
        if FLOORS[pieces[1]] > FLOORS[part]:
            found.append(f"{name}: floor {FLOORS[pieces[1]]} from floor {FLOORS[part]}")
        if part == "certification" and pieces[1] in ("envs", "modules"):
            found.append(f"{name}: certification takes networks and callables, it knows no environment and no module")
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_go_downward(path):
    if path == PACKAGE / "__init__.py":
        return  # loads everything, when asked
    assert part_of(path) in FLOORS, f"{part_of(path)} has no floor; give it one in FLOORS"
    assert not breaches(path, path.read_text())


@pytest.mark.parametrize(
    ("file", "line"),
    [
        ("sets.py", "from torchrl_sspl.lipschitz import cayley"),
        ("lipschitz/exact.py", "def f():\n    from ..modules import Policy"),
        ("modules/salad.py", "import torchrl_sspl.data"),
        ("certification/statistics.py", "from torchrl_sspl import envs"),
        ("certification/statistics.py", "from torchrl_sspl.modules.networks import Policy"),
        ("objectives/base.py", "from torchrl_sspl.trainers.config import make_config"),
        ("viz/plots.py", "from examples.inverted_pendulum import main"),
    ],
)
def test_upward_imports_are_seen(file, line):
    assert breaches(PACKAGE / file, line)


def test_first_floor_needs_torch_only():
    allowed = set(sys.stdlib_module_names) | {"torch", "torchrl_sspl"}
    for name in ("errors", "sets", "functional"):
        path = PACKAGE / f"{name}.py"
        roots = {n.split(".")[0] for n in imported(path, path.read_text())}
        assert roots <= allowed, roots - allowed


def loaded_after(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*sorted({{m.split('.')[0] for m in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    return set(done.stdout.split())


def test_importing_the_library_is_light():
    heavy = loaded_after("import torchrl_sspl") & set(HEAVY)
    assert not heavy, f"`import torchrl_sspl` loads {sorted(heavy)}; import them where they are used"


THEIRS = "import torchrl.data, torchrl.envs, torchrl.objectives, torchrl.collectors"


def test_no_sub_package_loads_optional_dependencies():
    names = ("functional", "sets", "lipschitz", "modules", "certification", "data", "objectives", "envs")
    heavy = loaded_after("; ".join(f"import torchrl_sspl.{n}" for n in names)) & {
        "pybullet", "wandb", "hydra", "ray", "matplotlib",
    }  # fmt: skip
    # TorchRL looks for some of these itself: only what it does not load on its own counts.
    assert not heavy - (loaded_after(THEIRS) if heavy else set())

"""The floors of the house: imports go downward and not in circles, and importing the library is light."""

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
    "errors": 0, "devices": 0, "sets": 0, "functional": 0, "seeds": 0, "interrupts": 0, "files": 0, "journal": 0, "direction": 0,
    "lipschitz": 1,
    "modules": 2, "envs": 2, "certification": 2,
    "viability": 2, "configs": 2, "objectives": 3, "data": 3,
    "evaluation": 4, "trainers": 5, "runtime": 5, "viz": 5, "experiments": 6, "baselines": 6, "cli": 7, "__main__": 7,
}  # fmt: skip
HEAVY = ("pybullet", "wandb", "hydra", "ray", "matplotlib", "scipy", "torchrl")
FILES = sorted(PACKAGE.rglob("*.py"))


def part_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def statements(path: Path, source: str) -> list[tuple[str, str]]:
    """Every import of a file, anywhere in it: module, and name taken from it or ""; relative imports resolved."""
    package = path.relative_to(ROOT).parent.parts
    found: list[tuple[str, str]] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = [*package[: len(package) - node.level + 1]] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            found += [(module, alias.name) for alias in node.names]
        elif isinstance(node, ast.Call) and "import_module" in ast.unparse(node.func):
            found += [(str(a.value), "") for a in node.args[:1] if isinstance(a, ast.Constant)]
    return found


def imported(path: Path, source: str) -> set[str]:
    """Names of the modules that a file imports, and of what it takes from them."""
    return {n for module, name in statements(path, source) for n in (module, f"{module}.{name}".rstrip("."))}


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
        ("viz/plots.py", "if TYPE_CHECKING:\n    from torchrl_sspl.experiments.run import Experiment"),
        ("viz/plots.py", "importlib.import_module('torchrl_sspl.experiments.run')"),
    ],
)
def test_upward_imports_are_seen(file, line):
    assert breaches(PACKAGE / file, line)


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def dependencies(sources: dict[Path, str]) -> dict[str, set[str]]:
    """Modules that each module needs, in functions too, and the packages that are loaded on the way."""
    modules = {module_of(path): path for path in sources}
    needs: dict[str, set[str]] = {name: set() for name in modules}
    for name, path in modules.items():
        # The package itself loads everything, when asked.
        for module, taken in () if name == "torchrl_sspl" else statements(path, sources[path]):
            found = f"{module}.{taken}" if f"{module}.{taken}" in modules else module
            if found in modules:
                needs[name].add(found)
            while found := found.rpartition(".")[0]:
                if found in modules and not f"{name}.".startswith(f"{found}."):
                    needs[name].add(found)
        needs[name] -= {name, "torchrl_sspl"}
    return needs


def circle(needs: dict[str, set[str]]) -> list[str]:
    """The shortest circle of imports, its first module again at its end; empty where there is none."""
    best: list[str] = []
    for start in sorted(needs):
        before: dict[str, str] = {}
        queue = [start]
        for name in queue:
            for other in sorted(needs[name]):
                if other == start and (not best or len(trail(before, start, name)) + 1 < len(best)):
                    best = [*trail(before, start, name), start]
                if other not in before and other != start:
                    before[other] = name
                    queue.append(other)
    return best


def trail(before: dict[str, str], start: str, end: str) -> list[str]:
    way = [end]
    while way[0] != start:
        way.insert(0, before[way[0]])
    return way


def test_no_imports_go_in_circles():
    found = circle(dependencies({path: path.read_text() for path in FILES}))
    assert not found, "a circle of imports: " + " -> ".join(found) + "; move what both need to a module below"


@pytest.mark.parametrize(
    ("files", "found"),
    [
        ({"sets.py": "import torchrl_sspl.errors", "errors.py": ""}, []),
        ({"sets.py": "import torchrl_sspl.errors", "errors.py": "from .sets import Box"}, ["errors", "sets", "errors"]),
        (
            {"viz/a.py": "def f():\n    from torchrl_sspl.viz.b import g", "viz/b.py": "from torchrl_sspl.viz import a"},
            ["viz.a", "viz.b", "viz.a"],
        ),
        ({"viz/a.py": "import importlib\nimportlib.import_module('torchrl_sspl.viz.a')"}, []),
        (
            {"viz/a.py": "x = importlib.import_module('torchrl_sspl.viz.b')", "viz/b.py": "from . import a"},
            ["viz.a", "viz.b", "viz.a"],
        ),
        (  # through what a package loads
            {"viz/__init__.py": "from torchrl_sspl.viz.a import f", "viz/a.py": "from torchrl_sspl.viz import f"},
            ["viz", "viz.a", "viz"],
        ),
        (
            {
                "envs/__init__.py": "from torchrl_sspl.envs.b import g", "envs/b.py": "from torchrl_sspl.data.a import f",
                "data/a.py": "import torchrl_sspl.envs.c", "envs/c.py": "", "data/__init__.py": "",
            },
            ["data.a", "envs", "envs.b", "data.a"],
        ),
        ({"viz/__init__.py": "from torchrl_sspl.viz.a import f", "viz/a.py": "from torchrl_sspl.viz import b", "viz/b.py": ""}, []),
    ],
)  # fmt: skip
def test_circles_are_seen(files, found):
    sources = {PACKAGE / name: text for name, text in files.items()}
    assert circle(dependencies(sources)) == [f"torchrl_sspl.{name}" for name in found]


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

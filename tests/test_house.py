"""The size of functions and classes, what there is one of, and what may not be in a file that is shipped."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path

import pytest

import torchrl_sspl

PACKAGE = Path(torchrl_sspl.__file__).parent
LINES, METHODS = 80, 20
#: What may be larger, with the reason. Better: none.
EXCEPTIONS: dict[str, str] = {}
#: Folders at the root of machines, and drives: none of them is the same elsewhere.
MACHINE = re.compile(
    rb"(?<![\w.:/~-])/(?:home|root|tmp|work|Users|usr|var|opt|mnt|media|data|scratch|srv|run|private|content|workspace)/\w"
    rb"|file://|(?<!\w)[A-Za-z]:\\\\?\w"
)
SHIPPED = sorted(p for part in ("agents", "configs") for p in (PACKAGE / part).rglob("*") if p.is_file() and "__pycache__" not in p.parts)


def too_large(source: str) -> dict[str, str]:
    """Functions with too many lines, their docstrings counted, and classes with too many methods, nested ones too."""
    found: dict[str, str] = {}

    def visit(node: ast.AST, name: str) -> None:
        for child in ast.iter_child_nodes(node):
            if not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                visit(child, name)
                continue
            inner = f"{name}.{child.name}".lstrip(".")
            lines = (child.end_lineno or 0) - child.lineno + 1
            methods = [n for n in ast.walk(child) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef) and n in child.body]
            if isinstance(child, ast.ClassDef):
                if len(methods) > METHODS:
                    found[inner] = f"{len(methods)} methods, at most {METHODS}"
            elif lines > LINES:
                found[inner] = f"{lines} lines, at most {LINES}"
            visit(child, inner)

    visit(ast.parse(source), "")
    return found


def test_functions_and_classes_are_small():
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        module = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        found |= {f"{module}.{name}": why for name, why in too_large(path.read_text()).items()}
    assert not {k: v for k, v in found.items() if k not in EXCEPTIONS}
    assert set(EXCEPTIONS) <= set(found), "an exception that is not needed any more"


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("def f():\n" + "    x = 1\n" * 79, []),
        ("def f():\n" + "    x = 1\n" * 80, ["f"]),
        ("class A:\n    def f(self):\n" + "        x = 1\n" * 80, ["A.f"]),
        ("def g():\n    def f():\n" + "        x = 1\n" * 80, ["g", "g.f"]),
        ("class A:\n" + "".join(f"    def m{k}(self): pass\n" for k in range(20)), []),
        ("class A:\n    @property\n    def p(self): pass\n" + "".join(f"    def m{k}(self): pass\n" for k in range(20)), ["A"]),
    ],
)
def test_what_is_too_large_is_seen(source, found):
    assert sorted(too_large(source)) == found


#: What there is one of: calls by which it is known, the files that hold it, and others with such calls that are none.
ONE = {
    "optimiser loop": (
        r"\.backward",
        {"trainers/stepper.py": "on pictures", "trainers/phases.py": "on frozen tensors, for everything else"},
    ),
    "closed-loop simulator": (
        r"(^|\.)(env|world)\.(step|dynamics)$|\.step_and_maybe_reset$",
        {
            "evaluation/simulation.py": "the simulator",
            "evaluation/blocks.py": "one step with the action zero tells two systems apart",
            "evaluation/known.py": "one step, whose error in the latent is measured",
            "envs/games.py": "an environment around another",
            "runtime/wrapper.py": "an environment around another",
            "experiments/film.py": "a world around another",
            "baselines/ceilings.py": "predictions of filters that know the dynamics",
            "baselines/imitation.py": "one step of every action: the expert",
            "baselines/nerf_cbf.py": "one step ahead by known dynamics",
            "baselines/neural_cbf.py": "one step ahead by known dynamics",
            "baselines/vision_cbf.py": "one step ahead by known dynamics",
        },
    ),
    "parser of settings": (
        r"\.from_dotlist$|\.partition\('='\)$",
        {"configs/reader.py": "the parser", "cli.py": "options of the command, --jobs=2",
         "baselines/cell.py": "sizes of a score, of words that the parser took apart", "baselines/registry.py": "the same of a method"},
    ),
}


def callers(source: str, pattern: str) -> bool:
    """Whether a file calls something whose name matches, docstrings not counted; `.partition` with its argument."""
    names = [
        ast.unparse(n) if ast.unparse(n.func).endswith(".partition") else ast.unparse(n.func)
        for n in ast.walk(ast.parse(source))
        if isinstance(n, ast.Call)
    ]
    return any(re.search(pattern, name) for name in names)


@pytest.mark.parametrize("thing", ONE)
def test_there_is_one_of_it(thing):
    pattern, known = ONE[thing]
    found = {str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py") if callers(path.read_text(), pattern)}
    assert found == set(known), f"{thing}: {sorted(found ^ set(known))}"


@pytest.mark.parametrize(
    ("thing", "line", "seen"),
    [
        ("optimiser loop", "loss.backward()", True),
        ("optimiser loop", "(a + b).sum().backward()", True),
        ("optimiser loop", "def backward(x): return x", False),
        ("closed-loop simulator", "data = env.step(data)", True),
        ("closed-loop simulator", "self.world.step(u)", True),
        ("closed-loop simulator", "z = agent.dynamics(z, u)", False),
        ("parser of settings", "key, _, value = word.partition('=')", True),
        ("parser of settings", "name.partition('.')", False),
    ],
)
def test_another_one_is_seen(thing, line, seen):
    assert callers(line, ONE[thing][0]) is seen


@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_no_shipped_file_knows_a_machine(path):
    found = [m.group().decode() for m in MACHINE.finditer(path.read_bytes())]
    assert not found, f"paths of a machine: {found[:5]}"
    if path.suffix == ".json" and "agents" in path.parts:
        assert not list(entries(json.loads(path.read_text()), "out_dir")), "out_dir: where it was trained is nobody's business"


def entries(body: object, key: str) -> list[object]:
    """Values of a key, however deep."""
    if isinstance(body, dict):
        return [v for k, v in body.items() if k == key] + [e for v in body.values() for e in entries(v, key)]
    return [e for v in body for e in entries(v, key)] if isinstance(body, list) else []


@pytest.mark.parametrize(
    ("text", "seen"),
    [
        ('"out_dir": "/tmp/a/b"', True),
        ("/home/x", True),
        ("C:\\\\Users\\\\x", True),
        ("file:///x", True),
        ("runs/pendulum", False),
        ("https://example.org/home/x", False),
        ("a/tmp/b", False),
        ("rad/s and m/run", False),
        ("torchrl_sspl.envs:PendulumEnv", False),
    ],
)
def test_paths_of_machines_are_seen(text, seen):
    assert bool(MACHINE.search(text.encode())) is seen


def test_there_is_something_shipped():
    assert {"agents", "configs"} <= {p.relative_to(PACKAGE).parts[0] for p in SHIPPED}
    assert entries({"a": [{"out_dir": 1}]}, "out_dir") == [1]

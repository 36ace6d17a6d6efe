"""Every example in a docstring runs, and every public name has a docstring."""

from __future__ import annotations

import doctest
import importlib
import inspect
import os
from pathlib import Path
from types import ModuleType

import pytest
import torch

import torchrl_sspl

OPTIONAL = ("pybullet", "matplotlib", "imageio", "wandb", "hydra", "ray", "daqp", "pygame")
ROOT = Path(torchrl_sspl.__file__).parent
# From the files: a module that cannot be imported fails its own test, not the collection of all.
NAMES = sorted({
    ".".join(p.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__")
    for p in ROOT.rglob("*.py")
    if p.stem != "__main__" and p != ROOT / "__init__.py"
})


def load(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        missing = getattr(error, "name", None) or str(error)
        if any(o in str(missing) for o in OPTIONAL):
            pytest.skip(f"needs an extra: {error}")
        raise


# Those that prove a shipped agent's set again.
SLOW = "torchrl_sspl.evaluation.certify"


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n == SLOW else n for n in ("torchrl_sspl", *NAMES)])
def test_examples_in_docstrings_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # what an example writes does not stay
    module = load(name)
    state, threads = torch.get_rng_state(), torch.get_num_threads()
    try:
        failed, _ = doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE, extraglobs={"torch": torch})
    finally:
        torch.set_rng_state(state)
    assert failed == 0
    assert torch.get_num_threads() == threads, "an example changed a global setting"
    assert os.path.samefile(os.getcwd(), tmp_path)


def public_members(module: ModuleType) -> list[tuple[str, object]]:
    """Functions, classes and the methods of these, that a module defines under a public name."""
    found: list[tuple[str, object]] = []
    for name, value in vars(module).items():
        if name.startswith("_") or getattr(value, "__module__", None) != module.__name__:
            continue
        if inspect.isfunction(value) or inspect.isclass(value):
            found.append((name, value))
        if inspect.isclass(value):
            for method, body in vars(value).items():
                if not method.startswith("_") and (inspect.isfunction(body) or isinstance(body, property | classmethod)):
                    found.append((f"{name}.{method}", getattr(value, method)))
    return found


@pytest.mark.parametrize("name", NAMES)
def test_public_names_have_docstrings(name):
    bare = []
    for label, value in public_members(load(name)):
        text = inspect.getdoc(value) or ""
        # A dataclass without one gets its signature as docstring.
        if not text.strip() or (inspect.isclass(value) and text.startswith(f"{value.__name__}(")):
            bare.append(label)
    assert not bare, f"without a docstring: {bare}"


def test_a_bare_function_is_seen():
    module = ModuleType("bare")
    exec("def f(): pass", vars(module))
    module.f.__module__ = "bare"
    assert [n for n, v in public_members(module) if not inspect.getdoc(v)] == ["f"]

"""What an environment that is given in code is, as plain values: for reports, and to notice that it has changed."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from types import CellType, CodeType, MethodType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_sspl.configs.reader import resolve
from torchrl_sspl.configs.schema import Config
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.files import write

CODE_FILE = "code.json"
_PLAIN = (bool, int, float, str, bytes, type(None))
_HOLDS = (list, tuple, set, frozenset, Mapping)
_ARRAYS = (np.generic, np.ndarray, Tensor)
_LIBRARY = __name__.partition(".")[0]
_INSTALLED = {_LIBRARY, "torch", "torchrl", "torchvision", "tensordict", "numpy", "gymnasium", *sys.stdlib_module_names}
_PATH = re.compile(r"[A-Za-z_][\w.]*[:.][A-Za-z_][\w.]*")
_NAMES = ("_target_", "safe", "unsafe", "reset_options")  # of an environment, whose path may have a dot for the colon


def describe(value: Any) -> Any:
    """Plain values as they are, functions by name and a digest of their code, partials by function and arguments.

    Returns what JSON can write. Two functions with the same digest compute the same, as far as their code, their
    defaults, what they close over and what they read from their own module go; so do methods and callable objects
    with their attributes, and classes of somebody's own. Source: none.

    Example:
        >>> describe(partial(dict, safe=lambda state, info: state[0] < 1, image_size=64))["image_size"]
        64
        >>> describe(lambda x: x < 1) == describe(lambda x: x < 2)
        False
    """
    if isinstance(value, partial):
        positional = {"arguments": [describe(v) for v in value.args]} if value.args else {}
        return {"made by": describe(value.func), **positional, **{k: describe(v) for k, v in value.keywords.items()}}
    if isinstance(value, Mapping):
        return {str(k): describe(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [describe(v) for v in value]
    if isinstance(value, (set, frozenset)):
        return sorted((describe(v) for v in value), key=repr)
    if isinstance(value, (np.generic, np.ndarray, Tensor)):
        return describe(value.tolist())
    if isinstance(value, _PLAIN):
        return repr(value) if isinstance(value, bytes) else value
    named = value if hasattr(value, "__qualname__") else type(value)
    name = f"{named.__module__}.{named.__qualname__}"
    if not _has_code(value):
        return name
    digest = hashlib.sha256()
    _digest(value, digest, {})
    return f"{name} {digest.hexdigest()[:12]}"


def _has_code(value: Any) -> bool:
    """Whether it is a function, or a class or a callable object that is not of an installed library."""
    if hasattr(value, "__code__"):
        return True
    kind = value if isinstance(value, type) else type(value)
    return callable(value) and _package(kind) not in _INSTALLED


def _package(kind: Any) -> str:
    return str(kind.__module__).partition(".")[0]


def _digest(value: Any, digest: Any, seen: dict[int, Any]) -> None:
    """Feeds what a function computes with: its code, and what that refers to in its own module."""
    if isinstance(value, CodeType):
        digest.update(value.co_code + repr(value.co_names).encode())
        for constant in value.co_consts:
            _digest(constant, digest, seen)
    elif isinstance(value, (*_HOLDS, *_ARRAYS, partial)) or _has_code(value):
        if id(value) in seen:
            return
        seen[id(value)] = value  # kept, as another object could get its id
        for part in _parts(value):
            _digest(part, digest, seen)
    else:
        digest.update(repr(describe(value)).encode())


def _parts(value: Any) -> Iterator[Any]:
    """What a container, an array, a class, an object or a function is made of."""
    if isinstance(value, Mapping):
        yield from ("{", *(part for pair in value.items() for part in pair), "}")
    elif isinstance(value, (set, frozenset)):
        yield from ("{", *sorted(value, key=lambda v: repr(describe(v))), "}")
    elif isinstance(value, (list, tuple)):
        yield from ("[", *value, "]")
    elif isinstance(value, _ARRAYS):
        data = value.detach().cpu().numpy() if isinstance(value, Tensor) and value.dtype != torch.bfloat16 else value
        yield from (str(value.dtype), list(value.shape), data.tobytes() if isinstance(data, np.ndarray) else data.tolist())
    elif isinstance(value, partial):
        yield from (value.func, value.args, value.keywords)
    elif isinstance(value, MethodType):
        yield value.__func__
        yield from _state(value.__self__)
    elif isinstance(value, type):
        for kind in value.__mro__:
            if _package(kind) == _package(value):
                yield from (part for name, member in sorted(vars(kind).items()) for part in _member(name, member))
    elif not hasattr(value, "__code__"):
        yield type(value)
        yield from _state(value)
    else:
        cells = [cell.cell_contents for cell in value.__closure__ or () if cell != CellType()]
        yield from (value.__code__, value.__defaults__, value.__kwdefaults__, *cells)
        kinds = (*_PLAIN, tuple) if _package(value) in _INSTALLED else (*_PLAIN, *_HOLDS, *_ARRAYS)  # registries fill up
        for name in _names(value.__code__):
            found = value.__globals__.get(name)
            if isinstance(found, kinds) or getattr(found, "__module__", None) == value.__module__:
                yield found


def _state(owner: Any) -> Iterator[Any]:
    """What a callable object, or the object of a method, computes with."""
    if isinstance(owner, nn.Module):
        yield owner.state_dict()
    elif isinstance(owner, type):
        yield owner
    elif not (hasattr(owner, "reset") and hasattr(owner, "step")):  # an environment changes as it runs
        yield getattr(owner, "__dict__", {})


def _member(name: str, member: Any) -> Iterator[Any]:
    """Name and code, or value, of an attribute of a class."""
    if isinstance(member, property):
        inner: tuple[Any, ...] = (member.fget, member.fset)
    else:
        inner = (getattr(member, "__func__", getattr(member, "func", member)),)
    if not name.startswith("__") or hasattr(inner[0], "__code__"):
        yield from (name, *inner)


def _names(code: CodeType) -> list[str]:
    inner = [name for constant in code.co_consts if isinstance(constant, CodeType) for name in _names(constant)]
    return sorted({*code.co_names, *inner})


def differences(one: Any, other: Any, path: str = "") -> list[str]:
    """A line such as ``"image_size: 32, now 48"`` for every difference of what was and what is. Source: none.

    Example:
        >>> differences({"a": 1, "b": {"c": 2}}, {"a": 1, "b": {"c": 3}})
        ['b.c: 2, now 3']
    """
    if isinstance(one, dict) and isinstance(other, dict):
        keys = [*one, *(k for k in other if k not in one)]
        return [d for k in keys for d in differences(one.get(k), other.get(k), f"{path}.{k}" if path else str(k))]
    return [] if one == other else [f"{path}: {one}, now {other}"]


def code_of(config: Config, encoder: Any = None) -> dict[str, Any]:
    """The code of their own that a system and an encoder run, by key: what import paths name, and a given encoder.

    Of what is in this library nothing is said. Source: none.

    Example:
        >>> sorted(code_of(Config(env={"_target_": "torchrl_sspl.envs.PendulumEnv"}), lambda latent_dim: None))
        ['encoder']
    """
    env = config.env if isinstance(config.env, dict) else {}
    named = {**{f"env.{key}": value for key, value in env.items()}, "encoder": config.network.encoder}
    found = {}
    for key, path in named.items():
        dots = key.removeprefix("env.") in (*_NAMES, "encoder")
        if isinstance(path, str) and _PATH.fullmatch(path) and (":" in path or dots) and not path.startswith(f"{_LIBRARY}."):
            try:
                found[key] = describe(resolve(path))
            except ConfigError:  # a text that only looks like a path
                continue
    return found if encoder is None else {**found, "encoder": describe(encoder)}


def keep_code(directory: Path, code: Mapping[str, Any]) -> None:
    """Write down the code of a run that begins. Source: none."""
    write(directory / CODE_FILE, json.dumps(code, indent=1, sort_keys=True) + "\n")


def changed_code(directory: Path, code: Mapping[str, Any]) -> list[str]:
    """Differences from the code of the run in a directory; none where it has not written that down. Source: none."""
    file = directory / CODE_FILE
    return differences(json.loads(file.read_text()), json.loads(json.dumps(code))) if file.is_file() else []


__all__ = ["changed_code", "code_of", "describe", "differences", "keep_code"]

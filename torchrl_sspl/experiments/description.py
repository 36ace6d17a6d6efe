"""What an environment that is given in code is, as plain values: for reports, and to notice that it has changed."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import partial
from types import CodeType
from typing import Any

import numpy as np
from torch import Tensor

_PLAIN = (bool, int, float, str, bytes, type(None))


def describe(value: Any) -> Any:
    """Plain values as they are, functions by name and a digest of their code, partials by function and arguments.

    Returns what JSON can write. Two functions with the same digest compute the same, as far as their code, their
    defaults, what they close over and what they read from their own module go. Source: none.

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
    if isinstance(value, (np.generic, np.ndarray, Tensor)):
        return describe(value.tolist())
    if isinstance(value, _PLAIN):
        return repr(value) if isinstance(value, bytes) else value
    named = value if hasattr(value, "__qualname__") else type(value)
    name = f"{named.__module__}.{named.__qualname__}"
    if not hasattr(value, "__code__"):
        return name
    digest = hashlib.sha256()
    _digest(value, digest, set())
    return f"{name} {digest.hexdigest()[:12]}"


def _digest(value: Any, digest: Any, seen: set[int]) -> None:
    """Feeds what a function computes with: its code, and what that refers to in its own module."""
    if isinstance(value, CodeType):
        digest.update(value.co_code + repr(value.co_names).encode())
        for constant in value.co_consts:
            _digest(constant, digest, seen)
    elif hasattr(value, "__code__"):
        if id(value) in seen:
            return
        seen.add(id(value))
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        for part in (value.__code__, value.__defaults__, value.__kwdefaults__, *cells):
            _digest(part, digest, seen)
        for name in _names(value.__code__):
            found = value.__globals__.get(name)
            if isinstance(found, (*_PLAIN, tuple)) or getattr(found, "__module__", None) == value.__module__:
                _digest(found, digest, seen)
    else:
        digest.update(repr(describe(value)).encode())


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


__all__ = ["describe", "differences"]

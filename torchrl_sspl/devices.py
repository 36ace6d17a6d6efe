"""Devices by name, and functions compiled for them."""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType, MethodType
from typing import Any

import torch

from torchrl_sspl.errors import ConfigError, MissingDependencyError


def usable_device(name: torch.device | str) -> torch.device:
    """The device of a name such as ``"cpu"``, ``"cuda"`` or ``"cuda:1"``, if this machine has it.

    Raises ConfigError if there is no such device here. Source: none.

    Example:
        >>> usable_device("cpu")
        device(type='cpu')
    """
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(
            f"device: expected a device that this machine has, such as cpu"
            f"{', cuda' if torch.cuda.is_available() else ''}, received '{name}' ({reason}); leave device out to run on the CPU"
        ) from error
    return device


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """A Python function or method of tensors as one graph for the shapes it is called with; the first call compiles, for up to half a minute.

    Beyond the eight shapes that torch keeps graphs for, calls run without one.
    What it takes from frozen modules must not change afterwards. When called, a MissingDependencyError if this machine has no
    compiler for it. Source: none.

    Example:
        >>> double = compiled(lambda x: 2 * x)
        >>> double(torch.ones(1))  # doctest: +SKIP
        tensor([2.])
    """
    # The modules are frozen, so they need not be looked at again in every call. Graphs are kept by code, and would be taken for those
    # of other modules of the same shapes: each gets a copy of the code.
    options: dict[str, Any] = {"guard_filter_fn": torch.compiler.skip_guard_on_all_nn_modules_unsafe}
    plain = getattr(function, "__func__", function)
    own = FunctionType(plain.__code__.replace(), plain.__globals__, plain.__name__, plain.__defaults__, plain.__closure__)
    bound = own if plain is function else MethodType(own, function.__self__)  # type: ignore[attr-defined]
    graph = torch.compile(bound, fullgraph=True, dynamic=False, options=options)

    def call(*given: Any) -> Any:
        try:
            return graph(*given)
        except Exception as error:
            if type(error).__name__ == "FailOnRecompileLimitHit":  # a loop that runs must not stop for it
                return function(*given)
            if not isinstance(error, RuntimeError) or "compiler" not in str(error).lower():
                raise
            raise MissingDependencyError(
                f"compile=True needs a C++ compiler such as g++, received: {str(error).splitlines()[0][:200]}; install one, or leave it out"
            ) from error

    return call


__all__ = ["compiled", "usable_device"]

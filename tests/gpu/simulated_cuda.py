"""Pytest plugin that gives a machine without a GPU a CUDA device (see ``simulated_cuda.cpp``).

It is to be loaded before torch: ``pytest -p simulated_cuda``, with the library in ``SIMULATED_CUDA``. What is compiled is
captured as a graph and run as it is, as there is no code generator for the device.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

SOURCE = Path(__file__).with_suffix(".cpp")


def build(compiler: str, directory: Path) -> Path:
    """Compile the device against the torch that is installed."""
    torch = Path(importlib.util.find_spec("torch").submodule_search_locations[0])
    library = directory / "libsimulated_cuda.so"
    include = [f"-I{torch / 'include'}", f"-I{torch / 'include' / 'torch' / 'csrc' / 'api' / 'include'}"]
    link = [f"-L{torch / 'lib'}", f"-Wl,-rpath,{torch / 'lib'}", "-lc10", "-ltorch_cpu"]
    command = [compiler, "-std=c++20", "-O0", "-shared", "-fPIC", *include, str(SOURCE), "-o", str(library), *link]
    result = subprocess.run(command, capture_output=True, text=True)
    if result.returncode:
        raise RuntimeError(f"{' '.join(command)}\n{result.stderr[-4000:]}")
    return library


class _Event:
    def __init__(self, *_, **__) -> None: ...

    def record(self, *_) -> None: ...

    def synchronize(self) -> None: ...


class _Stream:
    def __init__(self, *_, **__) -> None: ...

    def record_event(self, *_) -> _Event:
        return _Event()

    def wait_stream(self, *_) -> None: ...


def _install() -> None:
    """Answer for the parts of ``torch.cuda`` that a build without CUDA lacks."""
    import torch

    nothing = {"_lazy_init", "init", "synchronize", "empty_cache", "manual_seed", "manual_seed_all", "set_rng_state"}
    for name in nothing:
        setattr(torch.cuda, name, lambda *_, **__: None)
    answers = {
        "is_available": True,
        "is_initialized": True,
        "is_bf16_supported": True,
        "is_current_stream_capturing": False,
        "device_count": 1,
        "current_device": 0,
        "_exchange_device": 0,
        "_maybe_exchange_device": -1,
        "get_device_name": "simulated",
    }
    for name, answer in answers.items():
        setattr(torch.cuda, name, lambda *_, answer=answer, **__: answer)
    torch.cuda.get_rng_state = lambda *_: torch.zeros(16, dtype=torch.uint8)
    torch.cuda.Event, torch.cuda.Stream = _Event, _Stream
    torch.cuda.current_stream = lambda *_: _Stream()
    torch.cuda.stream = lambda _: contextlib.nullcontext()

    host_clone = torch.UntypedStorage.clone

    def clone(self: torch.UntypedStorage) -> torch.UntypedStorage:
        if self.device.type == "cpu":
            return host_clone(self)
        return torch.empty(self.nbytes(), dtype=torch.uint8, device="cuda").untyped_storage().copy_(self)

    torch.UntypedStorage.clone = clone
    compiled, compiled_module = torch.compile, torch.nn.Module.compile
    torch.compile = lambda model=None, **options: compiled(model, **options | {"backend": "aot_eager", "mode": None})
    torch.nn.Module.compile = lambda self, *_, **options: compiled_module(self, **options | {"backend": "aot_eager"})


if "SIMULATED_CUDA" in os.environ:
    assert "torch" not in sys.modules, "the device has to be there before torch"
    ctypes.CDLL(os.environ["SIMULATED_CUDA"], mode=ctypes.RTLD_GLOBAL)
    _install()

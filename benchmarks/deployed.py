"""One step of an agent where it is used: latency on one thread, and what its ONNX file and its graph compute differently.

Run: OMP_NUM_THREADS=1 python benchmarks/deployed.py [AGENT ...]
Prints a table in Markdown; differences are the largest of 10,000 random steps, the action's of its range.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import onnxruntime
import torch

import torchrl_sspl as sspl
from torchrl_sspl.devices import compiled
from torchrl_sspl.modules.export import DeployedStep, _steps
from torchrl_sspl.runtime import Shield

STEPS, BATCH, TIMED = 10_000, 500, 1000


def milliseconds(call: Callable[[Any], Any], rows: list[Any]) -> str:
    """Median and 99 % of calls on rows, one after the other."""
    taken = []
    for row in rows[:50]:  # graphs are made, caches filled
        call(row)
    for k in range(TIMED):
        began = time.perf_counter()
        call(rows[k % len(rows)])
        taken.append(1e3 * (time.perf_counter() - began))
    return f"{np.quantile(taken, 0.5):.2f} / {np.quantile(taken, 0.99):.2f}"


def protected(monitor: sspl.Monitor, shield: Shield, row: dict[str, torch.Tensor]) -> Any:
    """Another policy's action behind monitor and filter."""
    told = monitor.step(row["pixels"])
    return shield(told.latent, row["action"], told.action)


def differences(agent: Any, other: Callable[..., Any]) -> str:
    """Largest difference of another step from the library's, of 10,000: of the action, relative to its range, and of the barrier."""
    step, scale, action, barrier = DeployedStep(agent), 2 * float(agent.policy.action_scale.max()), 0.0, 0.0
    for k in range(STEPS // BATCH):
        given = _steps(agent, BATCH, 100 + k)
        wanted, found = step(**given), other(given)
        action = max(action, float((wanted[0] - found[0]).abs().max()) / scale)
        barrier = max(barrier, float((wanted[1] - found[1]).abs().max()))
    return f"{action:.1e} | {barrier:.1e}"


@torch.no_grad()
def main(*names: str) -> None:
    """Print the table."""
    torch.set_num_threads(1)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    print("| Agent | run by | step, p50 / p99 [ms] | with monitor | with monitor and filter | action differs | barrier differs |")
    print("|---|---|---|---|---|---|---|")
    for name in names or ("pendulum", "quadruped"):
        agent = sspl.load(name)
        file = agent.export(Path(mkdtemp()) / "agent.onnx")
        session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        given = _steps(agent, BATCH, 100)
        rows = [{key: value[k : k + 1] for key, value in given.items()} for k in range(BATCH)]
        arrays = [{key: value.numpy() for key, value in row.items()} for row in rows]

        def run(given: dict[str, torch.Tensor], session: Any = session) -> list[torch.Tensor]:
            return [torch.from_numpy(made) for made in session.run(None, {key: value.numpy() for key, value in given.items()})]

        print(f"| {name} | onnxruntime | {milliseconds(partial(session.run, None), arrays)} | | | {differences(agent, run)} |")
        graph = compiled(DeployedStep(agent).forward)
        for compile in (False, True):
            alone, monitor = agent.controller(compile=compile), sspl.Monitor.load(name, compile=compile)
            shield = Shield(agent, margin=0.02, compile=compile)
            calls = [
                lambda row, alone=alone: alone.step(row["pixels"]),
                lambda row, monitor=monitor: monitor.step(row["pixels"]),
                partial(protected, monitor, shield),
            ]
            apart = differences(agent, lambda given, graph=graph: graph(*given.values())) if compile else "| "
            times = " | ".join(milliseconds(call, rows) for call in calls)
            print(f"| {name} | torch{', compiled' * compile} | {times} | {apart} |")


if __name__ == "__main__":
    main(*sys.argv[1:])

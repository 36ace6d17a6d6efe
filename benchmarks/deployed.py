"""One step of an agent where it is used: latency on one thread, and what its ONNX file computes differently.

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
from torchrl_sspl.modules.export import DeployedStep, _steps
from torchrl_sspl.runtime import Shield

STEPS, TIMED = 10_000, 1000


def milliseconds(call: Callable[[Any], Any], rows: list[Any]) -> str:
    """Median and 99 % of calls on rows, one after the other."""
    taken = []
    for k in range(TIMED):
        began = time.perf_counter()
        call(rows[k % len(rows)])
        taken.append(1e3 * (time.perf_counter() - began))
    return f"{np.quantile(taken, 0.5):.2f} / {np.quantile(taken, 0.99):.2f}"


def protected(monitor: sspl.Monitor, shield: Shield, row: dict[str, torch.Tensor]) -> Any:
    """Another policy's action behind monitor and filter."""
    told = monitor.step(row["pixels"])
    return shield(told.latent, row["action"], told.action)


@torch.no_grad()
def main(*names: str) -> None:
    """Print the table."""
    torch.set_num_threads(1)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    print("| Agent | onnxruntime, p50 / p99 [ms] | torch | with monitor | with monitor and filter | action differs | barrier differs |")
    print("|---|---|---|---|---|---|---|")
    for name in names or ("pendulum", "quadruped"):
        agent = sspl.load(name)
        file = agent.export(Path(mkdtemp()) / "agent.onnx")
        session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        step, monitor, shield = DeployedStep(agent), sspl.Monitor.load(name), Shield(agent, margin=0.02)
        scale, action, barrier = 2 * float(agent.policy.action_scale.max()), 0.0, 0.0
        for k in range(STEPS // 500):
            given = _steps(agent, 500, 100 + k)
            wanted = step(**given)
            found = session.run(None, {key: value.numpy() for key, value in given.items()})
            action = max(action, float(np.abs(wanted[0].numpy() - found[0]).max()) / scale)
            barrier = max(barrier, float(np.abs(wanted[1].numpy() - found[1]).max()))
        rows = [{key: value[k : k + 1] for key, value in given.items()} for k in range(500)]
        arrays = [{key: value.numpy() for key, value in row.items()} for row in rows]
        calls = {
            "onnxruntime": partial(session.run, None),
            "torch": lambda row, step=step: step(**row),
            "monitor": lambda row, monitor=monitor: monitor.step(row["pixels"]),
            "filter": partial(protected, monitor, shield),
        }
        times = [milliseconds(call, arrays if label == "onnxruntime" else rows) for label, call in calls.items()]
        print(f"| {name} | {' | '.join(times)} | {action:.1e} | {barrier:.1e} |")


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Faults of the camera in the loop: does the monitor notice before U is entered, how late, and how often for nothing.

Run: python benchmarks/camera_faults.py [AGENT] [EPISODES] [STEPS] [FAULT ...]
Prints two tables in Markdown. Episodes start in {B <= 0}, drawn with a seed of their own; the fault begins at step 3, and the camera
has a noise of one grey level. The agent goes on during an
alarm, so that its use is seen: "noticed" are those of the episodes that enter U whose alarm came before.
"""

from __future__ import annotations

import sys

import torch
from tqdm import tqdm

import torchrl_sspl as sspl
from torchrl_sspl.evaluation import simulate
from torchrl_sspl.evaluation.blocks import described_system
from torchrl_sspl.runtime.faults import FAULTS, CameraFault
from torchrl_sspl.runtime.monitor import Calibration, Watching, starts
from torchrl_sspl.sets import UNSAFE

SEED, ONSET, NOISE = 20261123, 3, 1.0


@torch.no_grad()
def main(name: str = "pendulum", episodes: int = 100, steps: int = 100, only: tuple[str, ...] = ()) -> None:
    """Print the tables."""
    agent = sspl.load(name)
    calibration, factory = Calibration.load(name, agent), described_system(agent.description)
    assert factory is not None
    env = factory([1], SEED)
    begin = starts(agent, env, max(episodes, 1000), torch.Generator().manual_seed(SEED))
    if not only:
        watching = Watching(agent, calibration, change=CameraFault("dark", 1.0, noise=NOISE))
        simulate(watching, env, start=begin, horizon=200)
        alarmed = int(watching.alarms().any(0).sum())
        print(f"Clean episodes of 200 steps with an alarm: {alarmed} of {len(begin)} (expected at most {100 * calibration.false_alarms:.2g} %)\n")
    begin = begin[:episodes]
    print("| Fault | strength | episodes into U | of these noticed before | with an alarm | delay, median [steps] |\n|---|---|---|---|---|---|")
    for fault, strength in tqdm([(f, s) for f in only or FAULTS for s in FAULTS[f]], leave=False):
        watching = Watching(agent, calibration, change=CameraFault(fault, strength, onset=ONSET, noise=NOISE))
        run = simulate(watching, env, start=begin, horizon=steps)
        alarm = watching.alarms()
        unsafe = (run.region == UNSAFE) & run.alive
        never = len(alarm)
        first = torch.where(alarm.any(0), alarm.int().argmax(0), never)
        entered, when = unsafe.any(0), torch.where(unsafe.any(0), unsafe.int().argmax(0), never)
        noticed = int((entered & (first < when)).sum())
        late, there = (first - ONSET)[first < never], int(run.alive[ONSET].sum())
        told = f"{float(late.median()):.0f}" if len(late) else "-"
        print(f"| {fault} | {strength:g} | {int(entered.sum())} | {noticed} | {len(late)} of {there} | {told} |", flush=True)


if __name__ == "__main__":
    given = sys.argv[1:]
    main(*given[:1], *(int(v) for v in given[1:3]), tuple(given[3:]))

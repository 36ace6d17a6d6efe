"""How much the pendulum's torque changes from step to step where it is at rest.

Run: python benchmarks/rest.py [AGENT ...]
Prints a table in Markdown, of 100 episodes of 300 steps from S with a seed of their own; the last 140 steps count.
"""

from __future__ import annotations

import sys

import torch

import torchrl_sspl as sspl
from torchrl_sspl.evaluation import simulate
from torchrl_sspl.evaluation.blocks import described_system

SEED, EPISODES, STEPS, LAST = 20261124, 100, 300, 140


def main(*names: str) -> None:
    """Print the table."""
    print("| Agent | change of the torque per step, mean [N m] | median | mean torque | speed, standard deviation [rad/s] |\n|---|---|---|---|---|")
    for name in names or ("pendulum",):
        agent = sspl.load(name)
        env = described_system(agent.description)([1], SEED)  # type: ignore[misc]
        start = env.sample_states(EPISODES, torch.Generator().manual_seed(SEED), region=env.safe_set)
        run = simulate(agent, env, start=start, horizon=STEPS)
        torque, speed = run.actions[-LAST:, :, 0], run.states[-LAST:, :, 1]  # type: ignore[index]
        change = torque.diff(dim=0).abs()
        print(f"| {name} | {change.mean():.3f} | {change.median():.3f} | {torque.abs().mean():.2f} | {speed.std():.3f} |", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])

"""The safety filter on the pendulum: episodes that enter U under random and adversarial actions, with it and without.

Run: python benchmarks/filter.py [AGENT] [EPISODES] [LEVEL ...]
Prints a table in Markdown. Episodes have 200 steps and start in {B <= 0}, drawn with a seed of their own.
"""

from __future__ import annotations

import sys

import torch
from torch import Tensor
from tqdm import tqdm

import torchrl_sspl as sspl
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.modules.controller import Memory
from torchrl_sspl.runtime import Shield
from torchrl_sspl.runtime.monitor import starts

STEPS, SEED = 200, 20261122


def random_actions(state: Tensor, held: Tensor, generator: torch.Generator) -> Tensor:
    """Uniform, each held for five steps on average."""
    new = (torch.rand(len(state), 1, generator=generator) * 2 - 1) * 10
    return torch.where(torch.rand(len(state), 1, generator=generator) < 0.2, new, held)


def towards_u(state: Tensor, held: Tensor, generator: torch.Generator) -> Tensor:
    """Full torque away from upright."""
    return 10.0 * torch.sign(state[:, :1] + 0.3 * state[:, 1:])


@torch.no_grad()
def main(name: str = "pendulum", episodes: int = 1000, *levels: float) -> None:
    """Print the table."""
    agent, env = sspl.load(name), PendulumEnv(batch_size=[1], seed=SEED)
    start = starts(agent, env, episodes, torch.Generator().manual_seed(SEED))
    print("| Actions | filter | episodes that enter U | steps with an intervention | mean deviation [half ranges] |\n|---|---|---|---|---|")
    policies = {"random": random_actions, "adversarial": towards_u, "the agent's own": None}
    for (label, wants), level in ((p, v) for p in policies.items() for v in levels or (None, 0.0, -0.1)):
        shield = None if level is None else Shield(agent, level=level)
        g, memory, x, before = torch.Generator().manual_seed(SEED + 1), Memory(agent), start, env.previous_state(start)
        entered, action = torch.zeros(len(x), dtype=torch.bool), torch.zeros(len(x), 1)
        changed = moved = 0.0
        for _ in tqdm(range(STEPS), desc=f"{label}, {level}", leave=False):
            latent = memory.correct(agent.encode(torch.cat([env.draw(before), env.draw(x)], 1)))[0]
            action = agent.policy(latent) if wants is None else wants(x, action, g)
            taken = action
            if shield is not None:
                made = shield(latent, action)
                taken = made.action
                changed, moved = changed + float(made.intervened.float().mean()), moved + float(made.deviation.mean())
            memory.expect(agent.dynamics(latent, taken))
            before, x = x, env.wrap(env.dynamics(x, taken))
            entered |= env.unsafe_set.contains(x)
        told = "none" if level is None else f"level {level:g}"
        print(f"| {label} | {told} | {int(entered.sum()):,} of {len(x):,} | {100 * changed / STEPS:.1f} % | {moved / STEPS:.2f} |")


if __name__ == "__main__":
    given = sys.argv[1:]
    main(*given[:1], *(int(v) for v in given[1:2]), *(float(v) for v in given[2:]))

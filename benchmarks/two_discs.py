r"""CMU's car between two discs: a nominal policy heads for the goal, alone and behind filters that see pictures.

Run: python benchmarks/two_discs.py RUN_OR_AGENT [RUN_OR_AGENT ...] [--episodes N] [--seed S] [--budget small] [--rivals NAMES] [--level L] [--out FILE]
Prints tables in Markdown and writes one JSON. The nominal policy is sampling-based (MPPI, with the weights of the public code of latent_cbf), which
knows state, goal and discs, but looks only 0.4 m ahead; *blind* is the same without the discs. Episodes start as theirs do, at the left, at states of
the true kernel, and end at the goal, outside the arena or after 200 steps. The rivals learn from ``--budget`` transitions, with the encoder that
the agents have, on pictures of 64 x 64. A step counts as changed where the action differs from the wanted one.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_sspl.baselines import BUDGETS, SafetyMethod, make
from torchrl_sspl.baselines.data import record
from torchrl_sspl.certification.statistics import clopper_pearson
from torchrl_sspl.envs.base import wrapped
from torchrl_sspl.envs.two_discs import DISCS, GOAL, RADIUS, CMUTwoDiscsEnv
from torchrl_sspl.evaluation import simulate
from torchrl_sspl.evaluation.controllers import Camera, Decision
from torchrl_sspl.evaluation.known import states_where
from torchrl_sspl.evaluation.simulation import looked_at
from torchrl_sspl.sets import Box
from torchrl_sspl.viability import ViabilityKernel, viability_kernel

SEED, HORIZON, SIZE = 20261126, 200, 64
STARTS = Box([-1.5, -1.0, -math.pi / 3, -0.6], [-1.0, 1.0, math.pi / 3, 0.6])
RIVALS = "latent_safe,latent_safe:threshold=0.1,latent_safe:threshold=0.2,latent_safe:threshold=0.3,smooth_latent,smooth_latent:keep=0.5"
SAMPLES, AHEAD, SPREAD, TEMPERATURE = 500, 8, math.sqrt(3.0), 3.0
TO_GOAL, TO_DISC, EFFORT, STEADY, MARGIN = 10.0, 10.0, 0.01, 0.2, 0.05


class Planner:
    """MPPI from true states ``(n, 4)`` to yaw rates ``(n, 1)``, for episodes side by side.

    Their costs: squared distances to the goal, the last one six times; an exponential of how deep a disc with a margin is entered, and a small square of
    nearness, both times one random number a step, as theirs; effort, its changes, and what differs from the plan before.
    """

    def __init__(self, env: CMUTwoDiscsEnv, blind: bool = False, seed: int = SEED) -> None:
        self.env, self.blind = env, blind
        self.generator, self.plans = torch.Generator().manual_seed(seed), torch.zeros(0)

    def __call__(self, state: Tensor, rows: Tensor) -> Tensor:
        """The first action of the mean plan, of some of the episodes; of all of them where they begin."""
        if not len(self.plans):
            off = torch.atan2(state[:, 3] - state[:, 1], GOAL - state[:, 0]) - state[:, 2]
            self.plans = (2.0 * wrapped(off)).clamp(-2.0, 2.0)[:, None].repeat(1, AHEAD)
        n, before = len(state), self.plans[rows, None]
        noise = SPREAD * torch.randn(n, SAMPLES, AHEAD, generator=self.generator)
        tried = (before + noise).clamp(-self.env.max_action, self.env.max_action)
        at, cost = state[:, None].expand(n, SAMPLES, 4).reshape(-1, 4), torch.zeros(n * SAMPLES)
        luck = torch.rand(2, 2, generator=self.generator)
        for k in range(AHEAD):
            at = self.env.dynamics(at, tried[:, :, k].reshape(-1, 1))
            away = (at[:, 0] - GOAL).square() + (at[:, 1] - at[:, 3]).square()
            cost += TO_GOAL * (6.0 if k == AHEAD - 1 else 1.0) * away
            for disc, (deep, near) in zip([] if self.blind else DISCS, luck, strict=False):
                off = (at[:, :2] - torch.tensor(disc)).norm(dim=1)
                inside = RADIUS + MARGIN - off
                cost += torch.where(inside > 0, TO_DISC * deep * (5.0 * inside).exp(), near * (1.5 * (RADIUS + MARGIN) - off).clamp_min(0.0).square())
        cost = cost.reshape(n, SAMPLES) + EFFORT * tried.square().sum(2) + 0.5 * EFFORT * tried.diff(dim=2).square().sum(2)
        cost += STEADY * (tried - before).square().sum(2)
        plan = (torch.softmax(-cost / TEMPERATURE, 1)[..., None] * tried).sum(1)
        self.plans[rows] = torch.cat([plan[:, 1:], plan[:, -1:]], 1)
        return plan[:, :1]


class Through(SafetyMethod):
    """No filter at all: what is wanted is done."""

    name, reads, learns = "none", "state", False

    def fit(self, data: Any, env: Any, budget: Any, seed: int) -> None:
        """Nothing is learnt."""

    def barrier(self, seen: Tensor) -> Tensor | None:
        """It claims nothing."""
        return None

    def act(self, seen: Tensor, nominal: Tensor) -> tuple[Tensor, Tensor]:
        """What is wanted."""
        return nominal, torch.zeros(len(seen), dtype=torch.bool)


class Noted:
    """A method behind a nominal policy; notes what that wants of every car at every step."""

    reads, streams = "pixels", True

    def __init__(self, method: SafetyMethod, nominal: Callable[[Tensor, Tensor], Tensor], n: int) -> None:
        self.inner, self.nominal, self.n = method.controller(lambda state: self.now), nominal, n
        self.wanted: list[Tensor] = []

    def reset(self, rows: Tensor | None = None) -> None:
        """Forgets what belongs to episodes."""
        self.inner.reset(rows)

    def watch(self, camera: Camera, rows: Tensor | None = None) -> Decision:
        """Nothing is decided about the last observation."""
        return Decision()

    def step(self, camera: Camera, rows: Tensor | None = None) -> Decision:
        """What the method makes of what is wanted."""
        index = torch.arange(self.n) if rows is None else rows
        self.now = self.nominal(camera.state, index)
        self.wanted.append(torch.zeros(self.n).index_copy(0, index, self.now[:, 0]))
        return self.inner.step(camera, rows)


def episodes(method: SafetyMethod, env: CMUTwoDiscsEnv, start: Tensor, nominal: Callable[[Tensor, Tensor], Tensor]) -> dict[str, Any]:
    """What happens from states ``(n, 4)``: shares of the episodes, and means over their steps."""
    acts = Noted(method, nominal, len(start))
    run = simulate(acts, env, start=start, horizon=HORIZON)
    assert run.states is not None
    there = env.reached(run.states)
    alive = looked_at(run, env) & (there.cumsum(0) - there.int() == 0)  # until the goal is reached, that moment included
    hit = (env.unsafe_set.contains(run.states) & alive).any(0)
    reached = (there & alive).any(0)
    steps = alive[1:]  # a step counts where it led to something
    taken, wanted = run.actions[..., 0], torch.stack(acts.wanted)
    off = torch.zeros_like(taken)
    off[: len(wanted)] = (taken[: len(wanted)] - wanted[: len(taken)]).abs()  # when all are gone nothing is wanted any more
    turn, both = taken.diff(dim=0).abs(), steps[1:]
    return {
        "episodes": len(start), "collisions": int(hit.sum()), "bounds": clopper_pearson(int(hit.sum()), len(start)),
        "reached without a collision": int((reached & ~hit).sum()), "left": int((~hit & ~reached & ~looked_at(run, env)[-1]).sum()),
        "changed": float((off > 1e-6)[steps].float().mean()), "deviation": float(off[steps].mean()), "jerk": float(turn[both].mean()),
        "hit": hit.tolist(),
    }  # fmt: skip


def truth(env: CMUTwoDiscsEnv) -> ViabilityKernel:
    """The true kernel on the system's own grid."""
    return viability_kernel(env, resolution=env.system.kernel_grid)


def main() -> None:
    """Print the tables, write the JSON."""
    asked = argparse.ArgumentParser()
    asked.add_argument("agents", nargs="*")
    asked.add_argument("--episodes", type=int, default=400)
    asked.add_argument("--seed", type=int, default=0, help="of the rivals' training")
    asked.add_argument("--budget", default="small", help="of the rivals; none: without them")
    asked.add_argument("--rivals", default=RIVALS, help="NAME or NAME:key=value, separated by commas")
    asked.add_argument("--level", type=float, action="append", help="of the agents' filter; may be given again")
    asked.add_argument("--out", default="two_discs.json")
    given = asked.parse_args()
    env = CMUTwoDiscsEnv([1], seed=SEED)
    kernel = truth(env)
    start = states_where(kernel.contains, STARTS, given.episodes, torch.Generator().manual_seed(SEED))
    perfect: Any = make("kernel")
    perfect.kernel = kernel
    methods: dict[str, SafetyMethod] = {"none": Through(), "true kernel, true state": perfect}
    if given.budget != "none":
        data = record(env, BUDGETS[given.budget], given.seed, size=SIZE)
        for rival in given.rivals.split(","):
            name, *options = rival.split(":")
            methods[rival] = make(name, options)
            torch.manual_seed(given.seed)
            methods[rival].fit(data, env, BUDGETS[given.budget], given.seed)
    perfect.fit(None, env, BUDGETS["tiny"], 0)
    for agent in given.agents:
        for level in given.level or (0.0,):
            methods[f"{agent}, level {level:g}"] = made = make("sspl", [f"agent={agent}", "filter=true", f"level={level}"])
            made.fit(None, env, BUDGETS["tiny"], 0)
    body: dict[str, Any] = {}
    print("| filter | nominal | collisions | at the goal without one | left | steps changed | deviation [rad/s] | change of u [rad/s a step] | claimed at the start, and of these collide |")
    print("|" + "---|" * 9)
    for name, method in methods.items():
        parts = [start] if method.reads == "state" else [env.observe(part) for part in start.split(64)]
        claimed = None if (claims := [method.claims(part) for part in parts])[0] is None else torch.cat(claims)
        for label in ("MPPI", "blind MPPI"):
            found = episodes(method, env, start, Planner(env, blind=label != "MPPI"))
            hit = torch.tensor(found.pop("hit"))
            found |= {"claimed": None if claimed is None else int(claimed.sum()), "of these collide": None if claimed is None else int((claimed & hit).sum())}
            body.setdefault(name, {})[label] = found
            n = found["episodes"]
            said = "-" if claimed is None else f"{found['claimed']}, {found['of these collide']}"
            print(
                f"| {name} | {label} | {found['collisions']} of {n} | {found['reached without a collision']} | {found['left']} | {100 * found['changed']:.0f} % "
                f"| {found['deviation']:.2f} | {found['jerk']:.2f} | {said} |", flush=True,
            )  # fmt: skip
    Path(given.out).write_text(json.dumps(body, indent=1) + "\n")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()

"""The safety filter: episodes that enter U under random, adversarial and safe actions, with it and without.

Run: python benchmarks/filter.py [AGENT] [EPISODES] [LEVEL ...] [--margin M] [--noise N] [--only ACTIONS] [--physics]
Prints a table in Markdown. Episodes have 200 steps and start in {B <= 0}, drawn with a seed of their own; with --physics they are walks
of the quadruped in PyBullet. An agent without a proof gets the margin --margin, .02 by default.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

import torchrl_sspl as sspl
from torchrl_sspl.envs import DubinsEnv, PendulumEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.evaluation import simulate
from torchrl_sspl.evaluation.blocks import described_system
from torchrl_sspl.evaluation.controllers import AgentController, Decision
from torchrl_sspl.evaluation.known import encode_states
from torchrl_sspl.evaluation.simulation import Episodes
from torchrl_sspl.runtime import Protected, SafetyWrapper, Shield
from torchrl_sspl.runtime.filter import LEVEL, UNPROVED_MARGIN
from torchrl_sspl.runtime.monitor import starts
from torchrl_sspl.sets import UNSAFE

STEPS, SEED, AT_ONCE = 200, 20261122, 250
TURNS, LOOKAHEAD = 32, 60  # longest turn that the adversarial driver of a car thinks of, and how far it looks ahead, in steps

SIDES = (-1.0, 0.0, 1.0)
PLANS = list(itertools.product(SIDES, range(0, 24, 3), SIDES, range(0, 24, 3), SIDES))  # a turn for so many steps, another one, a third


class Driver:
    """Actions from true states, as what acts in ``simulate``: on known dynamics from its camera's states, else from poses."""

    streams = True

    def __init__(self, wants: Callable[[Any, Tensor, Tensor, torch.Generator], Tensor], env: Any, reads: str = "pixels") -> None:
        self.wants, self.env, self.reads, self.generator = wants, env, reads, torch.Generator().manual_seed(SEED + 1)

    def reset(self, rows: Tensor | None = None) -> None:
        """Nothing is held any more."""
        self.held: Tensor | None = None

    def step(self, observation: Any, rows: Tensor | None = None) -> Decision:
        """Actions for some or all of the systems."""
        state = (observation if self.reads == "state" else observation.state).float()
        if self.held is None:
            self.held = torch.zeros(len(state), self.env.action_dim)
        index = torch.arange(len(self.held)) if rows is None else rows
        action = self.wants(self.env, state, self.held[index], self.generator)
        self.held[index] = action
        return Decision(action=action)


def random_actions(env: Any, state: Tensor, held: Tensor, generator: torch.Generator) -> Tensor:
    """Uniform, each held for five steps on average."""
    new = (torch.rand(len(state), 1, generator=generator) * 2 - 1) * env.max_action
    return torch.where(torch.rand(len(state), 1, generator=generator) < 0.2, new, held)


def away_from_upright(env: Any, state: Tensor, held: Tensor, generator: torch.Generator) -> Tensor:
    """Full torque."""
    return env.max_action * torch.sign(state[:, :1] + 0.3 * state[:, 1:])


def first_entry(env: Any, state: Tensor, turns: Callable[[int], Tensor]) -> Tensor:
    """Step ``(n,)`` in which cars enter U under turns ``(n, 1)`` in [-1, 1] at every step; LOOKAHEAD where they leave first, or never do."""
    when, out = torch.full((len(state),), LOOKAHEAD), torch.zeros(len(state), dtype=torch.bool)
    for t in range(LOOKAHEAD):
        state = env.wrap(env.dynamics(state, env.max_action * turns(t)))
        out |= ~env.state_space.contains(state)
        when = torch.where(~out & (env.region(state)[:, 0] == UNSAFE), when.clamp(max=t), when)
    return when


def towards_obstacle(env: Any, state: Tensor, held: Tensor, generator: torch.Generator) -> Tensor:
    """The way into U that is there first, of full turns to either side and then straight ahead; the shorter turn to its middle if none is."""
    turns = torch.arange(-TURNS, TURNS + 1, 2)
    x, k = state.repeat_interleave(len(turns), 0), turns.repeat(len(state))[:, None]
    when = first_entry(env, x, lambda t: k.sgn() * (t < k.abs())).reshape(len(state), -1)
    chosen = turns[when.argmin(1)].sgn()[:, None] * env.max_action
    ahead = torch.stack([state[:, 2].cos(), state[:, 2].sin()], 1)
    aside = ahead[:, :1] * -state[:, 1:2] - ahead[:, 1:] * -state[:, :1]
    return torch.where(when.amin(1, keepdim=True) < LOOKAHEAD, chosen, env.max_action * aside.sgn())


def reachable(env: Any, state: Tensor) -> int:
    """From how many states one of PLANS steers a car into U before it leaves."""
    plans, entered = torch.tensor(PLANS), 0
    for some in state.split(50):
        first, until, second, longer, third = plans.repeat(len(some), 1)[..., None].unbind(1)
        when = first_entry(
            env, some.repeat_interleave(len(plans), 0),
            lambda t, f=first, u=until, s=second, n=longer, e=third: torch.where(t < u, f, torch.where(t < u + n, s, e)),
        )  # fmt: skip
        entered += int((when < LOOKAHEAD).reshape(len(some), -1).any(1).sum())
    return entered


ADVERSARIAL = ((PendulumEnv, away_from_upright), (DubinsEnv, towards_obstacle))


def adversary_of(env: Any) -> Callable[..., Tensor]:
    """Who wants harm of a system."""
    for kind, wants in ADVERSARIAL:
        if isinstance(env, kind):
            return wants
    raise ConfigError(f"adversarial: expected an agent of a pendulum or a Dubins car, received one of {type(env).__name__}; give --only random or --only own")


def noisy(draw: Any, noise: float) -> Any:
    """What draws states, seen by a camera with a noise of some grey levels."""
    generator = torch.Generator().manual_seed(SEED + 2)

    def drawn(state: Tensor) -> Tensor:
        frame = draw(state).float()
        return (frame + noise * torch.randn(frame.shape, generator=generator)).round().clamp(0, 255).to(torch.uint8)

    return drawn if noise > 0.0 else draw


def on_known_dynamics(agent: Any, env: Any, draw: Any, start: Tensor, wants: Any, shield: Shield | None) -> tuple[Episodes, str]:
    """Episodes side by side, and the share of steps with an intervention with the mean deviation."""
    made: list[Protected] = []

    def change(latent: Tensor, action: Tensor) -> Tensor:
        assert shield is not None
        made.append(shield(latent, action))
        return made[-1].action

    runs, steps, changed, moved = list[Episodes](), 0, 0.0, 0.0
    # An agent by itself acts on few episodes at once; whoever draws actions for all of them needs all of them.
    for part in start.split(AT_ONCE if wants is None else len(start)):
        made.clear()
        acts = AgentController(agent, None if wants is None else Driver(wants, env), None if shield is None else change)
        runs.append(simulate(acts, env, start=part, horizon=STEPS, draw=draw, label="episodes" if sys.stderr.isatty() else None))
        there = runs[-1].alive[1 : len(made) + 1]  # whoever left is asked for nothing
        if made:
            intervened, deviation = (torch.stack([getattr(m, k) for m in made])[: len(there)][there] for k in ("intervened", "deviation"))
            steps, changed, moved = steps + len(deviation), changed + float(intervened.sum()), moved + float(deviation.sum())
    told = f"{100 * changed / steps:.3g} % | {moved / steps:.2g}" if steps else "- | -"
    return runs[0].joined(*runs[1:]), told


def in_physics(agent: Any, env: Any, start: Tensor, wants: Any, options: dict[str, Any] | None) -> tuple[Episodes, str]:
    """Walks one after the other, as above."""
    world = env.physics()()
    world = world if options is None else SafetyWrapper(world, agent, **options)
    acts = agent if wants is None else Driver(wants, env, reads="state")
    run = simulate(acts, world, start=start, horizon=STEPS, seed=SEED, label="walks" if sys.stderr.isatty() else None)
    told = world.statistics if isinstance(world, SafetyWrapper) else None
    world.close()
    if told is None:
        return run, "- | -"
    return run, f"{100 * told['interventions'] / told['steps']:.3g} % | {told['deviation'] / told['steps']:.2g}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("agent", nargs="?", default="pendulum")
    parser.add_argument("episodes", nargs="?", type=int, default=1000)
    parser.add_argument("levels", nargs="*", type=float, default=[])
    parser.add_argument("--margin", type=float, help="in place of the proved one")
    parser.add_argument("--noise", type=float, default=0.0, help="of the camera, grey levels; not in physics")
    parser.add_argument("--only", help="random, adversarial or own")
    parser.add_argument("--physics", action="store_true", help="walks in full physics")
    given = parser.parse_args(arguments)
    agent = sspl.load(given.agent)
    factory = described_system(agent.description)
    if factory is None:
        raise ConfigError(f"agent: expected one whose description names a system of this library, received '{given.agent}', which names none")
    env: Any = factory([1], SEED)
    env = env.known_twin() if given.physics else env
    start = starts(agent, env, given.episodes, torch.Generator().manual_seed(SEED))
    margin = given.margin if given.margin is not None or agent.tolerated_error > 0 else UNPROVED_MARGIN
    if given.noise > 0.0 and not given.physics:
        shown = agent.barrier(encode_states(agent, env, start, draw=noisy(env.draw, given.noise)))[:, 0] <= 0.0
        print(f"Starts that this camera shows in {{B <= 0}}: {int(shown.sum()):,} of {len(start):,}\n")
    worst = adversary_of(env) if given.only in (None, "adversarial") else None
    if worst is towards_obstacle:
        print(f"Starts from which one of {len(PLANS):,} plans enters U before the car leaves: {reachable(env, start):,} of {len(start):,}\n")
    print("| Actions | filter | episodes that enter U | hit | fallen | steps with an intervention | mean deviation [half ranges] |")
    print("|---|---|---|---|---|---|---|")
    policies = {"random": random_actions, "adversarial": worst, "own": None}
    for label, wants in policies.items():
        for level in (None, *(given.levels or (0.0, LEVEL))) if given.only in (None, label) else ():
            options = None if level is None else {"level": level, "margin": margin}
            if given.physics:
                run, told = in_physics(agent, env, start, wants, options)
            else:
                shield = None if options is None else Shield(agent, **options)
                run, told = on_known_dynamics(agent, env, noisy(env.draw, given.noise), start, wants, shield)
            entered = int(((run.region == UNSAFE) & run.alive).any(0).sum())
            hit, fallen = (int(run.events[k].sum()) if k in run.events else "-" for k in ("hit", "fallen"))
            name = "none" if options is None else f"level {level:g}" + ("" if margin is None else f", margin {margin:g}")
            print(f"| {label} | {name} | {entered:,} of {len(run):,} | {hit} | {fallen} | {told} |", flush=True)


if __name__ == "__main__":
    main()

"""Faults in the loop: does the monitor notice before U is entered, how late, and how often for nothing.

Run: python benchmarks/camera_faults.py [AGENT] [EPISODES] [STEPS] [FAULT ...] [--physics]
Prints a table in Markdown. Episodes start in {B <= 0}, drawn with a seed of their own; the fault begins at step 3, and the camera
has a noise of one grey level. The agent goes on during an alarm, so that its use is seen: "noticed" are those of the episodes that
enter U whose alarm came before. "Premise" says when it was first not met: before U was entered, in the same step, or not by then.

FAULT is one of a camera's, or "none": clean episodes, of which each alarm is a false one. With --physics episodes are walks of the quadruped
in PyBullet, and "pushed" and "slippery" are faults, too: a push towards the obstacle during step 3 (N s), and another friction of the
ground from the first step on. The walks of these two start in S as well.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium
import torch
from torch import Tensor
from tqdm import tqdm

import torchrl_sspl as sspl
from torchrl_sspl.certification.statistics import clopper_pearson
from torchrl_sspl.evaluation import simulate
from torchrl_sspl.evaluation.blocks import described_system
from torchrl_sspl.evaluation.simulation import Episodes
from torchrl_sspl.runtime.faults import FAULTS, CameraFault
from torchrl_sspl.runtime.monitor import Calibration, Watching, starts
from torchrl_sspl.sets import UNSAFE

SEED, ONSET, NOISE, CLEAN_STEPS = 20261123, 3, 1.0, 200
WORLD_FAULTS: dict[str, tuple[float, float, float]] = {
    "pushed": (6.0, 12.0, 24.0),  # N s, of a robot of 12 kg
    "slippery": (0.5, 0.3, 0.15),  # coefficient of friction; 0.9 is usual, no less than 0.6 what the walking controller supposes
}
HEAD = "| Fault | strength | episodes into U | of these noticed before | premise lost before / then / later | with an alarm | delay, median [steps] | hit | fallen |"


class Pushed(gymnasium.Wrapper):
    """A world whose robot is pushed towards the obstacle during one step of every episode."""

    def __init__(self, world: Any, impulse: float) -> None:
        super().__init__(world)
        self.impulse = impulse

    def reset(self, **options: Any) -> Any:
        """Begin, and count from here."""
        observation, info = self.env.reset(**options)
        self.t, self.pose = 0, info["pose"]
        return observation, info

    def step(self, action: Any) -> Any:
        """Walk, and be pushed if it is time."""
        if self.t == ONSET:
            x, y, heading = torch.as_tensor(self.pose)
            away = torch.as_tensor(self.unwrapped.obstacle_centre) - torch.stack([x, y])
            self.unwrapped.push(self.impulse * float(torch.sign(heading.cos() * away[1] - heading.sin() * away[0])))
        self.t += 1
        *rest, info = self.env.step(action)
        self.pose = info["pose"]
        return *rest, info


def told(run: Episodes, watching: Watching, onset: int) -> str:
    """The entries of a row."""
    alarm, applies, unsafe = watching.alarms(), watching.applies(), (run.region == UNSAFE) & run.alive
    never = len(unsafe)

    def first(happens: Tensor) -> Tensor:
        return torch.where(happens.any(0), happens.int().argmax(0), never)

    entered, when, noticed, lost = unsafe.any(0), first(unsafe), first(alarm), first(~applies)
    late, there = (noticed - onset)[noticed < never], int(run.alive[onset].sum())
    delay = f"{float(late.median()):.0f}" if len(late) else "-"
    premise = [int((entered & happened).sum()) for happened in (lost < when, lost == when, lost > when)]
    events = [str(int(run.events[k].sum())) if k in run.events else "-" for k in ("hit", "fallen")]
    counts = f"{int(entered.sum())} | {int((entered & (noticed < when)).sum())} | {' / '.join(map(str, premise))}"
    return f"{counts} | {len(late)} of {there} | {delay} | {' | '.join(events)}"


def in_the_world(agent: Any, calibration: Calibration, env: Any, name: str, strength: float, start: Tensor, steps: int) -> str:
    """Walks with another friction, or with a push."""
    world = env.physics()(friction=strength) if name == "slippery" else Pushed(env.physics()(), strength)
    watching = Watching(agent, calibration, change=CameraFault("dark", 1.0, noise=NOISE))
    run = simulate(watching, world, start=start, horizon=steps, seed=SEED)
    world.close()
    return told(run, watching, 0 if name == "slippery" else ONSET)


def rows(agent: Any, calibration: Calibration, given: Any) -> Iterator[tuple[str, str]]:
    """Faults, and what they do."""
    factory, generator = described_system(agent.description), torch.Generator().manual_seed(SEED)
    assert factory is not None
    env: Any = factory([1], SEED)
    env = env.known_twin() if given.physics else env
    begin = starts(agent, env, max(given.episodes, 1000), generator)
    few, world = begin[: given.episodes], env.physics()() if given.physics else env
    options: dict[str, Any] = {"seed": SEED} if given.physics else {}
    if not given.faults or "none" in given.faults:
        watching = Watching(agent, calibration, change=CameraFault("dark", 1.0, noise=NOISE))
        start, steps = (few, given.steps) if given.physics else (begin, CLEAN_STEPS)
        run = simulate(watching, world, start=start, horizon=steps, label="clean episodes" if sys.stderr.isatty() else None, **options)
        alarmed = int(watching.alarms().any(0).sum())
        print(
            f"Clean episodes of {steps} steps with an alarm: {alarmed} of {len(start):,}, at most {100 * clopper_pearson(alarmed, len(start))[1]:.2g} % "
            f"with 95 % confidence; the calibration expects at most {100 * calibration.false_alarms:.2g} %. Mean length {float(run.alive.sum(0).float().mean()):.1f}\n"
        )
        print(f"{HEAD}\n|{'---|' * (HEAD.count('|') - 1)}")
        yield "none | -", told(run, watching, 0)
    else:
        print(f"{HEAD}\n|{'---|' * (HEAD.count('|') - 1)}")
    for name, strength in tqdm([(f, s) for f in given.faults or FAULTS if f in FAULTS for s in FAULTS[f]], leave=False):
        watching = Watching(agent, calibration, change=CameraFault(name, strength, onset=ONSET, noise=NOISE))
        run = simulate(watching, world, start=few, horizon=given.steps, **options)
        yield f"{name} | {strength:g}", told(run, watching, ONSET)
    places = {"S": env.safe_set.sample(given.episodes, generator), "{B <= 0}": few} if given.physics else {}
    for where, start in places.items():
        for name, strength in [(f, s) for f in given.faults or WORLD_FAULTS if f in WORLD_FAULTS for s in WORLD_FAULTS[f]]:
            yield f"{name}, from {where} | {strength:g}", in_the_world(agent, calibration, env, name, strength, start, given.steps)


@torch.no_grad()
def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("agent", nargs="?", default="pendulum")
    parser.add_argument("episodes", nargs="?", type=int, default=100)
    parser.add_argument("steps", nargs="?", type=int, default=100)
    parser.add_argument("faults", nargs="*", choices=[*FAULTS, *WORLD_FAULTS, "none", []], default=[])
    parser.add_argument("--physics", action="store_true", help="walks in full physics")
    given = parser.parse_args(arguments)
    agent = sspl.load(given.agent)
    for fault, result in rows(agent, Calibration.load(given.agent, agent), given):
        print(f"| {fault} | {result} |", flush=True)


if __name__ == "__main__":
    main()

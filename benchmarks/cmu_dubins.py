"""CMU's Dubins car from pixels, scored as latent safety filters were, and on the full grid, in the loop and on shifted pictures.

Run: python benchmarks/cmu_dubins.py [RUN_OR_AGENT ...] [--rows DIR ...] [--out FILE] [--episodes N] [--shifts 0]
Prints tables in Markdown and writes one JSON. ``--rows`` are directories of rows of ``python -m torchrl_sspl.baselines METHOD
env=cmu``, scored on the cells of their own grid. Positive is "safe". Truth is the viability kernel of ``CMUDubinsEnv``. Their score
uses 51 x 51 positions at the headings 0 and pi/2; the full grid has 51 headings. An agent sees two frames of a car that
drove straight on before, and nothing else. Starts of episodes are drawn with a seed of their own.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchrl_sspl as sspl
from torchrl_sspl.baselines.cell import CLAIMS_FILE, ROW_FILE, Cell
from torchrl_sspl.baselines.table import name_of
from torchrl_sspl.certification.statistics import clopper_pearson
from torchrl_sspl.envs import CMUDubinsEnv
from torchrl_sspl.evaluation import simulate
from torchrl_sspl.evaluation.known import barrier_of, states_where
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.runtime import Monitor
from torchrl_sspl.runtime.faults import CameraFault
from torchrl_sspl.viability import ViabilityKernel, viability_kernel

SEED, NODES, HORIZON, ROWS = 20261122, 51, 60, 1000
CYAN, MAGENTA, YELLOW = (0.0, 1.0, 1.0), (1.0, 0.0, 1.0), (1.0, 1.0, 0.0)
#: What LatentSafe reports (evaluate_appearance_ood.html of its repository, branch dubins_wm_lasse): shares tp, tn, fp, fn, two headings.
PUBLISHED = {
    "nominal": (0.757, 0.216, 0.003, 0.024),
    "arrow scale 0.1": (0.738, 0.208, 0.012, 0.042),
    "cyan background": (0.0, 0.220, 0.0, 0.780),
    "magenta background": (0.0, 0.220, 0.0, 0.780),
    "magenta obstacle": (0.0, 0.220, 0.0, 0.780),
    "yellow obstacle": (0.764, 0.213, 0.006, 0.016),
}
SHIFTS: dict[str, dict[str, Any]] = {
    "nominal": {},
    "arrow scale 0.1": {"arrow_scale": 0.1},
    "cyan background": {"background": CYAN},
    "magenta background": {"background": MAGENTA},
    "magenta obstacle": {"obstacle_colour": MAGENTA},
    "yellow obstacle": {"obstacle_colour": YELLOW},
    "arrow of their evaluation, no dot": {"arrow_scale": 0.2, "arrow_width": 0.05, "dot_area": 0.0},
}


def slices(env: CMUDubinsEnv) -> Tensor:
    """Their states: 51 x 51 positions at two headings."""
    states = env.state_space.grid((NODES, NODES, 1)).repeat(2, 1)  # type: ignore[attr-defined]
    states[:, 2] = torch.tensor([0.0, math.pi / 2]).repeat_interleave(NODES**2)
    return states


def scores(called: Tensor, safe: Tensor) -> dict[str, Any]:
    """Shares and rates of states that are called safe."""
    found = {"tp": called & safe, "tn": ~called & ~safe, "fp": called & ~safe, "fn": ~called & safe}
    return rates(*(float(v.float().mean()) for v in found.values()))


def rates(tp: float, tn: float, fp: float, fn: float) -> dict[str, Any]:
    """What follows from the four shares; None where nothing is called safe."""
    recall, miss = tp / (tp + fn), fp / (fp + tn)
    return {
        "tp": tp, "tn": tn, "fp": fp, "fn": fn, "accuracy": tp + tn, "balanced_accuracy": (recall + 1 - miss) / 2,
        "precision": tp / (tp + fp) if tp + fp else None, "recall": recall, "unsafe_called_safe": miss,
        "f1": 2 * tp / (2 * tp + fp + fn),
    }  # fmt: skip


def heads_at_disc(state: Tensor) -> Tensor:
    """States outside the disc from which driving straight on ends in it."""
    x, y, heading = state.unbind(-1)
    along, aside = x * heading.cos() + y * heading.sin(), (y * heading.cos() - x * heading.sin()).abs()
    return (x.hypot(y) > 0.5) & (along < 0) & (aside < 0.5)


def in_the_loop(agent: Agent, env: CMUDubinsEnv, kernel: ViabilityKernel, n: int) -> dict[str, Any]:
    """Episodes that enter U: from {B <= 0}, and from states of the kernel that head at the disc."""
    generator = torch.Generator().manual_seed(SEED)
    inside = states_where(lambda x: barrier_of(agent, env, x) <= 0, env.state_space, n, generator)  # type: ignore[operator]
    ahead = states_where(lambda x: kernel.contains(x) & heads_at_disc(x), env.state_space, n // 5, generator)
    found: dict[str, Any] = {}
    for name, start in (("from the claimed set", inside), ("from the kernel, heading at the disc", ahead)):
        run = simulate(agent, env, start=start, horizon=HORIZON)
        entered = env.unsafe_set.contains(run.states).any(0)
        assert run.barrier is not None
        claimed = run.barrier[0] <= 0
        found[name] = {
            "episodes": len(start), "enter U": int(entered.sum()), "claimed": int(claimed.sum()),
            "of these enter U": int((entered & claimed).sum()), "bounds": clopper_pearson(int(entered.sum()), len(start)),
        }  # fmt: skip
    return found


def on_shifts(agent: Agent, kernel: ViabilityKernel, n: int) -> dict[str, Any]:
    """What is called safe on shifted pictures, and how often the monitor knows them for strange, frame by frame."""
    env = CMUDubinsEnv([1], seed=SEED)
    calibration = sspl.calibrate(agent, env, episodes=400, horizon=HORIZON, seed=SEED)
    drawn, theirs = env.state_space.sample(n, torch.Generator().manual_seed(SEED + 1)), slices(env)
    found = {}
    for name, options in SHIFTS.items():
        shifted = CMUDubinsEnv([1], seed=SEED, **options)
        camera, called, strange = CameraFault("dark", 1.0, onset=1, noise=1.0, seed=SEED), [], []
        for part in drawn.split(ROWS):
            # A step of episodes that have just begun: nothing is remembered.
            seen = Monitor(agent, calibration, batch_size=len(part)).step(camera(shifted.observe(part), 0))
            called.append(seen.barrier <= 0)
            strange.append(seen.alarm)
        value = barrier_of(agent, shifted, theirs)
        assert value is not None
        believed, alarm, safe = torch.cat(called), torch.cat(strange), kernel.contains(drawn)
        found[name] = {
            "two headings": scores(value <= 0, kernel.contains(theirs)),
            "uniform": scores(believed, safe),
            "uniform, believed by the monitor": scores(believed & ~alarm, safe),
            "unknown picture": float(alarm.float().mean()),
            "unknown picture of a state outside U": float(alarm[~env.unsafe_set.contains(drawn)].float().mean()),
        }
    return found


def row(name: str, s: dict[str, Any]) -> str:
    """A row of the first table."""
    shares = " | ".join(f"{s[k]:.3f}" for k in ("tp", "tn", "fp", "fn"))
    told = " | ".join("-" if s[k] is None else f"{100 * s[k]:.1f} %" for k in ("recall", "unsafe_called_safe", "precision", "balanced_accuracy"))
    return f"| {name} | {shares} | {told} | {s['f1']:.3f} |"


def of_row(directory: Path) -> tuple[str, dict[str, Any]]:
    """Name and scores of a row of the comparison, whose claims lie beside it."""
    cell = json.loads((directory / ROW_FILE).read_text())["cell"]
    if cell["env"] != "cmu":
        raise SystemExit(f"--rows: expected a row of env=cmu, received one of env={cell['env']} in {directory}")
    with np.load(directory / CLAIMS_FILE) as body:
        found = scores(*(torch.from_numpy(body[name]) for name in ("claimed", "viable")))
    name = name_of(Cell(cell["method"], options=tuple(cell["options"]), trials=cell.get("trials", 0)))
    return f"{name}, budget {cell['budget']}, seed {cell['seed']}", found


def main() -> None:
    """Print the tables, write the JSON."""
    asked = argparse.ArgumentParser()
    asked.add_argument("agents", nargs="*")
    asked.add_argument("--rows", nargs="+", type=Path, default=[])
    asked.add_argument("--out", default="cmu_dubins.json")
    asked.add_argument("--episodes", type=int, default=10_000)
    asked.add_argument("--shifts", type=int, default=20_000, help="uniform states per shift; 0: none")
    given = asked.parse_args()
    env = CMUDubinsEnv([1], seed=SEED)
    kernel = viability_kernel(env, resolution=env.system.kernel_grid)
    theirs, full = slices(env), env.state_space.grid((NODES,) * 3)  # type: ignore[attr-defined]
    body: dict[str, Any] = {"unsafe share of the grid": float((~kernel.contains(full)).float().mean()), "published": PUBLISHED, "agents": {}, "rows": {}}
    print("| method, states | tp | tn | fp | fn | recall | unsafe called safe | precision | balanced accuracy | F1 |\n|---|---|---|---|---|---|---|---|---|---|")
    print(row("LatentSafe, published, two headings", rates(*PUBLISHED["nominal"])))
    print(row('"only the disc is unsafe", full grid', scores(~env.unsafe_set.contains(full), kernel.contains(full))))
    for name in given.agents:
        agent = sspl.load(name)
        body["agents"][name] = found = {}
        for label, states in (("two headings", theirs), ("full grid", full)):
            value = barrier_of(agent, env, states)
            assert value is not None
            found[label] = scores(value <= 0, kernel.contains(states))
            print(row(f"{name}, {label}", found[label]), flush=True)
        found["training ended"] = agent.description.get("stop_reason", "")
    for directory in (path for path in given.rows if not path.is_file()):  # trials lie beside rows
        name, found = of_row(directory)
        body["rows"][name] = found
        print(row(f"{name}, its grid", found), flush=True)
    for name, found in body["agents"].items():
        agent = sspl.load(name)
        found["in the loop"] = in_the_loop(agent, env, kernel, given.episodes) if given.episodes else {}
        print(f"\n{name}")
        if found["in the loop"]:
            print(f"\n| episodes of {HORIZON} steps | enter U | claimed at the start | of these enter U |\n|---|---|---|---|")
        for label, of in found["in the loop"].items():
            print(f"| {label} | {of['enter U']} of {of['episodes']} | {of['claimed']} | {of['of these enter U']} |", flush=True)
        found["shifts"] = on_shifts(agent, kernel, given.shifts) if given.shifts else {}
        if found["shifts"]:
            print("\n| picture | LatentSafe F1 | F1 | unsafe called safe | the same, monitored | unknown pictures | outside U |\n|---|---|---|---|---|---|---|")
        for label, of in found["shifts"].items():
            told = f"{rates(*PUBLISHED[label])['f1']:.3f}" if label in PUBLISHED else "-"
            miss, kept = (of[k]["unsafe_called_safe"] for k in ("uniform", "uniform, believed by the monitor"))
            print(f"| {label} | {told} | {of['two headings']['f1']:.3f} | {100 * miss:.1f} % | {100 * kept:.1f} % | {100 * of['unknown picture']:.1f} % | {100 * of['unknown picture of a state outside U']:.1f} % |", flush=True)
    Path(given.out).write_text(json.dumps(body, indent=1) + "\n")


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()

"""Deciding invariance on a whole latent domain: time, and boxes per second against a plain loop over interval bounds.

    python benchmarks/verification.py [agent ...]

One thread; agents are names of shipped ones or run directories (default: pendulum). Ratios are measured in this run.
"""

from __future__ import annotations

import sys
import time

import torch

from torchrl_sspl.certification.branch_and_bound import SLACK, Budget, Problem
from torchrl_sspl.certification.conditions import decide_invariance, largest_error
from torchrl_sspl.certification.graph import Graph
from torchrl_sspl.certification.loop import ClosedLoop, closed_loop
from torchrl_sspl.certification.propagation import interval_bounds
from torchrl_sspl.lipschitz import SandwichBarrier, prove_lipschitz
from torchrl_sspl.modules.agent import load


def plain_loop(problem: Problem, seconds: float) -> tuple[float, float]:
    """Branch and bound, one box at a time, interval arithmetic: boxes per second, volume left after the time."""
    looped, barrier = problem.function, problem.barrier
    boxes = [(problem.low, problem.high)]
    domain, left, count = float((problem.high - problem.low).prod()), 0.0, 0
    start = time.perf_counter()
    while boxes and time.perf_counter() - start < seconds:
        low, high = boxes.pop()
        count += 1
        if float(_bounds(barrier, low, high)[0]) > problem.level + SLACK:
            continue
        if float(_bounds(looped, low, high)[1]) + float(problem.constant) <= -SLACK:
            continue
        axis = int((high - low).argmax())
        middle = 0.5 * (low[axis] + high[axis])
        first, second = high.clone(), low.clone()
        first[axis], second[axis] = middle, middle
        boxes += [(low, first), (second, high)]
    left = sum(float((high - low).prod()) for low, high in boxes) / domain
    return count / (time.perf_counter() - start), left


def _bounds(graph: Graph, low: torch.Tensor, high: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    lower, upper = interval_bounds(graph, low[None], high[None])[-1]
    return lower[0, 0], upper[0, 0]


def measure(name: str, system: ClosedLoop) -> None:
    """Print time and verdict of one closed loop."""
    start = time.perf_counter()
    outcome = decide_invariance(system, budget=Budget(seconds=900.0))
    seconds = time.perf_counter() - start
    print(f"{name}: {system.latent_dim}-D latent, [V] {outcome.status} in {seconds:.2f} s, {outcome.boxes} boxes", flush=True)
    if outcome.status != "proved":
        print(f"  largest violation found {outcome.lower:.4f}, volume left {outcome.remaining_volume:.3g}")
        return
    start = time.perf_counter()
    found = largest_error(system, budget=Budget(seconds=900.0))
    print(
        f"  tolerated error between {found.delta:.5f} and {found.refuted_above:.5f} latent in "
        f"{time.perf_counter() - start:.2f} s, {found.outcome.boxes} boxes",
        flush=True,
    )
    per_second, left = plain_loop(system.problem(level=0.0), 20.0)
    low = system.low.expand(16384, -1)
    start = time.perf_counter()
    for graph in (system.barrier, system.looped):
        interval_bounds(graph, low, low + 0.01)
    batched, tight = len(low) / (time.perf_counter() - start), outcome.boxes / seconds
    print(
        f"  boxes per second: plain loop over interval bounds {per_second:.0f}, the same bounds in one batch {batched:.0f} "
        f"({batched / per_second:.0f} x), linear bounds {tight:.0f} ({tight / per_second:.1f} x)"
    )
    print(f"  after 20 s the plain loop has {100 * left:.1f} % of the domain left")


def main() -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    for name in sys.argv[1:] or ["pendulum"]:
        agent = load(name)
        parts = (agent.barrier, agent.dynamics, agent.policy)
        measure(name, closed_loop(*parts, latent_dim=agent.latent_dim, lipschitz_bound=agent.lipschitz_bound))
    torch.manual_seed(0)
    barrier = SandwichBarrier(3, (64, 64, 64), 2.0)
    proof = prove_lipschitz(barrier.collapse(), 2.0, multipliers=barrier.multipliers())
    print(f"exact Lipschitz proof, 3 x 64: proved {proof.proved} in {proof.seconds:.2f} s")


if __name__ == "__main__":
    main()

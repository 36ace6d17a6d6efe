"""Lipschitz barriers: time of the exact proof of a 3 x 64 barrier, tightness of both kinds, cost of the sandwich layers.

python benchmarks/lipschitz.py [steps]

Processor time of one thread, so that other work on the machine does not count.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_sspl.lipschitz import LMIBarrier, SandwichBarrier, lipschitz_lower, lipschitz_upper, prove_lipschitz

BOUND, WIDTH, SEEDS = 2.0, 64, (0, 1, 2)


def cone(z: Tensor) -> Tensor:
    """A function whose slope is the bound everywhere: a loose barrier cannot follow it."""
    return BOUND * (z.norm(dim=1, keepdim=True) - 0.6)


def clocked(function: Callable[[], Any]) -> tuple[float, Any]:
    """Processor seconds and result."""
    start = time.process_time()
    result = function()
    return time.process_time() - start, result


def per_call(function: Callable[[], object], repeats: int = 40) -> float:
    """Median processor seconds of a call."""
    return statistics.median(clocked(function)[0] for _ in range(repeats))


def train(barrier: SandwichBarrier | LMIBarrier, steps: int, penalty: float = 1e-4) -> float:
    """Fits the cone; the LMI barrier with the paper's log-determinant and backtracking. Root mean square error."""
    generator = torch.Generator().manual_seed(0)
    optimiser = torch.optim.Adam(barrier.parameters(), 3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        z = 2 * torch.rand(256, 2, generator=generator) - 1
        loss = (barrier(z) - cone(z)).square().mean()
        optimiser.zero_grad()
        if isinstance(barrier, LMIBarrier):
            before = {k: v.clone() for k, v in barrier.state_dict().items()}
            (loss + penalty * barrier.loss()).backward()
            optimiser.step()
            barrier.backtracking_step(before)
        else:
            loss.backward()
            optimiser.step()
        schedule.step()
    with torch.no_grad():
        z = 2 * torch.rand(20000, 2, generator=generator) - 1
        return float((barrier(z) - cone(z)).square().mean().sqrt())


def main() -> None:
    """Measure and print."""
    steps = int(sys.argv[1]) if len(sys.argv) > 1 else 1500
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(1)

    print(f"cone of slope {BOUND} on [-1, 1]^2, L = {BOUND}, 3 x {WIDTH}, {steps} steps")
    print("barrier   seed   rms error   sampled/L   provable/L   proof of L   proof     ms/step")
    trained: dict[str, nn.Sequential] = {}
    for name, make in (("sandwich", SandwichBarrier), ("LMI", LMIBarrier)):
        for seed in SEEDS:
            torch.manual_seed(seed)
            barrier = make(2, (WIDTH,) * 3, BOUND)
            spent, error = clocked(lambda b=barrier: train(b, steps))
            plain = trained[name] = barrier.collapse()
            took, proof = clocked(lambda p=plain, b=barrier: prove_lipschitz(p, BOUND, multipliers=b.multipliers()))
            lower = lipschitz_lower(plain, -1.0, 1.0, 20000, generator) / BOUND
            upper = lipschitz_upper(plain) / BOUND
            print(f"{name:9} {seed:4} {error:11.4f} {lower:11.4f} {upper:12.4f}   {proof.proved!s:10} "
                  f"{took:6.2f} s {1e3 * spent / steps:9.2f}")

    plain = trained["sandwich"]
    took, proof = clocked(lambda: prove_lipschitz(plain, BOUND))
    print(f"proof without a witness, multipliers searched for: {proof.proved} in {took:.2f} s")
    false = 0.99 * lipschitz_lower(plain, -1.0, 1.0, 20000, generator)
    took, proof = clocked(lambda: prove_lipschitz(plain, false))
    print(f"claim of {false:.3f}, below the sampled slope: {proof.proved} in {took:.2f} s")

    torch.manual_seed(0)
    barrier, z = SandwichBarrier(2, (WIDTH,) * 3, BOUND), torch.rand(512, 2)
    bare = barrier.collapse()
    print("ms for a batch of 512        sandwich   plain network   ratio")
    for name, run in (
        ("forward", lambda net: net(z)),
        ("forward and backward", lambda net: net(z).sum().backward()),
    ):
        both = [1e3 * per_call(lambda n=net, r=run: r(n)) for net in (barrier, bare)]
        print(f"{name:26} {both[0]:10.3f} {both[1]:15.3f} {both[0] / both[1]:7.2f}")


if __name__ == "__main__":
    main()

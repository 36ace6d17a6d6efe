"""Frames per second and accuracy of the batched renderer against gymnasium's render() and area resize.

    python benchmarks/rendering.py [n_angles]

Both run in this process, on one thread, one after the other.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable

import torch

from torchrl_sspl.envs.rendering import GymnasiumRenderer, PendulumRenderer


def seconds_per_frame(draw: Callable[[], object], n: int, repeats: int) -> float:
    """Median over repeats of the time that drawing n frames takes, per frame."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        draw()
        times.append((time.perf_counter() - start) / n)
    return statistics.median(times)


def main() -> None:
    """Measure and print."""
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    torch.set_num_threads(1)
    angle = (torch.rand(n, generator=torch.Generator().manual_seed(0)) * 2 - 1) * torch.pi
    reference, few = GymnasiumRenderer(64), angle[:200]
    expected = reference(angle)
    reference.draw(few[:5])
    slow = seconds_per_frame(lambda: reference.draw(few), len(few), 3)
    table = seconds_per_frame(lambda: reference(angle), n, 5)
    scene = reference._env.unwrapped
    alone = seconds_per_frame(lambda: [scene.render() for _ in range(100)], 100, 3)
    print(f"gymnasium render() + area resize   {1e6 * slow:9.1f} us/frame")
    print(f"gymnasium render() alone           {1e6 * alone:9.1f} us/frame")
    print(f"table of gymnasium's frames, warm  {1e6 * table:9.1f} us/frame")
    for snap in (True, False):
        renderer = PendulumRenderer(64, snap=snap)
        error = (renderer(angle).int() - expected.int()).abs()
        fast = seconds_per_frame(lambda draw=renderer: draw(angle), n, 9)  # type: ignore[misc]
        print(
            f"this library, snap={snap!s:<5}           {1e6 * fast:9.1f} us/frame, error mean "
            f"{error.float().mean():.4f}, max {int(error.max())} of 255, ratio {slow / fast:.0f} "
            f"({alone / fast:.0f} to render() alone)"
        )


if __name__ == "__main__":
    main()

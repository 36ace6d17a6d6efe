"""The compositor of training frames against PyBullet's own renderer: how far apart, and how much faster.

    python benchmarks/quadruped_frames.py [poses]

Random poses over the view and random gait phases; one thread; the ratio of times is measured in this run.
"""

from __future__ import annotations

import math
import sys
import time

import torch

from torchrl_sspl.envs.quadruped.compositor import TopViewCompositor
from torchrl_sspl.envs.quadruped.sprites import BulletRenderer
from torchrl_sspl.sets import Box

BATCH = 250


def heading_error(frames: torch.Tensor, heading: torch.Tensor) -> float:
    """Standard deviation (rad) of the heading read from the centres of yellow and blue pixels."""
    rgb = frames.float() / 255.0
    axis = torch.arange(frames.shape[-1], dtype=torch.float32)
    yellow = (torch.minimum(rgb[:, 0], rgb[:, 1]) - rgb[:, 2]).clamp_min(0)
    blue = (rgb[:, 2] - torch.maximum(rgb[:, 0], rgb[:, 1]) - 0.1).clamp_min(0)

    def centre(weight: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        total = weight.sum((1, 2))
        return (weight.sum(1) @ axis) / total, -(weight.sum(2) @ axis) / total

    (hx, hy), (bx, by) = centre(yellow), centre(blue)
    error = torch.atan2(hy - by, hx - bx) - heading
    return float(torch.atan2(error.sin(), error.cos()).std())


def main() -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    g = torch.Generator().manual_seed(0)
    pose = (torch.rand(n, 3, generator=g) * 2 - 1) * torch.tensor([2.0, 2.0, math.pi])
    phase = torch.rand(n, generator=g)
    renderer = BulletRenderer()
    compositor = TopViewCompositor(obstacle=Box([-0.3, -0.3], [0.3, 0.3]))
    start = time.perf_counter()
    reference = renderer(pose, phase)
    slow = time.perf_counter() - start
    compositor(pose[:BATCH], phase[:BATCH])
    start = time.perf_counter()
    drawn = torch.cat([compositor(p, f) for p, f in zip(pose.split(BATCH), phase.split(BATCH), strict=True)])
    fast = time.perf_counter() - start
    gap = (drawn.int() - reference.int()).abs()
    print(f"{n} frames of {drawn.shape[-1]} x {drawn.shape[-1]} pixels")
    print(f"mean absolute error {gap.float().mean():.4f} / 255")
    print(f"pixels off by more than 16: {100 * (gap.amax(1) > 16).float().mean():.4f} %")
    print(f"frames per second: PyBullet {n / slow:.0f}, compositor {n / fast:.0f}, ratio {slow / fast:.1f}")
    clear = pose[:, :2].abs().amax(1) > 0.8  # not over the red obstacle
    for name, frames in (("PyBullet", reference), ("compositor", drawn)):
        print(f"heading from colours, {name}: sd {heading_error(frames[clear], pose[clear, 2]):.4f} rad")


if __name__ == "__main__":
    main()

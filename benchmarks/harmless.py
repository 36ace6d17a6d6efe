"""Changes of the picture that should not matter: how much of {B <= 0} is still called safe, and whether any of U is.

Run: python benchmarks/harmless.py [AGENT] [STATES]
Prints a table in Markdown, for fresh states, drawn uniformly with a seed of their own: STATES outside U, and as many of U.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F
from tqdm import tqdm

import torchrl_sspl as sspl
from torchrl_sspl.evaluation.blocks import described_system
from torchrl_sspl.evaluation.known import encode_states
from torchrl_sspl.runtime.faults import CameraFault

SEED = 20261124
CHANGES = {
    "noise of 1 grey level": ("noise", 1.0),
    "noise of 12 grey levels": ("noise", 12.0),
    "brightness - 15 %": ("dark", 0.85),
    "brightness + 15 %": ("bright", 1.15),
    "camera shifted by one pixel of 64": ("shifted", 1.0),
}
RESIZED = {"drawn at twice the size, mean of 2 x 2": "area", "drawn at twice the size, bilinear": "bilinear"}


def changed(draw: Callable[[Tensor], Tensor], fault: str, strength: float) -> Callable[[Tensor], Tensor]:
    """Frames as a camera with a fault captures them."""
    camera = CameraFault(fault, strength, onset=0, seed=SEED)
    return lambda state: camera(draw(state).repeat(1, 2, 1, 1), 0)[:, 3:]


def resized(draw: Callable[[Tensor], Tensor], mode: str) -> Callable[[Tensor], Tensor]:
    """Frames at half the size."""
    smooth = {"antialias": True} if mode == "bilinear" else {}
    return lambda state: F.interpolate(draw(state).float(), scale_factor=0.5, mode=mode, **smooth).round().clamp(0, 255).to(torch.uint8)


@torch.no_grad()
def main(name: str = "pendulum", states: int = 20_000) -> None:
    """Print the table."""
    agent = sspl.load(name)
    system = agent.description["config"]["env"]
    env, large = (
        described_system({"config": {"env": system | {"image_size": k * system["image_size"]}}})([1], SEED)  # type: ignore[misc]
        for k in (1, 2)
    )
    draws = {"none": env.draw} | {what: changed(env.draw, *how) for what, how in CHANGES.items()}
    draws |= {what: resized(large.draw, mode) for what, mode in RESIZED.items()}
    generator = torch.Generator().manual_seed(SEED)
    outside = env.sample_states(states, generator, region=env.state_space - env.unsafe_set)
    unsafe = env.sample_states(states, generator, region=env.unsafe_set)
    print("| Change | still in {B <= 0} | newly in it | of U in {B <= 0} |\n|---|---|---|---|")
    clean = None
    for what, draw in tqdm(draws.items(), leave=False):
        inside = agent.barrier(encode_states(agent, env, outside, draw=draw))[:, 0] <= 0.0
        wrong = int((agent.least_barrier(encode_states(agent, env, unsafe, draw=draw)) <= 0.0).sum())
        clean = inside if clean is None else clean
        kept, new = float((inside & clean).sum() / clean.sum()), int((inside & ~clean).sum())
        print(f"| {what} | {100 * kept:.1f} % of {int(clean.sum()):,} | {new:,} | {wrong} of {len(unsafe):,} |", flush=True)


if __name__ == "__main__":
    given = sys.argv[1:]
    main(*given[:1], *(int(v) for v in given[1:2]))

"""What a GPU, mixed precision and torch.compile gain on the training step of SSPLLoss.

python benchmarks/gpu.py [--batch 1024] [--steps 30] [--cpu]

Times forward, backward and Adam of the total loss on the same batch of 64 x 64 frames: on the CPU in float32 as the
yardstick, then on the GPU eager, with bfloat16, compiled, and both. Without a CUDA device it says so and measures nothing;
--cpu measures the options on the CPU then, for comparison.
"""

from __future__ import annotations

import argparse
import json
import time

import torch
from tensordict import TensorDict

from torchrl_sspl.modules import InverseDynamics, Policy, SaLaD
from torchrl_sspl.objectives import SSPLLoss

OPTIONS = {"eager": (False, False), "bfloat16": (True, False), "compile": (False, True), "bfloat16+compile": (True, True)}


def seconds_per_step(device: str, batch: int, steps: int, mixed: bool, compiled: bool) -> float:
    """Median time of a training step, after a warm-up that holds the compilation."""
    torch.manual_seed(0)
    salad = SaLaD.from_sizes(3, 1, action_scale=10.0)
    loss = SSPLLoss(*salad, Policy(3, 1, action_scale=10.0), inverse_dynamics=InverseDynamics(3, 1, action_scale=10.0))
    loss.to(device)
    run = torch.compile(loss) if compiled else loss
    optimizer = torch.optim.Adam(loss.parameters(), 1e-3)
    data = TensorDict(
        frames=torch.randint(256, (batch, 3, 3, 64, 64), dtype=torch.uint8),
        action=torch.rand(batch, 1) * 20 - 10,
        region=torch.randint(3, (batch, 1)),
        batch_size=batch,
    ).to(device)
    times = []
    for step in range(steps + 5):
        began = time.perf_counter()
        with torch.autocast(torch.device(device).type, dtype=torch.bfloat16, enabled=mixed):
            terms = run(data)
            total = sum(value for key, value in terms.items() if key.startswith("loss_"))
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        if device != "cpu":
            torch.cuda.synchronize()
        if step >= 5:
            times.append(time.perf_counter() - began)
    return sorted(times)[len(times) // 2]


def main() -> dict[str, float]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--cpu", action="store_true", help="measure the options on the CPU where there is no GPU")
    options = parser.parse_args()
    cuda = torch.cuda.is_available()
    if not cuda and not options.cpu:
        print("no CUDA device here: nothing was measured, and no gain is claimed")
        return {}
    device = "cuda" if cuda else "cpu"
    name = torch.cuda.get_device_name() if cuda else f"CPU, {torch.get_num_threads()} threads"
    result = {"cpu eager": seconds_per_step("cpu", options.batch, min(options.steps, 5), False, False)}
    for label, (mixed, compiled) in OPTIONS.items():
        result[f"{device} {label}"] = seconds_per_step(device, options.batch, options.steps, mixed, compiled)
    print(f"{name}, torch {torch.__version__}, batch {options.batch}, median of {options.steps} steps")
    eager = result[f"{device} eager"]
    for label, value in result.items():
        print(f"{label:<24} {1000 * value:9.2f} ms   {result['cpu eager'] / value:6.2f}x CPU   {eager / value:5.2f}x eager")
    print(json.dumps({"device": name, "batch": options.batch, "seconds": result}))
    return result


if __name__ == "__main__":
    main()

"""Cost per update of `SSPLTrainer` over a loop in bare PyTorch with the same mathematics and the same replay.

Run: python benchmarks/trainer_overhead.py [batch=192] [image_size=64] [repeats=8] [steps=5]
Both sides sample, go forward and backward and step; they take turns, and the figure is the ratio of the medians.
"""

from __future__ import annotations

import statistics
import sys
import time
import warnings

import torch
from loss_overhead import bare_sound, networks
from torchrl.collectors import Collector

from torchrl_sspl.data import collect_random
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.modules import make_rollout_policy
from torchrl_sspl.objectives import SSPLLoss
from torchrl_sspl.trainers.torchrl_trainer import SSPLTrainer


def main(batch: int = 192, image_size: int = 64, repeats: int = 8, steps: int = 5) -> dict[str, float]:
    env = PendulumEnv(batch_size=[32], image_size=image_size, horizon=5, seed=0)
    env.initial_set = env.safe_set | env.state_space
    buffer = collect_random(env, 4096, seed=0, steps=5).replay_buffer(batch)
    ours, theirs = networks(), networks()
    loss = SSPLLoss(*ours[:4], inverse_dynamics=ours[4])
    collector = Collector(
        env,
        make_rollout_policy(ours[0], ours[3]),
        frames_per_batch=64,
        total_frames=64,
        auto_register_policy_transforms=False,
    )
    trainer = SSPLTrainer(
        collector=collector,
        total_frames=64,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), 1e-3),
        replay_buffer=buffer,
        optim_steps_per_batch=steps,
        progress_bar=False,
    )
    bare, optimizer = (
        bare_sound(theirs),
        torch.optim.Adam([p for net in theirs for p in net.parameters()], 1e-3),
    )

    def by_hand() -> None:
        for _ in range(steps):
            optimizer.zero_grad()
            bare(buffer.sample()).backward()
            optimizer.step()

    times: list[list[float]] = [[], []]
    for repeat in range(repeats + 1):
        for side, run in enumerate((lambda: trainer.optim_steps(None), by_hand)):
            torch.manual_seed(repeat)
            start = time.perf_counter()
            run()
            if repeat:  # the first round warms up
                times[side].append((time.perf_counter() - start) / steps)
    collector.shutdown()
    trainer_s, bare_s = (statistics.median(side) for side in times)
    return {"trainer_ms": 1e3 * trainer_s, "bare_ms": 1e3 * bare_s, "ratio": trainer_s / bare_s}


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    print(main(**{key: int(value) for key, value in (item.split("=") for item in sys.argv[1:])}))

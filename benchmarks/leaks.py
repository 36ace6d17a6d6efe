"""What a long training keeps: memory, open files and threads after a tenth of the collected batches and after all of them.

python benchmarks/leaks.py [n_batches]

Every batch is collected, stored, learnt from, logged, and enters the running margins; checkpoints are written every 5 s. The
exit code is 1 if the memory grew by more than 5 %. Linux only: it reads /proc.
"""

from __future__ import annotations

import gc
import os
import sys
import tempfile
import threading
import warnings
from pathlib import Path

import torch
from torchrl.collectors import Collector

from torchrl_sspl.data import TransitionStore
from torchrl_sspl.envs import PixelPendulumEnv
from torchrl_sspl.modules import Policy, SaLaD, make_rollout_policy
from torchrl_sspl.objectives import SSPLLoss
from torchrl_sspl.trainers import SSPLTrainer
from torchrl_sspl.trainers.hooks import MarginHook
from torchrl_sspl.trainers.loggers import make_logger

LIMIT = 1.05


def resident() -> int:
    """Bytes of this process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def make_trainer(batches: int, out: str) -> SSPLTrainer:
    """A training as small as one can be: four pendulums, 16 x 16 pixels, eight transitions per batch."""
    env = PixelPendulumEnv(batch_size=[4], image_size=16, horizon=2, seed=0)
    env.initial_set = env.safe_set | env.unsafe_set
    salad, policy = SaLaD.from_sizes(2, 1, action_scale=10.0, pool_to=8), Policy(2, 1, action_scale=10.0)
    loss = SSPLLoss(*salad, policy)
    collector = Collector(
        env, make_rollout_policy(salad, policy), frames_per_batch=8, total_frames=8 * batches, init_random_frames=256,
        reset_at_each_iter=True, auto_register_policy_transforms=False,
    )  # fmt: skip
    buffer = TransitionStore(512).replay_buffer(8, safe=0.2, unsafe=0.2)
    return SSPLTrainer(
        collector=collector, total_frames=8 * batches, loss_module=loss, optimizer=torch.optim.Adam(loss.parameters(), 1e-4),
        optim_steps_per_batch=1, replay_buffer=buffer, margins=MarginHook(loss, buffer, lipschitz_bound=2.0, samples=8, maximum=0.2),
        checkpoint_dir=out, checkpoint_seconds=5.0, out_dir=out, progress_bar=False, logger=make_logger("csv", directory=out),
        log_interval=0,
    )  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Train, measure and print."""
    words = sys.argv[1:] if argv is None else argv
    n = int(words[0]) if words else 10_000
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    torch.manual_seed(0)
    sizes: list[int] = []
    done = 0

    def weigh() -> None:
        nonlocal done
        done += 1
        if done in (n // 10, n):
            gc.collect()
            sizes.append(resident())
            files = len(os.listdir("/proc/self/fd"))
            print(
                f"after {done:6,d} batches {sizes[-1] / 2**20:8.1f} MiB, {files} open files, {threading.active_count()} threads",
                flush=True,
            )

    with tempfile.TemporaryDirectory() as out:
        trainer = make_trainer(n, out)
        trainer.register_op("post_steps", weigh)
        trainer.train()
    early, late = sizes
    print(f"ratio {late / early:.3f}, at most {LIMIT}")
    return int(late > LIMIT * early)


if __name__ == "__main__":
    sys.exit(main())

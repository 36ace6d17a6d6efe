"""Memory and speed of the transition store: bytes per transition, collection, sampling.

python benchmarks/replay.py [n_transitions]
"""

from __future__ import annotations

import sys
import tempfile
import time

import torch

from torchrl_sspl.data import TransitionStore, collect_random
from torchrl_sspl.envs import PendulumEnv


def main() -> None:
    """Measure and print."""
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 20000
    torch.set_num_threads(1)
    env = PendulumEnv(batch_size=[64], seed=0)
    start = time.perf_counter()
    store = collect_random(env, n, seed=0)
    print(f"collection      {1e6 * (time.perf_counter() - start) / n:8.1f} us/transition")
    per = store.memory_bytes / n
    print(f"frames          {store.n_frames / n:8.3f} per transition")
    print(f"memory          {per:8.0f} bytes/transition: {per / 1e3:.2f} GB for a million")
    print(f"stored plainly  {4 * 3 * 64 * 64:8d} bytes/transition (two stacks of two frames)")
    generator, batch, repeats = torch.Generator().manual_seed(0), 256, 50
    start = time.perf_counter()
    for _ in range(repeats):
        store.sample(batch, generator, safe=0.0, unsafe=0.125)
    print(f"sampling        {1e6 * (time.perf_counter() - start) / repeats / batch:8.1f} us/transition")
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        store.dumps(folder)
        saved = time.perf_counter()
        same = TransitionStore.from_folder(folder)
        loaded = time.perf_counter()
        print(f"save, load      {saved - start:8.2f} s, {loaded - saved:.2f} s")
        assert torch.equal(same.get(slice(0, 500))["frames"], store.get(slice(0, 500))["frames"])


if __name__ == "__main__":
    main()

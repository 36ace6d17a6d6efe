"""Wrong labels: which of them the others give away, and what is then missed of U.

Run: python benchmarks/wrong_labels.py [--wrong 0 0.01 0.05] [--seeds 0 1] [--states 14000]

No training: latents are the true coordinates of uniform states, of states of S and of U, with noise. 100 labels of S and of U come first, 400 are
chosen (``choose_and_spread``). Prints, in Markdown: labels that are wrong, how many of these are not used, how many right ones are not, and how many
of all states of U do not count as such, with and without that.
"""

from __future__ import annotations

import argparse

import torch

from torchrl_sspl.baselines.perception import Coordinates
from torchrl_sspl.data import Labels
from torchrl_sspl.envs import DubinsEnv, PendulumEnv
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.sets import UNSAFE
from torchrl_sspl.trainers import asking, choose_and_spread

NOISE = 0.01  # of the latents


def measure(env: SafetyEnv, wrong: float, seed: int, states: int) -> dict[str, int]:
    """Counts for one system, share of wrong labels and seed; ``states`` are drawn anywhere, half as many in S or U."""
    generator, at = torch.Generator().manual_seed(seed), Coordinates(env)
    regions = ((env.state_space, states), (env.safe_set, states // 4), (env.unsafe_set, states // 4))
    x = torch.cat([region.sample(n, generator) for region, n in regions])
    x = x[torch.randperm(len(x), generator=generator)]
    z = at.features(x) + NOISE * torch.randn(len(x), at.size, generator=generator)
    true = env.region(x).reshape(-1, 1)
    labels = Labels(safe=100, unsafe=100, wrong=wrong, choose=400, seed=seed)
    answer, first = labels.answers(true)[:, 0], labels(true)[:, 0] > 0
    region, told = choose_and_spread(z, first, answer, 400)
    unused = told & asking._contradicted(z, told, answer == UNSAFE)
    limit, asking._AGAINST = asking._AGAINST, float("inf")
    try:
        believed = choose_and_spread(z, told, answer, 0)[0]
    finally:
        asking._AGAINST = limit
    mistaken, unsafe = told & (answer != true[:, 0]), true[:, 0] == UNSAFE
    return {
        "labels": int(told.sum()), "wrong": int(mistaken.sum()), "wrong and not used": int((unused & mistaken).sum()),
        "right and not used": int((unused & ~mistaken).sum()), "states of U": int(unsafe.sum()),
        "missed": int((unsafe & (region != UNSAFE)).sum()), "missed if all labels are used": int((unsafe & (believed != UNSAFE)).sum()),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--wrong", type=float, nargs="+", default=[0.0, 0.01, 0.05])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--states", type=int, default=14_000)
    given = parser.parse_args()
    head = None
    for env in (PendulumEnv(), DubinsEnv()):
        for wrong in given.wrong:
            for seed in given.seeds:
                found = measure(env, wrong, seed, given.states)
                if head is None:
                    head = ["system", "wrong", "seed", *found]
                    print(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
                print(f"| {env.system.title} | {100 * wrong:g} % | {seed} | {' | '.join(map(str, found.values()))} |", flush=True)


if __name__ == "__main__":
    main()

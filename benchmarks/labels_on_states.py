"""What labels say of states without one, without training: first ones by how frequent they are, chosen ones by interpolation, and wrong ones.

Run: python benchmarks/labels_on_states.py [--first 30 100 300 1000] [--wrong 0 0.01 0.05] [--seeds 0 1] [--states 14000]

Latents are the true coordinates of uniform states, of states of S and of U, with noise, on the pendulum and the car. The first table has labels of S and
of U that come first (``infer_unsafe``): the share of all states of U that do not count as such, the share of the others that do, and both where nothing is inferred and
where f interpolates the labels. The second has 100 of each that come first and 400 that are chosen (``choose_and_spread``): labels that are wrong, how many
of these are not used, how many right ones are not, and how many of all states of U are missed, with and without that. Both in Markdown.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

from torchrl_sspl.baselines.perception import Coordinates
from torchrl_sspl.data import Labels
from torchrl_sspl.envs import DubinsEnv, PendulumEnv
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.sets import UNLABELLED, UNSAFE
from torchrl_sspl.trainers import asking, choose_and_spread, infer_unsafe

NOISE = 0.01  # of the latents


def drawn(env: SafetyEnv, seed: int, states: int) -> tuple[Tensor, Tensor]:
    """Latents ``(n, p)`` and true codes ``(n,)``; ``states`` are drawn anywhere, half as many in S or U."""
    generator, at = torch.Generator().manual_seed(seed), Coordinates(env)
    regions = ((env.state_space, states), (env.safe_set, states // 4), (env.unsafe_set, states // 4))
    x = torch.cat([region.sample(n, generator) for region, n in regions])
    x = x[torch.randperm(len(x), generator=generator)]
    return at.features(x) + NOISE * torch.randn(len(x), at.size, generator=generator), env.region(x).reshape(-1)


def inferred(env: SafetyEnv, first: int, seed: int, states: int, steps: int = 1500) -> dict[str, str]:
    """What is missed of U, and what counts as U and is not, with so many labels of each kind."""
    z, true = drawn(env, seed, states)
    known, unsafe = Labels(safe=first, unsafe=first)(true[:, None])[:, 0], true == UNSAFE
    told = known != UNLABELLED
    found = {
        "": infer_unsafe(z, known, torch.ones_like(told), steps=steps, seed=seed), ", labels alone": known, ", interpolated": choose_and_spread(z, told, true, 0)[0],
    }  # fmt: skip
    shares = {name: ((unsafe & (of != UNSAFE)).sum() / unsafe.sum(), (~unsafe & (of == UNSAFE)).sum() / (~unsafe).sum()) for name, of in found.items()}
    return {f"{what}{name}": f"{100 * float(pair[k]):.1f} %" for name, pair in shares.items() for k, what in enumerate(("missed", "added"))}


def measure(env: SafetyEnv, wrong: float, seed: int, states: int) -> dict[str, int]:
    """Counts for one system, share of wrong labels and seed."""
    z, true = drawn(env, seed, states)
    labels = Labels(safe=100, unsafe=100, wrong=wrong, choose=400, seed=seed)
    answer, first = labels.answers(true[:, None])[:, 0], labels(true[:, None])[:, 0] > 0
    region, told = choose_and_spread(z, first, answer, 400)
    unused = told & asking._contradicted(z, told, answer == UNSAFE)
    limit, asking._AGAINST = asking._AGAINST, float("inf")
    try:
        believed = choose_and_spread(z, told, answer, 0)[0]
    finally:
        asking._AGAINST = limit
    mistaken, unsafe = told & (answer != true), true == UNSAFE
    return {
        "labels": int(told.sum()), "wrong": int(mistaken.sum()), "wrong and not used": int((unused & mistaken).sum()),
        "right and not used": int((unused & ~mistaken).sum()), "states of U": int(unsafe.sum()),
        "missed": int((unsafe & (region != UNSAFE)).sum()), "missed if all labels are used": int((unsafe & (believed != UNSAFE)).sum()),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, nargs="*", default=[30, 100, 300, 1000])
    parser.add_argument("--wrong", type=float, nargs="*", default=[0.0, 0.01, 0.05])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--states", type=int, default=14_000)
    given = parser.parse_args()
    tables = (("labels of each kind", given.first, inferred), ("wrong", given.wrong, measure))
    for name, values, of in tables:
        head = None
        for env in (PendulumEnv(), DubinsEnv()):
            for value in values:
                for seed in given.seeds:
                    found = of(env, value, seed, given.states)
                    if head is None:
                        head = ["system", name, "seed", *found]
                        print(f"\n| {' | '.join(head)} |\n|{'---|' * len(head)}")
                    shown = value if of is inferred else f"{100 * value:g} %"
                    print(f"| {env.system.title} | {shown} | {seed} | {' | '.join(map(str, found.values()))} |", flush=True)


if __name__ == "__main__":
    main()

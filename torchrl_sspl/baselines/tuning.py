"""Trials: as many for every method, as far as its space has so many: defaults, published options, random draws; judged on data that no score sees."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from torchrl_sspl.baselines.base import SafetyMethod
from torchrl_sspl.baselines.registry import kind_of
from torchrl_sspl.baselines.scoring import barrier_on, nominals, paths
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import SSPLError

SEED = 100  # of recording, weights and starts of the trials; scored seeds are others
Trial = dict[str, Any]  # the options, what they were worth (None: the fit failed, and why), and s of the processor
STARTS = 400  # states from which a trial is judged
LOST = 10.0  # an episode from the claimed set that enters U costs as much as so many that do not are worth


def draws(method: str, trials: int, seed: int = SEED, *, named: Sequence[str] = ()) -> list[tuple[str, ...]]:
    """``key=value`` options of each trial: the defaults, the published ones where those are others, then random draws from the method's ``space``, none drawn twice.

    A draw may be the defaults, written out; options that are ``named`` are not drawn. A space with fewer points than trials gives fewer trials.

    Source: none.

    Example:
        >>> draws("imitation", 3)[0], len(draws("imitation", 8))
        ((), 4)
    """
    kind, generator = kind_of(method), random.Random(seed)
    space = {k: v for k, v in kind.space.items() if k not in named}
    published = tuple(f"{k}={v}" for k, v in kind.published.items() if k not in named)
    found: list[tuple[str, ...]] = [(), published] if published else [()]
    for _ in range(100 * trials):
        if len(found) >= trials:
            break
        drawn = tuple(f"{name}={generator.choice(values)}" for name, values in space.items())
        if drawn and drawn not in found:
            found.append(drawn)
    return found[:trials]


@torch.no_grad()
def merit(method: SafetyMethod, env: SafetyEnv, *, states: int = STARTS, horizon: int = 60, seed: int = SEED) -> float:
    r"""What a fitted method is worth: claimed states that it keeps out of U, less ten times those that it does not.

    .. math:: M = \frac1n \bigl( \#\{\text{claimed, kept}\} - 10\, \#\{\text{claimed, lost}\} \bigr)

    over n uniform states outside U, half of them under a harmless and half under an adversarial nominal policy. Of a method
    that claims nothing all states count as claimed and the lost ones as nothing. The true kernel is not asked. Source: none.

    Example:
        >>> from torchrl_sspl.baselines import BUDGETS, make
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> env, worth = PendulumEnv(), []
        >>> for name in ("lqr", "box_margin"):
        ...     method = make(name)
        ...     method.fit(None, env, BUDGETS["tiny"], 0)
        ...     worth.append(merit(method, env, states=60, horizon=30))
        >>> worth[0] > 0 > worth[1]
        True
    """
    outside = env.state_space - env.unsafe_set
    start = outside.sample(states, torch.Generator().manual_seed(seed))
    value = barrier_on(method, env, start)
    claimed = torch.ones(states, dtype=torch.bool) if value is None else value <= 0
    lost = torch.zeros(states, dtype=torch.bool)
    wanted = list(nominals(env).values())
    for k, nominal in enumerate(wanted):
        rows = claimed.nonzero()[:, 0][k :: len(wanted)]
        if len(rows):
            lost[rows] = paths(method, env, start[rows], nominal, horizon)[1]
    price = 0.0 if value is None else LOST
    return float(((claimed & ~lost).sum() - price * lost.sum()) / states)


def search(
    trial: Callable[[Sequence[str]], float], options: Sequence[Sequence[str]], told: Sequence[Trial] = (), keep: Callable[[list[Trial]], object] = lambda _: None
) -> tuple[Sequence[str], list[Trial]]:
    """The options of the largest merit, the first of them, and what every trial was worth. Source: none.

    Args:
        trial: options -> merit.
        options: of each trial.
        told: the first of the trials, which an earlier call has made.
        keep: is given all trials so far after each of them.

    Example:
        >>> chosen, trials = search(lambda words: float(len(words)), [(), ("a=1",)])
        >>> chosen, [trial["merit"] for trial in trials]
        (('a=1',), [0.0, 1.0])
    """
    found = [*told]
    for words in options[len(found) :]:
        made: Trial = {"options": list(words), "merit": None}
        begun = time.process_time()
        try:
            made["merit"] = trial(words)
        except SSPLError as error:  # options with which nothing can be fitted are not chosen
            made["error"] = f"{type(error).__name__}: {error}"
        found.append(made | {"cpu": time.process_time() - begun})
        keep(found)
    best = max(range(len(found)), key=lambda k: (-math.inf if found[k]["merit"] is None else found[k]["merit"], -k))
    return options[best], found


__all__ = ["LOST", "SEED", "STARTS", "draws", "merit", "search"]

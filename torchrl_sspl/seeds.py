"""One registry of seeds: the run's seed and a purpose with a name give a seed that no other purpose of the run has.

Some things are drawn from the run's own seed all the same, as it is or with a fixed number added: the first weights, which of the stored transitions
go on to the phases on frozen latents, and what these phases draw, such as batches and targets.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from torchrl_sspl.errors import ConfigError

#: What seeds are drawn for. A number is never given twice; a new purpose takes the next one.
PURPOSES = {
    "data": 0,  # recorded transitions and labelled observations
    "weights": 1,  # initial weights
    "training": 2,  # batches and noise of the optimisation
    "collection": 3,  # environments of the collectors
    "exploration": 4,  # noise on actions
    "rounds": 5,  # data of the rounds of a synthesis
    "checks": 6,  # held-out checks that select a round
    "level": 7,  # episodes by which the zero level is chosen
    "evaluation": 8,
    "physics": 9,  # walks of a full-physics world
    "certificate": 10,  # fresh episodes of a certificate
    "certificate actions": 11,  # random actions among them
    "report": 12,  # figures and films
    "benchmark": 13,
    "monitor": 14,  # clean episodes by which the monitor is calibrated
    "pictures": 15,  # changes of what cameras see
    "labels": 16,  # which of few labels are wrong
    "retries": 17,  # weights of further attempts of a synthesis
    "spread": 18,  # which pictures have a label
    "inferred labels": 19,  # networks that say what the others are
}
_INDICES = 1 << 24
_MASK = 0xFFFF_FFFF
_FACTORS = (0x85EBCA6B, 0xC2B2AE35)  # odd
_LOOKED_FOR = 4096  # indices of a purpose; a seed of another run is one of them by a chance of one in fifty thousand


def spawn(seed: int, purpose: str, index: int = 0) -> int:
    """Seed for one purpose of a run.

    Two purposes or indices of one run never get the same seed: they are numbered, and the number is mixed into 32 bits
    by a bijection. It has 32 bits because that is what ``torch.Generator`` keeps of a seed on the CPU. Different runs
    start from different places, which :class:`numpy.random.SeedSequence` gives; between two of them a seed can be the
    same by a chance of one in four thousand million, which :func:`used_before` finds.

    For a seed that is not negative, one of :data:`PURPOSES`, and the number among its own, below 2^24; returns a seed
    in [0, 2^32). Raises ConfigError if the purpose is not registered, or a number is out of range.
    Source: none.

    Example:
        >>> len({spawn(0, purpose, k) for purpose in PURPOSES for k in range(100)}) == 100 * len(PURPOSES)
        True
    """
    if purpose not in PURPOSES:
        raise ConfigError(
            f"expected one of the purposes {', '.join(PURPOSES)}, received {purpose!r}; register it there"
        )
    if not 0 <= index < _INDICES or seed < 0:
        raise ConfigError(f"expected a seed >= 0 and an index in [0, {_INDICES}), received seed={seed}, index={index}")
    x = (_start(seed) + PURPOSES[purpose] * _INDICES + index) & _MASK
    # Bijections of 32 bits: multiplications by odd numbers, and exclusive ors with a shift of at least half.
    for factor in _FACTORS:
        x = ((x ^ (x >> 16)) * factor) & _MASK
    return x ^ (x >> 16)


def _start(seed: int) -> int:
    """Where the numbers of a run begin."""
    return int(np.random.SeedSequence(seed).generate_state(1)[0])


def drawn_for(seed: int, root: int) -> str:
    """Purpose for which a run with this seed draws that one; "" if for none, among the first 4,096 of each purpose.

    The inverse of :func:`spawn`. Source: none.

    Example:
        >>> drawn_for(spawn(7, "checks", 3), 7), drawn_for(spawn(7, "checks", 3), 8)
        ('checks', '')
    """
    if root < 0:
        return ""
    x = seed & _MASK
    for factor in reversed(_FACTORS):
        x = ((x ^ (x >> 16)) * pow(factor, -1, 1 << 32)) & _MASK
    x = ((x ^ (x >> 16)) - _start(root)) & _MASK
    named = {number: purpose for purpose, number in PURPOSES.items()}
    return named.get(x // _INDICES, "") if x % _INDICES < _LOOKED_FOR else ""


def used_before(seed: int, history: Iterable[int]) -> bool:
    """Whether a generator would repeat one of earlier seeds: they agree in the 32 bits that torch keeps on the CPU.

    Source: none.

    Example:
        >>> used_before(1, [2**32 + 1]), used_before(1, [2])
        (True, False)
    """
    return any((seed - other) & _MASK == 0 for other in history)

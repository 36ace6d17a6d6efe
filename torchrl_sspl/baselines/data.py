"""What all methods of the comparison learn from: one recording of transitions, with everything that any of them asks for."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from torchrl_sspl.baselines.base import POOL, Budget
from torchrl_sspl.data import TransitionStore, collect_random
from torchrl_sspl.envs.base import SafetyEnv
from torchrl_sspl.errors import ConfigError, DTypeError, ShapeError
from torchrl_sspl.seeds import spawn
from torchrl_sspl.sets import SAFE, UNSAFE, Mixture, Region

STEPS = 4  # longest episode, as in this library's own training
_CHUNK, _ENVS = 2048, 256
_PART = 64  # pictures that are averaged at a time; they stay in the cache


def pooled(pixels: Tensor, size: int = POOL) -> Tensor:
    """Pictures averaged to ``size`` and rounded, uint8 ``(n, c, H, W) -> (n, c, size, size)``.

    Raises DTypeError or ShapeError for anything else. Source: none.

    Example:
        >>> pooled(torch.full((1, 6, 64, 64), 7, dtype=torch.uint8)).shape
        torch.Size([1, 6, 32, 32])
    """
    if pixels.dtype != torch.uint8:
        raise DTypeError(f"pixels: expected uint8, received {pixels.dtype}; keep frames unconverted")
    if pixels.ndim != 4:
        raise ShapeError(f"pixels: expected (n, c, H, W), received {tuple(pixels.shape)}")
    if pixels.shape[-2:] == (size, size):
        return pixels
    mean = _mean_of_blocks if pixels.shape[-1] in (2 * size, 4 * size, 8 * size) and pixels.shape[-2] == pixels.shape[-1] else _mean
    parts = [mean(part, size) for part in pixels.split(_PART)]
    return torch.cat(parts) if parts else pixels.new_zeros(0, pixels.shape[1], size, size)


def _mean(pixels: Tensor, size: int) -> Tensor:
    return F.adaptive_avg_pool2d(pixels.float(), size).round().to(torch.uint8)


def _mean_of_blocks(pixels: Tensor, size: int) -> Tensor:
    """The same, to the bit, of blocks of 2, 4 or 8 in integers: four times as fast. Halves go to the even number."""
    k = pixels.shape[-1] // size
    tall = pixels[..., 0::k, :].short()
    for i in range(1, k):
        tall += pixels[..., i::k, :]
    total = tall[..., 0::k].clone()
    for i in range(1, k):
        total += tall[..., i::k]
    shift = 2 * (k.bit_length() - 1)
    return (total + (k * k // 2 - 1) + ((total >> shift) & 1) >> shift).to(torch.uint8)


@dataclass
class Recording:
    """Transitions side by side. Who learns without states does not look at them.

    Attributes:
        frames: uint8 ``(n, 3, 3, size, size)``, pooled pictures of t-1, t and t+1.
        action: ``(n, m)`` physical units.
        region, next_region: ``(n,)`` labels of the states at t and t+1.
        state, next_state: ``(n, s)`` true states.

    Source: none.
    """

    frames: Tensor
    action: Tensor
    region: Tensor
    next_region: Tensor
    state: Tensor
    next_state: Tensor

    def __len__(self) -> int:
        return len(self.action)

    @property
    def pixels(self) -> Tensor:
        """Observations at t, ``(n, 6, size, size)``."""
        return self.frames[:, :2].flatten(1, 2)

    @property
    def next_pixels(self) -> Tensor:
        """Observations at t+1."""
        return self.frames[:, 1:].flatten(1, 2)

    def count(self, code: int) -> int:
        """Number of observations at t that carry a label."""
        return int((self.region == code).sum())

    def labels(self) -> dict[str, Any]:
        """The part of the ledger that every learned method shares."""
        return {"transitions": len(self), "safe_labels": self.count(SAFE), "unsafe_labels": self.count(UNSAFE)}

    def joined(self, other: Recording) -> Recording:
        """Both, one after the other."""
        return Recording(**{f.name: torch.cat([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)})


def of_store(store: TransitionStore, size: int = POOL) -> Recording:
    """What a store with true states holds, pictures pooled. Source: none."""
    batch = store.get(slice(None))
    frames = batch["frames"]
    return Recording(
        pooled(frames.flatten(1, 2), size).reshape(len(frames), 3, 3, size, size), batch["action"],
        batch["region"][:, 0], batch["next", "region"][:, 0], batch["info", "state"], batch["info", "next_state"],
    )  # fmt: skip


def record(env: SafetyEnv, budget: Budget, seed: int, *, size: int = POOL) -> Recording:
    """Records a budget: episodes of a few steps under random actions, from anywhere, from outside U, from S and from U.

    Args:
        env: the system; its batch size does not matter, its geometry does.
        budget: how many transitions; what it allows for rollouts is recorded under random actions too.
        seed: of states and actions.
        size: height and width of the pictures that are kept.

    Raises ConfigError if the budget is empty, or the system's pictures are smaller. Source: the data sets D, S and U of the paper, Section IV.

    Example:
        >>> from torchrl_sspl.baselines.base import Budget
        >>> from torchrl_sspl.envs import PendulumEnv
        >>> found = record(PendulumEnv([8]), Budget("try", 24, 8, 8), seed=0)
        >>> len(found), found.count(SAFE) >= 8, found.frames.shape
        (40, True, torch.Size([40, 3, 3, 32, 32]))
    """
    if size > env.image_size:
        raise ConfigError(f"pixels: expected at most {env.image_size}, the size of the system's pictures, received {size}")
    outside = env.state_space - env.unsafe_set
    plan: list[tuple[int, Region]] = [
        (budget.transitions + budget.rollouts, Mixture([env.state_space, outside], [0.5, 0.5])),
        (budget.safe, env.safe_set),
        (budget.unsafe, env.unsafe_set),
    ]
    parts, number = [], 0
    for k, (n, region) in enumerate(plan):
        for size_of_part in torch.arange(n).split(_CHUNK) if n else ():
            # What starts in S or U is labelled at its first step only: episodes of one step count as labels whole.
            steps = STEPS if k == 0 else 1
            store = collect_random(
                env, len(size_of_part), seed=spawn(seed, "data", number), steps=steps, region=region, keep_state=True
            )
            parts.append(of_store(store, size))
            number += 1
    if not parts:
        raise ConfigError(f"budget: expected at least one transition, received {budget}")
    return Recording(**{f.name: torch.cat([getattr(p, f.name) for p in parts]) for f in fields(Recording)})


__all__ = ["POOL", "Recording", "of_store", "pooled", "record"]

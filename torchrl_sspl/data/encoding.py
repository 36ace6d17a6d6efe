"""Latents of stored transitions."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_sspl.data import TransitionStore

_CHUNK = 1000


@torch.no_grad()
def encode_transitions(
    encode: Callable[[TensorDict], tuple[Tensor, ...]], store: TransitionStore, index: Tensor | None = None
) -> dict[str, Tensor]:
    """Latents of stored transitions, as :class:`~torchrl_sspl.trainers.LatentTraining` takes them.

    Args:
        encode: batch of the store -> latents ``(k, p)`` before and after, such as ``SSPLLoss.latents``.
        store: transitions.
        index: ``(n,)`` which of them; by default all.

    Returns ``"latent"``, ``"next_latent"``, ``"action"`` and ``"region"``, on the CPU. Source: none.
    """
    parts = []
    for rows in (torch.arange(len(store)) if index is None else index).split(_CHUNK):
        batch = store.get(rows)
        latent, after = encode(batch)
        parts.append((latent.cpu(), after.cpu(), batch["action"], batch["region"]))
    names = ("latent", "next_latent", "action", "region")
    return {k: torch.cat(v) for k, v in zip(names, zip(*parts, strict=True), strict=True)}

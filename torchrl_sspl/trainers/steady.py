"""Phases on pictures: the encoder learns to show of changed pictures what it shows of unchanged ones, and what is left is kept."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.journal import kept_parts
from torchrl_sspl.seeds import spawn
from torchrl_sspl.trainers.phases import Phase, Workspace

_BATCH = 128  # pictures per step, each with and without changes
_LR = 1e-3
_KEPT = 20_000  # errors that changes leave
_ENCODED = 500  # pictures that are encoded at a time


class SteadyEncoder(Phase):
    r"""The encoder alone, taught by what it was: changes of a picture, such as a camera's noise, should not move its latent.

    .. math:: L = \operatorname{mean} \|E(\tilde o) - \bar E(o)\|^2 + \operatorname{mean} \|E(o) - \bar E(o)\|^2

    with :math:`\bar E` the encoder of the joint training, and :math:`\tilde o` the picture o as a camera of :class:`Augmentation`
    captures it, drawn anew in every step. The data stay unchanged, so dynamics and barrier are fitted to clean latents; what changes
    still do to latents is kept by :class:`KeepChanges`.
    Raises ConfigError without stored pictures, without changes,
    or if the encoder has nothing to train. Source: none (self-distillation).
    """

    name, pictures = "steady", True

    def size(self, work: Workspace) -> int:
        return max(1, work.config.steady_steps)

    def run(self, work: Workspace) -> None:
        source, encoder, pick = work.source, work.encoder, work.loop.pick
        store = getattr(source, "store", None)
        if store is None or not len(store) or source.changes is None:
            raise ConfigError(
                "expected stored pictures and changes of them with synthesis.steady_steps > 0, received a source without; give "
                "Source(store=..., changes=Augmentation(...)), or set synthesis.steady_steps=0"
            )
        trained = [p for p in encoder.parameters() if p.requires_grad]
        if not trained:
            raise ConfigError(
                f"expected an encoder with parameters with synthesis.steady_steps > 0, received {type(encoder).__name__} without; "
                "set synthesis.steady_steps=0"
            )
        n, device = len(store), trained[0].device
        if work.loop.step == 0:
            work.latents = {"before": _encoded(work, torch.arange(n))}
        before = work.latents["before"]

        def step() -> dict[str, Tensor]:
            rows = pick(n, _BATCH)
            frames = store.get(rows)["frames"][:, :2]
            both = torch.cat([frames, _changed(work, frames, int(pick(2**31 - 1, 1)))])
            off = encoder(both.flatten(1, 2).to(device)) - before[rows].repeat(2, 1).to(device)
            return {"loss_steady": 2.0 * off.square().sum(1).mean()}

        work.loop(self.size(work), {encoder: _LR}, step)


class KeepChanges(Phase):
    """What changes of stored pictures still do to their latents, kept in ``work.changes``.

    :class:`FineTune` pushes U out of the set by as much; :class:`Settle`, after targets on a grid, does not. Source: none.
    """

    name, pictures = "changes", True

    def run(self, work: Workspace) -> None:
        n = len(work.source.store)
        kept = torch.randint(n, (min(n, _KEPT),), generator=work.loop.generator)
        after = _encoded(work, torch.arange(n))
        work.changes = _encoded(work, kept, spawn(work.seed, "pictures", 1)) - after[kept]
        spread, moved = work.changes.std(0), (after - work.latents["before"]).std(0)
        work.log({"step": self.number, "left_by_changes": spread.tolist(), "moved": moved.tolist()})


def _changed(work: Workspace, frames: Tensor, seed: int) -> Tensor:
    """Frames ``(n, 2, 3, H, W)`` as cameras with changes capture them, both of a picture by the same one."""
    n = len(frames)
    changed = work.source.changes.with_seed(seed)(frames.flatten(0, 1), torch.arange(n).repeat_interleave(2))
    return changed.unflatten(0, (n, 2))


@torch.no_grad()
def _encoded(work: Workspace, rows: Tensor, seed: int | None = None) -> Tensor:
    """Latents ``(k, p)`` of stored pictures, on the CPU; with a seed as cameras with changes capture them."""
    device = next(work.encoder.parameters()).device

    def latent(numbered: tuple[int, Tensor]) -> Tensor:
        k, part = numbered
        frames = work.source.store.get(part)["frames"][:, :2]
        if seed is not None:
            frames = _changed(work, frames, seed + k)
        return work.encoder(frames.flatten(1, 2).to(device)).cpu()

    return torch.cat(kept_parts(latent, enumerate(rows.split(_ENCODED)), "pictures", seed, rows))


__all__ = ["KeepChanges", "SteadyEncoder"]

"""Storage for frames, each kept once however many transitions refer to it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


class FrameBank:
    """Slots for RGB frames, allocated block by block and reused when nothing refers to them any more.

    A frame whose second and third channel are equal (as in a picture of one hue on white) takes two thirds of
    the memory: the bank stores two channels until the first frame that needs three arrives.

    Args:
        block (int): frames per block.
    """

    def __init__(self, block: int) -> None:
        self._block = block
        self._blocks: list[Tensor] = []
        self._uses = torch.zeros(0, dtype=torch.int32)
        self._free = torch.zeros(0, dtype=torch.int64)
        self._planes = 2

    @property
    def memory_bytes(self) -> int:
        """Bytes of all allocated blocks and counters."""
        return sum(b.numel() for b in self._blocks) + 4 * self._uses.numel() + 8 * self._free.numel()

    def reserve(self, n: int, frame_shape: Sequence[int]) -> Tensor:
        """Take n free slots, int64 ``(n,)``."""
        while self._free.numel() < n:
            shape = (self._block, self._planes, *frame_shape)
            first = len(self._blocks) * self._block
            self._blocks.append(torch.empty(shape, dtype=torch.uint8))
            self._uses = torch.cat([self._uses, torch.zeros(self._block, dtype=torch.int32)])
            self._free = torch.cat([self._free, torch.arange(first, first + self._block)])
        taken, self._free = self._free[:n], self._free[n:]
        return taken

    def write(self, slots: Tensor, frames: Tensor) -> None:
        """Store frames ``(n, 3, H, W)`` in slots ``(n,)``."""
        if self._planes == 2 and not torch.equal(frames[:, 1], frames[:, 2]):
            self._planes = 3
            self._blocks = [b[:, [0, 1, 1]] for b in self._blocks]
        frames = frames[:, : self._planes]
        for block, rows, places in self._split(slots):
            block[places] = frames[rows]

    def read(self, slots: Tensor) -> Tensor:
        """Frames ``(n, 3, H, W)`` of slots ``(n,)``."""
        out = torch.empty(slots.numel(), 3, *self._blocks[0].shape[2:], dtype=torch.uint8)
        for block, rows, places in self._split(slots):
            out[rows, : self._planes] = block[places]
        if self._planes == 2:
            out[:, 2] = out[:, 1]
        return out

    def hold(self, slots: Tensor, change: int) -> None:
        """Count references to slots up (+1) or down (-1); a slot without any becomes free."""
        flat = slots.reshape(-1)
        self._uses.index_add_(0, flat, torch.full_like(flat, change, dtype=torch.int32))
        if change < 0:
            dropped = flat.unique()
            self._free = torch.cat([self._free, dropped[self._uses[dropped] == 0]])

    def _split(self, slots: Tensor) -> list[tuple[Tensor, Tensor | slice, Tensor]]:
        """The blocks that hold the slots: (block, rows of ``slots``, places in the block)."""
        if len(self._blocks) == 1:
            return [(self._blocks[0], slice(None), slots)]
        number = slots // self._block
        parts: list[tuple[Tensor, Tensor | slice, Tensor]] = []
        for k in number.unique().tolist():
            rows = (number == k).nonzero().squeeze(1)
            parts.append((self._blocks[k], rows, slots[rows] - k * self._block))
        return parts


__all__ = ["FrameBank"]

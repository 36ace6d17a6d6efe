"""What TorchRL draws by priority with, for a torch with which TorchRL's compiled extension does not load."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl.data.replay_buffers.samplers import prioritized


class Priorities:
    r"""Priorities by place, with their sum or minimum over a range; one cumulative sum in place of a tree.

    .. math:: i(m) = \min \{ i : p_0 + \dots + p_i \ge m \}

    What is asked for and returned is that of TorchRL's segment trees. A tree takes :math:`O(\log n)` a row, this :math:`O(n)` a
    batch: a fraction of a millisecond for 100,000 places. Source: none.

    Args:
        capacity: number n of places.
        dtype: of the priorities.
        least: whether :meth:`query` tells the minimum; the sum otherwise.

    Example:
        >>> priorities = Priorities(3)
        >>> priorities[torch.tensor([0, 1, 2])] = torch.tensor([1.0, 2.0, 3.0])
        >>> priorities.query(0, 3), priorities.scan_lower_bound(torch.tensor([0.5, 3.0, 3.5]))
        (6.0, tensor([0, 1, 2]))
    """

    def __init__(self, capacity: int, dtype: type = np.float32, *, least: bool = False) -> None:
        self.capacity, self.least = capacity, least
        self.identity_element = float(np.finfo(dtype).max) if least else 0.0
        self.values: np.ndarray = np.full(capacity, self.identity_element, dtype)

    def __len__(self) -> int:
        return self.capacity

    def __getitem__(self, index: Any) -> Any:
        return _like(index, self.values[np.asarray(index)])

    def __setitem__(self, index: Any, value: Any) -> None:
        self.values[np.asarray(index)] = np.asarray(value)  # of a place that is named twice the later value counts

    def query(self, left: int, right: int) -> float:
        """Sum or minimum of the places from ``left`` to before ``right``."""
        part = self.values[left:right]
        return float(part.min(initial=self.identity_element) if self.least else part.sum())

    def scan_lower_bound(self, mass: Any) -> Any:
        """The first places up to which the sum reaches a mass, a number or an array of them; n where it never does."""
        return _like(mass, np.searchsorted(self.values.cumsum(dtype=np.float64), np.asarray(mass)))


def _like(asked: Any, found: Any) -> Any:
    """A tensor for a tensor, an array for an array, a number for a number."""
    return torch.as_tensor(found) if isinstance(asked, Tensor) else found if isinstance(asked, np.ndarray) else found.item()


def stand_in() -> None:
    """Gives TorchRL's prioritised samplers :class:`Priorities`, if their own trees are missing. Source: none."""
    for bits, dtype in (("Fp32", np.float32), ("Fp64", np.float64)):
        for kind in ("Sum", "Min"):
            if getattr(prioritized, f"{kind}SegmentTree{bits}") is None:
                setattr(prioritized, f"{kind}SegmentTree{bits}", partial(Priorities, dtype=dtype, least=kind == "Min"))


__all__ = ["Priorities", "stand_in"]

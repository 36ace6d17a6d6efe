"""Few labels, and wrong ones: which of the labels that an environment gives a run may use."""

from __future__ import annotations

import copy
from collections.abc import Mapping

import torch
from torch import Tensor

from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.seeds import spawn
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE


class Labels:
    """At most so many labels of S and of U, those that come first; what comes later is unlabelled. Some of them are wrong.

    A label that is wrong says S of a picture of U, or U of one of S, and counts as what it says. Source: none; the paper's title
    asks for few labels.

    Args:
        safe, unsafe: labels of S and of U, at most; None: all.
        wrong: chance that a label is the other one, in [0, 1].
        share: chance that a picture of S or of U has a label, in (0, 1]. Below 1 labels are spread over more of the data, and say which of the
            pictures without one are of U, too, see :func:`~torchrl_sspl.trainers.infer_unsafe`; not with ``choose``. A limit still counts from the first on.
        choose: pictures that are labelled beside them once there are latents to choose them by, see
            :func:`~torchrl_sspl.trainers.choose_and_spread`. These may be of neither set, and that is never said wrongly.
        seed: of which are wrong.

    Raises ConfigError for other values, or if pictures are to be chosen without a limit of both kinds, or with a limit of 0.

    Example:
        >>> Labels(safe=1)(torch.tensor([[1], [2], [1], [0]])).flatten().tolist()
        [1, 2, 0, 0]
    """

    def __init__(
        self,
        *,
        safe: int | None = None,
        unsafe: int | None = None,
        wrong: float = 0.0,
        share: float = 1.0,
        choose: int = 0,
        seed: int = 0,
    ) -> None:
        if any(n is not None and n < 0 for n in (safe, unsafe)) or not 0.0 <= wrong <= 1.0 or not 0.0 < share <= 1.0:
            raise ConfigError(
                "labels: expected safe and unsafe >= 0 or None, wrong in [0, 1] and share in (0, 1], "
                f"received {safe!r}, {unsafe!r}, {wrong!r}, {share!r}"
            )
        if choose < 0 or (choose and not (safe and unsafe)):
            raise ConfigError(
                f"labels: expected choose >= 0, and limits >= 1 of both kinds where pictures are to be chosen, received choose={choose!r} with "
                f"safe={safe!r}, unsafe={unsafe!r}; give labels.safe and labels.unsafe, such as 100 each"
            )
        self.most, self.wrong, self.choose, self.seed = {SAFE: safe, UNSAFE: unsafe}, float(wrong), choose, seed
        self.share = float(share)

    def less(self, safe: int, unsafe: int, *, seed: int) -> Labels:
        """What is left of them when so many have been used; other ones are wrong."""
        other = copy.copy(self)
        other.most = {code: None if n is None else max(0, n - used) for (code, n), used in zip(self.most.items(), (safe, unsafe), strict=True)}
        other.seed = seed
        return other

    def __call__(self, region: Tensor, given: Mapping[int, int] | None = None, position: int = 0) -> Tensor:
        """Labels ``(n, 1)`` in place of true ones, after so many of each code have been given; other ones are wrong at every position.

        Raises ShapeError for another shape.
        """
        found = self.answers(region, position)
        if self.share < 1.0:
            draw = torch.Generator().manual_seed(spawn(self.seed, "spread", position))
            found[torch.rand(region.shape, generator=draw) >= self.share] = UNLABELLED
        for code, most in self.most.items():
            if most is not None:
                mine = found == code
                found[mine & (mine.cumsum(0) + (given or {}).get(code, 0) > most)] = UNLABELLED
        return found

    def left(self, found: Tensor, given: Mapping[int, int] | None = None) -> Tensor:
        """Whether there were labels of U left ``(n, 1)`` when it came to each picture, where labels ``(n, 1)`` were given after so many."""
        most, mine = self.most[UNSAFE], found == UNSAFE
        if most is None:
            return torch.ones_like(mine)
        return mine.cumsum(0) - mine.long() + (given or {}).get(UNSAFE, 0) < most

    @property
    def infers(self) -> bool:
        """Whether labels at random say which pictures without one are of U."""
        return self.share < 1.0 and not self.choose

    @property
    def kept(self) -> list[str]:
        """What a store keeps of every transition for them, by name."""
        return ["answer"] if self.choose else ["drawn"] if self.infers else []

    @property
    def tells(self) -> bool:
        """Whether labels say something of pictures that have none."""
        return bool(self.kept)

    def answers(self, region: Tensor, position: int = 0) -> Tensor:
        """What is said of every picture ``(n, 1)`` that is asked for, some of it wrong; a ShapeError for another shape."""
        if region.ndim != 2 or region.shape[1] != 1:
            raise ShapeError(f"labels: expected (n, 1), received {tuple(region.shape)}")
        found = region.clone()
        if self.wrong:
            draw = torch.Generator().manual_seed(spawn(self.seed, "labels", position))
            mistaken = (torch.rand(region.shape, generator=draw) < self.wrong) & (region != UNLABELLED)
            found = torch.where(mistaken, SAFE + UNSAFE - found, found)
        return found


__all__ = ["Labels"]

"""Few labels, and wrong ones: which of the labels that an environment gives a run may use."""

from __future__ import annotations

import copy

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
        share: chance that a picture of S or of U has a label at all, in (0, 1]: labels of all the data, in place of all of the first.
        choose: pictures that are labelled beside them once there are latents to choose them by, see
            :func:`~torchrl_sspl.trainers.choose_and_spread`. These may be of neither set.
        spread: whether pictures that are left without a label count as of U where labels of U are as frequent as in U at large, see
            :func:`~torchrl_sspl.trainers.infer_unsafe`; None: where ``share`` is below 1. Not with ``choose``. Labels that come first are of few
            episodes, side by side, so that what looks free of labels there may be of U.
        seed: of which are wrong.

    Raises ConfigError for other values, or if pictures are to be chosen where all are labelled.

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
        spread: bool | None = None,
        seed: int = 0,
    ) -> None:
        if any(n is not None and n < 0 for n in (safe, unsafe)) or not 0.0 <= wrong <= 1.0 or not 0.0 < share <= 1.0:
            raise ConfigError(
                "labels: expected safe and unsafe >= 0 or None, wrong in [0, 1] and share in (0, 1], "
                f"received {safe!r}, {unsafe!r}, {wrong!r}, {share!r}"
            )
        if choose < 0 or (choose and None in (safe, unsafe)):
            raise ConfigError(
                f"labels: expected choose >= 0, and limits of both kinds where pictures are to be chosen, received choose={choose!r} with "
                f"safe={safe!r}, unsafe={unsafe!r}; give labels.safe and labels.unsafe, such as 100 each"
            )
        self.most, self.wrong, self.choose, self.seed = {SAFE: safe, UNSAFE: unsafe}, float(wrong), choose, seed
        self.share, self.spread = float(share), (share < 1.0 if spread is None else spread) and not choose

    def less(self, safe: int, unsafe: int, *, seed: int) -> Labels:
        """What is left of them when so many have been used; other ones are wrong."""
        other = copy.copy(self)
        other.most = {code: None if n is None else max(0, n - used) for (code, n), used in zip(self.most.items(), (safe, unsafe), strict=True)}
        other.seed = seed
        return other

    def __call__(self, region: Tensor, held: Tensor | None = None, position: int = 0) -> Tensor:
        """Labels ``(n, 1)`` in place of true ones, behind those that are held already ``(m,)``; other ones are wrong at every position.

        Raises ShapeError for another shape.
        """
        found = self.answers(region, position)
        if self.share < 1.0:
            draw = torch.Generator().manual_seed(spawn(self.seed, "spread", position))
            found[torch.rand(region.shape, generator=draw) >= self.share] = UNLABELLED
        for code, most in self.most.items():
            if most is not None:
                mine = found == code
                before = 0 if held is None else int((held == code).sum())
                found[mine & (mine.cumsum(0) + before > most)] = UNLABELLED
        return found

    @property
    def tells(self) -> bool:
        """Whether labels say something of pictures that have none."""
        return bool(self.choose) or self.spread

    def used_up(self, unsafe: int) -> bool:
        """Whether pictures of U are without a label once so many of U have one."""
        most = self.most[UNSAFE]
        return self.share < 1.0 or (most is not None and unsafe >= most)

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

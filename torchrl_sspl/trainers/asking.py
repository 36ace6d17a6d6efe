"""Which pictures are worth a label, and what a few labels say of all the others."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_sspl.errors import EmptyRegionError
from torchrl_sspl.sets import UNLABELLED, UNSAFE
from torchrl_sspl.viability.cloud import nearest_distance

_DOUBT = 4  # how much more what lies between the two is asked for than what is far from both
_CAUTION = 1.25  # how much nearer to what is not of U a latent has to lie


@torch.no_grad()
def choose_and_spread(seen: Tensor, region: Tensor, told: Tensor, answer: Tensor, count: int) -> tuple[Tensor, Tensor]:
    r"""Labels for the latents of which a few labels tell least, and the label of the nearest one for all that have none.

    .. math:: i^\star = \arg\max_i \; \min(a_i, b_i) \left( \frac{\min(a_i, b_i)}{\max(a_i, b_i)} \right)^4, \qquad
        z_i \text{ counts as of U if } a_i < 1.25\, b_i

    with the distances :math:`a_i` to the nearest latent that is told to be of U, and :math:`b_i` to the nearest one that is told not to
    be: asked for is what lies between the two and far from both. Unlike labels of S and U alone, an answer can be *neither*: without
    it nobody knows where U ends. Source: none (uncertainty sampling, spread out by distances); the paper takes its labels at random.

    Args:
        seen: ``(n, p)`` latents of single pictures.
        region: ``(n,)`` codes of ``sets``, 0 where nothing is told.
        told: ``(n,)`` bool, whose label is known.
        answer: ``(n,)`` codes; read only where a label is known or asked for.
        count: labels that are asked for.

    Returns ``(n,)`` codes, in which only labels say S, and of which labels are known now, bool. Raises EmptyRegionError where nothing
    is told to be of U, or nothing not to be.

    Example:
        >>> z = torch.linspace(-1, 1, 201)[:, None]
        >>> answer = torch.where(z[:, 0] > 0.305, 2, 0)
        >>> told = torch.zeros(201, dtype=torch.bool).index_fill(0, torch.tensor([0, 200]), True)
        >>> region, told = choose_and_spread(z, answer * told, told, answer, 8)
        >>> int((region != answer).sum()), int(told.sum())
        (1, 10)
    """
    told, answer = told.clone(), torch.where(told, region, answer)
    unsafe = answer == UNSAFE
    sides = told & unsafe, told & ~unsafe
    if not all(bool(side.any()) for side in sides):
        raise EmptyRegionError(
            f"expected labels of U and of what is not of U, received {int(sides[0].sum())} and {int(sides[1].sum())}; raise labels.safe and "
            "labels.unsafe"
        )
    to_unsafe, to_rest = (nearest_distance(seen, seen[side]) for side in sides)
    for _ in range(count):  # one after the other: each answer tells what to ask next
        near, far = torch.minimum(to_unsafe, to_rest), torch.maximum(to_unsafe, to_rest)
        row = (near * (near / far.clamp_min(1e-9)).pow(_DOUBT)).masked_fill(told, -1.0).argmax()
        told[row], side = True, to_unsafe if unsafe[row] else to_rest
        torch.minimum(side, (seen - seen[row]).norm(dim=1), out=side)
    spread = torch.where(to_unsafe < _CAUTION * to_rest, UNSAFE, UNLABELLED)
    return torch.where(told, answer, spread), told


__all__ = ["choose_and_spread"]

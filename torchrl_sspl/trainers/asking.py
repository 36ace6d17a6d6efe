"""Which pictures are worth a label, and what a few labels say of all the others."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_sspl.errors import EmptyRegionError
from torchrl_sspl.sets import UNLABELLED, UNSAFE
from torchrl_sspl.viability.cloud import nearest_distance

_ROUNDS = 20  # in which labels are asked for; what they say of the others is computed anew in each
_DOUBT = 0.3  # value of f up to which the border of U may be near
_CAUTION = 0.1  # below zero from which on a latent counts as of U
_SMOOTHING = 0.1  # of f, latent units: the border does not turn to every single label
_MOST, _AROUND = 2000, 64  # labels that are interpolated all at once, and of more the nearest ones


@torch.no_grad()
def choose_and_spread(seen: Tensor, told: Tensor, answer: Tensor, count: int) -> tuple[Tensor, Tensor]:
    r"""Labels for the latents of which a few labels tell least, and what labels say of all latents that have none.

    .. math:: f(z) = c - \sum_j w_j \lVert z - z_j \rVert, \qquad
        i^\star = \arg\max_i \; \min_j \lVert z_i - z_j \rVert \, e^{-(f(z_i) / 0.3)^2}, \qquad z_i \text{ counts as of U if } f(z_i) > -0.1

    where f interpolates 1 at the latents :math:`z_j` that are told to be of U, and -1 at those that are told not to be: asked for is what may
    lie on the border of U and far from what is known. Unlike labels of S and U alone, an answer can be *neither*: without it nobody
    knows where U ends. Source: none (uncertainty sampling, spread out by distances); the paper takes its labels at random.

    Args:
        seen: ``(n, p)`` latents of single pictures.
        told: ``(n,)`` bool, whose label is known.
        answer: ``(n,)`` codes of ``sets``; read only where a label is known or asked for.
        count: labels that are asked for.

    Returns ``(n,)`` codes, in which only labels say S, and of which labels are known now, bool. Raises EmptyRegionError where nothing
    is told to be of U, or nothing not to be.

    Example:
        >>> z = torch.linspace(-1, 1, 201)[:, None]
        >>> answer = torch.where(z[:, 0] > 0.305, 2, 0)
        >>> told = torch.zeros(201, dtype=torch.bool).index_fill(0, torch.tensor([0, 200]), True)
        >>> region, told = choose_and_spread(z, told, answer, 8)
        >>> int((region != answer).sum()), int(told.sum())
        (0, 10)
    """
    told, unsafe = told.clone(), answer == UNSAFE
    sides = int((told & unsafe).sum()), int((told & ~unsafe).sum())
    if 0 in sides:
        raise EmptyRegionError(
            f"expected labels of U and of what is not of U, received {sides[0]} and {sides[1]}; raise labels.safe and labels.unsafe"
        )
    for part in torch.arange(count).chunk(_ROUNDS):
        doubt = (-(_interpolated(seen, told, unsafe) / _DOUBT).square()).exp()
        far = nearest_distance(seen, seen[told])
        for _ in range(len(part)):
            row = (doubt * far).masked_fill(told, -1.0).argmax()
            told[row] = True
            far = torch.minimum(far, (seen - seen[row]).norm(dim=1))
    spread = torch.where(_interpolated(seen, told, unsafe) > -_CAUTION, UNSAFE, UNLABELLED)
    return torch.where(told, answer, spread), told


def _interpolated(seen: Tensor, told: Tensor, unsafe: Tensor) -> Tensor:
    """f ``(n,)`` at all latents."""
    # Imported here: scipy is a dependency, but importing the library stays light without it.
    from scipy.interpolate import RBFInterpolator

    z, near = seen.double().numpy(), None if int(told.sum()) <= _MOST else _AROUND
    f = RBFInterpolator(z[told.numpy()], torch.where(unsafe[told], 1.0, -1.0).numpy(), neighbors=near, kernel="linear", smoothing=_SMOOTHING)
    return torch.as_tensor(f(z), dtype=torch.float32)


__all__ = ["choose_and_spread"]

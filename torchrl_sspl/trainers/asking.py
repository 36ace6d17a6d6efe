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
_AGAINST = 0.9  # value of what the other labels say beyond which one is wrong that says the opposite
_ENOUGH = 20  # labels of either kind from which on this is asked
_MOST, _AROUND = 2000, 64  # labels that are interpolated all at once, and of more the nearest ones


@torch.no_grad()
def choose_and_spread(seen: Tensor, told: Tensor, answer: Tensor, count: int) -> tuple[Tensor, Tensor]:
    r"""Labels for the latents of which a few labels tell least, and what labels say of all latents that have none.

    .. math:: f(z) = c - \sum_j w_j \lVert z - z_j \rVert, \qquad
        i^\star = \arg\max_i \; \min_j \lVert z_i - z_j \rVert \, e^{-(f(z_i) / 0.3)^2}, \qquad z_i \text{ counts as of U if } f(z_i) > -0.1

    where f interpolates 1 at the latents :math:`z_j` that are told to be of U, and -1 at those that are told not to be: asked for is what may
    lie on the border of U and far from what is known. Unlike labels of S and U alone, an answer can be *neither*: without it nobody
    knows where U ends. A label that all others contradict, :math:`f_{-j}(z_j)` beyond 0.9 on the other side where f is interpolated without it, counts as
    wrong and is not used. Source: none (uncertainty sampling, spread out by distances); the paper takes its labels at random.

    Args:
        seen: ``(n, p)`` latents of single pictures.
        told: ``(n,)`` bool, whose label is known.
        answer: ``(n,)`` codes of ``sets``; read only where a label is known or asked for.
        count: labels that are asked for.

    Returns ``(n,)`` codes, in which only labels say S, and of which labels are known now, wrong ones among them, bool. Raises EmptyRegionError where nothing
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
    used = told & ~_contradicted(seen, told, unsafe)
    spread = torch.where(_interpolated(seen, used, unsafe) > -_CAUTION, UNSAFE, UNLABELLED)
    return torch.where(used, answer, spread), told


def _interpolated(seen: Tensor, told: Tensor, unsafe: Tensor) -> Tensor:
    """f ``(n,)`` at all latents."""
    # Imported here: scipy is a dependency, but importing the library stays light without it.
    from scipy.interpolate import RBFInterpolator

    z, near = seen.double().numpy(), None if int(told.sum()) <= _MOST else _AROUND
    f = RBFInterpolator(z[told.numpy()], torch.where(unsafe[told], 1.0, -1.0).numpy(), neighbors=near, kernel="linear", smoothing=_SMOOTHING)
    return torch.as_tensor(f(z), dtype=torch.float32)


def _contradicted(seen: Tensor, told: Tensor, unsafe: Tensor) -> Tensor:
    """``(n,)`` which labels all others contradict; of few labels nothing is said, nor of more than are interpolated all at once."""
    found, sides = torch.zeros_like(told), (int((told & unsafe).sum()), int((told & ~unsafe).sum()))
    if min(sides) >= _ENOUGH and sum(sides) <= _MOST:
        y = torch.where(unsafe[told], 1.0, -1.0).double()
        found[told] = _left_out(seen[told].double(), y) * y < -_AGAINST
    return found


def _left_out(z: Tensor, y: Tensor) -> Tensor:
    r"""f at every latent ``(n, p)`` without its own value ``(n,)``: :math:`f_{-j}(z_j) = y_j - c_j / (A^{-1})_{jj}` where :math:`A c = y`.

    A is the matrix of the interpolation, with its constant.
    """
    n = len(z)
    system = torch.ones(n + 1, n + 1, dtype=torch.float64)
    system[:n, :n] = _SMOOTHING * torch.eye(n) - torch.cdist(z, z, compute_mode="donot_use_mm_for_euclid_dist")
    system[n, n] = 0.0
    inverse = torch.linalg.inv(system)[:n, :n]
    return y - inverse @ y / inverse.diagonal()


__all__ = ["choose_and_spread"]

r"""Barriers that are Lipschitz by construction: sandwich layers (Wang & Manchester 2023)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.lipschitz.layers import collapsible

# Every weight is made smaller by this share: the matrix of the certificate is then positive definite with a slack
# that rounding to float32 cannot use up. The bound loses (layers) times as much.
_SHRINK = 1e-5


def cayley(weight: Tensor) -> Tensor:
    r"""Matrix ``(n, m)`` with orthonormal columns (rows, if n < m) from a free matrix of its shape.

    .. math:: Q = \begin{bmatrix} (I + Z)^{-1} (I - Z) \\ -2 V (I + Z)^{-1} \end{bmatrix}, \quad Z = U - U^\top + V^\top V

    with U the upper square and V the rest of the matrix.

    Source: Wang & Manchester 2023, eq. (12).

    Example:
        >>> q = cayley(torch.tensor([[0.3], [0.7], [-0.2]]))
        >>> torch.allclose(q.mT @ q, torch.eye(1))
        True
    """
    n, m = weight.shape
    if n < m:
        return cayley(weight.mT).mT
    square, rest = weight[:m], weight[m:]
    skew = square - square.mT + rest.mT @ rest
    eye = torch.eye(m, dtype=weight.dtype, device=weight.device)
    inverse = torch.linalg.inv(eye + skew)
    return torch.cat([inverse @ (eye - skew), -2.0 * rest @ inverse])


@collapsible
class SandwichBarrier(nn.Module):
    r"""Scalar ReLU network whose Lipschitz constant is at most L for every value of its parameters.

    With :math:`[A_k, B_k]` from a Cayley transform (:math:`A_k A_k^\top + B_k B_k^\top = I`) and positive diagonal
    :math:`\Psi_k` the equivalent plain weights are

    .. math::
        W_0 = \sqrt{2 L}\, \Psi_0^{-1} B_0, \quad W_k = 2 \Psi_k^{-1} B_k A_{k-1}^\top \Psi_{k-1}, \quad
        W_l = \sqrt{2 L}\, B_l A_{l-1}^\top \Psi_{l-1}

    which satisfy the matrix inequality of paper Lemma 2 with :math:`\Lambda_k = L \Psi_k^2`.

    Args:
        latent_dim: size p of the latent.
        hidden: widths of the hidden layers, at least one.
        lipschitz_bound: L; ``ConfigError`` if this or a size is not positive.

    Source: Wang & Manchester 2023, Theorem 3.2; in place of the penalty of paper eq. (9).

    Example:
        >>> _ = torch.manual_seed(0)
        >>> barrier, z = SandwichBarrier(3, (16, 16), lipschitz_bound=2.0), torch.randn(100, 3)
        >>> torch.allclose(barrier(z), barrier.collapse()(z), atol=1e-5)
        True
    """

    def __init__(self, latent_dim: int, hidden: Sequence[int] = (64, 64, 64), lipschitz_bound: float = 2.0) -> None:
        super().__init__()
        sizes = [latent_dim, *hidden, 1]
        if len(sizes) < 3 or min(sizes) < 1 or not (math.isfinite(lipschitz_bound) and lipschitz_bound > 0):
            raise ConfigError(
                f"expected latent_dim and hidden widths >= 1 (at least one hidden layer) and lipschitz_bound > 0, received "
                f"{latent_dim}, {list(hidden)} and {lipschitz_bound}"
            )
        self.latent_dim, self.lipschitz_bound = latent_dim, float(lipschitz_bound)
        shapes = [(n_out, n_in + n_out) for n_in, n_out in itertools.pairwise(sizes)]
        self.free = nn.ParameterList([nn.Parameter(torch.empty(shape)) for shape in shapes])
        self.gain = nn.ParameterList([nn.Parameter(torch.empty(())) for _ in shapes])
        self.log_psi = nn.ParameterList([nn.Parameter(torch.empty(n)) for n in hidden])
        self.bias = nn.ParameterList([nn.Parameter(torch.empty(n)) for n in sizes[1:]])
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Draws the weights anew, in place."""
        for free, gain in zip(self.free, self.gain, strict=True):
            free.normal_(std=1.0 / math.sqrt(free.shape[1]))
            gain.copy_(free.norm())
        for zero in (*self.log_psi, *self.bias):
            zero.zero_()

    def weights(self, dtype: torch.dtype | None = None) -> list[Tensor]:
        """Plain weights ``W_0 .. W_l``, each ``(out, in)``, differentiable; computed in ``dtype``."""
        halves = []
        for free, gain in zip(self.free, self.gain, strict=True):
            free = free.to(dtype or free.dtype)
            orthogonal = cayley(gain.to(free) * free / free.norm())
            halves.append((orthogonal[:, : len(free)], orthogonal[:, len(free) :]))
        psi = [p.to(dtype or p.dtype).exp() for p in self.log_psi]
        keep = 1.0 - _SHRINK
        outer = math.sqrt(2.0 * self.lipschitz_bound) * keep
        plain = [outer * halves[0][1] / psi[0][:, None]]
        for k in range(1, len(halves)):
            inner = halves[k][1] @ (halves[k - 1][0].mT * psi[k - 1])
            plain.append(outer * inner if k == len(halves) - 1 else 2.0 * keep * inner / psi[k][:, None])
        return plain

    def multipliers(self) -> list[Tensor]:
        r"""Witness of the bound: :math:`\Lambda_k = L \Psi_k^2`, one float64 vector per hidden layer."""
        return [self.lipschitz_bound * (2.0 * p.detach().double()).exp() for p in self.log_psi]

    def forward(self, latent: Tensor) -> Tensor:
        """Barrier value ``(*batch, p) -> (*batch, 1)``."""
        if latent.shape[-1] != self.latent_dim:
            raise ShapeError(f"expected latents of shape (*batch, {self.latent_dim}), received {tuple(latent.shape)}")
        weights = self.weights()
        for weight, bias in zip(weights[:-1], list(self.bias)[:-1], strict=True):
            latent = torch.relu(nn.functional.linear(latent, weight, bias))
        return nn.functional.linear(latent, weights[-1], self.bias[-1])

    @torch.no_grad()
    def collapse(self) -> nn.Sequential:
        """The same function as a plain network of linear layers and ReLU; weights computed in float64, then rounded.

        What is lost by rounding is below the slack of the certificate however large the parameters are.
        """
        layers: list[nn.Module] = []
        for weight, bias in zip(self.weights(torch.float64), self.bias, strict=True):
            linear = nn.Linear(weight.shape[1], weight.shape[0], device=bias.device, dtype=bias.dtype)
            linear.weight.copy_(weight)
            linear.bias.copy_(bias)
            layers += [linear, nn.ReLU()]
        return nn.Sequential(*layers[:-1])

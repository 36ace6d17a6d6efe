r"""The paper's barrier: a plain network that a log-determinant keeps inside the cone of its Lipschitz certificate."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError, NotPositiveDefiniteError, ShapeError
from torchrl_sspl.functional import lmi_loss, lmi_matrix
from torchrl_sspl.lipschitz.layers import activation_of, collapsible
from torchrl_sspl.lipschitz.multipliers import norm_product, start_multipliers

ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {
    "relu": nn.ReLU, "leaky_relu": lambda: nn.LeakyReLU(0.1), "tanh": nn.Tanh, "softplus": nn.Softplus,
    "sigmoid": nn.Sigmoid, "silu": nn.SiLU,
}  # fmt: skip


@collapsible
class LMIBarrier(nn.Module):
    r"""Network with trainable multipliers whose matrix :math:`M(\theta, \Lambda)` stays positive definite.

    It starts feasible: the weights are scaled so that :math:`\rho = \beta^l \prod_k \|W_k\| / L < 1`. Steps are taken
    through :meth:`backtracking_step`, which never leaves the cone: the bound holds at every moment of the training.

    Args:
        latent_dim: size p of the latent; ``ConfigError`` if this or another argument is not valid.
        hidden: widths of the hidden layers, at least one.
        lipschitz_bound: L > 0.
        activation: one of ``ACTIVATIONS``.
        start_ratio: :math:`\rho` at the start, in (0, 1).

    Source: paper Lemma 2 and eq. (9) (Pauli et al. 2021); deviation: the cone is never left.

    Example:
        >>> barrier = LMIBarrier(2, (8, 8), lipschitz_bound=2.0)
        >>> barrier.feasible(), barrier(torch.zeros(5, 2)).shape
        (True, torch.Size([5, 1]))
    """

    def __init__(
        self,
        latent_dim: int,
        hidden: Sequence[int] = (64, 64, 64),
        lipschitz_bound: float = 2.0,
        *,
        activation: str = "relu",
        start_ratio: float = 0.5,
    ) -> None:
        super().__init__()
        if activation not in ACTIVATIONS:
            raise ConfigError(f"expected activation to be one of {sorted(ACTIVATIONS)}, received {activation!r}")
        sizes = [latent_dim, *hidden, 1]
        if len(sizes) < 3 or min(sizes) < 1 or not lipschitz_bound > 0 or not 0 < start_ratio < 1:
            raise ConfigError(
                f"expected sizes >= 1 with a hidden layer, lipschitz_bound > 0 and 0 < start_ratio < 1, received "
                f"{sizes}, {lipschitz_bound} and {start_ratio}"
            )
        make = ACTIVATIONS[activation]
        self.slope = activation_of(make()).slope
        self.latent_dim, self.lipschitz_bound = latent_dim, float(lipschitz_bound)
        layers: list[nn.Module] = []
        for n_in, n_out in itertools.pairwise(sizes):
            layers += [nn.Linear(n_in, n_out), make()]
        self.net = nn.Sequential(*layers[:-1])
        self.log_multipliers = nn.ParameterList([nn.Parameter(torch.empty(n)) for n in hidden])
        self.start_ratio = float(start_ratio)
        self._start()

    @torch.no_grad()
    def _start(self) -> None:
        """Scales the weights and sets the multipliers so that the matrix is positive definite."""
        weights = self.weights()
        factor = (self.start_ratio * self.lipschitz_bound / norm_product(weights, self.slope)) ** (1.0 / len(weights))
        for weight in weights:
            weight.mul_(factor)
        levels = start_multipliers(weights, self.lipschitz_bound, self.slope)
        for level, logs in zip(levels, self.log_multipliers, strict=True):
            logs.fill_(math.log(level))

    def reset_parameters(self) -> None:
        """Draws the weights anew, in place, inside the cone."""
        for module in self.net:
            if isinstance(module, nn.Linear):
                module.reset_parameters()
        self._start()

    def weights(self) -> list[Tensor]:
        """Weights ``W_0 .. W_l``, each ``(out, in)``."""
        return [m.weight for m in self.net if isinstance(m, nn.Linear)]

    def multipliers(self) -> list[Tensor]:
        r"""Diagonals of :math:`\Lambda`, one vector per hidden layer."""
        return [p.exp() for p in self.log_multipliers]

    def matrix(self) -> Tensor:
        r"""The matrix :math:`M(\theta, \Lambda)`, float64."""
        return lmi_matrix(
            [w.double() for w in self.weights()], [m.double() for m in self.multipliers()], self.lipschitz_bound, self.slope
        )

    def forward(self, latent: Tensor) -> Tensor:
        """Barrier value ``(*batch, p) -> (*batch, 1)``."""
        if latent.shape[-1] != self.latent_dim:
            raise ShapeError(f"expected latents of shape (*batch, {self.latent_dim}), received {tuple(latent.shape)}")
        return self.net(latent)

    @torch.no_grad()
    def collapse(self) -> nn.Sequential:
        """A copy as a plain network."""
        return copy.deepcopy(self.net)

    @torch.no_grad()
    def feasible(self) -> bool:
        """Whether the matrix is positive definite."""
        return not int(torch.linalg.cholesky_ex(self.matrix()).info)

    @torch.no_grad()
    def backtracking_step(self, before: dict[str, Tensor], *, shrink: float = 0.5, attempts: int = 20) -> float:
        """Pulls the parameters back towards where they came from until they are inside the cone.

        Args:
            before: ``state_dict`` (cloned) from before the optimiser's step; it must be feasible.
            shrink: factor on the step at every attempt.
            attempts: number of attempts, after which the old parameters are restored.

        Returns:
            The share of the step that was kept, 1 if it was feasible, 0 if none of it.

        Raises:
            NotPositiveDefiniteError: if the old parameters are not feasible either.

        Source: none; the printed loss has no such safeguard.
        """
        if self.feasible():
            return 1.0
        after = {k: v.clone() for k, v in self.state_dict().items()}
        share = 1.0
        for _ in range(attempts):
            share *= shrink
            self.load_state_dict({k: torch.lerp(before[k], after[k], share) for k in after})
            if self.feasible():
                return share
        self.load_state_dict(before)
        if not self.feasible():
            raise NotPositiveDefiniteError("expected feasible parameters before the step, received infeasible ones; start from a feasible point")
        return 0.0

    def loss(self) -> Tensor:
        r"""The paper's :math:`L_M = -\log\det M`; raises ``NotPositiveDefiniteError`` outside the cone."""
        return lmi_loss(self.matrix())

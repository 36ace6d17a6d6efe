"""The Lipschitz constant of a network from above, by proof, and from below, by samples."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError
from torchrl_sspl.lipschitz.exact import prove_lipschitz
from torchrl_sspl.lipschitz.multipliers import minimise_bound, norm_product
from torchrl_sspl.lipschitz.network import Slope, layer_weights, slope_interval


def lipschitz_upper(network: nn.Module | Sequence[Tensor], slope: Slope | None = None) -> float:
    """Smallest Lipschitz bound that can be proved for a network (within the accuracy of an interior-point method).

    Args:
        network: plain network or its weights, as for :func:`~torchrl_sspl.lipschitz.layer_weights`.
        slope: smallest and largest slope of the activation; read from the network if not given.

    Returns:
        A bound that :func:`prove_lipschitz` accepts, at least 1e-6; infinity if there is none in reach of float64.

    Source: paper Lemma 2; Fazlyab et al. 2019 (LipSDP-Neuron).

    Example:
        >>> round(lipschitz_upper([torch.tensor([[0.5], [0.5]]), torch.tensor([[1.0, 1.0]])]), 2)
        1.0
    """
    slope = slope_interval(network, slope)
    weights = [w.double() for w in layer_weights(network)]
    multipliers: list[Tensor] = []
    bound = max(norm_product(weights, slope), 1e-6)
    if len(weights) > 1:
        multipliers, bound = minimise_bound(weights, slope)
    claims = (bound * (1 + 10.0**-digits) for digits in range(9, 0, -1))
    return next((c for c in claims if prove_lipschitz(weights, c, slope, multipliers=multipliers).proved), math.inf)


def lipschitz_lower(
    function: Callable[[Tensor], Tensor],
    low: float | Tensor,
    high: float | Tensor,
    n: int = 20000,
    generator: torch.Generator | None = None,
    *,
    dim: int | None = None,
) -> float:
    """Largest gradient norm of a scalar function that was seen in samples: no Lipschitz constant can be smaller.

    A third of the samples is uniform, the others lie around the steepest found so far.

    Args:
        function: ``(m, p) -> (m, 1)``, differentiable almost everywhere; a module may lie on any device.
        low: lower corner of the box, number or ``(p,)``.
        high: upper corner.
        n: number of gradients in each of three passes.
        generator: random numbers; the samples are drawn where it lives.
        dim: p; taken from the corners or the first linear layer if not given, else ``ConfigError``.

    Source: none.

    Example:
        >>> lipschitz_lower(lambda x: 3 * x[:, :1] + 4 * x[:, 1:], -1.0, 1.0, n=10, dim=2)
        5.0
    """
    low, high = torch.as_tensor(low, dtype=torch.float32), torch.as_tensor(high, dtype=torch.float32)
    if dim is None and isinstance(function, nn.Module):
        dim = next((m.in_features for m in function.modules() if isinstance(m, nn.Linear)), None)
    dim = dim or (low.numel() if low.ndim else high.numel() if high.ndim else None)
    if not dim:
        raise ConfigError("expected dim, the size of the input, for a function without linear layers; pass dim=")
    device = low.device if generator is None else generator.device
    low, high = low.to(device), high.to(device)
    weight = next(function.parameters(), low) if isinstance(function, nn.Module) else low
    x = low + (high - low) * torch.rand(n, dim, generator=generator, device=device)
    best = 0.0
    with torch.enable_grad():
        for _ in range(3):
            x = x.detach().requires_grad_()
            norm = torch.autograd.grad(function(x.to(weight)).sum(), x)[0].norm(dim=-1)
            best = max(best, float(norm.max()))
            # A piecewise linear function: a look around the steepest pieces beats more samples everywhere.
            steepest = x.detach()[norm.topk(max(1, n // 20)).indices]
            x = steepest[torch.arange(n, device=device) % len(steepest)]
            x = x + 0.05 * (high - low) * torch.randn(n, dim, generator=generator, device=device)
            x = torch.minimum(torch.maximum(x, low), high)
    return best

"""What a proof speaks of: the weights of a plain feed-forward network and the slopes of its activations."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

from torch import Tensor, nn

from torchrl_sspl.errors import ConfigError, NonFiniteError, ShapeError

Slope = tuple[float, float]

# Smallest and largest slope of each activation, rounded outward.
_SLOPES: dict[type[nn.Module], Callable[[nn.Module], Slope]] = {
    nn.Identity: lambda m: (1.0, 1.0),
    nn.ReLU: lambda m: (0.0, 1.0),
    nn.LeakyReLU: lambda m: (min(float(m.negative_slope), 1.0), max(float(m.negative_slope), 1.0)),  # type: ignore[arg-type]
    nn.Tanh: lambda m: (0.0, 1.0),
    nn.Softplus: lambda m: (0.0, 1.0),
    nn.Sigmoid: lambda m: (0.0, 0.25),
    nn.SiLU: lambda m: (-0.1, 1.1),
    nn.GELU: lambda m: (-0.13, 1.13),
}


def _flat(module: nn.Module) -> Iterator[nn.Module]:
    if isinstance(module, nn.Sequential):
        for part in module:
            yield from _flat(part)
    else:
        yield module


def plain_layers(network: nn.Module) -> tuple[list[nn.Linear], list[Slope]]:
    r"""Linear layers of a plain network, and the slopes of what stands between them.

    Args:
        network: ``nn.Sequential`` of linear layers and activations, possibly nested, or a module with a
            ``collapse()`` method that gives one.

    Returns:
        The layers, and one interval of slopes per gap between two layers.

    Raises:
        ConfigError: if the module is anything else: what is proved of its weights would not hold for it.

    Source: none.

    Example:
        >>> plain_layers(nn.Sequential(nn.Linear(2, 8), nn.LeakyReLU(0.1), nn.Linear(8, 1)))[1]
        [(0.1, 1.0)]
    """
    layers: list[nn.Linear] = []
    slopes: list[Slope] = []
    after_linear = False
    parts = list(_flat(network.collapse() if hasattr(network, "collapse") else network))  # type: ignore[operator]
    for part in parts:
        if isinstance(part, nn.Linear):
            if after_linear:
                slopes.append((1.0, 1.0))
            layers.append(part)
            after_linear = True
        elif type(part) in _SLOPES and after_linear:
            slopes.append(_SLOPES[type(part)](part))
            after_linear = False
        else:
            after_linear = False
            break
    if not after_linear:
        raise ConfigError(
            "expected a plain network (linear layers with one activation between two of them, of the kinds "
            f"{sorted(kind.__name__ for kind in _SLOPES)}), received {[type(p).__name__ for p in parts]}; pass such a "
            "network, or its weights and the slopes of its activation"
        )
    return layers, slopes


def layer_weights(network: nn.Module | Sequence[Tensor]) -> list[Tensor]:
    """Weight matrices of a plain network, in order.

    Args:
        network: plain network (see :func:`plain_layers`), or the weights themselves.

    Returns:
        One ``(out, in)`` matrix per linear layer, detached, in host memory, where bounds are computed.

    Raises:
        ConfigError: if the module is no plain network.
        ShapeError: if the shapes do not follow each other.
        NonFiniteError: if a weight is NaN or infinite.

    Source: none.

    Example:
        >>> [tuple(w.shape) for w in layer_weights(nn.Sequential(nn.Linear(2, 8), nn.ReLU(), nn.Linear(8, 1)))]
        [(8, 2), (1, 8)]
    """
    if isinstance(network, nn.Module):
        weights = [layer.weight.detach().cpu() for layer in plain_layers(network)[0]]
    else:
        weights = [w.detach().cpu() for w in network]
    if not weights or any(w.ndim != 2 for w in weights):
        raise ShapeError(
            f"expected at least one matrix, received shapes {[tuple(w.shape) for w in weights]}; pass a network or its weights"
        )
    for first, second in zip(weights[:-1], weights[1:], strict=True):
        if second.shape[1] != first.shape[0]:
            raise ShapeError(
                f"expected weights whose sizes follow each other, received {tuple(first.shape)} then "
                f"{tuple(second.shape)}; pass the layers in order"
            )
    if not all(bool(w.isfinite().all()) for w in weights):
        raise NonFiniteError("expected finite weights, received NaN or infinity; the network cannot be certified")
    return weights


def slope_interval(network: nn.Module | Sequence[Tensor], slope: Slope | None = None) -> Slope:
    r"""Slopes :math:`[\alpha, \beta]` of the activations of a network.

    Args:
        network: plain network, or its weights.
        slope: interval to use; it must contain the slopes of the network's activations. Without it they are read
            from the network; weights alone stand for a ReLU network.

    Returns:
        Smallest and largest slope; an interval (almost) without width is widened downward, which costs nothing.

    Raises:
        ConfigError: if the given interval is not one, or does not contain the slopes of the network.

    Source: none.

    Example:
        >>> slope_interval(nn.Sequential(nn.Linear(2, 8), nn.SiLU(), nn.Linear(8, 1)))
        (-0.1, 1.1)
    """
    found = plain_layers(network)[1] if isinstance(network, nn.Module) else []
    if slope is None:
        slope = (min(low for low, _ in found), max(high for _, high in found)) if found else (0.0, 1.0)
    low, high = slope
    if not (low <= high and math.isfinite(low) and math.isfinite(high)):
        raise ConfigError(f"expected slope (low, high) in order and finite, received {slope}")
    if any(a < low or b > high for a, b in found):
        raise ConfigError(
            f"expected slopes that contain those of the activations, {sorted(set(found))}, received {slope}; leave "
            "slope out to have it read from the network"
        )
    # Multipliers grow without limit as the width goes to zero.
    return min(float(low), high - max(1e-3 * abs(high), 1e-6)), float(high)

"""What a proof speaks of: the weights of a plain feed-forward network and the slopes of its activations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import NoneType

from torch import Tensor, nn
from torch.nn.modules import module as torch_module

from torchrl_sspl.errors import ConfigError, NonFiniteError, ShapeError, StructureError
from torchrl_sspl.lipschitz.layers import COLLAPSIBLE, FORMS, LAYERS, ORIGINAL, activation_of

Slope = tuple[float, float]

_CALLS = ("_forward_pre_hooks", "_forward_hooks", "_backward_pre_hooks", "_backward_hooks")
_CALL = nn.Module.__call__


def check_module(module: nn.Module) -> None:
    """Refuses a module, its children aside, that may compute something else than its type and its weights say.

    Raises:
        StructureError: if the type is not exactly one that is known (:mod:`.layers`); if a hook (of the module or of
            all modules), an overridden, replaced or compiled method or a parametrization stands in between.
        NonFiniteError: if a weight is NaN or infinite.

    Example:
        >>> layer = nn.Linear(2, 1)
        >>> layer.forward = lambda x: 0 * x
        >>> check_module(layer)
        Traceback (most recent call last):
        torchrl_sspl.errors.StructureError: expected a Linear whose methods are its own, received one with 'forward'
        replaced
    """
    kind, name = type(module), type(module).__name__
    known = (*LAYERS, nn.Sequential, *FORMS, *COLLAPSIBLE)
    if "parametrizations" in module._modules:
        raise StructureError(f"expected stored weights, received a {name} with a parametrization; remove it", "PARAMETRIZED")
    if kind not in known:
        base = next((k for k in kind.__mro__ if k in known), None)
        if base is None:
            raise StructureError(
                "expected a plain network (nn.Sequential of layers of the kinds "
                f"{', '.join(sorted(k.__name__ for k in LAYERS))}), received {name}; deploy a network made of these"
            )
        raise StructureError(
            f"expected a plain network made of {base.__name__} itself, received its subclass {name}, which may compute "
            "something else",
            "SUBCLASSED",
        )
    everywhere = (torch_module._global_forward_hooks, torch_module._global_forward_pre_hooks,
                  torch_module._global_backward_hooks, torch_module._global_backward_pre_hooks)  # fmt: skip
    if any(everywhere) or any(getattr(module, hooks, None) for hooks in _CALLS):
        raise StructureError(
            f"expected layers without forward or backward hooks, received a {name} with one (or one of all modules); a "
            "hook may change what a layer computes",
            "HOOKED",
        )
    replaced = [k for k in vars(module) if callable(getattr(kind, k, None))]
    if vars(module).get("_compiled_call_impl") is not None:
        replaced.append("_compiled_call_impl")
    if kind.forward is not ORIGINAL.get(kind, kind.forward) or kind.__call__ is not _CALL:
        replaced.append("forward")
    if replaced:
        raise StructureError(
            f"expected a {name} whose methods are its own, received one with {replaced[0]!r} replaced", "OVERRIDDEN"
        )
    if kind is nn.Linear and any(not isinstance(module._parameters.get(k, 0), (nn.Parameter, NoneType)) for k in ("weight", "bias")):
        raise StructureError(f"expected weights that are parameters, received a {name} whose are not", "PARAMETRIZED")
    for value in (*module._parameters.values(), *module._buffers.values()):
        if value is not None and (value.is_meta or not bool(value.isfinite().all())):
            raise NonFiniteError("expected finite weights, received NaN or infinity; the network cannot be certified")


def flat_layers(network: nn.Module) -> list[nn.Module]:
    """The layers of a plain network in order, each looked at (:func:`check_module`); what does nothing is left out.

    A plain network is a layer, an ``nn.Sequential`` of such, possibly nested, or a registered module whose
    ``collapse()`` gives one.

    Example:
        >>> [type(layer).__name__ for layer in flat_layers(nn.Sequential(nn.Linear(2, 2), nn.Sequential(nn.ReLU())))]
        ['Linear', 'ReLU']
    """
    check_module(network)
    if type(network) in COLLAPSIBLE:
        return flat_layers(network.collapse())  # type: ignore[operator]
    if type(network) is nn.Sequential:
        return [layer for part in network for layer in flat_layers(part)]
    if type(network) in FORMS:
        raise StructureError(f"expected a plain network, received a {type(network).__name__}; pass its 'net'")
    return [] if type(network) is nn.Identity else [network]


def _plain_layers(network: nn.Module) -> tuple[list[nn.Linear], list[Slope]]:
    """Linear layers of a plain network, and one interval of slopes for what stands between two of them."""
    layers: list[nn.Linear] = []
    slopes: list[Slope] = []
    after_linear = False
    parts = flat_layers(network)
    for part in parts:
        if isinstance(part, nn.Linear):
            if after_linear:
                slopes.append((1.0, 1.0))
            layers.append(part)
            after_linear = True
        elif after_linear:
            slopes.append(activation_of(part).slope)
            after_linear = False
        else:
            break
    if not after_linear:
        raise StructureError(
            "expected a plain network (linear layers with at most one activation between two of them), received "
            f"{[type(p).__name__ for p in parts]}; pass such a network, or its weights and the slopes of its activation"
        )
    return layers, slopes


def layer_weights(network: nn.Module | Sequence[Tensor]) -> list[Tensor]:
    """Weight matrices ``(out, in)`` of a plain network, in order, detached, in host memory, where bounds are computed.

    Args:
        network: plain network (linear layers with at most one activation between two of them), or the weights
            themselves.

    Raises:
        ConfigError: if the module is no plain network: what is proved of its weights would not hold for it.
        ShapeError: if the shapes do not follow each other.
        NonFiniteError: if a weight is NaN or infinite.

    Source: none.

    Example:
        >>> [tuple(w.shape) for w in layer_weights(nn.Sequential(nn.Linear(2, 8), nn.ReLU(), nn.Linear(8, 1)))]
        [(8, 2), (1, 8)]
    """
    if isinstance(network, nn.Module):
        weights = [layer.weight.detach().cpu() for layer in _plain_layers(network)[0]]
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
    r"""Smallest and largest slope :math:`[\alpha, \beta]` of the activations of a network.

    Args:
        network: plain network, or its weights, which alone stand for a ReLU network.
        slope: interval to use in place of the network's own, which it must contain, else ``ConfigError``.

    Returns:
        Both; an interval (almost) without width is widened downward, which costs nothing.

    Source: none.

    Example:
        >>> slope_interval(nn.Sequential(nn.Linear(2, 8), nn.SiLU(), nn.Linear(8, 1)))
        (-0.1, 1.1)
    """
    found = _plain_layers(network)[1] if isinstance(network, nn.Module) else []
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

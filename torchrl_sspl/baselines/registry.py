"""The methods by name."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Sequence
from typing import Any

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchrl_sspl.baselines.base import SafetyMethod
from torchrl_sspl.errors import ConfigError

_HERE = "torchrl_sspl.baselines"
#: Where each method is; the ceilings first.
METHODS = {
    "box_margin": "ceilings:BoxMargin",
    "depth": "ceilings:DepthBarrier",
    "hocbf": "ceilings:HigherOrder",
    "lqr": "ceilings:LQREllipsoid",
    "cone": "ceilings:CollisionCone",
    "turning_circle": "ceilings:TurningCircle",
    "kernel": "ceilings:TrueKernel",
    "imitation": "imitation:Imitation",
    "nerf_cbf": "nerf_cbf:NeRFCBF",
    "vision_cbf": "vision_cbf:VisionCBF",
    "neural_cbf": "neural_cbf:NeuralCBF",
    "latent_cbf": "latent_cbf:LatentCBF",
    "latent_safe": "latent_safe:LatentSafe",
    "smooth_latent": "smooth_latent:SmoothLatent",
    "sspl": "sspl:SSPL",
}


#: Options of one meaning, by name, what is expected of them, and whether a value is valid.
_RANGES: tuple[tuple[tuple[str, ...], str, Callable[[float], bool]], ...] = (
    (("alpha", "discount", "warmup"), "in [0, 1)", lambda v: 0 <= v < 1),
    (("tau", "keep"), "in (0, 1]", lambda v: 0 < v <= 1),
    (("beta", "radius", "rate", "slack", "hinge", "penalty", "plain"), ">= 0", lambda v: v >= 0),
)


def kind_of(name: str) -> type[SafetyMethod]:
    """Class of a method; a ConfigError that lists all if there is none of that name. Source: none.

    Example:
        >>> kind_of("lqr").__name__
        'LQREllipsoid'
    """
    if name not in METHODS:
        raise ConfigError(f"expected a method, one of {', '.join(METHODS)}, received '{name}'")
    module, _, kind = METHODS[name].partition(":")
    return getattr(importlib.import_module(f"{_HERE}.{module}"), kind)


def make(name: str, options: Sequence[str] = ()) -> SafetyMethod:
    """A method by name, with ``key=value`` changes of its configuration; ConfigError if one is not valid. Source: none.

    Example:
        >>> make("hocbf", ["k=2.0"]).config.k
        2.0
    """
    kind = kind_of(name)
    if kind.Config is None:
        if options:
            raise ConfigError(f"{name}: expected no options, received {list(options)}")
        return kind()
    config = changed(kind.Config, options, f"{name}: expected options")
    for keys, words, valid in _RANGES:
        for key in keys:
            if not valid(value := getattr(config, key, 0.5)):
                raise ConfigError(f"{name}: expected {key} {words}, received {value}")
    for key, usual in vars(kind.Config()).items():
        value, least = getattr(config, key), min(1, usual) if type(usual) is int else -math.inf
        if isinstance(value, (int, float)) and not least <= value < math.inf:
            raise ConfigError(f"{name}: expected {key} {f'>= {least}' if type(usual) is int else 'to be finite'}, received {value}")
    return kind(config)


def changed(config: type, words: Sequence[str], expected: str) -> Any:
    """A dataclass of options with ``key=value`` changes; a ConfigError that begins with what was ``expected`` if one is not valid. Source: none.

    Example:
        >>> from torchrl_sspl.baselines import ScoreConfig
        >>> changed(ScoreConfig, ["episodes=10"], "expected score.*").episodes
        10
    """
    usual = OmegaConf.structured(config)
    try:
        return OmegaConf.to_object(OmegaConf.merge(usual, OmegaConf.from_dotlist(list(words))))
    except (OmegaConfBaseException, yaml.YAMLError) as error:
        raise ConfigError(f"{expected} among {', '.join(usual)}, received {list(words)} ({' '.join(str(error).split())})") from error


__all__ = ["METHODS", "kind_of", "make"]

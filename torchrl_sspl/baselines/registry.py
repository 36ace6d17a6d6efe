"""The methods by name."""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence

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
    try:
        merged = OmegaConf.merge(OmegaConf.structured(kind.Config), OmegaConf.from_dotlist(list(options)))
    except (OmegaConfBaseException, yaml.YAMLError) as error:
        valid = ", ".join(OmegaConf.structured(kind.Config))
        raise ConfigError(f"{name}: expected options among {valid}, received {list(options)} ({' '.join(str(error).split())})") from error
    for key, usual in vars(kind.Config()).items():
        value, least = merged[key], min(1, usual) if type(usual) is int else -math.inf
        if isinstance(value, (int, float)) and not least <= value < math.inf:
            raise ConfigError(f"{name}: expected {key} {f'>= {least}' if type(usual) is int else 'to be finite'}, received {value}")
    return kind(OmegaConf.to_object(merged))


__all__ = ["METHODS", "kind_of", "make"]

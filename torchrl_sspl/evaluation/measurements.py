"""Figures of an evaluation, each with its sample size and exact 95 % bounds where it is a share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_sspl.certification.statistics import clopper_pearson
from torchrl_sspl.lipschitz import lipschitz_lower
from torchrl_sspl.modules.agent import Agent

_CONFIDENCE = 0.95

Draw = Callable[[Tensor], Tensor]
MakeEnv = Callable[..., EnvBase]


@dataclass
class Measurement:
    """One figure of an evaluation."""

    name: str  # what was measured
    value: float | None  # None: not measured
    unit: str  # "share", "latent", "barrier", ...
    n: int | None = None  # sample size; None: not a sample
    events: int | None = None  # among the n, of shares only, as what follows
    lower: float | None = None  # end of the two-sided 95 % Clopper-Pearson interval
    upper: float | None = None  # the other; with no event, the one-sided 95 % bound
    note: str = ""  # how it was measured


def share(name: str, events: int, n: int, note: str = "") -> Measurement:
    """Measurement of a share, events of n independent trials, with its exact confidence bounds.

    Value and bounds are None when there was no trial. Source: Clopper and Pearson (1934).

    Example:
        >>> round(share("leaves", 0, 3000).upper, 4)
        0.001
    """
    if n == 0:
        return Measurement(name, None, "share", 0, 0, None, None, note)
    lower, upper = clopper_pearson(events, n, confidence=_CONFIDENCE)
    return Measurement(name, events / n, "share", n, events, lower, upper, note)


@dataclass
class Evaluation:
    """All measurements of one agent by name, and ``arrays``: tensors for figures, not written to ``metrics.json``."""

    measurements: dict[str, Measurement] = field(default_factory=dict)
    arrays: dict[str, Any] = field(default_factory=dict)

    def add(self, measurement: Measurement) -> None:
        """Keep a measurement under its name."""
        self.measurements[measurement.name] = measurement

    def count(self, name: str, events: Tensor, note: str, of: Tensor | None = None, *, independent: bool = True) -> None:
        """Keep the share of events, bool, in the trials, or in some of them, which hold all events.

        Nodes of a grid and steps of an episode are not ``independent``: their share has no bounds.
        """
        found = share(name, int(events.sum()), events.numel() if of is None else int(of.sum()), note)
        self.add(found if independent else replace(found, lower=None, upper=None))

    def missing(self, *names: str, unit: str = "share", note: str = "no barrier") -> None:
        """Names of what could not be measured, and why."""
        for name in names:
            self.add(Measurement(name, None, unit, note=note))

    def __getitem__(self, name: str) -> float | None:
        return self.measurements[name].value

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {name: asdict(m) for name, m in self.measurements.items()}


def quantiles(out: Evaluation, name: str, values: Tensor | None, unit: str, note: str) -> None:
    """Adds 99 %, 99.9 %, mean and maximum of a sample ``(n,)`` as ``<name>_q99``, ``_q999``, ``_mean`` and ``_max``.

    Of a sample that is None or empty, the four are not measured. Source: none.

    Example:
        >>> import torch
        >>> out = Evaluation()
        >>> quantiles(out, "error", torch.arange(1.0, 1001.0), "m", "")
        >>> out["error_q99"], out["error_mean"], out["error_max"]
        (990.0, 500.5, 1000.0)
    """
    if values is None or not len(values):
        out.missing(*(f"{name}_{label}" for label in ("q99", "q999", "mean", "max")), unit=unit, note=note)
        return
    ordered = values.double().sort().values
    n = len(ordered)
    q99, q999 = (ordered[min(n - 1, math.ceil(q * n) - 1)] for q in (0.99, 0.999))
    for label, value in (("q99", q99), ("q999", q999), ("mean", ordered.mean()), ("max", ordered[-1])):
        out.add(Measurement(f"{name}_{label}", float(value), unit, n, note=note))


def refutes(slope: float, agent: Agent) -> bool:
    """Whether a slope that was found, in float32, is steeper than what is claimed of an agent's barrier. Source: none."""
    return slope > agent.lipschitz_bound * (1.0 + 1e-5)


def lipschitz(out: Evaluation, agent: Agent, generator: torch.Generator) -> float:
    """Adds the bound of an agent's barrier, where it was proved, and the largest slope that is found; returns the latter, in barrier / latent.

    A bound that an agent only claims is not measured. Source: none.
    """
    lower, unit = lipschitz_lower(agent.barrier, -1.0, 1.0, n=20000, generator=generator), "barrier / latent"
    if refutes(lower, agent):
        out.missing("lipschitz_certified", unit=unit, note=f"claimed to be {agent.lipschitz_bound:g}, refuted by a slope of {lower:.4g}")
    elif agent.lipschitz_proved:
        out.add(Measurement("lipschitz_certified", agent.lipschitz_bound, unit, note="proved for the deployed weights"))
    else:
        out.missing("lipschitz_certified", unit=unit, note=f"claimed to be {agent.lipschitz_bound:g}, not proved")
    out.add(Measurement("lipschitz_sampled", lower, unit, 20000, note="largest gradient found"))
    return lower

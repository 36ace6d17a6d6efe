"""Figures of an evaluation, each with its sample size and exact 95 % bounds where it is a share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

from torch import Tensor

from torchrl_sspl.certification.statistics import clopper_pearson

CONFIDENCE = 0.95

Draw = Callable[[Tensor], Tensor]


@dataclass
class Measurement:
    """One figure of an evaluation.

    Attributes:
        name: what was measured.
        value: the figure; None: not measured.
        unit: "share", "latent", "barrier", ...
        n: sample size (None: not a sample).
        events: number of events among the n (shares only).
        lower: lower end of the two-sided 95 % Clopper-Pearson interval (shares only).
        upper: upper end of it; with no event, the one-sided 95 % bound.
        note: how it was measured.
    """

    name: str
    value: float | None
    unit: str
    n: int | None = None
    events: int | None = None
    lower: float | None = None
    upper: float | None = None
    note: str = ""


def share(name: str, events: int, n: int, note: str = "") -> Measurement:
    """Measurement of a share with its exact confidence bounds.

    Args:
        name: what was measured.
        events: number of events.
        n: number of independent trials.
        note: how it was measured.

    Returns:
        The measurement; value and bounds are None when there was no trial.

    Source: Clopper and Pearson (1934).

    Example:
        >>> round(share("leaves", 0, 3000).upper, 4)
        0.001
    """
    if n == 0:
        return Measurement(name, None, "share", 0, 0, None, None, note)
    lower, upper = clopper_pearson(events, n, confidence=CONFIDENCE)
    return Measurement(name, events / n, "share", n, events, lower, upper, note)


@dataclass
class Evaluation:
    """All measurements of one agent, and what is needed to draw them.

    Attributes:
        measurements: by name.
        arrays: tensors for figures (grid values, trajectories); not written to ``metrics.json``.
    """

    measurements: dict[str, Measurement] = field(default_factory=dict)
    arrays: dict[str, Any] = field(default_factory=dict)

    def add(self, measurement: Measurement) -> None:
        """Keep a measurement under its name."""
        self.measurements[measurement.name] = measurement

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
    """Adds mean, 99 %, 99.9 % and maximum of a sample, as measurements of their own.

    Args:
        out: what they are added to.
        name: what was measured; the four are called ``<name>_q99``, ``_q999``, ``_mean`` and ``_max``.
        values: ``(n,)`` the sample; of None or none, the four are not measured.
        unit: of the values.
        note: how it was measured.

    Source: none.

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
    for label, q in (("q99", 0.99), ("q999", 0.999)):
        rank = min(len(ordered) - 1, math.ceil(q * len(ordered)) - 1)
        out.add(Measurement(f"{name}_{label}", float(ordered[rank]), unit, len(values), note=note))
    out.add(Measurement(f"{name}_mean", float(ordered.mean()), unit, len(values), note=note))
    out.add(Measurement(f"{name}_max", float(ordered[-1]), unit, len(values), note=note))


__all__ = ["CONFIDENCE", "Draw", "Evaluation", "Measurement", "quantiles", "share"]

"""What is particular to a system: names and units for people, what its agents have to reach, sizes of its grids."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from torchrl_sspl.errors import ConfigError


@dataclass(frozen=True)
class Requirement:
    """One row of a table of requirements: a measurement has to be ``sense`` ("<=" or ">=") ``must``, better ``aim``.

    ``name`` is that of the measurement, ``label`` says to people what it is. Source: none.

    Example:
        >>> from types import SimpleNamespace
        >>> half = SimpleNamespace(measurements={"share": SimpleNamespace(value=0.5)})
        >>> Requirement("share", "share that leaves", "<=", 0.4, 0.0).verdict(half)
        'missed by 0.1'
    """

    name: str
    label: str
    sense: str
    must: float
    aim: float

    def verdict(self, evaluation: Any) -> str:
        """Of an evaluation with ``measurements`` by name: "aim", "must", "missed by x" or "not measured"."""
        measured = evaluation.measurements.get(self.name)
        if measured is None or measured.value is None:
            return "not measured"
        sign = 1.0 if self.sense == "<=" else -1.0
        if sign * (measured.value - self.aim) <= 0:
            return "aim"
        miss = sign * (measured.value - self.must)
        return "must" if miss <= 0 else f"missed by {miss:.3g}"


def bounded(requirement: Any, verdict: str, measurement: Any) -> str:
    """A verdict "aim" or "must" stands where the 95 % bound of the measurement reaches the must too.

    Else it is "none seen" (or "all seen") of what no bound of a sample can reach, and "too few episodes" of the rest. Nodes of a
    grid are no sample: without a bound a verdict stands, but that none of some nodes is a fault says nothing of what lies between.

    Source: none.

    Example:
        >>> from types import SimpleNamespace
        >>> few, many = SimpleNamespace(lower=0.0, upper=0.06), SimpleNamespace(lower=0.0, upper=0.0009)
        >>> rule = SimpleNamespace(sense="<=", must=0.001)
        >>> bounded(rule, "aim", few), bounded(rule, "aim", many)
        ('too few episodes', 'aim')
    """
    upward = requirement.sense == "<="
    bound = getattr(measurement, "upper" if upward else "lower", None)
    if not verdict.startswith(("aim", "must")):
        return verdict
    if bound is None or math.isnan(bound):
        if getattr(measurement, "unit", "") != "share" or requirement.must != (0.0 if upward else 1.0):
            return verdict
    elif (bound <= requirement.must) if upward else (bound >= requirement.must):
        return verdict
    if requirement.must == (0.0 if upward else 1.0):
        return "none seen" if upward else "all seen"
    return "too few episodes"


@dataclass(frozen=True)
class Opening:
    """How a scene of a film begins: a title, a first state, and what acts in it without protection.

    ``nominal`` makes a policy, true states ``(1, s)`` -> actions ``(1, m)``, that knows nothing of safety; it is shown alone and
    behind the safety filter. None: no action at all, beside the learned policy. Source: none.

    Example:
        >>> Opening("Head on", (-1.8, 0.0, 0.0)).nominal is None
        True
    """

    title: str
    start: tuple[float, ...]
    nominal: Callable[[], Callable[[Tensor], Tensor]] | None = None


@dataclass(frozen=True)
class System:
    """Everything about a system that evaluations and reports need beyond its dynamics, regions and pictures.

    Args:
        title: title of its reports.
        state_names, action_name: name and unit of every state coordinate, and of the action.
        requirements: what its agents have to reach.
        state_grid: nodes per state coordinate (one number, or one for each) of the evaluation's grid, corners included;
            of a periodic coordinate the last node is the first again.
        kernel_grid: the same of the grid of the true kernel.
        unsafe_grid: the same of a grid of its own over U, a periodic coordinate without its last node; None: the nodes
            of ``state_grid`` in U.
        action_direction: direction of a positive action in the plane of the first two coordinates (a torque pushes the
            angular velocity: ``(0, 1)``), for figures, two numbers or a ConfigError; None: along the path.
        notes: what a report has to say about this system.
        openings: scenes of its film.

    Source: none.

    Example:
        >>> System("Cart", ("place [m]", "speed [m/s]"), "force [N]", action_direction=(0.0, 1.0)).state_grid
        201
    """

    title: str
    state_names: tuple[str, ...]
    action_name: str
    requirements: tuple[Requirement, ...] = ()
    state_grid: tuple[int, ...] | int = 201
    kernel_grid: tuple[int, ...] | int = 301
    unsafe_grid: tuple[int, ...] | None = None
    action_direction: tuple[float, float] | None = None
    notes: tuple[str, ...] = ()
    openings: tuple[Opening, ...] = ()

    def __post_init__(self) -> None:
        if self.action_direction is not None and len(self.action_direction) != 2:
            raise ConfigError(
                f"System {self.title!r}: expected action_direction of two numbers, in the plane of the first two coordinates, received {self.action_direction}; "
                "give None where an action does not move that plane along one direction"
            )

"""What an agent has to reach: a table of requirements, and the verdict of an evaluation on it."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_sspl.trainers.evaluation import Evaluation


@dataclass(frozen=True)
class Requirement:
    """One row of a table of requirements.

    Attributes:
        name: name of the measurement.
        label: what it is, for people.
        sense: "<=" or ">=".
        must: value that has to be reached.
        aim: value that one would like to reach.
    """

    name: str
    label: str
    sense: str
    must: float
    aim: float

    def verdict(self, evaluation: Evaluation) -> str:
        """"aim", "must", "missed by x" or "not measured"."""
        measured = evaluation.measurements.get(self.name)
        if measured is None or measured.value is None:
            return "not measured"
        sign = 1.0 if self.sense == "<=" else -1.0
        if sign * (measured.value - self.aim) <= 0:
            return "aim"
        miss = sign * (measured.value - self.must)
        return "must" if miss <= 0 else f"missed by {miss:.3g}"


PENDULUM = (
    Requirement("unsafe_called_safe", "grid of U with B <= 0", "<=", 0.0, 0.0),
    Requirement("safe_called_unsafe", "S with B > 0", "<=", 0.0, 0.0),
    Requirement("volume_over_kernel", "volume of {B <= 0} over the true kernel", ">=", 0.5, 0.9),
    Requirement("false_safe", "{B <= 0} outside the true kernel", "<=", 0.01, 0.0),
    Requirement("safe_rollouts_touch_unsafe", "episodes from {B <= 0} that touch U", "<=", 0.0, 0.0),
    Requirement("safe_rollouts_leave", "episodes from {B <= 0} that leave it", "<=", 0.001, 0.0),
    Requirement("unsafe_rollouts_return", "recoverable starts in U that come back", ">=", 0.95, 1.0),
    Requirement("lipschitz_ratio", "sampled over certified Lipschitz constant", ">=", 0.5, 0.95),
)

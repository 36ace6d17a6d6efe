"""The deterministic layer of a certificate: what the weights prove."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_sspl.certification.branch_and_bound import SLACK, Budget
from torchrl_sspl.certification.certificate import BY_LIPSCHITZ, EVERY_WAY, PROVED, Layer, Reason
from torchrl_sspl.certification.conditions import (
    computed_error,
    decide_domain,
    decide_invariance,
    decide_vacuity,
    largest_error,
    search_level,
    tolerates,
)
from torchrl_sspl.certification.deployed import check_deployed, deployed_dtype
from torchrl_sspl.certification.floating import UNITS
from torchrl_sspl.certification.loop import ClosedLoop, closed_loop, evaluation_rounding
from torchrl_sspl.certification.rounding import up
from torchrl_sspl.errors import ConfigError, NonFiniteError, ShapeError, StructureError
from torchrl_sspl.lipschitz import prove_lipschitz


def deterministic_layer(
    barrier: nn.Module,
    dynamics: nn.Module,
    policy: nn.Module,
    *,
    latent_dim: int,
    lipschitz_bound: float,
    level: float = 0.0,
    required_error: float = 0.0,
    multipliers: Sequence[Tensor] | None = None,
    low: float | Tensor = -1.0,
    high: float | Tensor = 1.0,
    tolerance: float = 1e-3,
    budget: Budget | None = None,
) -> Layer:
    """What follows from the weights alone, on the whole latent domain; networks that are not certified raise nothing.

    Args:
        barrier: plain network, p inputs, 1 output.
        dynamics: see :func:`~torchrl_sspl.certification.loop.closed_loop`.
        policy: see there.
        latent_dim: p.
        lipschitz_bound: claimed Lipschitz constant of the barrier.
        level: s <= 0, barrier units.
        required_error: error of the latent dynamics that the set has to tolerate at least, latent units.
        multipliers: witness of the Lipschitz constant; searched for if not given.
        low: lower corner of the domain.
        high: upper corner.
        tolerance: accuracy of the tolerated error, barrier units.
        budget: of each search.

    Source: paper Theorem 1 and Lemma 2; deviations: the set instead of everywhere, the whole domain instead of samples,
    a proof instead of the sign of a log-determinant.

    Example:
        >>> step, policy = nn.Sequential(nn.Linear(2, 1, bias=False)), nn.Sequential(nn.Linear(1, 1))  # z+ = z / 2
        >>> nn.utils.vector_to_parameters(torch.tensor([0.5, 0.0]), step.parameters())
        >>> barrier = nn.Sequential(nn.Linear(1, 2), nn.ReLU(), nn.Linear(2, 1))  # |z| - 1/2
        >>> nn.utils.vector_to_parameters(torch.tensor([1.0, -1.0, 0.0, 0.0, 1.0, 1.0, -0.5]), barrier.parameters())
        >>> layer = deterministic_layer(barrier, step, policy, latent_dim=1, lipschitz_bound=2.0)
        >>> layer.holds, round(layer["tolerated error"].value, 2)
        (True, 0.12)
    """
    proof = _Proof(level, required_error, tolerance, budget)
    if level > 0:
        proof.state("level", "s <= 0", False, Reason.LEVEL, value=level, unit="barrier", misses_by=level)
        return proof.layer
    of = {"latent_dim": latent_dim, "lipschitz_bound": lipschitz_bound, "low": low, "high": high}
    system = proof.networks(barrier, dynamics, policy, of)
    if system is None or not proof.lipschitz(barrier, lipschitz_bound, multipliers):
        return proof.layer  # the searches below use the constant
    proof.domain(system)
    if proof.vacuity(system):
        if proof.invariance(system):
            proof.tolerated(system, deployed_dtype(barrier, dynamics, policy))
        proof.rounding(system)
    return proof.layer


_BOXES = 200_000  # after which a search that has to do without the Lipschitz constant gives up


class _Proof:
    """The layer as it grows; each method adds statements, and says whether the next ones have a meaning."""

    def __init__(self, level: float, required_error: float, tolerance: float, budget: Budget | None) -> None:
        self.level, self.required, self.tolerance, self.budget = level, required_error, tolerance, budget
        self.layer = Layer("deterministic")

    def state(self, name: str, text: str, holds: bool, reason: Reason | None = None, **more: Any) -> bool:
        """Adds a statement, and returns whether it holds."""
        self.layer.state(PROVED, name, text, holds, reason, **more)
        return holds

    def networks(self, barrier: nn.Module, dynamics: nn.Module, policy: nn.Module, of: dict[str, Any]) -> ClosedLoop | None:
        """The closed loop, if it is what the modules compute."""
        text = "the modules that are deployed compute what is proved, up to rounding: known types, nothing in between, equal values"
        try:
            system = closed_loop(barrier, dynamics, policy, **of)
            points = check_deployed(system, barrier, dynamics, policy)
        except NonFiniteError as error:
            self.state("networks", "all weights are finite", False, Reason.NOT_FINITE, detail=str(error))
        except StructureError as error:
            self.state("deployed", text, False, Reason[error.reason], detail=str(error))
        except (ConfigError, ShapeError) as error:
            text = "bounds can be propagated through the networks"
            self.state("networks", text, False, Reason.NOT_UNDERSTOOD, detail=str(error))
        else:
            self.state("deployed", text, True, detail=f"values compared at {points} points")
            return system
        return None

    def lipschitz(self, barrier: nn.Module, bound: float, multipliers: Sequence[Tensor] | None) -> bool:
        try:
            proof = prove_lipschitz(barrier, bound, multipliers=multipliers)
            proved, why = proof.proved, proof.reason
        except (ConfigError, ShapeError) as error:
            proved, why = False, str(error)
        text = f"B is {up(bound, 6)}-Lipschitz (exact arithmetic on the deployed weights)"
        of = {"value": bound, "unit": "barrier / latent", "detail": why}
        return self.state("Lipschitz constant", text, proved, Reason.LIPSCHITZ_NOT_PROVED, **of)

    def domain(self, system: ClosedLoop) -> None:
        found = decide_domain(system, budget=self.budget)
        left = found.status == "refuted"
        reason, miss = (Reason.LEAVES_DOMAIN, found.lower) if left else (Reason.UNDECIDED, None)
        text = "d(z, pi(z)) stays in the latent domain"
        self.state("domain", text, found.status == "proved", reason, unit="latent", misses_by=miss)

    def vacuity(self, system: ClosedLoop) -> bool:
        status = decide_vacuity(system, level=self.level, budget=self.budget).status
        reasons = {"empty": Reason.EMPTY, "everything": Reason.EVERYTHING, "undecided": Reason.VACUITY_UNDECIDED}
        text = "{B <= s} is neither empty nor the whole domain"
        self.state("not vacuous", text, status == "neither", reasons.get(status))
        return status != "empty"

    def invariance(self, system: ClosedLoop) -> bool:
        kept = decide_invariance(system, level=self.level, budget=self.budget)
        refuted = kept.status == "refuted"
        detail = f"{kept.boxes} boxes"
        if refuted and kept.witness is not None:
            detail = f"counterexample z = {kept.witness.tolist()}"
        elif kept.status == "undecided":
            detail += f", {up(kept.remaining_volume, 2)} of the domain is left"
            if system.accepted > self.level:
                detail = f"the policy accepts its own action at B <= {system.accepted:g}, more than s; give it a larger margin"
        return self.state(
            "invariance",
            "B(z) <= s implies B(d(z, pi(z))) <= s, for every z of the domain",
            kept.status == "proved",
            Reason.NOT_INVARIANT if refuted else Reason.UNDECIDED,
            unit="barrier",
            misses_by=max(kept.lower, 0.0) if refuted else None,
            detail=detail,
        )

    def tolerated(self, system: ClosedLoop, dtype: torch.dtype) -> None:
        """Which error the set tolerates, in real arithmetic and in that of the computed numbers."""
        how: dict[str, Any] = {"level": self.level, "tolerance": self.tolerance, "budget": self.budget}
        found = largest_error(system, **how)
        delta, detail = found.delta, BY_LIPSCHITZ.format(up(found.refuted_above))
        if self._in_every_way(system, delta):
            delta, detail = self.required, EVERY_WAY
        text = "the same, whatever error of at most this is added to d(z, pi(z))"
        if not self._error("tolerated error", text, delta, Reason.MARGIN_TOO_SMALL, detail):
            return
        name = str(dtype).removeprefix("torch.")
        real = computed_error(system, found, unit=UNITS[dtype], **how)
        delta, rounding = real.delta, {"barrier_rounding": real.barrier_rounding, "step_rounding": real.step_rounding}
        if self._in_every_way(system, delta, **rounding):
            delta = self.required
        text = f"the same of the {name} numbers that are computed, in whatever order they are summed, for errors of at most this"
        detail = f"rounding of B at most {up(real.barrier_rounding, 2)}, of d(z, pi(z)) at most {up(real.step_rounding, 2)}"
        short = name == "float32" and not self._enough(delta)
        self._error(name, text, delta, Reason.ROUNDING, detail + ("; deploy in float64" if short else ""))

    def _in_every_way(self, system: ClosedLoop, delta: float, **rounding: Any) -> bool:
        """Whether the required error is tolerated although the Lipschitz constant gives a little less."""
        if not 0.0 < delta < self.required <= 2.0 * delta or not math.isfinite(sum(rounding.values())):
            return False
        budget = Budget(boxes=_BOXES) if self.budget is None else replace(self.budget, boxes=min(self.budget.boxes, _BOXES))
        return tolerates(system, self.required, level=self.level, budget=budget, **rounding).status == "proved"

    def _error(self, name: str, text: str, delta: float, reason: Reason, detail: str) -> bool:
        enough = self._enough(delta)
        miss = None if enough else max(self.required - delta, 0.0)
        return self.state(name, text, enough, reason, value=delta, unit="latent", misses_by=miss, detail=detail)

    def _enough(self, delta: float) -> bool:
        return delta >= self.required and delta > 0.0

    def rounding(self, system: ClosedLoop) -> None:
        value = evaluation_rounding(system)
        text = "rounding of the float64 evaluation is far below the slack by which bounds decide"
        of = {"value": value, "unit": "barrier", "detail": f"slack {SLACK:g}"}
        self.state("rounding", text, value < 0.1 * SLACK, Reason.UNDECIDED, **of)


def level_that_holds(
    barrier: nn.Module,
    dynamics: nn.Module,
    policy: nn.Module,
    *,
    latent_dim: int,
    lipschitz_bound: float,
    levels: Sequence[float] = (0.0, -0.01, -0.02, -0.05, -0.1, -0.15, -0.2, -0.3),
    budget: Budget | None = None,
) -> float:
    """The largest of several levels, barrier units, whose set is kept; the first of them if none is.

    The networks are those of :func:`~torchrl_sspl.certification.loop.closed_loop`; the levels are tried in their
    order, each with this budget.

    Example:
        >>> step, policy = nn.Sequential(nn.Linear(2, 1, bias=False)), nn.Sequential(nn.Linear(1, 1))  # z+ = 2 z
        >>> nn.utils.vector_to_parameters(torch.tensor([2.0, 0.0]), step.parameters())
        >>> level_that_holds(nn.Identity(), step, policy, latent_dim=1, lipschitz_bound=1.0, levels=(-0.1, -0.2))
        -0.1
    """
    try:
        system = closed_loop(barrier, dynamics, policy, latent_dim=latent_dim, lipschitz_bound=lipschitz_bound)
    except (ConfigError, ShapeError, NonFiniteError):
        return levels[0]
    found = search_level(system, levels=levels, budget=budget)
    return levels[0] if found is None else found[0]

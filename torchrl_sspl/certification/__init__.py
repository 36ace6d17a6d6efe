"""What can be said about frozen networks: proofs on the latent domain, measurements with confidence."""

from __future__ import annotations

from torchrl_sspl.certification.branch_and_bound import Budget, Outcome
from torchrl_sspl.certification.certificate import Certificate, Layer, Reason, Statement
from torchrl_sspl.certification.conditions import (
    decide_domain,
    decide_invariance,
    decide_vacuity,
    find_counterexamples,
    largest_error,
    search_level,
    tolerates,
)
from torchrl_sspl.certification.layers import deterministic_layer
from torchrl_sspl.certification.loop import ClosedLoop, closed_loop
from torchrl_sspl.certification.record import Counts, Record
from torchrl_sspl.certification.statistics import clopper_pearson, paper_layer, run_time_layer, statistical_layer
from torchrl_sspl.certification.vnnlib import export_vnnlib

__all__ = [
    "Budget",
    "Certificate",
    "ClosedLoop",
    "Counts",
    "Layer",
    "Outcome",
    "Reason",
    "Record",
    "Statement",
    "clopper_pearson",
    "closed_loop",
    "decide_domain",
    "decide_invariance",
    "decide_vacuity",
    "deterministic_layer",
    "export_vnnlib",
    "find_counterexamples",
    "largest_error",
    "paper_layer",
    "run_time_layer",
    "search_level",
    "statistical_layer",
    "tolerates",
]

"""Which states, or latents, can be kept out of U: true kernels on grids, robust invariant sets on point clouds."""

from __future__ import annotations

from torchrl_sspl.viability.grid import ViabilityKernel, recoverable_set, viability_kernel

__all__ = ["ViabilityKernel", "recoverable_set", "viability_kernel"]

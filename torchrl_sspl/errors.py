"""Typed errors; every message names what was expected, what was received and what to do."""

from __future__ import annotations


class SSPLError(Exception):
    """Base class of every error that this library raises on purpose."""


class ShapeError(SSPLError, ValueError):
    """A tensor has the wrong shape."""


class DTypeError(SSPLError, TypeError):
    """A tensor has the wrong dtype."""


class NonFiniteError(SSPLError, ValueError):
    """A tensor holds NaN or infinity where a finite value is needed."""


class EmptyRegionError(SSPLError, ValueError):
    """A set from which samples are needed is empty."""


class OverlapError(SSPLError, ValueError):
    """The safe and the unsafe set share states."""


class ConfigError(SSPLError, ValueError):
    """A configuration value or key is not valid."""


class StructureError(ConfigError):
    """A network may compute something else than its layers say.

    Args:
        message: what was expected and received.
        reason: name of a ``certification.certificate.Reason``.
    """

    def __init__(self, message: str, reason: str = "NOT_UNDERSTOOD") -> None:
        super().__init__(message)
        self.reason = reason


class CheckpointError(SSPLError, RuntimeError):
    """A checkpoint, a run directory or a shipped agent cannot be read."""


class OutputError(SSPLError, OSError):
    """A file or a directory cannot be written to, or belongs to another run."""


class NotPositiveDefiniteError(SSPLError, ValueError):
    """A matrix has left the cone of positive definite matrices."""


class CertificationError(SSPLError, RuntimeError):
    """A certificate cannot be computed, read or reproduced."""


class MissingDependencyError(SSPLError, ImportError):
    """An optional dependency is not installed."""


class WorkerError(SSPLError, RuntimeError):
    """A process that works for this one has ended."""


class SolverError(SSPLError, RuntimeError):
    """A numerical solver did not return a valid solution."""

r"""The certificate: what was proved, what was measured with which confidence, what is assumed, and what fails.

It has three layers. The *paper* layer holds the paper's margins and on what share of samples its conditions hold with
them. The *deterministic* layer is about the frozen networks alone and follows from their weights: anybody can compute it
again. The *statistical* layer is about fresh episodes and holds with a confidence. A certificate is never one boolean;
every statement that does not hold is refused with a reason and with how far it misses.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_sspl.errors import CertificationError

SCHEMA = 1
PROVED, MEASURED, ASSUMED = "proved", "measured", "assumed"


class Reason(StrEnum):
    """Why a statement is refused."""

    NOT_FINITE = "a weight or a measured value is NaN or infinite"
    NOT_UNDERSTOOD = "the networks are of a form that bounds cannot be propagated through, or do not fit each other"
    LIPSCHITZ_NOT_PROVED = "the claimed Lipschitz constant of the barrier could not be proved"
    LEAVES_DOMAIN = "the latent dynamics leave the domain"
    EMPTY = "the set {B <= s} is empty"
    EVERYTHING = "the set {B <= s} is the whole domain"
    VACUITY_UNDECIDED = "no point inside and outside {B <= s} was found"
    NOT_INVARIANT = "a latent of {B <= s} is led out of it"
    UNDECIDED = "the budget was too small to decide"
    MARGIN_TOO_SMALL = "the error that the set tolerates is smaller than required"
    LEVEL = "the level is positive: {B <= s} is more than {B <= 0}"
    OUTSIDE_DOMAIN = "an observation is encoded outside the domain"
    UNSAFE_INSIDE = "an unsafe observation lies in the set"
    EPISODES_LEAVE = "too many episodes leave the set"
    ERROR_EXCEEDS = "the error of the latent dynamics exceeds what the set tolerates"
    TOO_FEW = "too few episodes for the required bound"
    NOT_MEASURED = "nothing was measured"
    CALIBRATION_REUSED = "the episodes are not fresh: their seed or their observations were used before"
    LABELS_LEAKED = "labelled observations of the measurement were trained on"
    CONDITION_FAILS = "a condition does not hold on the held-out samples with the paper's margins"
    WEIGHTS_CHANGED = "the weights are not those that were certified"
    CONFIGURATION_CHANGED = "the configuration is not the one that was certified"
    NUMBERS_CHANGED = "a number or a verdict is not what the weights give"
    SCHEMA_UNKNOWN = "the file is no certificate of a version that is understood"


@dataclass
class Statement:
    """One statement of a certificate.

    Attributes:
        name: short name.
        text: the statement.
        kind: "proved", "measured" or "assumed".
        holds: whether it holds; None for what is assumed.
        value: the number behind it, or None.
        unit: its unit.
        n: sample size (measured).
        confidence: confidence of the value (measured).
        reason: name of the :class:`Reason` why it does not hold, else "".
        misses_by: how far it misses, in the unit, or None.
        detail: anything else that a reader should know.
    """

    name: str
    text: str
    kind: str
    holds: bool | None
    value: float | None = None
    unit: str = ""
    n: int | None = None
    confidence: float | None = None
    reason: str = ""
    misses_by: float | None = None
    detail: str = ""


@dataclass
class Layer:
    """Statements of one layer.

    Attributes:
        name: "paper", "deterministic" or "statistical".
        statements: in the order in which they are shown.
    """

    name: str
    statements: list[Statement] = field(default_factory=list)

    @property
    def holds(self) -> bool:
        """Whether every statement that is not assumed holds, and there is one."""
        decided = [s for s in self.statements if s.kind != ASSUMED]
        return bool(decided) and all(s.holds for s in decided)

    @property
    def reasons(self) -> list[Reason]:
        """Why it does not hold, without repetition."""
        return list(dict.fromkeys(Reason[s.reason] for s in self.statements if s.reason))

    def __getitem__(self, name: str) -> Statement:
        for statement in self.statements:
            if statement.name == name:
                return statement
        raise KeyError(name)

    @property
    def verdict(self) -> str:
        """One line for people."""
        failed = [s for s in self.statements if s.kind != ASSUMED and not s.holds]
        if not failed:
            return "holds" if self.holds else "nothing was decided"
        first = failed[0]
        miss = "" if first.misses_by is None else f", misses by {first.misses_by:.3g} {first.unit}"
        return f"not certified: {first.name} ({Reason[first.reason].value if first.reason else 'fails'}{miss})"


@dataclass
class Certificate:
    """Everything that is claimed about one frozen agent.

    Attributes:
        agent: name of the agent.
        weights: SHA-256 of all weights.
        configuration: SHA-256 of the configuration.
        level: s; all statements are about {B <= s}, in units of the barrier.
        layers: by name.
        schema: version of the format.

    Source: none (the paper claims that no verification after the training is needed).

    Example:
        >>> certificate = Certificate("demo", "0" * 64, "1" * 64, 0.0, {})
        >>> Certificate.from_dict(certificate.to_dict()) == certificate
        True
    """

    agent: str
    weights: str
    configuration: str
    level: float
    layers: dict[str, Layer]
    schema: int = SCHEMA

    @property
    def reasons(self) -> list[Reason]:
        """Why something is refused, without repetition."""
        return list(dict.fromkeys(r for layer in self.layers.values() for r in layer.reasons))

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        body = asdict(self)
        for name, layer in self.layers.items():
            body["layers"][name]["verdict"] = layer.verdict
        return body

    @classmethod
    def from_dict(cls, body: Mapping[str, Any]) -> Certificate:
        """Reads what :meth:`to_dict` gives.

        Raises:
            CertificationError: if something is missing, superfluous or of another version.
        """
        try:
            if body["schema"] != SCHEMA:
                raise CertificationError(
                    f"expected schema {SCHEMA}, received {body['schema']!r}; use a version that reads it"
                )
            layers = {}
            for name, layer in body["layers"].items():
                layers[name] = Layer(layer["name"], [Statement(**s) for s in layer["statements"]])
                if layer["verdict"] != layers[name].verdict:
                    raise CertificationError(
                        f"expected the verdict '{layers[name].verdict}' of layer {name}, received '{layer['verdict']}'; "
                        "the file was edited"
                    )
            known = {"agent", "weights", "configuration", "level", "schema", "layers"}
            if set(body) != known:
                raise CertificationError(f"expected the fields {sorted(known)}, received {sorted(body)}")
            return cls(body["agent"], body["weights"], body["configuration"], float(body["level"]), layers)
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            if isinstance(error, CertificationError):
                raise
            raise CertificationError(
                f"expected a certificate of schema {SCHEMA}, received something else ({type(error).__name__}: {error})"
            ) from error

    def save(self, path: str | Path) -> Path:
        """Write as JSON.

        Args:
            path: file.

        Returns:
            The file.
        """
        path = Path(path)
        path.write_text(json.dumps(self.to_dict(), indent=1) + "\n")
        return path

    @classmethod
    def load(cls, path: str | Path) -> Certificate:
        """Read a certificate that :meth:`save` has written.

        Args:
            path: file.

        Returns:
            The certificate.

        Raises:
            CertificationError: if it cannot be read.
        """
        try:
            body = json.loads(Path(path).read_text())
        except (OSError, ValueError) as error:
            raise CertificationError(
                f"expected a certificate at '{path}', received {type(error).__name__}: {error}"
            ) from error
        if not isinstance(body, dict):
            raise CertificationError(f"expected a certificate at '{path}', received a {type(body).__name__}")
        return cls.from_dict(body)


def weights_digest(state: Mapping[str, Tensor]) -> str:
    """SHA-256 of names, types, shapes and bytes of weights, independent of their order.

    Args:
        state: state dict.

    Returns:
        64 hexadecimal digits.

    Source: none.

    Example:
        >>> weights_digest({"a": torch.zeros(2)}) == weights_digest({"a": torch.zeros(2).double()})
        False
    """
    digest = hashlib.sha256()
    for name in sorted(state):
        value = state[name].detach().cpu().contiguous()
        digest.update(f"{name}|{value.dtype}|{tuple(value.shape)}|".encode())
        digest.update(value.reshape(-1).view(torch.uint8).numpy().tobytes() if value.numel() else b"")
    return digest.hexdigest()


def configuration_digest(configuration: Any) -> str:
    """SHA-256 of plain values, independent of the order of keys.

    Args:
        configuration: what ``json`` can write.

    Returns:
        64 hexadecimal digits.

    Source: none.

    Example:
        >>> configuration_digest({"a": 1, "b": 2}) == configuration_digest({"b": 2, "a": 1})
        True
    """
    return hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()


def differences(
    claimed: Certificate, recomputed: Certificate, *, layers: Sequence[str] = ("deterministic",)
) -> dict[Reason, str]:
    """What a certificate claims that a recomputation does not give; one that had more time may give more.

    Args:
        claimed: as it was read.
        recomputed: from the weights.
        layers: that were recomputed.

    Returns:
        Reasons with what was found; empty if all agrees.

    Source: none.

    Example:
        >>> one = Certificate("a", "0", "0", 0.0, {})
        >>> differences(one, Certificate("a", "1", "0", 0.0, {}), layers=())
        {<Reason.WEIGHTS_CHANGED: 'the weights are not those that were certified'>: 'expected 0, received 1'}
    """
    found: dict[Reason, str] = {}
    for reason, field_name in (
        (Reason.WEIGHTS_CHANGED, "weights"),
        (Reason.CONFIGURATION_CHANGED, "configuration"),
        (Reason.NUMBERS_CHANGED, "level"),
    ):
        before, now = getattr(claimed, field_name), getattr(recomputed, field_name)
        if before != now:
            found[reason] = f"expected {before}, received {now}"
    for name in layers:
        mine, other = claimed.layers.get(name), recomputed.layers.get(name)
        if mine is None or other is None:
            found[Reason.NUMBERS_CHANGED] = f"expected the layer {name}, received none"
            continue
        there, gave_up = {s.name: s for s in other.statements}, [s.name for s in mine.statements if _gave_up(s)]
        names = [s.name for s in mine.statements]
        if not set(names) <= set(there) or (not gave_up and names != list(there)):
            found.setdefault(Reason.NUMBERS_CHANGED, f"{name}: other statements")
            continue
        for a in mine.statements:
            b = there[a.name]
            if not (_same(a, b) or _weaker(a, b)):
                found.setdefault(
                    Reason.NUMBERS_CHANGED,
                    f"{name}, {a.name}: claimed {a.holds} {_number(a.value)}, recomputed {b.holds} {_number(b.value)}",
                )
    return found


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def _same(a: Statement, b: Statement) -> bool:
    exact = ("name", "text", "kind", "holds", "unit", "n", "confidence", "reason")
    return (
        all(getattr(a, k) == getattr(b, k) for k in exact)
        and _close(a.value, b.value)
        and _close(a.misses_by, b.misses_by)
    )


def _gave_up(s: Statement) -> bool:
    """Whether a search ran out of time: then nothing is claimed, and another one may find more."""
    return s.kind == PROVED and not s.holds and s.reason in (Reason.UNDECIDED.name, Reason.VACUITY_UNDECIDED.name)


def _weaker(claimed: Statement, found: Statement) -> bool:
    """Whether less is claimed than was found, as by a search that had less time."""
    if claimed.name == "tolerated error" and claimed.value is not None and found.value is not None:
        return bool(found.holds) and found.value >= claimed.value
    return _gave_up(claimed)


def _close(x: float | None, y: float | None) -> bool:
    """Searches end within a tolerance, and another machine may round otherwise."""
    if x is None or y is None:
        return x is y
    return math.isclose(x, y, rel_tol=1e-3, abs_tol=1e-9)

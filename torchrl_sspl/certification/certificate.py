"""The certificate: what was proved, what was measured with which confidence, what is assumed, and what fails.

The *paper* layer holds the paper's margins and on what share of samples its conditions hold with them. The
*deterministic* layer is about the frozen networks alone: anybody can compute it again from the weights. The
*statistical* layer is about fresh episodes and holds with a confidence. The *run-time* layer joins the two: to how many of
these episodes the proof applies, by a premise that a robot can watch. Every statement that does not hold is refused
with a reason and how far it misses.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from enum import StrEnum
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_sspl.certification.record import Record, count, finite, keys
from torchrl_sspl.certification.rounding import LOWER_BOUNDS, missed
from torchrl_sspl.errors import CertificationError
from torchrl_sspl.files import write

SCHEMA = 4
#: What a statement is; what is reported has a number and no verdict, and what is assumed has neither.
PROVED, MEASURED, REPORTED, ASSUMED = "proved", "measured", "reported", "assumed"
KINDS = (PROVED, MEASURED, REPORTED, ASSUMED)
_BYTES, _DEPTH, _TEXT = 1_000_000, 8, 2000  # of a file; of its nesting; of one text


class Reason(StrEnum):
    """Why a statement is refused."""

    NOT_FINITE = "a weight or a measured value is NaN or infinite"
    NOT_UNDERSTOOD = "bounds cannot be propagated through networks of this form, or the networks do not fit together"
    HOOKED = "a hook may change what a network computes"
    OVERRIDDEN = "a method of a network is overridden, replaced or compiled"
    SUBCLASSED = "a module is a subclass of a known one and may compute something else"
    PARAMETRIZED = "a weight is computed, not stored"
    CHOOSES_BY_OTHERS = "the policy chooses with another barrier or other dynamics than the proved ones"
    SCALE_INVALID = "an action scale is not positive and finite, one number per action"
    WRONG_DTYPE = "the networks are not all float32, or all float64"
    VALUES_DIFFER = "a deployed network computes other values than the proved one"
    LIPSCHITZ_NOT_PROVED = "the claimed Lipschitz constant of the barrier could not be proved"
    LEAVES_DOMAIN = "the latent dynamics leave the domain"
    EMPTY = "the set {B <= s} is empty"
    EVERYTHING = "the set {B <= s} is the whole domain"
    VACUITY_UNDECIDED = "no point inside and outside {B <= s} was found"
    NOT_INVARIANT = "the policy leads a latent of {B <= s} out of it"
    UNDECIDED = "the budget was too small to decide"
    MARGIN_TOO_SMALL = "the error that the set tolerates is smaller than required"
    ROUNDING = "rounding in the deployed networks may exceed what the proof leaves room for"
    LEVEL = "the level is positive, or not the one that the agent keeps as it runs"
    OUTSIDE_DOMAIN = "an observation is encoded outside the domain"
    UNSAFE_INSIDE = "an unsafe observation lies in the set"
    EPISODES_LEAVE = "too many episodes leave the set"
    UNSAFE_ENTERED = "too many episodes leave the set or enter U"
    PREMISE_NOT_MET = "in too many episodes the premise of the proof fails at some step"
    NOTHING_TOLERATED = "no error is proved to be tolerated: the proof applies to no episode"
    TOO_FEW = "too few episodes for the required bound"
    NOT_MEASURED = "nothing was measured"
    CALIBRATION_REUSED = "the episodes are not fresh: their seed or their observations were used before"
    LABELS_LEAKED = "labelled observations of the measurement were trained on"
    CONDITION_FAILS = "a condition does not hold on the held-out samples with the paper's margins"
    NO_LIPSCHITZ = "the policy chooses, so that its closed loop has no Lipschitz constant"
    WEIGHTS_CHANGED = "the weights are not those that were certified"
    CONFIGURATION_CHANGED = "the configuration is not the one that was certified"
    NUMBERS_CHANGED = "a number or a verdict does not follow from the weights"
    TEXT_CHANGED = "a statement differs from the recomputed one"
    RECORD_CHANGED = "the episodes do not follow from their settings, or the statements from the episodes"
    DIGEST_CHANGED = "the file was changed after it was written"
    SCHEMA_UNKNOWN = "the file is no certificate of a version that is understood"


@dataclass
class Statement:
    """One statement of a certificate.

    Attributes:
        name: short name.
        text: the statement.
        kind: "proved", "measured", "reported" or "assumed".
        holds: whether it holds; None for what is reported or assumed.
        value: the number behind it; None where there is none or it is not finite.
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

    def __post_init__(self) -> None:
        for name in ("value", "misses_by"):
            number = getattr(self, name)
            if number is not None and not math.isfinite(number):
                setattr(self, name, None)

    @property
    def decides(self) -> bool:
        """Whether it holds or does not."""
        return self.kind in (PROVED, MEASURED)

    @classmethod
    def from_dict(cls, body: Any) -> Statement:
        """Reads plain values, each of exactly the type that a statement writes, else ``CertificationError``."""
        body = keys("a statement", body, [f.name for f in fields(cls)])
        for name in ("name", "text", "kind", "unit", "reason", "detail"):
            if type(body[name]) is not str or len(body[name]) > _TEXT or not body[name].isprintable():
                raise CertificationError(f"expected {name} to be a line of text, received {str(body[name])[:40]!r}")
        if body["kind"] not in KINDS or not body["name"] or not body["text"]:
            raise CertificationError(f"expected a name, a text and one of the kinds {', '.join(KINDS)}, received {body['kind']!r}")
        decides = body["kind"] in (PROVED, MEASURED)
        if type(body["holds"]) is not (bool if decides else type(None)):
            raise CertificationError(f"expected {body['kind']} statements to hold or not, received {str(body['holds'])[:40]!r}")
        if bool(body["reason"]) != (body["holds"] is False) or (body["reason"] and body["reason"] not in Reason.__members__):
            raise CertificationError(f"expected a known reason where it does not hold, received {body['reason'][:40]!r}")
        for name in ("value", "misses_by"):
            if body[name] is not None:
                finite(name, body[name])
        if body["n"] is not None:
            count("n", body["n"])
        if body["confidence"] is not None and not 0.0 < finite("confidence", body["confidence"]) < 1.0:
            raise CertificationError(f"expected a confidence in (0, 1), received {body['confidence']}")
        return cls(**body)


@dataclass
class Layer:
    """Statements of one layer.

    Attributes:
        name: "paper", "deterministic", "statistical" or "run-time".
        statements: in the order in which they are shown.
    """

    name: str
    statements: list[Statement] = field(default_factory=list)

    @property
    def holds(self) -> bool:
        """Whether every statement that decides anything holds, and there is one."""
        decided = [s for s in self.statements if s.decides]
        return bool(decided) and all(s.holds for s in decided)

    @property
    def reasons(self) -> list[Reason]:
        """Why it does not hold, without repetition."""
        return list(dict.fromkeys(Reason[s.reason] for s in self.statements if s.reason))

    def state(
        self, kind: str, name: str, text: str, holds: bool | None = None, reason: Reason | None = None, **more: Any
    ) -> None:
        """Adds a statement; the reason is why it does not hold, if it does not."""
        code = "" if holds or reason is None else reason.name
        self.statements.append(Statement(name, text, kind, holds, reason=code, **more))

    def __getitem__(self, name: str) -> Statement:
        for statement in self.statements:
            if statement.name == name:
                return statement
        raise KeyError(name)

    @property
    def verdict(self) -> str:
        """One line for people."""
        failed = [s for s in self.statements if s.decides and not s.holds]
        if not failed:
            return "holds" if self.holds else "nothing was decided"
        first = failed[0]
        miss = "" if first.misses_by is None else f", misses by {missed(first)}"
        return f"not certified: {first.name} ({Reason[first.reason].value if first.reason else 'fails'}{miss})"


@dataclass
class Certificate:
    """Everything that is claimed about one frozen agent.

    Attributes:
        agent: name of the agent.
        weights: SHA-256 of all weights, those of the encoder among them.
        configuration: SHA-256 of the configuration.
        level: s; all statements are about {B <= s}, in units of the barrier.
        layers: by name.
        record: how fresh episodes were drawn and what was counted; None where nothing was measured.
        schema: version of the format.
        written: digest that stood in the file; None for one that was not read from a file.

    Source: none (the paper claims that no verification after the training is needed).

    Example:
        >>> certificate = Certificate("demo", "0" * 64, "1" * 64, 0.0, {"deterministic": Layer("deterministic")})
        >>> Certificate.from_dict(certificate.to_dict()) == certificate
        True
    """

    agent: str
    weights: str
    configuration: str
    level: float
    layers: dict[str, Layer]
    record: Record | None = None
    schema: int = SCHEMA
    written: str | None = field(default=None, compare=False)

    @property
    def reasons(self) -> list[Reason]:
        """Why something is refused, without repetition."""
        return list(dict.fromkeys(r for layer in self.layers.values() for r in layer.reasons))

    @property
    def digest(self) -> str:
        """SHA-256 over weights, configuration, level, record and statements together.

        It shows that a file is as it was written. It is no signature: whoever changes the file can compute it again,
        against which only computing everything else again protects.
        """
        return configuration_digest(self._body())

    def _body(self) -> dict[str, Any]:
        body = {k: getattr(self, k) for k in ("agent", "weights", "configuration", "level", "schema")}
        body["record"] = None if self.record is None else self.record.to_dict()
        body["layers"] = {k: asdict(layer) | {"verdict": layer.verdict} for k, layer in self.layers.items()}
        return body

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return self._body() | {"digest": self.digest}

    @classmethod
    def from_dict(cls, body: Any) -> Certificate:
        """Reads what :meth:`to_dict` gives; another key, type, value or version raises ``CertificationError``."""
        if type(body) is not dict or type(body.get("schema")) is not int or body["schema"] != SCHEMA:
            found = body.get("schema") if type(body) is dict else type(body).__name__
            raise CertificationError(f"expected schema {SCHEMA}, received {str(found)[:40]!r}; issue the certificate again")
        body = keys("a certificate", body, [f.name for f in fields(cls) if f.name != "written"] + ["digest"])
        if type(body["agent"]) is not str or not re.fullmatch(r"[\w .,()+-]{1,80}", body["agent"]):
            raise CertificationError(f"expected a name of letters, digits and spaces, received {str(body['agent'])[:40]!r}")
        for name in ("weights", "configuration", "digest"):
            if type(body[name]) is not str or not re.fullmatch(r"[0-9a-f]{64}", body[name]):
                raise CertificationError(f"expected {name} to be 64 hexadecimal digits, received {str(body[name])[:40]!r}")
        level = finite("level", body["level"])
        record = None if body["record"] is None else Record.from_dict(body["record"])
        measured = () if record is None else ("statistical", "run-time", "paper")
        layers = {}
        for name, part in keys("layers", body["layers"], ("deterministic", *measured)).items():
            part = keys("a layer", part, ("name", "statements", "verdict"))
            if part["name"] != name or type(part["statements"]) is not list or len(part["statements"]) > 50:
                raise CertificationError(f"expected the statements of the layer {name}, received those of {str(part['name'])[:40]!r}")
            layers[name] = Layer(name, [Statement.from_dict(s) for s in part["statements"]])
            names = [s.name for s in layers[name].statements]
            if len(set(names)) < len(names) or (name != "deterministic" and any(s.kind == PROVED for s in layers[name].statements)):
                raise CertificationError(f"expected different statements in the layer {name}, and none proved by measuring")
            if part["verdict"] != layers[name].verdict:
                raise CertificationError(
                    f"expected the verdict '{layers[name].verdict}' of the layer {name}, received {str(part['verdict'])[:80]!r}"
                )
        return cls(body["agent"], body["weights"], body["configuration"], level, layers, record, SCHEMA, body["digest"])

    def save(self, path: str | Path) -> Path:
        """Writes it as JSON; returns the path."""
        return write(path, json.dumps(self.to_dict(), indent=1, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> Certificate:
        """Reads what :meth:`save` has written; any other key, type or value raises ``CertificationError``."""
        try:
            with Path(path).open("rb") as file:
                data = file.read(_BYTES + 1)
            if len(data) > _BYTES:
                raise CertificationError(f"expected a certificate of at most {_BYTES:,} bytes at '{path}', received more")
            text = data.decode("utf-8")
            _check_depth(text)
            body = json.loads(text, parse_constant=_no_constant, object_pairs_hook=_no_repetition)
        except (OSError, ValueError, RecursionError) as error:
            raise CertificationError(
                f"expected a certificate at '{path}', received {type(error).__name__}: {str(error)[:200]}"
            ) from error
        return cls.from_dict(body)


def _check_depth(text: str) -> None:
    """Refuses nested JSON before it is parsed; brackets inside of strings do not count."""
    depth = 0
    for mark in re.findall(r'"(?:[^"\\]|\\.)*"|[\[\]{}]', text):
        depth += (mark in ("[", "{")) - (mark in ("]", "}"))
        if depth > _DEPTH:
            raise CertificationError(f"expected at most {_DEPTH} levels of nesting, received more")


def _no_constant(name: str) -> float:
    raise CertificationError(f"expected finite numbers, received {name}")


def _no_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    body = dict(pairs)
    if len(body) < len(pairs):
        raise CertificationError("expected every key once, received one twice")
    return body


def weights_digest(state: Mapping[str, Tensor]) -> str:
    """SHA-256 of names, types, shapes and bytes of a state dict, independent of their order, in hexadecimal digits.

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
    """SHA-256 of what ``json`` can write, independent of the order of keys, in hexadecimal digits.

    Example:
        >>> configuration_digest({"a": 1, "b": 2}) == configuration_digest({"b": 2, "a": 1})
        True
    """
    return hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()


def differences(
    claimed: Certificate,
    recomputed: Certificate,
    *,
    confirm: Callable[[str, float], bool | None] | None = None,
    repeat: Callable[[int], Layer] | None = None,
    required: float = 0.0,
) -> dict[Reason, str]:
    """What a certificate claims about its weights that a recomputation does not give, by reason; empty if all agrees.

    A claim may be weaker than what was found, never stronger; all else has to be the same. Statements of measured
    layers are generated from the record again, and have to be the same in every word. ``UNDECIDED`` alone: nothing was
    found wrong, but not everything was found again in the time.

    Args:
        claimed: as it was read.
        recomputed: weights, configuration and deterministic layer from the agent, the rest from the claimed record.
        confirm: whether a tolerated error, by the name of its statement, is proved although the recomputed bound is
            smaller; None: not in time.
        repeat: the deterministic layer, computed with at most a number of boxes: whoever claims to have given up after
            so many has to have.
        required: error that the agent's monitor tolerates, latent units: no smaller one is a tolerated error that holds.

    Example:
        >>> one = Certificate("a", "0", "0", 0.0, {})
        >>> differences(one, Certificate("a", "1", "0", 0.0, {}))
        {<Reason.WEIGHTS_CHANGED: 'the weights are not those that were certified'>: 'expected 0, received 1'}
    """
    found: dict[Reason, str] = {}
    for reason, name in (
        (Reason.WEIGHTS_CHANGED, "weights"),
        (Reason.CONFIGURATION_CHANGED, "configuration"),
        (Reason.NUMBERS_CHANGED, "level"),
    ):
        before, now = getattr(claimed, name), getattr(recomputed, name)
        if before != now:
            found[reason] = f"expected {before}, received {now}"
    if claimed.written is not None and claimed.written != claimed.digest:
        found[Reason.DIGEST_CHANGED] = f"its content has the digest {claimed.digest[:12]}..., it says {claimed.written[:12]}..."
    if claimed.layers.keys() != recomputed.layers.keys():
        found[Reason.TEXT_CHANGED] = f"expected the layers {', '.join(recomputed.layers)}, received {', '.join(claimed.layers)}"
        return found
    for name, layer in claimed.layers.items():
        other = recomputed.layers[name]
        if name == "deterministic":
            changes = _proof_changes(layer, other, required, confirm, repeat)
        else:
            changes = _measured_changes(layer, other)
        for reason, detail in changes:
            found.setdefault(reason, f"{name}, {detail}")
    return found


def _measured_changes(mine: Layer, other: Layer) -> list[tuple[Reason, str]]:
    """Generated statements are the same in everything but the last digits of a number."""
    if [s.name for s in mine.statements] != [s.name for s in other.statements]:
        return [(Reason.RECORD_CHANGED, "other statements than the episodes give")]
    exact = [f.name for f in fields(Statement) if f.name not in ("value", "misses_by", "confidence")]
    changes = []
    for a, b in zip(mine.statements, other.statements, strict=True):
        differs = [k for k in exact if getattr(a, k) != getattr(b, k)]
        differs += [k for k in ("value", "misses_by", "confidence") if not _close(getattr(a, k), getattr(b, k))]
        if differs:
            changes.append((Reason.RECORD_CHANGED, f"{a.name}: {', '.join(differs)} not as the episodes give"))
    return changes


def _proof_changes(
    mine: Layer, other: Layer, required: float, confirm: Callable[[str, float], bool | None] | None, repeat: Callable[[int], Layer] | None
) -> list[tuple[Reason, str]]:
    """What the deterministic layer claims beyond what was proved again."""
    early, late = (any(_gave_up(s) or _falls_short(s) for s in layer.statements) for layer in (mine, other))
    again: Layer | None = None

    def with_so_little_effort() -> Layer | None:
        nonlocal again
        again = repeat(effort(mine)) if again is None and repeat is not None else again
        return again

    if early and not _same_names(mine, other, True):
        other = with_so_little_effort() or other
    there, changes = {s.name: s for s in other.statements}, []
    named = _same_names(mine, other, early or late)
    if not named or not _bounds_are_all_there(mine):
        changes.append((Reason.TEXT_CHANGED, "other statements than the weights give"))
    for a in (s for s in mine.statements if named or s.name in there):
        b = there.get(a.name)
        same = [] if b is None else [k for k in ("text", "kind", "unit", "n", "confidence") if getattr(a, k) != getattr(b, k)]
        if same:
            changes.append((Reason.TEXT_CHANGED, f"{a.name}: {', '.join(same)} not as computed"))
        elif b is None or (_gave_up(b) and not _gave_up(a)):
            changes.append((Reason.UNDECIDED, f"{a.name}: not decided again in the time"))
        elif not _gave_up(a):
            changes += _decided_changes(a, b, required, confirm)
        elif not (_EFFORT.fullmatch(a.detail) or (_gave_up(b) and a.detail == b.detail)) or a.value is not None or a.misses_by is not None:
            changes.append((Reason.TEXT_CHANGED, f"{a.name}: detail or number not as computed"))
        elif b.holds is False and not _gave_up(b):
            # Honest only if so little effort does not refute it.
            less = with_so_little_effort()
            if less is None or not any(s.name == a.name and _gave_up(s) for s in less.statements):
                changes.append((Reason.NUMBERS_CHANGED, f"{a.name}: claimed undecided, recomputed {b.reason}"))
    return changes


def _same_names(mine: Layer, other: Layer, partly: bool) -> bool:
    """Whether the statements are the same, but for those that follow on a proof where a search gave up."""
    first, second = ([s.name for s in layer.statements if not (partly and s.name in LOWER_BOUNDS)] for layer in (mine, other))
    return first == second


def _bounds_are_all_there(layer: Layer) -> bool:
    """Whether the bounds on errors are those that a layer has: of an invariant set one, which, if it holds, is followed by that of the computed numbers."""
    held = {s.name: s.holds for s in layer.statements}
    found = [s.name for s in layer.statements if s.name in LOWER_BOUNDS]
    expected = 0 if not held.get("invariance") else 2 if held.get(TOLERATED) else 1
    return len(found) == expected and found[:1] == [TOLERATED][:expected]


def _decided_changes(
    a: Statement, b: Statement, required: float, confirm: Callable[[str, float], bool | None] | None
) -> list[tuple[Reason, str]]:
    """Both decided: the verdict is the same, and no number is better."""
    numbers = f"claimed {a.holds} {_number(a.value)}, recomputed {b.holds} {_number(b.value)}"
    if a.name in LOWER_BOUNDS:
        return _tolerated_changes(a, b, required, confirm)
    if a.holds != b.holds or a.reason != b.reason or not _not_better(a, b):
        return [(Reason.NUMBERS_CHANGED, f"{a.name}: {numbers}")]
    if a.holds is False:
        # A search finds one of many counterexamples: another machine another one.
        if (a.misses_by is None) != (b.misses_by is None):
            return [(Reason.NUMBERS_CHANGED, f"{a.name}: {numbers}")]
        if a.misses_by is not None and b.misses_by is not None and not 0.5 <= _ratio(a.misses_by, b.misses_by) <= 2.0:
            return [(Reason.NUMBERS_CHANGED, f"{a.name}: claimed to miss by {a.misses_by:.6g}, recomputed {b.misses_by:.6g}")]
    elif a.misses_by is not None:
        return [(Reason.NUMBERS_CHANGED, f"{a.name}: {numbers}")]
    same = _words(a.detail) == _words(b.detail) if a.holds is False else _effortless(a.detail) == _effortless(b.detail)
    return [] if same else [(Reason.TEXT_CHANGED, f"{a.name}: detail not as computed")]


TOLERATED = "tolerated error"
EVERY_WAY = "by bounds on the barrier in every direction of the error"
BY_LIPSCHITZ = "for errors above {} the argument fails"
_EFFORT = re.compile(r"(\d+ boxes(, [0-9.e+-]+ of the domain is left)?)?")
_NUMBER = re.compile(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")
#: Statements whose value is a bound from above: a larger one claims less. Others have to agree, but for the last digits.
_UPPER = ("rounding",)


def _tolerated_changes(
    a: Statement, b: Statement, required: float, confirm: Callable[[str, float], bool | None] | None
) -> list[tuple[Reason, str]]:
    """Lower bounds, from searches that end within a tolerance: less is weaker, more has to be proved itself."""
    numbers = f"{a.name}: claimed {a.holds} {_number(a.value)}, recomputed {b.holds} {_number(b.value)}"
    ways = (EVERY_WAY, BY_LIPSCHITZ.format("#")) if a.name == TOLERATED else (_words(b.detail),)  # which of two is found depends on the time
    if _words(a.detail) not in ways:
        return [(Reason.TEXT_CHANGED, f"{a.name}: detail not as computed")]
    if a.value is None or not (a.value >= required and a.value > 0.0):
        less = a.value is None or (b.value is not None and a.value <= b.value + 1e-9 * abs(b.value))
        missed = _close(a.misses_by, None if a.value is None else max(required - a.value, 0.0))
        short = Reason.MARGIN_TOO_SMALL if a.name == TOLERATED else Reason.ROUNDING
        weaker = less and missed and not a.holds and a.reason == short.name
        return [] if weaker else [(Reason.NUMBERS_CHANGED, numbers)]
    if not a.holds or a.misses_by is not None or (a.detail == EVERY_WAY and a.value != required):  # in every direction no more is asked for
        return [(Reason.NUMBERS_CHANGED, numbers)]
    said, found = ([float(m.group()) for m in _NUMBER.finditer(s.detail)] for s in (a, b))
    if a.name == TOLERATED and any(limit < a.value for limit in said):
        return [(Reason.NUMBERS_CHANGED, f"{a.name}: claimed above its own refutation")]
    if a.name != TOLERATED and any(x < y - 1.001 * _last_digit(y) for x, y in zip(said, found, strict=True) if y > 0):
        return [(Reason.TEXT_CHANGED, f"{a.name}: detail not as computed")]
    if b.value is not None and a.value <= b.value * (1.0 + 1e-9):
        return []
    proved = None if confirm is None else confirm(a.name, a.value)
    if proved:
        return []
    if proved is None and confirm is not None:
        return [(Reason.UNDECIDED, f"{a.name}: {a.value:.6g} not decided again in the time")]
    return [(Reason.NUMBERS_CHANGED, numbers)]


def _last_digit(number: float) -> float:
    """One in the last place of a number that is written with two digits."""
    return 10.0 ** (math.floor(math.log10(number)) - 1)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def _ratio(x: float, y: float) -> float:
    return x / y if y > 0 else (1.0 if x == y else math.inf)


def _not_better(a: Statement, b: Statement) -> bool:
    if a.name in _UPPER and a.value is not None and b.value is not None:
        return a.value >= b.value * (1.0 - 1e-9)
    return _close(a.value, b.value)


def _gave_up(s: Statement) -> bool:
    """Whether a search ran out of time: then nothing is claimed, and another one may find more."""
    undecided = (Reason.UNDECIDED.name, Reason.VACUITY_UNDECIDED.name)
    return s.kind == PROVED and not s.holds and s.value is None and s.reason in undecided


def _falls_short(s: Statement) -> bool:
    """Whether a tolerated error is too small, after which nothing is said about rounding."""
    return s.name in LOWER_BOUNDS and not s.holds


def effort(layer: Layer) -> int:
    """Boxes after which a search of a deterministic layer gave up; 0 if none did."""
    found = (re.match(r"(\d{1,12}) boxes", s.detail) for s in layer.statements if _gave_up(s))
    return max((int(m.group(1)) for m in found if m), default=0)


def _words(detail: str) -> str:
    """The detail without its numbers; what stands for them is none."""
    return _NUMBER.sub("#", detail.replace("#", "##"))


def _effortless(detail: str) -> str:
    """The detail without the boxes that a search took."""
    return re.sub(r"\d+ boxes", "# boxes", detail)


def _close(x: float | None, y: float | None) -> bool:
    """The same, but for the last digits, which another machine may round otherwise."""
    if x is None or y is None:
        return x is y
    return math.isclose(x, y, rel_tol=1e-9, abs_tol=1e-15)

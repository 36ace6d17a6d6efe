"""The record behind what a certificate measures: settings and counts, which every measured statement follows from."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from torchrl_sspl.errors import CertificationError, ConfigError
from torchrl_sspl.seeds import spawn

_KINDS = ("states", "resets")
_SYSTEMS = ("described", "given")
_FINITE = sys.float_info.max  # an integer of a file may be larger
_LARGEST = 10_000_000  # above which a number of episodes or steps is not believed
#: Shares of the starts in the set and of the labels of U that may repeat others: float32 has few numbers on a line.
REPEATED = 0.05


def finite(name: str, value: Any, low: float = -math.inf, high: float = math.inf) -> float:
    """A number of a file; ``CertificationError`` unless it is one, finite and in range."""
    if type(value) not in (int, float) or not abs(value) <= _FINITE or not low <= value <= high:
        raise CertificationError(f"expected {name} to be a finite number in [{low}, {high}], received {str(value)[:40]!r}")
    return float(value)


def count(name: str, value: Any, low: int = 0, high: int = 2**63) -> int:
    """A whole number of a file; ``CertificationError`` unless it is one and in range; true and 1.0 are none."""
    if type(value) is not int or not low <= value <= high:
        raise CertificationError(f"expected {name} to be a whole number in [{low}, {high}], received {str(value)[:40]!r}")
    return value


def keys(name: str, body: Any, expected: Any) -> Mapping[str, Any]:
    """An object of a file; ``CertificationError`` unless it has exactly the expected keys."""
    if type(body) is not dict or set(body) != set(expected):
        found = sorted(body)[:20] if type(body) is dict else type(body).__name__
        raise CertificationError(f"expected {name} with the keys {sorted(expected)}, received {str(found)[:300]}")
    return body


@dataclass(frozen=True)
class Counts:
    """What one block of fresh episodes showed.

    Attributes:
        episodes: that began in the set.
        steps: of these episodes together.
        left: of these, how many left it.
        entered: how many entered U.
        aliased: how many showed an observation of U with B <= s.
        undefined: how many gave a barrier value or an error that is no number.
        events: how many did any of it.
        exceeding: how many did not meet the premise of the proof at every step: an error above the tolerated one (all,
            where none is tolerated), or an observation with B > s by itself.
        uncovered: of the steps, at how many the premise was not met.
        shown: observations of U, or episodes that show one.
        mistaken: of these, how many have B <= s.
        seen: latents of fresh observations.
        outside: of these, how many lie outside the domain or are no numbers.
    """

    episodes: int
    steps: int
    left: int
    entered: int
    aliased: int
    undefined: int
    events: int
    exceeding: int
    uncovered: int
    shown: int
    mistaken: int
    seen: int
    outside: int

    def __post_init__(self) -> None:
        for f in fields(self):
            count(f.name, getattr(self, f.name), 0, _LARGEST**2)
        parts = (self.left, self.entered, self.aliased, self.undefined)
        if not max(parts) <= self.events <= min(sum(parts), self.episodes) or self.exceeding > self.episodes:
            raise CertificationError(f"expected counts of events that fit each other, received {self}")
        if not self.uncovered <= self.steps or bool(self.uncovered) > bool(self.exceeding):
            raise CertificationError(f"expected no more steps without the premise than steps, received {self}")
        if self.mistaken > self.shown or self.outside > self.seen or self.aliased > self.entered:
            raise CertificationError(f"expected no more events than observations, received {self}")

    def __add__(self, other: Counts) -> Counts:
        return Counts(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


NOTHING = Counts(*[0] * len(fields(Counts)))
#: Numbers beside the counts, None where there is none: errors in latent units, the rest in units of the barrier.
NUMBERS = (
    "episode_error", "largest_error", "covering_radius", "closed_loop_constant", "safe_worst", "unsafe_worst", "following_worst",
)  # fmt: skip
#: Whole numbers beside the counts: lengths of episodes, repetitions, labelled states of the training that are known and those
#: met again, sizes of the paper's samples, and on how many its conditions hold.
SIZES = (
    "shortest", "median", "longest", "repeated", "trained_on", "leaked", "safe", "unsafe", "following", "safe_met", "unsafe_met",
    "following_met", "following_met_as_needed",
)  # fmt: skip


@dataclass
class Record:
    """How fresh episodes were drawn, and what was counted.

    Attributes:
        kind: "states" (starts and observations of U are drawn from a known state space) or "resets" (from the
            environment's own resets).
        system: "described" (the agent's description says how to build the system, and it is that one) or "given" (in
            code).
        seed: root; block k draws from ``spawn(seed, "certificate", k)``.
        episodes: asked for.
        horizon: longest episode, in steps.
        envs: environments side by side ("resets").
        confidence: c, of the two bounds of the statistical layer together, and of that of the run-time layer by itself.
        acceptable: risk above which a statement does not hold.
        used: seeds with which anything was trained, chosen or tuned; None where nobody has recorded them.
        blocks: counts, block by block.
        sizes: whole numbers by the names of :data:`SIZES`.
        numbers: numbers by the names of :data:`NUMBERS`.
        rims: rows of a table: part of the set, number of steps, largest error there.
        among: which states those that are drawn are, where they are not all ("states"), as the system says it.

    Source: none.
    """

    kind: str
    system: str
    seed: int
    episodes: int
    horizon: int
    envs: int = 1
    confidence: float = 0.95
    acceptable: float = 0.01
    used: list[int] | None = None
    blocks: list[Counts] = field(default_factory=list)
    sizes: dict[str, int] = field(default_factory=dict)
    numbers: dict[str, float | None] = field(default_factory=dict)
    rims: list[tuple[str, int, float]] = field(default_factory=list)
    among: str = ""

    def __post_init__(self) -> None:
        if min(self.episodes, self.horizon, self.envs) < 1 or not all(0.0 < x < 1.0 for x in (self.confidence, self.acceptable)):
            raise ConfigError(
                "expected at least one episode of one step in one environment, and confidence and acceptable in (0, 1), received "
                f"{self.episodes}, {self.horizon}, {self.envs}, {self.confidence}, {self.acceptable}"
            )
        self.sizes = {name: self.sizes.get(name, 0) for name in SIZES}
        given = ((name, self.numbers.get(name)) for name in NUMBERS)
        self.numbers = {name: v if v is None or math.isfinite(v) else None for name, v in given}

    @property
    def total(self) -> Counts:
        """All blocks together."""
        return sum(self.blocks, NOTHING)

    @property
    def block(self) -> int:
        """Episodes per block."""
        if self.kind == "states":
            return min(self.episodes, 250)
        return self.envs * -(-min(self.episodes, 100) // self.envs)  # whole batches: resets may come part by part

    def size(self, index: int) -> int:
        """Episodes to draw in a block; the last one of "states" takes the rest."""
        return min(self.block, self.episodes - index * self.block) if self.kind == "states" else self.block

    def complete(self) -> bool:
        """Whether the blocks are as many as the rule asks for, which looks at how many count, never at what happened.

        With starts of a known state space: as many as were asked for, one if the set is empty. From resets: at least
        that many, up to three times as many while fewer than asked for, but some, begin in the set. How many show U is not
        asked: that depends on what the policy did.
        """
        drawn, blocks = len(self.blocks) * self.block, self.blocks
        if not blocks or self.kind == "states":
            return bool(blocks) and (drawn >= self.episodes or blocks[0].episodes == 0)
        if drawn < self.episodes:
            return False
        begun = self.total.episodes
        return drawn >= 3 * self.episodes or begun == 0 or begun >= self.episodes

    def seeds(self) -> list[int]:
        """Seeds of the blocks."""
        purposes = ("certificate",) if self.kind == "states" else ("certificate", "certificate actions")
        return [spawn(self.seed, purpose, k) for k in range(len(self.blocks)) for purpose in purposes]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return asdict(self) | {"rims": [list(row) for row in self.rims]}

    @classmethod
    def from_dict(cls, body: Any) -> Record:
        """Reads what :meth:`to_dict` gives; ``CertificationError`` if a key, a type or a value is another one."""
        body = keys("a record", body, [f.name for f in fields(cls)])
        for name, known in (("kind", _KINDS), ("system", _SYSTEMS)):
            if body[name] not in known:
                raise CertificationError(f"expected {name} to be one of {', '.join(known)}, received {str(body[name])[:40]!r}")
        if type(body["among"]) is not str or len(body["among"]) > 200 or not body["among"].isprintable():
            raise CertificationError(f"expected among to be a line of text, received {str(body['among'])[:40]!r}")
        for name, low in (("seed", 0), ("episodes", 1), ("horizon", 1), ("envs", 1)):
            count(name, body[name], low, _LARGEST if name != "seed" else 2**64)
        for name in ("confidence", "acceptable"):
            if not 0.0 < finite(name, body[name], 0.0, 1.0) < 1.0:
                raise CertificationError(f"expected {name} in (0, 1), received {body[name]}")
        for name in ("used", "blocks", "rims"):
            if type(body[name]) is not list and not (name == "used" and body[name] is None):
                raise CertificationError(f"expected {name} to be a list, received a {type(body[name]).__name__}")
        used = body["used"] if body["used"] is None else [count("a used seed", s, -(2**63), 2**64) for s in body["used"]]
        names = [f.name for f in fields(Counts)]
        blocks = [Counts(**keys("a block", b, names)) for b in body["blocks"]]
        sizes = {k: count(k, v, 0, _LARGEST * 100) for k, v in keys("sizes", body["sizes"], SIZES).items()}
        numbers = {k: v if v is None else finite(k, v) for k, v in keys("numbers", body["numbers"], NUMBERS).items()}
        rims: list[tuple[str, int, float]] = []
        for row in body["rims"]:
            if type(row) is not list or len(row) != 3 or row[0] not in RIMS or len(rims) >= len(RIMS):
                raise CertificationError(f"expected rims as [part of the set, steps, largest error], received {str(row)[:80]}")
            rims.append((row[0], count("steps", row[1], 1), finite("largest error", row[2], 0.0)))
        plain = {k: body[k] for k in ("kind", "system", "seed", "episodes", "horizon", "envs", "confidence", "acceptable", "among")}
        record = cls(**plain, used=used, blocks=blocks, sizes=sizes, numbers=numbers, rims=rims)
        record.check()
        return record

    def check(self) -> None:
        """``CertificationError`` unless the numbers fit each other."""
        for index, block in enumerate(self.blocks):
            n = self.size(index)
            if block.episodes > n or block.shown > 2 * n or block.steps > block.episodes * self.horizon:
                raise CertificationError(f"expected at most {n} episodes of {self.horizon} steps in block {index}, received {block}")
        if not self.complete() or (len(self.blocks) > 1 and Record(**vars(self) | {"blocks": self.blocks[:-1]}).complete()):
            raise CertificationError(
                f"expected as many blocks as {self.episodes} episodes ask for, received {len(self.blocks)} with "
                f"{self.total.episodes} episodes from the set"
            )
        s, total = self.sizes, self.total
        if not s["shortest"] <= s["median"] <= s["longest"] <= self.horizon or s["repeated"] > total.episodes:
            raise CertificationError("expected lengths of episodes in order, and no more repetitions than episodes")
        if not total.episodes * s["shortest"] <= total.steps <= total.episodes * s["longest"]:
            raise CertificationError(f"expected lengths of episodes that give {total.steps} steps, received others")
        if s["leaked"] > total.shown or any(s[f"{k}_met"] > s[k] for k in ("safe", "unsafe", "following")):
            raise CertificationError("expected no more samples with a property than samples")


#: Parts of the set by the barrier value at which a step begins: name, from, to, both relative to s.
RIMS = {"deep in the set": (-math.inf, -0.3), "half way": (-0.3, -0.1), "at the rim": (-0.1, 0.0)}

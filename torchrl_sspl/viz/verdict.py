"""The first screen of a report: is it safe, and how do you know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from torchrl_sspl.certification.certificate import PROVED, Certificate, Layer, Reason, Statement
from torchrl_sspl.certification.rounding import down, missed, shown, up
from torchrl_sspl.viz.report import SEEN, format_value, verdict_kind

#: A kind ("good", "fair", "bad" or "none") and a sentence.
Item = tuple[str, str]

_MOST = 4  # rows of a run that the first screen shows
_NAMED = 3  # requirements without a measurement that it names; of more it gives the number
#: Measurements of what nobody wants, the most real first; a run's own sentence is about the first that it has.
_HARM = ("walks_from_safe_hit", "walks_from_set_enter", "safe_rollouts_touch_unsafe", "touch_unsafe")
#: What the statements of a proof mean, the most important first; of the others only those that fail are shown.
_PROOFS = {
    "invariance": "In the learned dynamics the policy never leaves the safe set: it leads every latent with B <= 0 to one with B <= 0.",
    "float32": "The same in float32, as it is computed, with an error of up to {} added at every step.",
    "tolerated error": "The same in exact arithmetic, with an error of up to {} added at every step.",
    "Lipschitz constant": "B changes by at most {} times as much as the latent (exact arithmetic on the deployed weights).",
}
_UNPROVED = {
    Reason.EMPTY: "No safe set was found: no latent has B <= 0.",
    Reason.EVERYTHING: "The safe set is everything, and so says nothing.",
    Reason.NOT_INVARIANT: "Refuted by a counterexample: the policy leads a latent with B <= 0 to one with B > 0, in the learned dynamics.",
}
_CLAUSES = {
    Reason.EMPTY: "no safe set was found, as no latent has B <= 0",
    Reason.EVERYTHING: "the safe set is everything and says nothing",
    Reason.NOT_INVARIANT: "the proof is refuted, as the learned dynamics lead out of the safe set",
}


@dataclass
class FirstScreen:
    """A sentence of verdict with its kind, what has to be added, and what both rest on."""

    headline: str
    kind: str
    more: str = ""
    proved: list[Item] = field(default_factory=list)
    measured: list[Item] = field(default_factory=list)


def first_screen(
    certificate: Certificate | None, rows: Sequence[Sequence[Any]] = (), *, trained: bool = True,
    measured: Sequence[str] = (), proved: Sequence[str] = (),
) -> FirstScreen:  # fmt: skip
    """What a run shows, and what it does not.

    Args:
        certificate: of the agent; None: there is none.
        rows: requirements of this run, see ``requirement_rows``.
        trained: whether this run trained and certified the agent; else the certificate came with it.
        measured: sentences in place of rows, where a system has no requirements.
        proved: statements that are proved without a certificate.

    Returns the verdict: "good" only where the proof holds, fresh episodes were counted and keep within the certificate's
    bound, and no row of this run misses its must or is too uncertain to reach it. Source: none.

    Example:
        >>> first_screen(None, measured=["episodes that touch U: 0"]).headline
        'Measured, without a certificate: nothing is proved.'
    """
    kinds = [verdict_kind(row[4]) for row in rows]
    order = sorted(range(len(rows)), key=lambda k: ("bad", "fair", "good", "none").index(kinds[k]))
    found = [(kinds[k], line) for k in order if (line := _line(rows[k]))]
    unknown = [str(row[0]) for row, kind in zip(rows, kinds, strict=True) if kind == "none"]
    if len(found) > _MOST:
        found = [*found[:_MOST], ("none", f"{len(found) - _MOST} more below.")]
    if unknown:
        what = f"{len(unknown)} requirements, listed below" if len(unknown) > _NAMED else "; ".join(unknown)
        found.append(("none", f"Not measured in this run: {what}."))
    found += [("none", line) for line in measured]
    if certificate is None:
        kind = "bad" if "bad" in kinds else "none"
        head = "Measured, without a certificate: " + ("the policy is not proved safe." if proved else "nothing is proved.")
        return FirstScreen(head, kind, _joined(_of_run(rows, kinds)), [("good", line) for line in proved], found)
    proof = certificate.layers["deterministic"]
    counted = _counted(certificate)
    parts = [_proof(proof, certificate.level), counted]
    run_time = certificate.layers.get("run-time")
    if run_time is not None and proof.holds:
        parts.append(_covered(run_time))
    of_parts, of_rows = [kind for kind, _ in parts], [k for k, row in zip(kinds, rows, strict=True) if row[4] not in SEEN]
    worst = _worst(of_parts + of_rows)
    said = _word(proof, of_parts, of_rows) + ": " + "; ".join(_at(certificate.level, text) for _, text in parts) + "."
    paper = certificate.layers.get("paper")
    more = [] if paper is None or paper.holds else ["Not certified: the paper's own conditions with its margins"]
    more += _of_run(rows, kinds) + ([] if trained else ["The certificate came with the agent; this run neither trained nor proved anything"])
    return FirstScreen(said, worst, _joined(more), [(kind, _at(certificate.level, text)) for kind, text in _proofs(proof)], [*_evidence(certificate), *found])


def _joined(sentences: Sequence[str]) -> str:
    return "".join(f"{s}. " for s in sentences).rstrip()


def _worst(kinds: Sequence[str]) -> str:
    return next(kind for kind in ("bad", "fair", "good", "none") if kind in kinds or kind == "none")


def _word(proof: Layer, parts: Sequence[str], rows: Sequence[str]) -> str:
    """How the sentence begins."""
    if Reason.EMPTY in proof.reasons:
        return "Not safe"
    if "bad" in parts or "fair" in parts or "good" not in parts:
        return "Not certified as safe"
    if "bad" in rows:
        return "Certified, but this run misses requirements"
    return "Certified, but this run has too few episodes to confirm it" if "fair" in rows else "Safe as far as this reaches"


def _at(level: float, text: str) -> str:
    """A sentence about {B <= 0}, of another level."""
    return text if level == 0.0 else text.replace("B <= 0", f"B <= {level:g}").replace("B > 0", f"B > {level:g}")


def _proof(layer: Layer, level: float) -> Item:
    if layer.holds and level != 0.0:
        return "fair", "in the learned dynamics the policy provably never leaves {B <= 0}, a part of the set that the agent calls safe"
    if layer.holds:
        return "good", "in the learned dynamics the policy provably never leaves the safe set {B <= 0}"
    reason = next(iter(layer.reasons), None)
    if reason in _CLAUSES:
        return "bad", _CLAUSES[reason]
    return "fair", "nothing is proved" + (f", as {reason.value}" if reason else "")


def _counted(certificate: Certificate) -> Item:
    """Fresh episodes from the set, counted for the certificate."""
    total = None if certificate.record is None else certificate.record.total
    statement = _statement(certificate.layers.get("statistical"), "episodes")
    if total is None or not total.episodes or statement is None:
        return "none", "no fresh episode began in the safe set"
    most = "" if statement.value is None else f" (at most {up(100 * statement.value, 3)} %)"
    text = f"{total.events or 'none'} of {total.episodes:,} fresh episodes left it or entered the unsafe set U{most}"
    return "good" if statement.holds else "bad", text


def _covered(layer: Layer) -> Item:
    statement = _statement(layer, "covered")
    if statement is None or statement.value is None:
        return "fair", "the proof covers no real episode"
    return "good" if statement.holds else "fair", f"the proof covers at least {down(100 * (1 - statement.value), 3)} % of them"


def _statement(layer: Layer | None, name: str) -> Statement | None:
    return next((s for s in layer.statements if s.name == name), None) if layer is not None else None


def _of_run(rows: Sequence[Sequence[Any]], kinds: Sequence[str]) -> list[str]:
    """What this run adds: harm that it looked for, and requirements that are missed or too uncertain."""
    said = []
    harm = {getattr(row[1], "name", ""): row for row in rows if _line(row)}
    for name in _HARM:
        if name in harm and harm[name][1].upper is not None:
            label, m = harm[name][0], harm[name][1]
            said.append(f"In this run, {label}: {m.events or 'none'} of {m.n:,} (at most {up(100 * m.upper, 3)} %)")
            break
    bad = kinds.count("bad")
    unsure = sum(kind == "fair" and row[4] not in SEEN for kind, row in zip(kinds, rows, strict=True))
    if bad:
        said.append(f"{bad} of {len(rows)} requirements {'is' if bad == 1 else 'are'} missed")
    if unsure:
        said.append(f"{unsure} of {len(rows)} requirements {'needs' if unsure == 1 else 'need'} more episodes")
    return said


def _line(row: Sequence[Any]) -> str:
    """A row as a sentence, "" where nothing was measured or no share was."""
    label, m, must = row[0], row[1], row[2]
    if getattr(m, "value", None) is None or not getattr(m, "n", None) or getattr(m, "events", None) is None:
        return ""
    bound = ""
    if m.upper is not None:
        low, high = f"{down(100 * m.lower, 3)} %", f"{up(100 * m.upper, 3)} %"
        among = f"at least {low}" if m.events == m.n else f"{low} to {high}"
        bound = f"95 %: {among if m.events else f'at most {high}'}; "
    count = "none" if m.events == 0 else "all" if m.events == m.n else format_value(m.value, "share")
    return f"{label[:1].upper()}{label[1:]}: {count} of {m.n:,} ({bound}must be {must})."


def _proofs(layer: Layer) -> list[Item]:
    """Statements of the proof in plain words: those that fail, then the most important ones."""
    items: list[Item] = []
    for s in layer.statements:
        if s.kind == PROVED and not s.holds:
            reason = Reason[s.reason] if s.reason else None
            text = _UNPROVED.get(reason, f"Not proved, {s.name}: {reason.value if reason else 'it fails'}.")  # type: ignore[arg-type]
            bad = reason in _UNPROVED
            items.append(("bad" if bad else "fair", text + (f" It misses by {missed(s)}." if missed(s) else "")))
    for name, text in _PROOFS.items():
        s = _statement(layer, name)  # type: ignore[assignment]
        if s is not None and s.holds:
            items.append(("good", text.format(shown(s).removesuffix(" barrier / latent"))))
    return items


def _evidence(certificate: Certificate) -> list[Item]:
    """What fresh episodes show, in plain words."""
    if certificate.record is None:
        return [("none", "The certificate counts no fresh episodes.")]
    layer, total, sure = certificate.layers.get("statistical"), certificate.record.total, certificate.record.confidence
    items: list[Item] = []
    for name, text, n in (
        ("episodes", f"Certificate: {total.left:,} of {total.episodes:,} fresh episodes left the set, {total.entered:,} entered U", total.episodes),
        ("unsafe observations", f"Certificate: {total.mistaken:,} of {total.shown:,} fresh pictures of U had B <= 0", total.shown),
    ):  # fmt: skip
        s = _statement(layer, name)
        if s is not None and n and s.value is not None:
            limit = f"at most {up(100 * s.value, 3)} %, must be at most {100 * certificate.record.acceptable:g} %"
            items.append(("good" if s.holds else "bad", f"{_at(certificate.level, text)}; {limit} (both with {100 * sure:g} % confidence)."))
    run_time = certificate.layers.get("run-time")
    if run_time is not None and certificate.layers["deterministic"].holds:
        kind, text = _covered(run_time)
        items.append((kind, f"Certificate: {text}, at every step."))
    return items or [("none", "No fresh episode began in the safe set: nothing could be counted.")]


__all__ = ["FirstScreen", "first_screen"]

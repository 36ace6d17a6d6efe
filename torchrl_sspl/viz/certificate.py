"""A certificate as a part of the report: in ten seconds, what is guaranteed and what is not."""

from __future__ import annotations

from html import escape

from torchrl_sspl.certification.certificate import PROVED, Certificate, Statement
from torchrl_sspl.certification.rounding import missed, shown
from torchrl_sspl.viz.report import badge, table

_TITLES = {
    "run-time": "To how many real episodes the proof applies",
    "deterministic": "What the weights prove",
    "statistical": "What fresh episodes show",
    "paper": "The paper's conditions, with its margins",
}
_SUCCESS = {"run-time": "yes", "deterministic": "proved", "statistical": "yes", "paper": "yes, all of them"}


def certificate_section(certificate: Certificate) -> str:
    """The certificate as an HTML ``<section>`` without scripts and outside resources. Source: none.

    Example:
        >>> from torchrl_sspl.certification import Layer
        >>> layer = Layer("deterministic", [Statement("a", "1 < 2", PROVED, True)])
        >>> "1 &lt; 2" in certificate_section(Certificate("demo", "0" * 64, "0" * 64, 0.0, {"deterministic": layer}))
        True
    """
    parts = [
        "<section><h2>Certificate</h2>",
        f"<p>About the set {{B &le; {certificate.level:g}}} of the agent <b>{escape(certificate.agent)}</b> with "
        f"weights <code>{escape(certificate.weights[:16])}&hellip;</code>. "
        "<code>sspl verify</code> computes it again.</p>",
    ]
    for name in _TITLES:
        if name not in certificate.layers:
            continue
        layer = certificate.layers[name]
        parts.append(f"<h3>{_TITLES[name]}</h3><p>{badge(_SUCCESS[name] if layer.holds else layer.verdict)}</p>")
        parts.append(table(("Statement", "Status", "Value", "n", "Remark"), [_row(s) for s in layer.statements]))
    return "".join(parts) + "</section>"


def _row(statement: Statement) -> list[str]:
    s = statement
    if not s.decides:
        status = s.kind
    elif s.holds:
        status = badge("proved" if s.kind == PROVED else "yes")
    else:
        miss = "" if s.misses_by is None else f", misses by {missed(s)}"
        status = badge(f"not {s.kind}{miss}" if s.kind == PROVED else f"does not hold{miss}")
    size = "" if s.n is None else f"{s.n:,}" + ("" if s.confidence is None else f", {100 * s.confidence:g} %")
    return [escape(s.text), status, escape(shown(s)), escape(size), escape(s.detail)]

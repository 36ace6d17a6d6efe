"""A certificate as a part of the report: in ten seconds, what is guaranteed and what is not."""

from __future__ import annotations

from torchrl_sspl.certification.certificate import PROVED, Certificate, Statement
from torchrl_sspl.certification.rounding import missed, shown
from torchrl_sspl.viz.pages import Cell, Table, render
from torchrl_sspl.viz.report import badge

_TITLES = {
    "run-time": "Does the proof cover real episodes?",
    "deterministic": "Do the weights keep the set?",
    "statistical": "Do fresh episodes keep the set?",
    "paper": "Do the paper's conditions hold, with its margins?",
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
    layers = [
        {
            "title": title,
            "badge": badge(_SUCCESS[name] if layer.holds else layer.verdict),
            "table": Table(("Statement", "Status", "Value", "n", "Remark"), [_row(s) for s in layer.statements], ""),
        }
        for name, title in _TITLES.items()
        if (layer := certificate.layers.get(name)) is not None
    ]
    about = {"level": f"{certificate.level:g}", "agent": certificate.agent, "weights": certificate.weights[:16]}
    return render("certificate.html", layers=layers, **about)


def _row(statement: Statement) -> list[str | Cell]:
    s = statement
    status: str | Cell = s.kind
    if s.decides and s.holds:
        status = Cell(badge=badge("proved" if s.kind == PROVED else "yes"))
    elif s.decides:
        miss = "" if s.misses_by is None else f", misses by {missed(s)}"
        status = Cell(badge=badge(f"not {s.kind}{miss}" if s.kind == PROVED else f"does not hold{miss}"))
    size = "" if s.n is None else f"{s.n:,}" + ("" if s.confidence is None else f", {100 * s.confidence:g} %")
    return [s.text, status, shown(s), size, s.detail]

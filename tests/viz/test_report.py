"""The report is one file, says the verdict first, leaves nothing out and lets nothing in."""

from __future__ import annotations

import base64
import re
from html.parser import HTMLParser
from types import SimpleNamespace

import pytest
import torch

from torchrl_sspl.certification.certificate import MEASURED, PROVED, Certificate, Layer, Reason, Statement
from torchrl_sspl.errors import ConfigError, ShapeError
from torchrl_sspl.viz import format_value, requirement_rows, write_report
from torchrl_sspl.viz.certificate import certificate_section
from torchrl_sspl.viz.plane import new_figure

CERTIFICATE = Certificate(
    "demo",
    "ab" * 32,
    "cd" * 32,
    -0.1,
    {
        "deterministic": Layer(
            "deterministic",
            [
                Statement("a", "kept <always>", PROVED, True),
                Statement("b", "tolerates", PROVED, False, 0.1, "latent", reason=Reason.MARGIN_TOO_SMALL.name, misses_by=0.25),
            ],
        ),
        "statistical": Layer("statistical", [Statement("c", "left", MEASURED, True, 0.001, "share", 2000, 0.95)]),
    },
)

VOID = {"meta", "img", "br", "link", "input", "hr"}


class Page(HTMLParser):
    """Checks that tags nest, and collects text, tags and addresses."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.stack == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [v for k, v in attrs if k in ("src", "href", "poster", "data", "action")]
        assert not any(k.startswith("on") for k, _ in attrs)
        if tag not in VOID:
            self.stack.append(tag)

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self):
        return " ".join(self.words)


def share(value, events, n, lower, upper, note=""):
    return SimpleNamespace(value=value, unit="share", n=n, events=events, lower=lower, upper=upper, note=note)


MEASUREMENTS = {
    "leaves": share(0.0, 0, 3000, 0.0, 0.000998, "episodes <b>from</b> {B<=0}"),
    "returns": share(1.0, 40, 40, 0.928, 1.0),
    "touches": share(0.02, 2, 100, 0.002431, 0.07038),
    "depth": {"value": 0.51234, "unit": "barrier", "n": None, "note": "|min B|"},
    "lost": {"value": float("nan"), "unit": "share", "n": 0, "lower": None, "upper": None},
}


def page(tmp_path, **arguments):
    path = write_report(tmp_path / "out" / "report.html", **{"title": "A run", **arguments})
    return Page(path.read_text(encoding="utf-8")), path.read_text(encoding="utf-8")


def full(tmp_path, **more):
    (tmp_path / "film.mp4").write_bytes(b"0000ftypisom")
    figure = new_figure(2, 2, "What it shows & why.")
    figure.add_subplot().plot([0, 1])
    figure.savefig(tmp_path / "saved.png", dpi=40)
    arguments = dict(
        summary=[
            ("leaves the set", MEASUREMENTS["leaves"], "\u2264 0.1 %", "0 %", "aim"),
            ("touches U", MEASUREMENTS["touches"], "0 %", "0 %", "missed by 2 %"),
            ("foreign frames", None, 0.5, 0.9, "aim"),
        ],
        measurements=MEASUREMENTS,
        figures={"Plane": figure, "Saved": (tmp_path / "saved.png", "From a file.")},
        config={"seed": 7, "preset": "sound", "network": {"latent_dim": 3}},
        checks=[{"round": 0, "size": 0.25, "passed": True, "reason": ""}],
        certificate=certificate_section(CERTIFICATE),
        video=tmp_path / "film.mp4",
        notes="First.\n\nSecond <script>alert(1)</script>.",
        proved=["B is 2-Lipschitz."],
    )
    return page(tmp_path, **{**arguments, **more})


def test_page_parses_and_needs_nothing_from_outside(tmp_path):
    parsed, text = full(tmp_path)
    assert parsed.addresses
    assert all(a.startswith("data:") for a in parsed.addresses)
    assert {"script", "link", "object", "embed"}.isdisjoint(parsed.tags)
    assert not re.search(r"url\(|@import", text)
    assert text.count("data:image/png;base64,") == 2
    assert base64.b64decode(re.search(r"data:video/mp4;base64,([\w+/=]+)", text)[1]) == b"0000ftypisom"


def test_the_film_comes_after_the_verdict_with_the_picture_that_lies_beside_it(tmp_path):
    assert " poster=" not in full(tmp_path)[1]
    (tmp_path / "film.jpg").write_bytes(b"picture")
    parsed, text = full(tmp_path)
    assert base64.b64decode(re.search(r'poster="data:image/jpeg;base64,([\w+/=]+)"', text)[1]) == b"picture"
    assert parsed.text.index("Assumed") < parsed.text.index("Film") < parsed.text.index("Requirements")


def test_verdict_comes_first_and_counts_rightly(tmp_path):
    parsed, _ = full(tmp_path)
    text = parsed.text
    order = [
        "A run",
        "1 of 3 requirements missed, 1 reached",
        "Proved",
        "Measured",
        "Assumed",
        "Requirements",
        "Figures",
    ]
    places = [text.index(word) for word in order]
    assert places == sorted(places)
    assert "B is 2-Lipschitz." in text
    assert "touches U: 2 % of 100 (95 %: 0.243 to 7.04 %)" in text
    assert "seed 7" in text
    assert "torchrl_sspl" in text


def test_every_measurement_setting_and_check_is_there(tmp_path):
    parsed, _ = full(tmp_path)
    for name in MEASUREMENTS:
        assert name in parsed.words
    for word in ("network.latent_dim", "0.5123", "\u2264 0.0998 %", "\u2265 92.8 %", "25 %", "From a file.", "3,000"):
        assert any(word in part for part in parsed.words), word


def test_missing_values_read_not_measured_and_never_pass(tmp_path):
    parsed, text = full(tmp_path)
    assert parsed.text.count("not measured") >= 3
    assert "nan" not in re.sub(r"data:[^\"]*", "", text.lower())
    parsed, _ = page(tmp_path, summary=[("a", float("nan"), "0", "0", "aim")])
    assert "0 of 1 requirements reached, 1 not measured" in parsed.text
    assert "aim reached" not in parsed.text


def test_nothing_is_called_proved_unless_it_was_passed(tmp_path):
    m = {"lipschitz": {"value": 2.0, "unit": "", "note": "proved for the deployed weights"}}
    parsed, _ = page(tmp_path, measurements=m)
    assert "Nothing is claimed as proved." in parsed.text


def test_all_requirements_reached(tmp_path):
    parsed, text = page(tmp_path, summary=[("a", 0.0, "0", "0", "aim"), ("b", 1, "1", "0", "must")])
    assert "All requirements reached (2 of 2), 1 at the aim" in parsed.text
    assert 'class="verdict good"' in text


@pytest.mark.parametrize(
    "where", ["title", "notes", "config", "summary", "measurements", "figures", "checks", "proved"]
)
def test_everything_is_escaped(tmp_path, where):
    bad = '<script>"x"</script><img src="https://example.org">'
    figure = new_figure(1, 1, bad)
    value = {
        "title": bad,
        "notes": bad,
        "config": {bad: bad, "seed": bad},
        "summary": [(bad, bad, bad, bad, bad)],
        "measurements": {bad: {"value": 1.0, "unit": bad, "note": bad}},
        "figures": {bad: figure},
        "checks": [{bad: bad}],
        "proved": [bad],
    }[where]
    parsed, text = page(tmp_path, **{where: value})
    assert "script" not in parsed.tags
    assert "https://example.org" not in parsed.addresses
    assert "&lt;script&gt;" in text


def test_certificate_says_what_is_proved_measured_and_not_certified(tmp_path):
    _, text = full(tmp_path)
    for words in ("Do the weights keep the set?", "kept &lt;always&gt;", "not proved, misses by 0.25 latent", "2,000, 95 %"):
        assert words in text


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (dict(summary=[("a", 1.0, "0")]), ShapeError),
        (dict(figures={"a": 3}), ConfigError),
        (dict(figures={"a": "missing.png"}), ConfigError),
        (dict(video="missing.mp4"), ConfigError),
        (dict(measurements={"a": 3.0}), ConfigError),
    ],
)
def test_wrong_content_gets_a_typed_error(tmp_path, arguments, error):
    with pytest.raises(error):
        page(tmp_path, **arguments)


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (None, "share", "not measured"),
        (float("nan"), "", "not measured"),
        (torch.tensor(0.5), "share", "50 %"),
        (0.0, "share", "0 %"),
        (1e-7, "", "1e-07"),
        (12345.6, "", "12,346"),
        (0.98765, "ratio", "0.9877"),
        (float("inf"), "", "\u221e"),
        (True, "", "yes"),
        (10000, "", "10,000"),
        (1.5, "N m", "1.5 N m"),
    ],
)
def test_figures_are_printed_for_people(value, unit, text):
    assert format_value(value, unit) == text


def test_requirement_rows_take_over_limits_and_verdicts():
    evaluation = SimpleNamespace(measurements={"a": MEASUREMENTS["touches"]})

    def requirement(name, sense, must, aim, verdict):
        return SimpleNamespace(
            name=name, label=name.upper(), sense=sense, must=must, aim=aim, verdict=lambda _: verdict
        )

    rows = requirement_rows(
        [requirement("a", "<=", 0.01, 0.0, "missed by 0.01"), requirement("b", ">=", 0.5, 1.0, "not measured")],
        evaluation,
    )
    assert rows[0] == ("A", MEASUREMENTS["touches"], "\u2264 1 %", "0 %", "missed by 1 %")
    assert rows[1] == ("B", None, "\u2265 50 %", "100 %", "not measured")

"""The first screen says what is proved, refuted, measured and not certified, and is green only where bounds allow it."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest

from torchrl_sspl.certification.certificate import PROVED, Certificate, Layer, Reason, Statement
from torchrl_sspl.envs.system import Requirement
from torchrl_sspl.evaluation.measurements import Evaluation, share
from torchrl_sspl.modules.agent import agent_directory
from torchrl_sspl.viz.report import badge, bounded, requirement_rows
from torchrl_sspl.viz.verdict import _line, first_screen

TOUCH = Requirement("safe_rollouts_touch_unsafe", "episodes that touch U", "<=", 0.01, 0.0)
LEAVE = Requirement("leave", "episodes that leave", "<=", 0.0, 0.0)


def shipped(name: str) -> Certificate:
    return Certificate.load(agent_directory(name) / "certificate.json")


def rows(events: int, n: int):
    found = Evaluation()
    found.add(share(TOUCH.name, events, n))
    return requirement_rows([TOUCH, Requirement("lost", "what nobody measured", "<=", 0.1, 0.0)], found)


def test_the_shipped_pendulum_is_safe_as_far_as_its_certificate_reaches():
    screen = first_screen(shipped("pendulum"), rows(0, 3000)[:1], trained=False)
    assert screen.kind == "good"
    assert screen.headline == (
        "Safe as far as this reaches: in the learned dynamics the policy provably never leaves the safe set {B <= 0}; none of 3,000 "
        "fresh episodes left it or entered the unsafe set U (at most 0.123 %); the proof covers at least 99 % of them."
    )
    assert "Not certified: the paper's own conditions" in screen.more
    assert "this run neither trained nor proved anything" in screen.more
    assert screen.proved[0] == (
        "good",
        "In the learned dynamics the policy never leaves the safe set: it leads every latent with B <= 0 to one with B <= 0.",
    )
    assert not any("rounding of the float64" in text or "known types" in text for _, text in screen.proved)


def test_the_shipped_quadruped_is_safe_as_far_as_its_certificate_reaches():
    screen = first_screen(shipped("quadruped"), rows(0, 3000)[:1], trained=False)
    assert screen.kind == "good"
    assert screen.headline.startswith("Safe as far as this reaches: in the learned dynamics the policy provably never leaves the safe set {B <= 0}")
    assert "Not certified: the paper's own conditions" in screen.more


def test_a_refuted_proof_is_said_first():
    certificate = shipped("quadruped")
    replaced = {
        "invariance": Statement("invariance", "t", PROVED, False, reason="NOT_INVARIANT", misses_by=0.045, unit="barrier"),
        "episodes": Statement("episodes", "t", "measured", False, value=0.01028, n=3000, reason="UNSAFE_ENTERED"),
    }
    for layer in certificate.layers.values():
        layer.statements = [replaced.get(s.name, s) for s in layer.statements]
    certificate.record.blocks[0] = dataclasses.replace(certificate.record.blocks[0], left=20, events=20)
    screen = first_screen(certificate, rows(0, 3000), trained=False)
    assert screen.kind == "bad"
    assert screen.headline.startswith("Not certified as safe: the proof is refuted")
    assert "20 of 3,000 fresh episodes left it or entered the unsafe set U (at most 1.03 %)" in screen.headline
    assert screen.proved[0][0] == "bad"
    assert "Refuted by a counterexample" in screen.proved[0][1]
    assert screen.measured[0][0] == "bad"


def test_few_episodes_are_never_green():
    screen = first_screen(shipped("pendulum"), rows(0, 50))
    assert screen.kind == "fair"
    assert "this run has too few episodes to confirm it" in screen.headline
    assert "none of 50 (at most 5.82 %)" in screen.more
    assert ("fair", "Episodes that touch U: none of 50 (95 %: at most 5.82 %; must be ≤ 1 %).") in screen.measured
    assert screen.measured[-1] == ("none", "Not measured in this run: what nobody measured.")
    many = requirement_rows([Requirement(f"lost {k}", f"lost {k}", "<=", 0.1, 0.0) for k in range(4)], Evaluation())
    assert first_screen(None, many).measured == [("none", "Not measured in this run: 4 requirements, listed below.")]


def test_a_missed_requirement_is_red_whatever_is_proved():
    screen = first_screen(shipped("pendulum"), rows(60, 3000))
    assert screen.kind == "bad"
    assert "misses requirements" in screen.headline
    assert "1 of 2 requirements is missed" in screen.more


@pytest.mark.parametrize(
    ("reason", "words"), [("EMPTY", "Not safe: no safe set was found"), ("UNDECIDED", "nothing is proved, as the budget was too small")]
)
def test_what_is_not_proved_is_named(reason, words):
    layer = Layer("deterministic", [Statement("not vacuous", "t", PROVED, False, reason=Reason[reason].name)])
    screen = first_screen(Certificate("demo", "", "", 0.0, {"deterministic": layer}))
    assert words in screen.headline
    assert screen.kind != "good"


def test_without_a_certificate_nothing_is_green():
    screen = first_screen(None, rows(0, 3000))
    assert (screen.kind, screen.headline) == ("none", "Measured, without a certificate: nothing is proved.")


@pytest.mark.parametrize(
    ("requirement", "events", "n", "verdict"),
    [
        (TOUCH, 0, 3000, "aim"), (TOUCH, 0, 50, "too few episodes"), (LEAVE, 0, 3000, "none seen"), (TOUCH, 60, 3000, "missed by 0.01"),
        (Requirement("r", "return", ">=", 0.95, 1.0), 10, 10, "too few episodes"), (Requirement("r", "all", ">=", 1.0, 1.0), 10, 10, "all seen"),
        (Requirement("r", "return", ">=", 0.95, 1.0), 400, 400, "aim"),
    ],
)  # fmt: skip
def test_a_verdict_stands_only_where_the_bound_reaches_the_must(requirement, events, n, verdict):
    m = share(requirement.name, events, n)
    said = requirement.verdict(SimpleNamespace(measurements={requirement.name: m}))
    assert bounded(requirement, said, m) == verdict
    assert (badge(bounded(requirement, said, m)).kind == "good") == (verdict == "aim")


def test_nodes_of_a_grid_have_no_bound():
    nodes = dataclasses.replace(share("unsafe_called_safe", 0, 31_816), lower=None, upper=None)
    none, most = Requirement("unsafe_called_safe", "grid of U", "<=", 0.0, 0.0), Requirement("v", "volume", ">=", 0.5, 0.9)
    assert bounded(none, "aim", nodes) == "none seen"
    volume = dataclasses.replace(share("v", 7, 10), lower=None, upper=None)
    assert bounded(most, "must", volume) == "must"
    lines = [_line(row) for row in [(most.label, volume, ">= 0.5", "", "must"), (none.label, nodes, "<= 0", "", "none seen")]]
    assert lines == ["Volume: 70 % of 10 (must be >= 0.5).", "Grid of U: none of 31,816 (must be <= 0)."]


def test_a_set_of_another_level_is_named_and_is_not_the_one_of_the_agent():
    certificate = shipped("pendulum")
    certificate.level = -0.25
    screen = first_screen(certificate, rows(0, 3000), trained=False)
    assert screen.kind != "good"
    assert screen.headline.startswith("Not certified as safe: ")
    assert "never leaves {B <= -0.25}, a part of" in screen.headline
    told = [screen.headline, *(text for _, text in (*screen.proved, *screen.measured))]
    assert not any("B <= 0 " in text or "B <= 0}" in text for text in told if "In this run" not in text)

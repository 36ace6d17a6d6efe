"""Forged and malformed certificates: each is refused for the reason that it was forged for, and none ends in a traceback."""

from __future__ import annotations

import copy
import itertools
import json
import math
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from analytic import SIDE, Line, line_agent
from safetensors.torch import load_file, save_file

from torchrl_sspl.certification.branch_and_bound import Budget
from torchrl_sspl.certification.certificate import Certificate, Reason, configuration_digest, weights_digest
from torchrl_sspl.certification.record import Record
from torchrl_sspl.certification.statistics import paper_layer, statistical_layer
from torchrl_sspl.errors import CheckpointError
from torchrl_sspl.evaluation.certify import Exit, certify, verify_run
from torchrl_sspl.modules.agent import Agent

Body = dict[str, Any]


@pytest.fixture(scope="module")
def issued(tmp_path_factory) -> Path:
    """An agent whose closed loop is known, with a certificate of two blocks of episodes."""
    directory = tmp_path_factory.mktemp("issued")
    agent = line_agent()
    agent.save(directory)
    certify(agent, Line(), name="line", episodes=300, horizon=4, acceptable=0.02).save(directory / "certificate.json")
    return directory


@pytest.fixture(scope="module")
def refuted(tmp_path_factory) -> Path:
    """An agent whose set is not kept, and says so."""
    directory = tmp_path_factory.mktemp("refuted")
    agent = line_agent()
    agent.policy.net[-1].weight.data.mul_(-1.0)
    agent.save(directory)
    certify(agent, None, name="line", level=0.0).save(directory / "certificate.json")
    return directory


def copied(source: Path, target: Path) -> Path:
    for file in source.iterdir():
        (target / file.name).write_bytes(file.read_bytes())
    return target


def verify(directory: Path, **options: Any) -> tuple[int, str]:
    lines: list[str] = []
    began = time.monotonic()
    code = verify_run(directory, report=lines.append, **({"env": Line()} | options))
    assert time.monotonic() - began < 60.0
    return code, "\n".join(lines)


def sealed(body: Body) -> Body:
    """With a digest that fits, as a careful forger would."""
    body["digest"] = configuration_digest({k: v for k, v in body.items() if k != "digest"})
    return body


def read(directory: Path) -> Body:
    return json.loads((directory / "certificate.json").read_text())


def write(directory: Path, body: Body, *, seal: bool = True) -> None:
    (directory / "certificate.json").write_text(json.dumps(sealed(body) if seal else body))


def verdicts(body: Body) -> None:
    """Verdicts as the statements give them."""
    for layer in body["layers"].values():
        layer["verdict"] = Certificate.from_dict.__globals__["Layer"](
            layer["name"], [Certificate.from_dict.__globals__["Statement"](**s) for s in layer["statements"]]
        ).verdict


def statement(body: Body, name: str, layer: str = "deterministic") -> Body:
    return next(s for s in body["layers"][layer]["statements"] if s["name"] == name)


def to(name: str, layer: str = "deterministic", /, **values: Any) -> Callable[[Body], None]:
    def change(body: Body) -> None:
        statement(body, name, layer).update(values)

    return change


def nearly(name: str, layer: str, /) -> Callable[[Body], None]:
    def change(body: Body) -> None:
        found = statement(body, name, layer)
        found["value"] *= 0.995

    return change


def regenerated(change: Callable[[Body], None]) -> Callable[[Body], None]:
    """Changes the record, and lets every measured statement follow from it, as a very careful forger would."""

    def forge(body: Body) -> None:
        change(body["record"])
        record = Record.from_dict(body["record"])
        found = (s["value"] for s in body["layers"]["deterministic"]["statements"] if s["name"] == "tolerated error")
        tolerated = next(found, None)
        layers = statistical_layer(record, tolerated_error=tolerated), paper_layer(record, 1.5)
        for layer in layers:
            body["layers"][layer.name] = json.loads(json.dumps({"name": layer.name, "statements": [vars(s) for s in layer.statements], "verdict": layer.verdict}))

    return forge


def relength(record: Body, steps: int) -> None:
    record["horizon"] = steps
    record["sizes"].update(shortest=steps, median=steps, longest=steps)
    for one in record["blocks"]:
        one["steps"] = steps * one["episodes"]


def block(index: int, **values: int) -> Callable[[Body], None]:
    return regenerated(lambda r: r["blocks"][index].update(values))


def test_the_honest_certificate_is_found_again(issued):
    code, text = verify(issued)
    assert code == Exit.HOLDS, text
    assert text.count("checked again:") == 3
    assert "claimed" not in text


HONEST = [
    {"episodes": episodes, "horizon": horizon, "confidence": confidence, "level": level, "seed": seed}
    for (episodes, horizon), (confidence, level, seed) in itertools.product(
        [(60, 1), (300, 7), (41, 30), (500, 3)],
        [(0.95, None, None), (0.999, 0.0, 17), (0.5, -0.1, 2**31 + 5), (0.9, 0.05, 20260102), (0.99, -0.2, 0)],
    )
]


@pytest.mark.parametrize("settings", [pytest.param(s, marks=pytest.mark.slow if k % 5 != k // 5 else ()) for k, s in enumerate(HONEST)])
def test_honest_certificates_of_any_settings_are_found_again(settings, tmp_path, monkeypatch):
    directory = tmp_path / "pendulum"  # also in a folder with the name of a shipped agent
    agent = line_agent()
    agent.save(directory)
    certificate = certify(agent, Line(), name="line", acceptable=0.5, **settings)
    certificate.save(directory / "certificate.json")
    monkeypatch.chdir(tmp_path)
    assert certificate.layers["deterministic"].verdict, "this is about certificates that hold"
    code, text = verify(directory)
    assert code == Exit.HOLDS, text
    assert text.count("checked again:") == 3


def test_without_the_system_nothing_measured_is_printed_as_checked(issued):
    code, text = verify(issued, env=None)
    assert code == Exit.HOLDS, text
    measured = text[text.index("statistical") :]
    assert "not checked again" in measured
    assert "    measured" not in measured


# --- claims that are not so, in files whose digest and verdicts fit ---------------------------------------------------------

TEXT, NUMBERS, RECORD = Reason.TEXT_CHANGED, Reason.NUMBERS_CHANGED, Reason.RECORD_CHANGED
FORGED: dict[str, tuple[Callable[[Body], Any], Reason]] = {
    # What the weights prove.
    "reworded to any push on the robot": (to("tolerated error", text="the same, whatever push on the physical robot, newton"), TEXT),
    "reworded by one letter": (to("invariance", text="B(z) <= s implies B(d(z, pi(z))) <= s, for any z of the domain"), TEXT),
    "unit newton": (to("tolerated error", unit="newton"), TEXT),
    "n invented": (to("tolerated error", n=10**9), TEXT),
    "confidence invented": (to("invariance", confidence=0.999999), TEXT),
    "detail: holds for the physical robot": (to("invariance", detail="529 boxes, and for the physical robot"), TEXT),
    "detail of a constant": (to("Lipschitz constant", detail="and smooth"), TEXT),
    "detail of the rounding": (to("rounding", detail="slack 1e-12"), TEXT),
    "detail of the tolerated error reworded": (to("tolerated error", detail="for errors above 9 the argument still holds"), TEXT),
    "delta* three times as large": (to("tolerated error", value=0.4), NUMBERS),
    "delta* above its own refutation by a thousandth": (to("tolerated error", value=0.13345), NUMBERS),
    "delta* above the truth, refutation raised too": (
        lambda b: (to("tolerated error", value=0.1336, detail="for errors above 0.14 the argument fails")(b),
                   regenerated(lambda r: None)(b)), NUMBERS),
    "delta* negative and holds": (to("tolerated error", value=-0.1), NUMBERS),
    "delta* missing and holds": (to("tolerated error", value=None), NUMBERS),
    "float32 error above the truth": (to("float32", value=0.1336), NUMBERS),
    "float32 roundings made small": (to("float32", detail="rounding of B at most 1e-12, of d(z, pi(z)) at most 1e-12"), TEXT),
    "Lipschitz constant lowered": (to("Lipschitz constant", value=1.0), NUMBERS),
    "Lipschitz constant lowered in the text": (to("Lipschitz constant", text="B is 1-Lipschitz (exact arithmetic on the deployed weights)"), TEXT),
    "rounding lowered": (to("rounding", value=1e-18), NUMBERS),
    "bound of the risk lowered by half a percent": (nearly("episodes", "statistical"), RECORD),
    "measured called proved": (to("invariance", kind="measured"), TEXT),
    "holds turned to fails": (to("invariance", holds=False, reason="NOT_INVARIANT", misses_by=0.1), NUMBERS),
    "statement added": (lambda b: b["layers"]["deterministic"]["statements"].append(
        statement(b, "invariance") | {"name": "robot", "text": "the robot never falls"}), TEXT),
    "statement removed": (lambda b: b["layers"]["deterministic"]["statements"].pop(4), TEXT),
    "last statement removed": (lambda b: b["layers"]["deterministic"]["statements"].pop(), TEXT),
    "statements in another order": (lambda b: b["layers"]["deterministic"]["statements"].reverse(), TEXT),
    "misses_by beside what holds": (to("domain", misses_by=0.5), NUMBERS),
    "tolerated error called too small, for no reason": (
        to("tolerated error", holds=False, reason="UNDECIDED", misses_by=None), NUMBERS),
    "undecided with a story": (to("invariance", holds=False, reason="UNDECIDED", detail="after 3 weeks on a cluster"), TEXT),
    "undecided with a number": (to("domain", holds=False, reason="UNDECIDED", misses_by=1e-9), TEXT),
    "level lowered under the same statements": (lambda b: b.update(level=-0.05), NUMBERS),
    "level raised": (lambda b: b.update(level=0.05), TEXT),
    # What was measured, with statements edited.
    "risk lowered to 1e-9": (to("episodes", "statistical", value=1e-9), RECORD),
    "n raised to a thousand million": (to("episodes", "statistical", n=10**9), RECORD),
    "confidence raised": (to("episodes", "statistical", confidence=0.999), RECORD),
    "no unsafe state is ever entered": (to("episodes", "statistical", text="no unsafe state is ever entered on the true system"), RECORD),
    "bound of U lowered": (to("unsafe observations", "statistical", value=1e-6), RECORD),
    "counts in the detail changed": (to("episodes", "statistical", detail="left 0; acceptable 1"), RECORD),
    "fresh called measured on more seeds": (to("fresh", "statistical", n=7), RECORD),
    "a measured statement removed": (lambda b: b["layers"]["statistical"]["statements"].pop(0), RECORD),
    "a measured statement added": (lambda b: b["layers"]["statistical"]["statements"].append(
        statement(b, "starts", "statistical") | {"name": "wind", "text": "whatever the wind"}), RECORD),
    "assumptions dropped": (lambda b: b["layers"]["statistical"]["statements"].__delitem__(slice(-2, None)), RECORD),
    "an assumption reworded": (to("starts", "statistical", text="episodes start anywhere"), RECORD),
    "an error reported smaller": (to("error at the rim", "statistical", value=1e-9), RECORD),
    "errors tolerated by more episodes": (to("errors tolerated", "statistical", value=1e-9), RECORD),
    "paper's condition called met": (to("q1", "paper", value=-9.0), RECORD),
    "paper's margin lowered": (to("safety margin", "paper", value=1e-9), RECORD),
    # The record changed, and every statement made to follow from it.
    "record of more latents outside": (block(0, seen=1), RECORD),
    "record with events moved away": (regenerated(lambda r: r["blocks"][0].update(shown=249)), RECORD),
    "seed of the episodes changed": (regenerated(lambda r: r.update(seed=77)), RECORD),
    "horizon raised": (regenerated(lambda r: relength(r, 6)), RECORD),
    "horizon lowered": (regenerated(lambda r: relength(r, 2)), RECORD),
    "horizon raised alone": (regenerated(lambda r: r.update(horizon=6)), RECORD),
    "fewer seeds of the training": (regenerated(lambda r: r.update(used=[3])), RECORD),
    "no seeds of the training": (regenerated(lambda r: r.update(used=None)), RECORD),
    "a smaller error of the dynamics": (regenerated(lambda r: r["numbers"].update(largest_error=1e-9)), RECORD),
    "smaller covering radius": (regenerated(lambda r: r["numbers"].update(covering_radius=1e-6)), RECORD),
    "larger sample of S": (regenerated(lambda r: r["sizes"].update(safe=10**6, safe_met=10**6)), RECORD),
    "lengths of episodes": (regenerated(lambda r: r["sizes"].update(shortest=0)), RECORD),
    "errors of the rim": (regenerated(lambda r: r["rims"][0].__setitem__(2, 1e-9)), RECORD),
    "steps of the rim": (regenerated(lambda r: r["rims"][0].__setitem__(1, 10**6)), RECORD),
    "a part of the set left out": (regenerated(lambda r: r["rims"].pop()), RECORD),
    "labels of the training called compared": (regenerated(lambda r: r["sizes"].update(trained_on=500)), RECORD),
    "an episode more": (regenerated(lambda r: r["sizes"].update(following=10**5, following_met=10**5)), RECORD),
}  # fmt: skip


@pytest.mark.parametrize("name", FORGED)
def test_a_forgery_with_a_fitting_digest_is_refused(name, issued, tmp_path):
    change, reason = FORGED[name]
    directory = copied(issued, tmp_path)
    body = read(directory)
    before = json.dumps(body)
    change(body)
    assert json.dumps(body) != before
    verdicts(body)
    write(directory, body)
    code, text = verify(directory)
    assert code == Exit.REFUSED, text
    assert f"FAILED {reason.name}" in text, text
    assert "OK" not in text


@pytest.mark.parametrize("name", list(FORGED)[::7])
def test_the_same_without_a_fitting_digest_says_so(name, issued, tmp_path):
    directory = copied(issued, tmp_path)
    body = read(directory)
    FORGED[name][0](body)
    verdicts(body)
    write(directory, body, seal=False)
    code, text = verify(directory)
    assert code == Exit.REFUSED
    assert f"FAILED {Reason.DIGEST_CHANGED.name}" in text


def test_a_digest_alone_is_changed(issued, tmp_path):
    directory = copied(issued, tmp_path)
    write(directory, read(directory) | {"digest": "0" * 64}, seal=False)
    code, text = verify(directory)
    assert (code, "DIGEST_CHANGED" in text) == (Exit.REFUSED, True)


# --- counts: what a system that is broken gives cannot be claimed away ------------------------------------------------------

BROKEN = {
    "leaves": (lambda x: torch.where(x.abs() > 0.2, 0.6, x), {"left": 0, "events": 0}),
    "enters U": (lambda x: torch.where(x.abs() > 0.2, 0.95, x), {"left": 0, "entered": 0, "events": 0}),
}


@pytest.mark.parametrize("name", BROKEN)
def test_events_of_the_true_system_are_counted_again(name, issued, tmp_path):
    # The certificate of the good system, verified on the broken one.
    directory, law = copied(issued, tmp_path), BROKEN[name][0]
    code, text = verify(directory, env=Line(law=law))
    assert (code, "RECORD_CHANGED" in text) == (Exit.REFUSED, True), text


@pytest.mark.parametrize("name", BROKEN)
@pytest.mark.parametrize("chosen", [0, 1])
def test_one_lowered_count_is_found_where_its_block_is_measured(name, chosen, tmp_path):
    law, lowered = BROKEN[name]
    agent, env = line_agent(), Line(law=law)
    agent.save(tmp_path)
    certify(agent, env, name="line", episodes=300, horizon=4, acceptable=0.9).save(tmp_path / "certificate.json")
    code, text = verify(tmp_path, env=env)
    assert code == Exit.HOLDS, text
    body = read(tmp_path)
    assert min(body["record"]["blocks"][chosen][k] for k in lowered) > 2
    regenerated(lambda r: r["blocks"][chosen].update(lowered))(body)
    write(tmp_path, body)
    code, text = verify(tmp_path, env=env)
    assert (code, "RECORD_CHANGED" in text) == (Exit.REFUSED, True), text
    assert verify(tmp_path, env=None)[0] == Exit.HOLDS  # nothing is measured, and nothing measured is called checked


@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_a_barrier_that_hovers_hides_no_events(scale, tmp_path):
    # All leave by a hair of the barrier's range: nobody may round them all away.
    agent, env = line_agent(), Line(law=lambda x: torch.full_like(x, 0.50002))
    agent.barrier[-1].weight.data.mul_(scale)
    agent.barrier[-1].bias.data.mul_(scale)
    agent.save(tmp_path)
    certify(agent, env, name="line", level=0.0, episodes=40, horizon=2, acceptable=0.9, budget=Budget(boxes=20_000)).save(
        tmp_path / "certificate.json"
    )
    body = read(tmp_path)
    assert body["record"]["blocks"][0]["left"] == 40
    regenerated(lambda r: r["blocks"][0].update(left=0, events=0))(body)
    write(tmp_path, body)
    code, text = verify(tmp_path, env=env)
    assert (code, "RECORD_CHANGED" in text) == (Exit.REFUSED, True), text


# --- the agent changed under its certificate --------------------------------------------------------------------------------


def resealed(directory: Path, agent: Agent) -> None:
    """Weights and configuration of another agent under the same statements."""
    body, other = read(directory), certify(agent, None, level=0.0)
    body.update(weights=other.weights, configuration=other.configuration)
    write(directory, body)


def swap_encoder(directory: Path) -> None:
    state = load_file(directory / "agent.safetensors")
    state["encoder.scale"] *= 0.5  # everything looks twice as safe
    save_file(state, directory / "agent.safetensors")
    resealed(directory, Agent.load(directory))


def swap_policy(directory: Path) -> None:
    state = load_file(directory / "agent.safetensors")
    state["policy.net.2.weight"] *= -1
    save_file(state, directory / "agent.safetensors")
    resealed(directory, Agent.load(directory))


def describe(directory: Path, *, seal: bool = False, **values: Any) -> None:
    body = json.loads((directory / "agent.json").read_text())
    body.update(values)
    (directory / "agent.json").write_text(json.dumps(body))
    if seal:
        resealed(directory, Agent.load(directory))


AGENTS: dict[str, tuple[Callable[[Path], Any], Reason]] = {
    "encoder and hashes swapped together": (swap_encoder, RECORD),
    "policy and hashes swapped together": (swap_policy, NUMBERS),
    "seeds of the training added": (lambda d: describe(d, seal=True, seeds=[3, 99]), RECORD),
    "Lipschitz bound lowered, hashes fit": (lambda d: describe(d, seal=True, lipschitz_bound=1.2), RECORD),
    "configuration edited": (lambda d: describe(d, config={"seed": 4}), Reason.CONFIGURATION_CHANGED),
    "Lipschitz bound edited": (lambda d: describe(d, lipschitz_bound=1.4), Reason.CONFIGURATION_CHANGED),
    "witness that is worthless": (
        lambda d: describe(d, seal=True, lipschitz={"multipliers": [[1e-3] * 4]}), Reason.TEXT_CHANGED),
    "witness of another size": (lambda d: describe(d, seal=True, lipschitz={"multipliers": [[1.0]]}), Reason.TEXT_CHANGED),
    "witness that is negative": (lambda d: describe(d, seal=True, lipschitz={"multipliers": [[-1.0] * 4]}), Reason.TEXT_CHANGED),
    "witness that is enormous": (lambda d: describe(d, seal=True, lipschitz={"multipliers": [[1e300] * 4]}), Reason.TEXT_CHANGED),
}  # fmt: skip


@pytest.mark.parametrize("name", AGENTS)
def test_another_agent_under_the_same_claims_is_refused(name, issued, tmp_path):
    change, reason = AGENTS[name]
    directory = copied(issued, tmp_path)
    change(directory)
    code, text = verify(directory)
    assert code == Exit.REFUSED, text
    assert f"FAILED {reason.name}" in text, text


UNREADABLE: dict[str, Callable[[Path], Any]] = {
    "multipliers are text": lambda d: describe(d, lipschitz={"multipliers": "many"}),
    "multipliers are numbers": lambda d: describe(d, lipschitz={"multipliers": [1.0]}),
    "a multiplier is text": lambda d: describe(d, lipschitz={"multipliers": [["1"] * 4]}),
    "a multiplier is NaN": lambda d: describe(d, lipschitz={"multipliers": [[math.nan] * 4]}),
    "multipliers are a flag": lambda d: describe(d, lipschitz=True),
    "no weights": lambda d: (d / "agent.safetensors").unlink(),
    "weights are text": lambda d: (d / "agent.safetensors").write_text("weights"),
    "description is no JSON": lambda d: (d / "agent.json").write_text("{"),
    "description is a list": lambda d: (d / "agent.json").write_text("[]"),
    "unknown network": lambda d: describe(d, networks={"encoder": {"class": "Nothing", "arguments": {}}}),
    "format of another version": lambda d: describe(d, format=99),
}


@pytest.mark.parametrize("name", UNREADABLE)
def test_an_agent_that_cannot_be_read_has_an_exit_code_of_its_own(name, issued, tmp_path):
    directory = copied(issued, tmp_path)
    UNREADABLE[name](directory)
    code, text = verify(directory)
    assert code == Exit.AGENT, text
    assert text.startswith("FAILED")


# --- a refutation is not hidden behind a lack of time -----------------------------------------------------------------------


@pytest.mark.parametrize("detail", ["0 boxes, 1 of the domain is left", "1000000 boxes, 0.5 of the domain is left", ""])
def test_a_refutation_replaced_by_undecided_is_refused(refuted, tmp_path, detail):
    directory = copied(refuted, tmp_path)
    assert verify(directory)[0] == Exit.HOLDS
    body = read(directory)
    to("invariance", reason="UNDECIDED", misses_by=None, detail=detail)(body)
    verdicts(body)
    write(directory, body)
    code, text = verify(directory)
    assert (code, "NUMBERS_CHANGED" in text) == (Exit.REFUSED, True), text


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (to("invariance", holds=True, reason="", misses_by=None, detail="529 boxes"), NUMBERS),
        (to("invariance", misses_by=1e-9), NUMBERS),
        (to("invariance", misses_by=None), NUMBERS),
        (to("invariance", reason="MARGIN_TOO_SMALL"), NUMBERS),
        (to("invariance", detail="a counterexample that does not matter"), TEXT),
        (lambda b: b["layers"]["deterministic"]["statements"].pop(4), TEXT),
    ],
)
def test_a_refutation_is_not_made_smaller(refuted, tmp_path, change, reason):
    directory = copied(refuted, tmp_path)
    body = read(directory)
    assert body["layers"]["deterministic"]["statements"][4]["name"] == "invariance"
    change(body)
    verdicts(body)
    write(directory, body)
    code, text = verify(directory)
    assert (code, f"FAILED {reason.name}" in text) == (Exit.REFUSED, True), text


# --- files that are none ----------------------------------------------------------------------------------------------------


def raw(text: str | bytes) -> Callable[[Path, Body], None]:
    data = text if isinstance(text, bytes) else text.encode()
    return lambda file, body: file.write_bytes(data)


def with_(change: Callable[[Body], Any]) -> Callable[[Path, Body], None]:
    def edit(file: Path, body: Body) -> None:
        change(body)
        file.write_text(json.dumps(sealed(body)))

    return edit


def text_edit(old: str, new: str) -> Callable[[Path, Body], None]:
    def edit(file: Path, body: Body) -> None:
        text = file.read_text()
        assert old in text
        file.write_text(text.replace(old, new, 1))

    return edit


def counts(**values: Any) -> Callable[[Path, Body], None]:
    return with_(lambda b: b["record"]["blocks"][0].update(values))


def of_record(**values: Any) -> Callable[[Path, Body], None]:
    return with_(lambda b: b["record"].update(values))


MALFORMED: dict[str, Callable[[Path, Body], Any]] = {
    "empty": raw(""),
    "not JSON": raw("{"),
    "not text": raw(b"\xff\xfe\x00\x01"),
    "a number": raw("1"),
    "a list": raw("[]"),
    "null": raw("null"),
    "nested a hundred thousand times": raw("[" * 100_000),
    "nested a few times too often": with_(lambda b: b["record"].update(system=json.loads("[" * 9 + "]" * 9))),
    "nested objects": raw('{"a":' * 50_000 + "1" + "}" * 50_000),
    "ten megabytes": lambda path, body: path.write_text(path.read_text() + " " * 10_000_000),
    "an integer of ten thousand digits": text_edit('"level": 0.0', f'"level": {"9" * 10_000}'),
    "level NaN": text_edit('"level": 0.0', '"level": NaN'),
    "level Infinity": text_edit('"level": 0.0', '"level": Infinity'),
    "level 1e999": text_edit('"level": 0.0', '"level": 1e999'),
    "level text": with_(lambda b: b.update(level="0")),
    "level a flag": with_(lambda b: b.update(level=False)),
    "a key twice": text_edit('"level": 0.0', '"level": 0.0, "level": -1.0'),
    "schema of the past": with_(lambda b: b.update(schema=1)),
    "schema true": with_(lambda b: b.update(schema=True)),
    "schema 2.0": with_(lambda b: b.update(schema=2.0)),
    "a key too many": with_(lambda b: b.update(approved_by="the authority")),
    "a key too few": with_(lambda b: b.pop("record")),
    "a layer formal": with_(lambda b: b["layers"].update(formal=b["layers"]["deterministic"] | {"name": "formal"})),
    "statistical calls itself deterministic": with_(lambda b: b["layers"]["statistical"].update(name="deterministic")),
    "no deterministic layer": with_(lambda b: b["layers"].pop("deterministic")),
    "no paper layer beside a record": with_(lambda b: b["layers"].pop("paper")),
    "statistical layer without a record": with_(lambda b: b.update(record=None)),
    "layers a list": with_(lambda b: b.update(layers=list(b["layers"].values()))),
    "a layer a list": with_(lambda b: b["layers"].update(paper=[])),
    "a verdict too good": with_(lambda b: b["layers"]["deterministic"].update(verdict="holds, whatever happens")),
    "a statistical statement called proved": with_(to("episodes", "statistical", kind="proved")),
    "a kind unknown": with_(to("invariance", kind="guaranteed")),
    "holds 0": with_(to("invariance", holds=0)),
    "holds 1": with_(to("invariance", holds=1)),
    "holds null where it decides": with_(to("invariance", holds=None)),
    "holds where nothing is decided": with_(to("starts", "statistical", holds=True)),
    "value text": with_(to("tolerated error", value="0.13")),
    "value a list": with_(to("tolerated error", value=[0.13])),
    "value Infinity": text_edit('"value": 1.5', '"value": Infinity'),
    "value minus Infinity": text_edit('"value": 1.5', '"value": -Infinity'),
    "value a flag": with_(to("Lipschitz constant", value=True)),
    "n a float": with_(to("episodes", "statistical", n=300.0)),
    "n negative": with_(to("episodes", "statistical", n=-1)),
    "confidence 1": with_(to("episodes", "statistical", confidence=1.0)),
    "confidence 95": with_(to("episodes", "statistical", confidence=95)),
    "reason unknown": with_(to("invariance", holds=False, reason="BAD_LUCK")),
    "reason beside what holds": with_(to("invariance", reason="UNDECIDED")),
    "no reason where it fails": with_(to("invariance", holds=False)),
    "detail a list": with_(to("invariance", detail=["a"])),
    "text of a megabyte": with_(to("invariance", text="a" * 100_000)),
    "text over two lines": with_(to("invariance", text="a\nOK: everything holds")),
    "text that moves the cursor": with_(to("invariance", text="\x1b[2Ka")),
    "name empty": with_(to("invariance", name="")),
    "a statement twice": with_(lambda b: b["layers"]["deterministic"]["statements"].append(statement(b, "domain"))),
    "a key too many in a statement": with_(to("domain", note="a")),
    "a statement a text": with_(lambda b: b["layers"]["deterministic"]["statements"].append("safe")),
    "a thousand statements": with_(lambda b: b["layers"]["deterministic"].update(statements=1000 * [statement(b, "domain")])),
    "weights no digest": with_(lambda b: b.update(weights="c0ffee")),
    "weights a number": with_(lambda b: b.update(weights=0)),
    "name of two lines": with_(lambda b: b.update(agent="line\nOK")),
    "name a sentence": with_(lambda b: b.update(agent="line: formally verified!")),
    "counts negative": counts(left=-1),
    "counts of a thousand million": counts(episodes=10**9),
    "counts of more episodes than a block": counts(episodes=251),
    "counts that are floats": counts(left=0.0),
    "counts that are flags": counts(left=False),
    "more events than episodes": counts(left=251, events=251),
    "events left out of the sum": counts(left=5),
    "events out of nothing": counts(events=5),
    "aliased without entering U": counts(aliased=2, events=2),
    "more mistaken than shown": counts(mistaken=251),
    "exceeding more than there are": counts(exceeding=400),
    "more episodes than the last block has": with_(lambda b: b["record"]["blocks"][1].update(episodes=51, steps=204)),
    "more steps than its episodes have": with_(lambda b: [one.update(steps=n) for one, n in zip(b["record"]["blocks"], (999, 201), strict=True)]),
    "episodes longer than the horizon": with_(lambda b: b["record"]["sizes"].update(longest=5)),
    "one block too many": with_(lambda b: b["record"]["blocks"].append(b["record"]["blocks"][0])),
    "one block too few": with_(lambda b: b["record"]["blocks"].pop()),
    "no blocks": of_record(blocks=[]),
    "blocks an object": of_record(blocks={}),
    "episodes a thousand million": of_record(episodes=10**9),
    "episodes a million, counts of a few": of_record(episodes=10**6),
    "episodes zero": of_record(episodes=0),
    "horizon negative": of_record(horizon=-5),
    "horizon shorter than its episodes": of_record(horizon=2),
    "confidence of the record 1": of_record(confidence=1.0),
    "acceptable 1": of_record(acceptable=1.0),
    "acceptable 0": of_record(acceptable=0.0),
    "kind of episodes unknown": of_record(kind="dreams"),
    "system unknown": of_record(system="trust me"),
    "seed negative": of_record(seed=-1),
    "seed text": of_record(seed="lucky"),
    "used seeds a text": of_record(used="none"),
    "used seeds of floats": of_record(used=[0.5]),
    "rims of another part": of_record(rims=[["everywhere", 5, 0.0]]),
    "rims of too many": of_record(rims=100 * [["at the rim", 5, 0.0]]),
    "sizes with a key too many": with_(lambda b: b["record"]["sizes"].update(more=1)),
    "more met than measured": with_(lambda b: b["record"]["sizes"].update(safe_met=10**6)),
    "more repeated than episodes": with_(lambda b: b["record"]["sizes"].update(repeated=10**6)),
    "numbers with text": with_(lambda b: b["record"]["numbers"].update(largest_error="small")),
    "record a list": with_(lambda b: b.update(record=[])),
    "record with a key too many": of_record(signed_by="us"),
}  # fmt: skip


@pytest.mark.parametrize("name", MALFORMED)
def test_a_malformed_file_is_no_certificate(name, issued, tmp_path):
    directory = copied(issued, tmp_path)
    MALFORMED[name](directory / "certificate.json", read(directory))
    began = time.monotonic()
    code, text = verify(directory)
    assert time.monotonic() - began < 2.0
    assert code == Exit.MALFORMED, text
    assert text.startswith(f"FAILED {Reason.SCHEMA_UNKNOWN.name}")
    assert len(text) < 1000
    assert text.isprintable()


def test_nesting_is_refused_before_anything_is_parsed(issued, tmp_path):
    directory = copied(issued, tmp_path)
    (directory / "certificate.json").write_text("[" * 9 + "]" * 9)
    assert "levels of nesting" in verify(directory)[1]


def test_no_certificate_and_a_folder_in_its_place_are_told(issued, tmp_path):
    directory = copied(issued, tmp_path)
    (directory / "certificate.json").unlink()
    assert verify(directory)[0] == Exit.MALFORMED
    (directory / "certificate.json").mkdir()
    assert verify(directory)[0] == Exit.MALFORMED


def test_there_are_enough_forgeries():
    assert len(FORGED) + len(AGENTS) + len(UNREADABLE) + len(MALFORMED) >= 160


# --- names and time ---------------------------------------------------------------------------------------------------------


def test_a_run_folder_of_a_shipped_name_is_never_mistaken_for_the_shipped_agent(issued, tmp_path, monkeypatch):
    (tmp_path / "pendulum").mkdir()
    copied(issued, tmp_path / "pendulum")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CheckpointError, match=r"\./pendulum"):
        verify_run("pendulum")
    for path in ("./pendulum", Path("pendulum"), tmp_path / "pendulum"):
        code, text = verify(path)
        assert (code, "Lipschitz" in text) == (Exit.HOLDS, True)
        assert weights_digest(line_agent().state_dict())[:12] in text


def test_what_cannot_be_checked_in_the_time_is_not_called_wrong(issued):
    code, text = verify(issued, seconds=0.02)
    assert code == Exit.TIME, text
    assert "UNDECIDED" in text


def test_the_command_ends_without_a_traceback(issued, tmp_path):
    directory = copied(issued, tmp_path)
    (directory / "certificate.json").write_text("[" * 100_000)
    code = f"import analytic; from torchrl_sspl.cli import main; raise SystemExit(main(['verify', {str(directory)!r}]))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(__file__).parent.parent, check=False)
    assert done.returncode == Exit.MALFORMED, done.stderr
    assert "Traceback" not in done.stdout + done.stderr


def test_a_description_runs_no_code_of_others(issued, tmp_path):
    directory, flag = copied(issued, tmp_path), tmp_path / "ran"
    target = {"_target_": "os.mkdir", "path": str(flag)}
    body = json.loads((directory / "agent.json").read_text())
    body["config"] = {"seed": 3, "env": target}
    (directory / "agent.json").write_text(json.dumps(body))
    resealed(directory, Agent.load(directory))
    changed = read(directory)
    changed["record"]["system"] = "described"
    write(directory, changed)
    code, text = verify(directory, env=None)
    assert code == Exit.HOLDS, text
    assert "not checked again" in text
    assert not flag.exists()


def named_system(directory: Path, **env: Any) -> tuple[int, str]:
    """The same certificate, of an agent that says that its system is one of the library."""
    body = json.loads((directory / "agent.json").read_text())
    body["config"] = {"seed": 3, "env": {"_target_": "torchrl_sspl.envs.PendulumEnv"} | env}
    (directory / "agent.json").write_text(json.dumps(body))
    resealed(directory, Agent.load(directory))
    changed = read(directory)
    changed["record"]["system"] = "described"
    write(directory, changed)
    return verify(directory, env=None)


def test_a_system_of_the_library_is_built_and_measured(issued, tmp_path):
    code, text = named_system(copied(issued, tmp_path), image_size=SIDE)
    assert (code, "RECORD_CHANGED" in text) == (Exit.REFUSED, True), text


def test_a_system_that_cannot_be_built_is_not_called_checked(issued, tmp_path):
    code, text = named_system(copied(issued, tmp_path), max_torque=-1.0)
    assert code == Exit.HOLDS, text
    assert "cannot be built" in text
    assert "    measured" not in text[text.index("statistical") :]


def test_what_breaks_while_it_is_checked_ends_without_a_traceback(issued, tmp_path):
    def broken(state: torch.Tensor) -> torch.Tensor:
        raise RuntimeError("shapes do not fit")

    code, text = verify(copied(issued, tmp_path), env=Line(law=broken))
    assert (code, "shapes do not fit" in text) == (Exit.AGENT, True), text


def test_reading_gives_what_was_written(issued):
    body = read(issued)
    one = Certificate.from_dict(copy.deepcopy(body))
    assert one.to_dict() == body
    assert one.written == one.digest

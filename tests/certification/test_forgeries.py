"""Forged certificates: each is refused for the reason that it was forged for, and none ends in a traceback."""

from __future__ import annotations

import copy
import itertools
import json
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from analytic import SIDE, Line, line_agent
from forging import Body, copied, read, statement, to, verdicts, verify, write
from safetensors.torch import load_file, save_file

from torchrl_sspl.certification.branch_and_bound import Budget
from torchrl_sspl.certification.certificate import Reason, weights_digest
from torchrl_sspl.certification.record import NOTHING, Record
from torchrl_sspl.certification.statistics import paper_layer, run_time_layer, statistical_layer
from torchrl_sspl.errors import CheckpointError
from torchrl_sspl.evaluation import certify as certify_module
from torchrl_sspl.evaluation.blocks import Block, block_changes
from torchrl_sspl.evaluation.certify import Exit, certify, verify_run
from torchrl_sspl.modules.agent import Agent


@pytest.fixture(scope="module")
def refuted(tmp_path_factory) -> Path:
    """An agent whose set is not kept, and says so."""
    directory = tmp_path_factory.mktemp("refuted")
    agent = line_agent()
    agent.policy.net[-1].weight.data.mul_(-1.0)
    agent.save(directory)
    certify(agent, None, name="line", level=0.0).save(directory / "certificate.json")
    return directory


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
        found = (s["value"] for s in body["layers"]["deterministic"]["statements"] if s["name"] == "float32")
        tolerated = next(found, None)
        for layer in (statistical_layer(record), run_time_layer(record, tolerated, watched=False), paper_layer(record, 1.5)):
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
    assert text.count("checked again:") == 4
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
    assert text.count("checked again:") == 4


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
    "delta* zero and holds, which is weaker than the truth and no claim": (
        lambda b: (to("tolerated error", value=0.0)(b), regenerated(lambda r: None)(b)), NUMBERS),
    "delta* missing and holds": (to("tolerated error", value=None), NUMBERS),
    "float32 error above the truth": (
        lambda b: (to("float32", value=0.1336)(b), regenerated(lambda r: None)(b)), NUMBERS),
    "float32 roundings made small": (to("float32", detail="rounding of B at most 1e-12, of d(z, pi(z)) at most 1e-12"), TEXT),
    "Lipschitz constant lowered": (to("Lipschitz constant", value=1.0), NUMBERS),
    "Lipschitz constant lowered in the text": (to("Lipschitz constant", text="B is 1-Lipschitz (exact arithmetic on the deployed weights)"), TEXT),
    "rounding lowered": (to("rounding", value=1e-18), NUMBERS),
    "bound of the risk lowered by half a percent": (nearly("episodes", "statistical"), RECORD),
    "measured called proved": (to("invariance", kind="measured"), TEXT),
    "holds turned to fails": (to("invariance", holds=False, reason="NOT_INVARIANT", misses_by=0.1), RECORD),
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
    "the premise met by more episodes": (to("covered", "run-time", value=1e-9), RECORD),
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
    "covering radius half a percent smaller": (
        regenerated(lambda r: r["numbers"].update(covering_radius=0.995 * r["numbers"]["covering_radius"])), RECORD),
    "larger sample of S": (regenerated(lambda r: r["sizes"].update(safe=10**6, safe_met=10**6)), RECORD),
    "lengths of episodes": (regenerated(lambda r: r["sizes"].update(shortest=0)), RECORD),
    "errors of the rim": (regenerated(lambda r: r["rims"][0].__setitem__(2, 1e-9)), RECORD),
    "steps of the rim": (regenerated(lambda r: r["rims"][0].__setitem__(1, 10**6)), RECORD),
    "a part of the set left out": (regenerated(lambda r: r["rims"].pop()), RECORD),
    "labels of the training called compared": (regenerated(lambda r: r["sizes"].update(trained_on=1)), RECORD),
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


@pytest.mark.parametrize(
    ("name", "chosen"),
    [pytest.param(name, c, marks=pytest.mark.slow if c != k % 2 else ()) for k, name in enumerate(BROKEN) for c in (0, 1)],
)
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
    agent, env = line_agent(), Line(law=lambda x: torch.full_like(x, 0.50002))  # which a picture shows with B = 2.29e-5
    agent.barrier[-1].weight.data.mul_(scale)
    agent.barrier[-1].bias.data.mul_(scale)
    agent.save(tmp_path)
    certify(agent, env, name="line", level=2.2e-5 * scale, episodes=300, horizon=1, acceptable=0.9, budget=Budget(boxes=2000)).save(
        tmp_path / "certificate.json"
    )
    honest = read(tmp_path)
    assert [b["left"] for b in honest["record"]["blocks"]] == [250, 50]
    for taken, refused in (((0, 50), True), ((0, 1), False), ((1, 1), True)):
        left = [250 - taken[0], 50 - taken[1]]
        body = copy.deepcopy(honest)
        regenerated(lambda r, left=left: [b.update(left=n, events=n) for b, n in zip(r["blocks"], left, strict=True)])(body)
        write(tmp_path, body)
        code, text = verify(tmp_path, env=env)
        assert (code, "RECORD_CHANGED" in text) == ((Exit.REFUSED, True) if refused else (Exit.HOLDS, False)), (taken, text)


def test_where_a_search_gave_up_the_rest_is_compared_all_the_same(tmp_path):
    agent, env = line_agent(), Line(law=lambda x: torch.full_like(x, 0.50002))
    agent.barrier[-1].weight.data.mul_(1e-6)  # flatter than the slack by which bounds decide
    agent.barrier[-1].bias.data.mul_(1e-6)
    agent.save(tmp_path)
    certify(agent, None, name="line", level=0.0, budget=Budget(boxes=500)).save(tmp_path / "certificate.json")
    body = read(tmp_path)
    assert statement(body, "invariance")["reason"] == "UNDECIDED"
    assert verify(tmp_path, env=env)[0] == Exit.HOLDS
    to("Lipschitz constant", value=0.5 * statement(body, "Lipschitz constant")["value"])(body)
    write(tmp_path, body)
    code, text = verify(tmp_path, env=env)
    assert (code, "NUMBERS_CHANGED" in text) == (Exit.REFUSED, True), text


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


def kept_after_all(body: Body) -> None:
    """The set is said to be kept, with the bounds on errors that follow."""
    to("invariance", holds=True, reason="", misses_by=None, detail="529 boxes")(body)
    more = [{"name": name, "value": 0.1, "unit": "latent", "detail": "for errors above 0.2 the argument fails"} for name in ("tolerated error", "float32")]
    body["layers"]["deterministic"]["statements"][5:5] = [statement(body, "invariance") | values for values in more]


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
        (kept_after_all, NUMBERS),
        (to("invariance", holds=True, reason="", misses_by=None, detail="529 boxes"), TEXT),
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


def test_there_are_enough_forgeries():
    assert len(FORGED) + len(AGENTS) + len(UNREADABLE) >= 80


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


def test_a_proof_that_does_not_end_is_interrupted(issued, monkeypatch):
    proof = certify_module._proof

    def slow(*arguments: Any) -> Any:
        time.sleep(3.0)
        return proof(*arguments)

    monkeypatch.setattr(certify_module, "_proof", slow)
    began = time.monotonic()
    code, text = verify(issued, env=None, seconds=0.5)
    assert (code, "not checked within" in text) == (Exit.TIME, True), text
    assert time.monotonic() - began < 2.5


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


@pytest.mark.parametrize(
    ("change", "refused"),
    [
        ({}, False),
        ({"steps": -1, "uncovered": -1}, False),  # an episode that ended a step earlier on another machine
        ({"steps": 2}, False),
        ({"steps": 3}, True),
        ({"steps": -3, "uncovered": -3}, True),
        ({"uncovered": -2}, True),
        ({"steps": 2, "uncovered": -2}, True),
    ],
)
def test_a_step_may_be_rounded_away_only_where_episodes_end_early(change, refused):
    found = replace(NOTHING, episodes=3, steps=700, uncovered=700, exceeding=3, events=0)
    steps, none = torch.tensor([200, 100, 400]), torch.zeros(0)
    block = Block(found, found, 0, none, steps, [], [], {}, none, none, none, none, none)
    claimed = replace(found, **{k: getattr(found, k) + v for k, v in change.items()})
    assert bool(block_changes(claimed, block, resets=False)) is refused
    whole = replace(block, steps=torch.full((3,), 400))
    assert bool(block_changes(claimed, whole, resets=False)) is bool(change)

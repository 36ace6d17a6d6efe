"""What a certificate says of the error that its agent tolerates, and what people read of a verification."""

from __future__ import annotations

import json
from typing import Any

import pytest
import torch
from analytic import Line, line_agent
from forging import Body, copied, read, statement, to, verdicts, verify, write

from torchrl_sspl.certification.branch_and_bound import Budget
from torchrl_sspl.certification.certificate import EVERY_WAY, Certificate, Reason, differences
from torchrl_sspl.evaluation import certify as certify_module
from torchrl_sspl.evaluation.certify import Exit, certify, verify_run
from torchrl_sspl.modules import ChoosingPolicy
from torchrl_sspl.modules.agent import Agent, _describe

#: Errors that an agent tolerates and that are not proved: in real numbers, in those that are computed.
TOO_LARGE = {"tolerated error": 0.2, "float32": 0.1}


def cancelling(**description: Any) -> Agent:
    """The same loop with two large terms that cancel: of the error that real numbers tolerate, float32 leaves half."""
    agent, large = line_agent(**description), 1e5
    net = agent.dynamics.net
    net[0].bias.data[0] = large
    net[2].weight.data[0] = torch.tensor([0.8, 0.0, 0.0, 0.0])
    net[2].bias.data[0] = -float(net[2].weight[0, 0]) * large
    agent.tolerated_error = description["tolerated_error"]  # of these weights
    return agent


def _is_said_to_hold(body: Body, name: str) -> None:
    to(name, holds=True, reason="", misses_by=None)(body)


def _is_left_out(body: Body, name: str) -> None:
    layer = body["layers"]["deterministic"]
    layer["statements"] = [s for s in layer["statements"] if s["name"] != name]


@pytest.mark.parametrize("forge", [None, _is_said_to_hold, _is_left_out])
@pytest.mark.parametrize("name", TOO_LARGE)
def test_an_agent_that_tolerates_more_than_is_proved_says_so_or_is_refused(name, forge, tmp_path):
    agent = cancelling(tolerated_error=0.1) if name == "float32" else line_agent(tolerated_error=TOO_LARGE[name])
    agent.save(tmp_path)
    certify(agent, None, name="line").save(tmp_path / "certificate.json")
    body = read(tmp_path)
    assert statement(body, name)["holds"] is False
    if forge is None:
        code, text = verify(tmp_path, env=None)
        assert code == Exit.HOLDS, text
        assert "these layers are not certified: deterministic" in text
        assert "It says nothing of these layers: statistical, run-time" in text
        return
    forge(body, name)
    verdicts(body)
    write(tmp_path, body)
    code, text = verify(tmp_path, env=None)
    assert code == Exit.REFUSED, text


@pytest.mark.parametrize(
    ("detail", "reasons"),
    [("for errors above 0.2 the argument fails", set()), (EVERY_WAY, set()), ("whatever pushes the robot", {Reason.TEXT_CHANGED}), ("", {Reason.TEXT_CHANGED})],
)
def test_a_tolerated_error_is_found_in_one_of_two_ways_and_says_nothing_else(issued, detail, reasons):
    claimed, again = (Certificate.load(issued / "certificate.json") for _ in range(2))
    again.layers["deterministic"]["tolerated error"].detail = EVERY_WAY
    claimed.layers["deterministic"]["tolerated error"].detail = detail
    claimed.written, required = None, claimed.layers["deterministic"]["float32"].value
    for certificate in (claimed, again):
        certificate.layers["deterministic"]["tolerated error"].value = required
    assert set(differences(claimed, again, required=required)) == reasons


def test_where_there_is_no_time_to_look_in_every_direction_nobody_is_called_a_liar(tmp_path, monkeypatch):
    agent = line_agent(tolerated_error=0.1995)  # B = max(z1 + 2, 0) - 2.5, of which the constant 1.5 leaves too little
    first, last = agent.barrier[0], agent.barrier[-1]
    for parameter, values in ((first.weight, [[1.0, 0.0]] + 3 * [[0.0, 0.0]]), (first.bias, [2.0, 0.0, 0.0, 0.0]), (last.weight, [[1.0, 0.0, 0.0, 0.0]]), (last.bias, [-2.5])):
        parameter.data.copy_(torch.tensor(values))
    agent.tolerated_error = 0.1995  # of these weights
    agent.save(tmp_path)
    certificate = certify(agent, None, name="line")
    assert certificate.layers["deterministic"]["tolerated error"].detail == EVERY_WAY
    certificate.save(tmp_path / "certificate.json")
    monkeypatch.setattr("torchrl_sspl.certification.layers._Proof._in_every_way", lambda *_, **__: False)
    code, text = verify(tmp_path, env=None)
    assert (code, "FAILED UNDECIDED" in text) == (Exit.TIME, True), text


def test_level_and_system_are_told_and_nothing_steers_the_terminal(tmp_path):
    agent = line_agent(config={"seed": 3, "env": {"_target_": "my_line:Line", "background": "\x1b[2J"}})
    agent.save(tmp_path)
    certify(agent, Line(), name="line", level=-0.1, episodes=20, horizon=1, acceptable=0.5).save(tmp_path / "certificate.json")
    code, text = verify(tmp_path, env=None)
    assert code == Exit.HOLDS, text
    assert text.startswith("The set {B <= s} has s = -0.1; the agent names the system {")
    agent.description["networks"]["encoder"]["class"] = "\x1b[2J\nOK: the weights are"
    lines = []
    body = json.loads((tmp_path / "agent.json").read_text())
    body["networks"]["encoder"]["class"] = "\x1b[2J\nOK: the weights are"
    (tmp_path / "agent.json").write_text(json.dumps(body))
    assert verify_run(tmp_path, report=lines.append) == Exit.AGENT
    assert all(line.isprintable() for line in lines)


def test_an_error_that_looks_like_a_count_of_blocks_is_none(issued, tmp_path, monkeypatch):
    directory = copied(issued, tmp_path)
    monkeypatch.setattr(certify_module, "_measured_again", lambda *_: ("its system cannot be built here: 12 of 12 blocks, drawn at random", 0))
    code, text = verify(directory)
    assert code == Exit.HOLDS, text
    assert "checked again on" not in text


def test_a_policy_that_accepts_its_own_action_too_early_is_found_again_as_undecided(tmp_path):
    plain = line_agent()
    policy = ChoosingPolicy(plain.policy, [[-2.0], [0.0], [2.0]], 0.1)
    networks = plain.description["networks"] | {"policy": _describe(policy, 2)}
    agent = Agent(plain.encoder, plain.dynamics, plain.barrier, policy, 1.5, plain.description | {"networks": networks})
    agent.save(tmp_path)
    certificate = certify(agent, None, name="line", level=-0.2, budget=Budget(boxes=500))
    assert "accepts its own action" in certificate.layers["deterministic"]["invariance"].detail
    certificate.save(tmp_path / "certificate.json")
    code, text = verify(tmp_path, env=None)
    assert code == Exit.HOLDS, text


def test_what_stands_for_a_number_is_none(issued, tmp_path):
    directory = copied(issued, tmp_path)
    body = read(directory)
    to("tolerated error", detail="for errors above # the argument fails")(body)
    verdicts(body)
    write(directory, body)
    code, text = verify(directory)
    assert (code, "FAILED TEXT_CHANGED" in text) == (Exit.REFUSED, True), text

"""What a run has produced: its text, and one file of numbers that says nothing about the machine."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import pytest
from evaluation.systems import straight_ahead

from torchrl_sspl.certification import Certificate, Layer, Statement
from torchrl_sspl.configs.schema import Config
from torchrl_sspl.envs.system import Requirement, System
from torchrl_sspl.evaluation.measurements import Evaluation, Measurement, share
from torchrl_sspl.evaluation.outcome import Outcome, write_metrics

SYSTEM = System("Cart", ("place [m]",), "force [N]", (
    Requirement("volume", "volume of the set", ">=", 0.5, 0.9),
    Requirement("leave", "episodes that leave", "<=", 0.01, 0.0),
    Requirement("walks", "walks that fall", "<=", 0.0, 0.0),
))  # fmt: skip


@dataclass
class Check:
    round: int
    passed: bool


def evaluation(volume: float, left: int) -> Evaluation:
    out = Evaluation()
    out.add(Measurement("volume", volume, "share", 50))
    out.add(share("leave", left, 1000))
    return out


def outcome(directory, **changes) -> Outcome:
    config = Config(out_dir=str(directory), agent=str(directory / "before" / "agent"), env={"_target_": "a.B", "size": 8})
    layers = {"deterministic": Layer("deterministic", [Statement("s", "s", "proved", True)])}
    given = Outcome(
        directory, straight_ahead(), config, SYSTEM, {"own": evaluation(0.7, 20), "gymnasium": evaluation(0.4, 0)},
        Certificate("a", "w", "c", 0.0, layers), 61.0, [Check(0, True)], "all phases are done", {"transitions": 5},
        ["the light is off"], ["more data"],
    )  # fmt: skip
    return replace(given, **changes)


def test_the_summary_is_the_table_of_requirements(tmp_path):
    lines = outcome(tmp_path).summary().splitlines()
    assert lines[0].startswith("volume of the set")
    assert lines[0].endswith("must >= 0.5    must")
    assert lines[1].endswith("missed by 0.01")
    assert "0.02 (n = 1,000, 95 % bound 0.031)" in lines[1]
    assert "not measured" in lines[2]
    assert lines[3].startswith("volume of the set, gymnasium frames")
    assert lines[3].endswith("missed by 0.1")
    assert lines[4].endswith("aim")
    assert len([line for line in lines if "walks" in line]) == 1  # of other frames only what was measured there
    assert lines[5].startswith("certificate, deterministic layer: ")
    assert lines[6:] == ["training: 61 s; all phases are done", "warning: the light is off", "to try: more data"]


def test_without_requirements_it_says_what_was_measured(tmp_path):
    out = Evaluation()
    out.add(share("touch_unsafe", 3, 100))
    out.missing("leave")
    found = outcome(tmp_path, system=None, evaluations={"own": out}, certificate=None, seconds=None, warnings=[], advice=[])
    assert found.summary().splitlines() == [
        "episodes from B <= 0 that touch U, under the policy: 3.00% (3 of 100), 95 % bounds 0.62% to 8.52%",
        "episodes from B <= 0 that leave it, under the policy: not measured",
    ]
    assert found.rows() == []


def test_metrics_have_a_schema_and_everything_that_was_measured(tmp_path):
    found = outcome(tmp_path)
    body = json.loads(write_metrics(found).read_text())
    assert body["schema"] == 1
    assert body["measurements"]["own"]["leave"]["events"] == 20
    assert body["measurements"]["gymnasium"]["volume"]["value"] == 0.4
    assert body["verdicts"]["volume of the set"] == "must"
    assert [Requirement(**r) for r in body["requirements"]] == list(SYSTEM.requirements)
    assert body["checks"] == [{"round": 0, "passed": True}]
    assert (body["budget"], body["warnings"], body["training_seconds"]) == ({"transitions": 5}, ["the light is off"], 61.0)
    assert body["config"]["network"]["latent_dim"] == 3


def test_no_path_of_the_machine_is_written(tmp_path):
    (tmp_path / "agent").mkdir()
    found = outcome(tmp_path)
    text = write_metrics(found).read_text()
    assert str(tmp_path) not in text
    assert "out_dir" not in text
    assert json.loads(text)["config"]["agent"].startswith("agent-")  # a hash tells folders of one name apart
    assert json.loads(text)["config"]["env"] == {"_target_": "a.B", "size": 8}


@pytest.mark.parametrize("trained", [True, False])
def test_the_same_lies_beside_an_agent_just_trained(tmp_path, trained):
    (tmp_path / "agent").mkdir()
    path = write_metrics(outcome(tmp_path, seconds=1.0 if trained else None))
    beside = tmp_path / "agent" / "evaluation.json"
    assert beside.is_file() == trained
    assert not trained or beside.read_text() == path.read_text()


def test_few_episodes_without_an_event_are_no_aim_and_what_is_no_number_is_null(tmp_path):
    few = evaluation(0.7, 0)
    few.add(share("leave", 0, 20))
    few.add(Measurement("walks", float("nan"), "share"))
    found = outcome(tmp_path, evaluations={"own": few})
    assert found.rows()[1][-1] == "too few episodes"
    body = json.loads(write_metrics(found).read_text(), parse_constant=pytest.fail)
    assert body["verdicts"]["episodes that leave"] == "too few episodes"
    assert body["measurements"]["own"]["walks"]["value"] is None

"""Whose a certificate is: of which weights, of which states, and of whom its seeds are."""

from __future__ import annotations

from typing import Any

import torch
from analytic import Line, line_agent
from torch import Tensor

from torchrl_sspl.certification.branch_and_bound import Budget
from torchrl_sspl.certification.certificate import Reason
from torchrl_sspl.evaluation.beside import certificate_beside
from torchrl_sspl.evaluation.certify import Exit, certify, issue, verify_run
from torchrl_sspl.seeds import spawn

SHORT = Budget(boxes=50)  # where no proof is asked for


class Half(Line):
    """Draws one half of its states alone, and says so."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.among = "to the right of the middle"

    def sample_states(self, n: int, generator: torch.Generator | None = None, **options: Any) -> Tensor:
        return super().sample_states(n, generator, **options).abs()


def test_which_states_are_drawn_is_said_and_compared(tmp_path):
    agent = line_agent()
    agent.save(tmp_path)
    certificate = certify(agent, Half(), name="line", episodes=20, horizon=1, acceptable=0.4, budget=SHORT)
    said = [s.text for s in certificate.layers["statistical"].statements if "to the right of the middle" in s.text]
    assert len(said) == 2  # the observations of U, and the starts
    certificate.save(tmp_path / "certificate.json")
    lines: list[str] = []
    assert verify_run(tmp_path, env=Line(), report=lines.append) == Exit.REFUSED
    assert "'to the right of the middle', the system draws states ''" in lines[-1]
    assert verify_run(tmp_path, env=Half(), report=lines.append) == Exit.HOLDS


def test_an_agent_that_was_changed_is_measured_on_other_episodes(tmp_path):
    agent = line_agent()
    agent.save(tmp_path)
    certify(agent, Line(), name="line", episodes=20, horizon=1, budget=SHORT).save(tmp_path / "certificate.json")
    with torch.no_grad():
        agent.policy.net[-1].weight.mul_(0.99)
    agent.save(tmp_path)
    again = issue(tmp_path, Line(), budget=SHORT)
    assert again.record is not None
    assert again.record.seed == 4
    assert spawn(3, "certificate", 0) in (again.record.used or ())
    assert Reason.CALIBRATION_REUSED not in again.reasons


def test_a_certificate_is_shown_beside_its_own_agent_alone(tmp_path):
    agent = line_agent()
    agent.save(tmp_path)
    assert certificate_beside(tmp_path, agent) == (None, "")
    path = certify(agent, None, name="line", level=0.0, budget=SHORT).save(tmp_path / "certificate.json")
    assert certificate_beside(tmp_path, agent)[1] == ""
    written = path.read_text()
    path.write_text(written.replace('"agent": "line"', '"agent": "mine"'))
    found, why = certificate_beside(tmp_path, agent)
    assert found is None
    assert "changed after it was written" in why
    path.write_text("{}")
    assert "cannot be read" in certificate_beside(tmp_path, agent)[1]
    path.write_text(written)
    agent.description["seeds"] = [5]
    assert "configuration" in certificate_beside(tmp_path, agent)[1]
    with torch.no_grad():
        agent.policy.net[-1].weight.neg_()
    found, why = certificate_beside(tmp_path, agent)
    assert found is None
    assert "the weights are not those that were certified; issue it again" in why

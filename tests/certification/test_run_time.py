"""Broken twins of what the proof says at run time: gain, tolerated error, dynamics and counts that are not those certified."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from analytic import Line, line_agent
from forging import copied, read, statement, to, verify, write
from safetensors.torch import load_file, save_file
from torch import nn

from torchrl_sspl.certification.conditions import largest_error, tolerates
from torchrl_sspl.certification.loop import closed_loop
from torchrl_sspl.evaluation.blocks import counted, holds_at
from torchrl_sspl.evaluation.certify import Exit, certify
from torchrl_sspl.evaluation.simulation import Episodes
from torchrl_sspl.modules.observer import gain_matrix


@pytest.fixture(scope="module")
def observed(tmp_path_factory) -> Path:
    """The agent whose closed loop is known behind an observer, its monitor set to an error of 0.1, with a certificate."""
    directory = tmp_path_factory.mktemp("observed")
    agent = line_agent(tolerated_error=0.1)
    agent.gain = gain_matrix(0.5, 2)
    agent.tolerated_error = 0.1  # of this agent
    agent.save(directory)
    certify(agent, Line(), name="line", episodes=300, horizon=4, acceptable=0.02).save(directory / "certificate.json")
    return directory


def weights(change: Callable[[dict[str, torch.Tensor]], dict[str, torch.Tensor]]) -> Callable[[Path], None]:
    return lambda path: save_file(change(load_file(path / "agent.safetensors")), path / "agent.safetensors")


def description(**values: Any) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        body = json.loads((path / "agent.json").read_text())
        (path / "agent.json").write_text(json.dumps(body | values))

    return change


def certificate(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    def forge(path: Path) -> None:
        body = read(path)
        change(body)
        write(path, body)

    return forge


TWINS: dict[str, tuple[Callable[[Path], None], str]] = {
    "gain raised": (weights(lambda w: w | {"gain": torch.eye(2)}), "WEIGHTS_CHANGED"),
    "gain too small": (weights(lambda w: w | {"gain": 1e-3 * torch.eye(2)}), "WEIGHTS_CHANGED"),
    "gain left out": (weights(lambda w: {k: v for k, v in w.items() if k != "gain"}), "WEIGHTS_CHANGED"),
    "gain in another direction": (weights(lambda w: w | {"gain": torch.diag(torch.tensor([0.5, 0.4]))}), "WEIGHTS_CHANGED"),
    "gain that is none": (weights(lambda w: w | {"gain": torch.zeros(2, 2)}), "gain"),
    "gain that is no number": (weights(lambda w: w | {"gain": torch.full((2, 2), torch.nan)}), "cannot be read"),
    "biased dynamics": (weights(lambda w: w | {"dynamics.net.2.bias": w["dynamics.net.2.bias"] + 0.05}), "WEIGHTS_CHANGED"),
    "monitor that tolerates more": (description(tolerated_error=0.12), "CONFIGURATION_CHANGED"),
    "monitor that tolerates less": (description(tolerated_error=0.05), "CONFIGURATION_CHANGED"),
    "monitor switched off": (description(tolerated_error=0.0), "CONFIGURATION_CHANGED"),
    "monitor that is none": (description(tolerated_error="0.1"), "cannot be read"),
    "premise met more often": (certificate(to("covered", "run-time", value=1e-6)), "RECORD_CHANGED"),
    "premise in other words": (certificate(to("premise", "run-time", text="nothing is assumed")), "RECORD_CHANGED"),
    "steps covered that were not": (certificate(to("steps covered", "run-time", text="steps: 1200 of 1200")), "RECORD_CHANGED"),
    "uncovered steps forgotten": (
        certificate(lambda b: [one.update(exceeding=0, uncovered=0) for one in b["record"]["blocks"]]), "RECORD_CHANGED"),
    "layer left out": (certificate(lambda b: b["layers"].pop("run-time")), "SCHEMA_UNKNOWN"),
    "proved in the layer of what is measured": (certificate(to("covered", "run-time", kind="proved")), "SCHEMA_UNKNOWN"),
}  # fmt: skip


def test_the_honest_one_is_found_again(observed):
    code, text = verify(observed)
    assert code == Exit.HOLDS, text
    assert "run-time" in text


@pytest.mark.parametrize("name", TWINS)
def test_a_broken_twin_is_refused(name, observed, tmp_path):
    change, reason = TWINS[name]
    if name == "uncovered steps forgotten" and not sum(b["uncovered"] for b in read(observed)["record"]["blocks"]):
        change = certificate(lambda b: statement(b, "covered", "run-time").update(n=299))
    path = copied(observed, tmp_path)
    change(path)
    code, text = verify(path)
    assert code in (Exit.REFUSED, Exit.MALFORMED, Exit.AGENT), text
    assert reason in text


def test_steps_are_covered_where_memory_and_observation_lie_in_the_set():
    """Three episodes of two steps: covered; the memory leaves, which an error cannot excuse; a picture lies outside."""
    barrier = torch.tensor([[-1.0, -1.0, -1.0], [-1.0, 0.5, -1.0], [-1.0, -1.0, -1.0]])
    seen = torch.tensor([[-1.0, -1.0, -1.0], [-1.0, -1.0, -1.0], [-1.0, -1.0, 0.5]])
    none, error = torch.zeros(3, 3, 1), torch.full((2, 3), 5.0)
    run = Episodes(
        latent=none, region=torch.zeros(3, 3, dtype=torch.int64), alive=torch.ones(3, 3, dtype=torch.bool),
        prediction_error=error, barrier=barrier, seen=seen, innovation=none, actions=torch.zeros(2, 3, 1),
    )  # fmt: skip
    found = counted(run, 0.0, 0.1, held=True)[0]
    assert (found["exceeding"], found["uncovered"]) == (2, 2)
    assert counted(run, 0.0, 0.1)[0]["uncovered"] == 6  # without a memory that is held, the error counts


def test_corrections_are_held_at_level_zero():
    agent = line_agent(tolerated_error=0.1)
    assert not holds_at(agent, 0.0)
    agent.gain = gain_matrix(0.5, 2)
    agent.tolerated_error = 0.1  # of this agent
    assert holds_at(agent, 0.0)
    assert not holds_at(agent, -0.1)


def test_a_monitor_beyond_the_proof_is_not_certified():
    certificate = certify(line_agent(tolerated_error=0.2), Line(), episodes=50, horizon=2)
    assert certificate.layers["deterministic"]["tolerated error"].reason == "MARGIN_TOO_SMALL"
    assert certificate.layers["run-time"].reasons[0].name == "NOTHING_TOLERATED"


def test_errors_in_every_direction_are_what_dense_samples_find():
    """B rises by 1 along the first axis, and its Lipschitz constant is claimed to be 3: only the bounds see the difference."""
    plant = nn.Sequential(nn.Linear(3, 2, bias=False))
    nn.utils.vector_to_parameters(torch.tensor([0.5, 0.0, 0.0, 0.0, 0.5, 0.0]), plant.parameters())
    barrier, policy = nn.Sequential(nn.Linear(2, 1)), nn.Sequential(nn.Linear(2, 1))
    nn.utils.vector_to_parameters(torch.tensor([1.0, 0.0, -0.5]), barrier.parameters())
    loop = closed_loop(barrier, plant, policy, latent_dim=2, lipschitz_bound=3.0)
    assert largest_error(loop).delta == pytest.approx(0.25 / 3, abs=1e-3)
    assert [tolerates(loop, error).status for error in (0.249, 0.251)] == ["proved", "refuted"]


@pytest.mark.parametrize("seed", range(6))
def test_no_error_that_is_proved_to_be_tolerated_leads_out(seed):
    torch.manual_seed(seed)
    barrier = nn.Sequential(nn.Linear(2, 8), nn.ReLU(), nn.Linear(8, 1))
    plant, policy = nn.Sequential(nn.Linear(3, 6), nn.ReLU(), nn.Linear(6, 2)), nn.Sequential(nn.Linear(2, 1))
    with torch.no_grad():
        barrier[2].bias -= barrier(torch.rand(200, 2) * 2 - 1).median()
        plant[2].weight *= 0.3
    loop = closed_loop(barrier, plant, policy, latent_dim=2, lipschitz_bound=50.0)
    grid = torch.cartesian_prod(*[torch.linspace(-1, 1, 101, dtype=torch.float64)] * 2)
    inside = grid[loop.barrier(grid)[:, 0] <= 0]
    angle = torch.arange(32, dtype=torch.float64) * (2 * torch.pi / 32)
    circle = torch.stack([angle.cos(), angle.sin()], 1)
    after = loop.step(inside).clamp(-1, 1)
    for error in (0.01, 0.05, 0.1):
        worst = max(float(loop.barrier((after + error * e).clamp(-1, 1)).max()) for e in circle)
        status = tolerates(loop, error).status
        assert not (status == "proved" and worst > 1e-6), (error, worst)
        assert not (status == "refuted" and worst < -0.5), (error, worst)

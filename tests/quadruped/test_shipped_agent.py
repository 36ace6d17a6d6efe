"""The shipped agent keeps away from the obstacle on the model and in full physics, and its certificate says the truth."""

from __future__ import annotations

import json

import pytest
import torch

import torchrl_sspl as sspl
from torchrl_sspl.certification import Budget, Certificate
from torchrl_sspl.configs import compose
from torchrl_sspl.envs.dubins import YAW_LAG, DubinsEnv
from torchrl_sspl.envs.system import Requirement, bounded
from torchrl_sspl.evaluation import simulate, verify_run
from torchrl_sspl.evaluation.beside import CERTIFICATE_FILE
from torchrl_sspl.evaluation.certify import _is_proved
from torchrl_sspl.evaluation.known import encode_states
from torchrl_sspl.evaluation.measurements import Evaluation, Measurement, share
from torchrl_sspl.modules.agent import agent_directory


@pytest.fixture(scope="module")
def agent():
    return sspl.load("quadruped")


@pytest.mark.parametrize("yaw_lag", [pytest.param(None, marks=pytest.mark.slow), YAW_LAG])
def test_on_the_model_it_tells_the_labels_apart_and_stays_out_of_the_unsafe_set(agent, yaw_lag):
    env, generator = DubinsEnv(batch_size=[1], yaw_lag=yaw_lag), torch.Generator().manual_seed(411)
    unsafe = env.sample_states(200, generator, region=env.unsafe_set)
    safe = env.sample_states(200, generator, region=env.safe_set)
    assert bool((agent.barrier(encode_states(agent, env, unsafe)) > 0).all())
    outside = agent.barrier(encode_states(agent, env, safe)) > 0
    assert float(outside.float().mean()) <= agent.description["config"]["synthesis"]["safe_share"]
    states = env.sample_states(200, generator, region=env.state_space - env.unsafe_set)
    inside = states[agent.barrier(encode_states(agent, env, states))[:, 0] <= 0]
    assert len(inside) > 150
    episodes = simulate(agent, env, start=inside, horizon=20)
    assert not bool(env.unsafe_set.contains(episodes.states).any())


@pytest.mark.parametrize("start", [(-1.9, 0.0, 0.0), (1.6, 0.3, 3.1), (0.2, -1.6, 1.6)])
def test_the_robot_walks_past_an_obstacle_ahead(agent, start):
    world = DubinsEnv(batch_size=[1]).physics()()
    try:
        found = simulate(agent, world, start=torch.tensor([start]), horizon=60)
    finally:
        world.close()
    assert {name: bool(seen[0]) for name, seen in found.events.items()} == {
        "left": True, "entered": False, "hit": False, "fallen": False,
    }  # fmt: skip


@pytest.fixture(scope="module")
def certificate():
    return Certificate.load(agent_directory("quadruped") / CERTIFICATE_FILE)


def test_it_tolerates_what_its_certificate_claims(agent, certificate):
    claimed = next(s.value for s in certificate.layers["deterministic"].statements if s.name == "float32")
    assert claimed >= agent.tolerated_error > 0


@pytest.mark.slow
def test_its_computed_set_is_proved_to_tolerate_what_is_claimed(agent):
    assert _is_proved(agent, 0.0, "float32", agent.tolerated_error, Budget())


def test_its_certificate_covers_the_episodes(certificate):
    assert [name for name, layer in certificate.layers.items() if layer.holds] == ["deterministic", "statistical", "run-time"]
    covered = next(s for s in certificate.layers["run-time"].statements if s.name == "covered")
    assert covered.n == 3000
    body = json.loads((agent_directory("quadruped") / "evaluation.json").read_text())
    assert body["measurements"]["own"]["walks_from_set_covered"]["value"] >= 0.8


@pytest.mark.slow
def test_its_certificate_is_found_again():
    lines: list[str] = []
    assert verify_run("quadruped", report=lines.append) == 0
    upper = lines[: next(k for k, line in enumerate(lines) if line.startswith("paper"))]
    assert any("proved" in line for line in upper)
    assert not any("FAILS" in line for line in upper)


def test_its_evaluation_names_settings_and_seed():
    body = json.loads((agent_directory("quadruped") / "evaluation.json").read_text())
    assert body["schema"] == 1
    assert body["seed"] == 0
    assert body["preset"] == "sound"
    assert body["measurements"]["own"]["walks_from_set_enter"]["n"] == 200
    assert body["config"]["env"]["yaw_lag"] == list(YAW_LAG)


@pytest.mark.parametrize("name", ["pendulum", "quadruped"])
def test_verdicts_beside_an_agent_are_those_of_its_measurements(name):
    body = json.loads((agent_directory(name) / "evaluation.json").read_text())
    expected = {}
    for where, found in body["measurements"].items():
        measured = Evaluation({key: Measurement(**value) for key, value in found.items()})
        for asked in body["requirements"]:
            requirement = Requirement(*(asked[key] for key in ("name", "label", "sense", "must", "aim")))
            if where == "own" or requirement.name in found:
                label = requirement.label + ("" if where == "own" else f", {where} frames")
                expected[label] = bounded(requirement, requirement.verdict(measured), measured.measurements.get(requirement.name))
    assert body["verdicts"] == expected


def test_a_run_has_as_many_walks_as_its_requirement_asks_for():
    (must,) = [r.must for r in DubinsEnv(image_size=32).system.requirements if r.name == "walks_from_set_enter"]
    assert share("walks", 0, compose(["env=quadruped"]).evaluation.walks).upper <= must

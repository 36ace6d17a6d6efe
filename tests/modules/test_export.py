"""Exported agents compute what the library computes, in a process without torch, too."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import CertificationError, ConfigError
from torchrl_sspl.modules.agent import load
from torchrl_sspl.modules.export import INPUTS, OUTPUTS, DeployedStep, _about, _compare, _drawn, _steps
from torchrl_sspl.modules.observer import corrected


@pytest.fixture(scope="module")
def onnx_file(tmp_path_factory) -> Path:
    return load("pendulum").export(tmp_path_factory.mktemp("onnx") / "pendulum.onnx", check=16)


def test_steps_are_those_of_the_controller():
    agent, env = load("pendulum"), PendulumEnv(batch_size=[8], seed=3)
    step, controller = DeployedStep(agent), agent.controller(8)
    latent, action, begins = torch.zeros(8, 3), torch.zeros(8, 1), torch.ones(8, dtype=torch.bool)
    applies = torch.ones(8, dtype=torch.bool)
    data = env.reset()
    with torch.no_grad():
        for _ in range(15):
            out = controller.step(data["pixels"])
            action, barrier, _, innovation, met, latent = step(data["pixels"], latent, action, begins)
            begins, applies = torch.zeros(8, dtype=torch.bool), applies & met
            assert torch.equal(action, out.action)
            assert torch.equal(barrier, out.barrier)
            assert torch.allclose(innovation, out.innovation)
            assert torch.equal(applies, out.applies)
            data = env.step(data.set("action", action))["next"].exclude("reward")


def test_corrections_are_held_in_the_set_as_the_controller_holds_them():
    agent, env = load("pendulum"), PendulumEnv(batch_size=[1], seed=3)
    states = env.sample_states(256)
    first = torch.cat([env.draw(env.previous_state(states)), env.draw(states)], 1)
    second = first.roll(1, 0)  # of another state each: large corrections
    step, controller = DeployedStep(agent), agent.controller(256)
    before = controller.step(first)
    out = controller.step(second)
    with torch.no_grad():
        latent = step(second, before.latent, before.action, torch.zeros(256, dtype=torch.bool))[-1]
        loose = corrected(agent.dynamics(before.latent, before.action), agent.encode(second), agent.gain)[0]
    assert torch.equal(latent, out.latent)
    assert not torch.equal(latent, loose)


@pytest.mark.parametrize("n", [1, 500])
def test_onnx_computes_the_same_for_any_batch(onnx_file, n):
    onnxruntime = pytest.importorskip("onnxruntime")
    agent = load("pendulum")
    given = _steps(agent, n, 7)
    with torch.no_grad():
        wanted = dict(zip(OUTPUTS, DeployedStep(agent)(**given), strict=True))
    session = onnxruntime.InferenceSession(str(onnx_file), providers=["CPUExecutionProvider"])
    assert tuple(i.name for i in session.get_inputs()) == INPUTS
    found = dict(zip(OUTPUTS, session.run(None, {k: v.numpy() for k, v in given.items()}), strict=True))
    assert np.abs(found["next_action"] - wanted["next_action"].numpy()).max() <= 1e-4 * 20
    assert np.abs(found["barrier"] - wanted["barrier"].numpy()).max() <= 1e-4
    assert np.mean(found["met"] == wanted["met"].numpy()) > 0.99  # those that are close may be rounded


def test_the_file_says_what_it_is(onnx_file):
    onnx = pytest.importorskip("onnx")
    about = {p.key: json.loads(p.value) for p in onnx.load(onnx_file).metadata_props}
    assert about["pixels"] == [6, 64, 64]
    assert about["action_scale"] == [10.0]
    assert about["tolerated_error"] == load("pendulum").tolerated_error
    assert about["dt"] == PendulumEnv().dt


@pytest.mark.parametrize(
    ("description", "period"),
    [
        ({"environment": "PendulumEnv"}, 0.05),
        ({"config": {"env": {"_target_": "torchrl_sspl.envs.PendulumEnv", "dt": 0.02}}}, 0.02),
        ({"config": {"env": {"_target_": "my_system:Cart", "dt": 1}}}, 1.0),  # its code is not run
        ({"config": {"env": {"_target_": "my_system:Cart"}}}, None),
        ({"config": {"env": {"made by": "my.make", "dt": "half"}}}, None),
        ({"config": 3}, None),
        ({"dt": 0.1, "config": {"env": {"_target_": "my_system:Cart"}}}, 0.1),  # as a run of a system in code says it
        ({}, None),
    ],
)
def test_the_period_is_told_where_the_description_says_it(description, period):
    agent = load("pendulum")
    agent.description = description
    assert _about(agent).get("dt") == period


def test_the_shipped_agents_say_their_periods():
    assert [_about(load(name))["dt"] for name in ("pendulum", "quadruped")] == [0.05, 0.1]


@pytest.mark.slow  # files of ONNX are
def test_programmes_of_torch_are_checked_too(tmp_path):
    agent = load("pendulum")
    assert agent.export(tmp_path / "deep" / "agent.pt2", check=8).is_file()
    other = load("pendulum")
    with torch.no_grad():
        other.policy.action_scale.mul_(1.01)
    with pytest.raises(CertificationError, match="exported"):
        _compare(DeployedStep(other), (tmp_path / "deep" / "agent.pt2").read_bytes(), ".pt2", 8)


@pytest.fixture(scope="module")
def programme(tmp_path_factory):
    return load("pendulum").export(tmp_path_factory.mktemp("programme") / "agent.pt2", check=0).read_bytes()


@pytest.mark.parametrize(("name", "changed"), [("next_latent", 0.0), ("seen_barrier", -100.0), ("innovation", 0.3), ("met", True), ("met", False)])
def test_all_that_comes_out_is_checked(programme, monkeypatch, name, changed):
    right = DeployedStep.forward

    def wrong(self, **given):
        found = dict(zip(OUTPUTS, right(self, **given), strict=True))
        return tuple((found | {name: torch.full_like(found[name], changed)}).values())

    monkeypatch.setattr(DeployedStep, "forward", wrong)
    with pytest.raises(CertificationError, match=f"'{name}': [^0]|'{name}': 0.[0-9]*[1-9]"):
        _compare(DeployedStep(load("pendulum")), programme, ".pt2", 256)


@pytest.mark.slow
def test_a_file_that_is_refused_does_not_replace_one_that_is_right(tmp_path, monkeypatch):
    agent, path = load("pendulum"), tmp_path / "agent.pt2"
    agent.export(path, check=8)
    before = path.read_bytes()
    agent.barrier[-1].bias.data += 0.1
    monkeypatch.setattr("torchrl_sspl.modules.export._TOLERANCE", -1.0)
    with pytest.raises(CertificationError):
        agent.export(path, check=8)
    assert path.read_bytes() == before


def test_the_callers_agent_is_not_touched(tmp_path):
    agent = load("pendulum").train()
    agent.export(tmp_path / "agent.pt2", check=0)
    assert agent.training
    assert agent.policy.training


def test_pictures_have_the_size_that_is_asked_for_where_the_encoder_takes_any(tmp_path):
    agent = load("pendulum")
    with pytest.raises(ConfigError, match=r"image_size=\(64, 64\), the one size .* received \(48, 48\)"):
        agent.export(tmp_path / "agent.pt2", image_size=48)
    agent.encoder.image_size = None
    step = torch.export.load(agent.export(tmp_path / "agent.pt2", check=8, image_size=(48, 80))).module()
    frames = torch.zeros(3, 6, 48, 80, dtype=torch.uint8)
    assert len(step(frames, torch.zeros(3, 3), torch.zeros(3, 1), torch.ones(3, dtype=torch.bool))) == len(OUTPUTS)
    assert agent.encoder.image_size is None


def test_another_suffix_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"\.onnx or \.pt2"):
        load("pendulum").export(tmp_path / "agent.pth")


@pytest.mark.parametrize("name", ["pendulum", "quadruped"])
def test_the_pictures_that_a_file_is_compared_on_lie_on_both_sides(name):
    agent = load(name)
    pictures = _drawn(agent, 64, 1)
    inside = agent.barrier(agent.encode(pictures)) <= 0.0
    assert 4 < int(inside.sum()) < 60
    agent.description = {}
    assert _drawn(agent, 64, 1) is None


def test_a_file_that_never_meets_the_premise_is_noticed(monkeypatch):
    step = DeployedStep(load("quadruped"))

    def never(*given):
        found = dict(zip(OUTPUTS, step(*given), strict=True))
        return tuple((found | {"met": torch.zeros_like(found["met"])}).values())

    monkeypatch.setattr(torch.export, "load", lambda file: SimpleNamespace(module=lambda: never))
    with pytest.raises(CertificationError, match=r"'met': 0\.[0-9]*[1-9]"):
        _compare(step, b"", ".pt2", 64)

"""Agents on disk: what is saved comes back bit for bit, and damage is named."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

import torchrl_sspl as sspl
from torchrl_sspl.errors import CheckpointError, ConfigError
from torchrl_sspl.modules.agent import DESCRIPTION_FILE, WEIGHTS_FILE, Agent, agent_directory, mlp_barrier
from torchrl_sspl.modules.networks import FrameEncoder, LatentDynamics, Policy

NETWORKS = {
    "encoder": {"class": "FrameEncoder", "arguments": {"latent_dim": 2, "image_size": 32}},
    "dynamics": {"class": "LatentDynamics", "arguments": {"latent_dim": 2, "action_dim": 1, "action_scale": 10.0}},
    "barrier": {"latent_dim": 2, "hidden": [8, 8]},
    "policy": {"class": "Policy", "arguments": {"latent_dim": 2, "action_dim": 1, "action_scale": 10.0}},
}


def make_agent(**description) -> Agent:
    torch.manual_seed(0)
    return Agent(
        FrameEncoder(**NETWORKS["encoder"]["arguments"]),
        LatentDynamics(**NETWORKS["dynamics"]["arguments"]),
        mlp_barrier(**NETWORKS["barrier"]),
        Policy(**NETWORKS["policy"]["arguments"]),
        2.0,
        description or {"networks": NETWORKS, "environment": "pendulum"},
    )


@pytest.fixture
def saved(tmp_path) -> Path:
    return make_agent().save(tmp_path / "agent")


def edit(directory: Path, change) -> None:
    body = json.loads((directory / DESCRIPTION_FILE).read_text())
    change(body)
    (directory / DESCRIPTION_FILE).write_text(json.dumps(body))


def test_loaded_agent_equals_the_saved_one_bit_for_bit(saved):
    before, after = make_agent(), Agent.load(saved)
    assert before.state_dict().keys() == after.state_dict().keys()
    for name, value in before.state_dict().items():
        assert torch.equal(value, after.state_dict()[name]), name
        assert value.dtype == after.state_dict()[name].dtype
    pixels = torch.randint(0, 256, (4, 6, 32, 32), generator=torch.Generator().manual_seed(1)).to(torch.uint8)
    for one, two in zip(before.act(pixels), after.act(pixels), strict=True):
        assert torch.equal(one, two)
    assert after.lipschitz_bound == 2.0
    assert after.description == before.description


def test_saving_again_writes_the_same_bytes(saved, tmp_path):
    again = Agent.load(saved).save(tmp_path / "again")
    for name in (WEIGHTS_FILE, DESCRIPTION_FILE):
        assert (saved / name).read_bytes() == (again / name).read_bytes()


def test_loaded_agent_is_frozen(saved):
    agent = Agent.load(saved)
    assert not agent.training
    assert not any(p.requires_grad for p in agent.parameters())
    assert agent.latent_dim == 2
    pixels = torch.zeros(3, 6, 32, 32, dtype=torch.uint8)
    action, barrier = agent.act(pixels)
    assert action.shape == barrier.shape == (3, 1)
    assert bool((agent.encode(pixels).abs() <= 1).all())
    assert bool((action.abs() <= 10).all())


def test_agent_is_found_in_its_directory_and_in_its_run(saved):
    assert agent_directory(saved) == saved
    assert agent_directory(saved.parent) == saved
    assert sspl.load(str(saved.parent)).latent_dim == 2


def test_agent_without_a_description_cannot_be_saved(tmp_path):
    with pytest.raises(ConfigError, match=r"description\['networks'\]"):
        make_agent(note="none").save(tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", [WEIGHTS_FILE, DESCRIPTION_FILE])
def test_missing_file_is_named(saved, name):
    (saved / name).unlink()
    with pytest.raises(CheckpointError, match=f"expected {re.escape(name)}.*found none"):
        Agent.load(saved)


@pytest.mark.parametrize("keep", [0, 4, 200, -8])
def test_truncated_weights_are_unreadable(saved, keep):
    data = (saved / WEIGHTS_FILE).read_bytes()
    (saved / WEIGHTS_FILE).write_bytes(data[:keep])
    with pytest.raises(CheckpointError, match=r"readable agent.*restore the files"):
        Agent.load(saved)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '"agent"'])
def test_truncated_description_is_unreadable(saved, text):
    (saved / DESCRIPTION_FILE).write_text(text)
    with pytest.raises(CheckpointError, match="readable agent"):
        Agent.load(saved)


@pytest.mark.parametrize("number", [0, 2, "1", None])
def test_other_formats_are_refused(saved, number):
    edit(saved, lambda body: body.update(format=number))
    with pytest.raises(CheckpointError, match=r"agent format 1.*another version"):
        Agent.load(saved)


@pytest.mark.parametrize("key", ["lipschitz_bound", "networks"])
def test_missing_entries_are_named(saved, key):
    edit(saved, lambda body: body.pop(key))
    with pytest.raises(CheckpointError, match=key):
        Agent.load(saved)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_named(saved, value):
    weights = load_file(saved / WEIGHTS_FILE)
    weights["barrier.0.weight"][0, 0] = value
    save_file(weights, saved / WEIGHTS_FILE)
    with pytest.raises(CheckpointError, match=r"finite weights.*'barrier\.0\.weight'"):
        Agent.load(saved)


@pytest.mark.parametrize("part", ["encoder", "dynamics", "policy"])
def test_unknown_network_class_lists_the_known_ones(saved, part):
    edit(saved, lambda body: body["networks"][part].update({"class": "Transformer"}))
    with pytest.raises(CheckpointError, match=rf"'{NETWORKS[part]['class']}'.*\], received 'Transformer'.*registries"):
        Agent.load(saved)


def test_arguments_that_a_network_does_not_take_are_refused(saved):
    edit(saved, lambda body: body["networks"]["policy"]["arguments"].update(depth=3))
    with pytest.raises(CheckpointError, match="depth"):
        Agent.load(saved)


def test_weights_of_other_sizes_are_refused(saved):
    edit(saved, lambda body: body["networks"]["barrier"].update(hidden=[8, 9]))
    with pytest.raises(CheckpointError, match="size mismatch"):
        Agent.load(saved)


def test_missing_and_surplus_weights_are_refused(saved):
    weights = load_file(saved / WEIGHTS_FILE)
    bias = weights.pop("barrier.0.bias")
    save_file(weights, saved / WEIGHTS_FILE)
    with pytest.raises(CheckpointError, match="Missing key"):
        Agent.load(saved)
    save_file({**weights, "barrier.0.bias": bias, "extra": torch.zeros(1)}, saved / WEIGHTS_FILE)
    with pytest.raises(CheckpointError, match="Unexpected key"):
        Agent.load(saved)


def test_unknown_name_lists_the_shipped_agents(tmp_path, monkeypatch, saved):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CheckpointError, match="received 'pendulumm'"):
        sspl.load("pendulumm")
    package = tmp_path / "package"
    (package / "agents").mkdir(parents=True)
    for name in ("walker", "cartpole"):
        make_agent().save(package / "agents" / name)
    (package / "agents" / "notes").mkdir()
    monkeypatch.setattr(sys.modules["torchrl_sspl.modules.agent"], "__file__", str(package / "modules" / "agent.py"))
    with pytest.raises(CheckpointError, match=r"\(cartpole, walker\).*received 'pendulumm'"):
        sspl.load("pendulumm")
    assert sspl.load("walker").latent_dim == 2

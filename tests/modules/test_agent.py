"""Agents on disk: what is saved comes back bit for bit, and damage is named."""

from __future__ import annotations

import json
import re
import runpy
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

import torchrl_sspl as sspl
from torchrl_sspl.errors import CheckpointError, ConfigError
from torchrl_sspl.lipschitz import LMIBarrier, SandwichBarrier
from torchrl_sspl.modules.agent import (
    DESCRIPTION_FILE,
    WEIGHTS_FILE,
    Agent,
    agent_directory,
    build_encoder,
    call_with,
    mlp_barrier,
)
from torchrl_sspl.modules.moments import MomentEncoder
from torchrl_sspl.modules.networks import FrameEncoder, LatentDynamics, Policy
from torchrl_sspl.modules.salad import SaLaD
from torchrl_sspl.objectives import SSPLLoss
from torchrl_sspl.runtime import Shield

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
def test_what_is_no_network_is_never_called(saved, tmp_path, part):
    made = tmp_path / "made"
    edit(saved, lambda body: body["networks"].update({part: {"class": "os:system", "arguments": {"latent_dim": f"touch {made}"}}}))
    with pytest.raises(CheckpointError, match="expected a class of networks"):
        Agent.load(saved)
    assert not made.exists()


def test_networks_of_ones_own_are_not_imported_without_trust(saved, own_module):
    edit(saved, lambda body: body["networks"]["encoder"].update({"class": f"{own_module}:Outer.Encoder"}))
    with pytest.raises(CheckpointError, match="whose import runs code"):
        Agent.load(saved, trust=False)
    assert own_module not in sys.modules


def test_weights_are_never_rounded(saved, tmp_path):
    agent = Agent.load(saved).double()
    with torch.no_grad():
        agent.barrier[-1].bias += 1e-12
    again = Agent.load(agent.save(tmp_path / "double"))
    assert all(torch.equal(v, again.state_dict()[k]) and v.dtype == again.state_dict()[k].dtype for k, v in agent.state_dict().items())


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


def networks(barrier: type = SandwichBarrier) -> list[nn.Module]:
    torch.manual_seed(0)
    return [FrameEncoder(2, 32), LatentDynamics(2, 1, (8,), 10.0), barrier(2, (8,), 1.5), Policy(2, 1, (8,), 10.0)]


def state(nets: list[nn.Module]) -> list[tuple]:
    """Weights, whether they take a gradient, and the mode of every part."""
    values = [(n, v.clone(), v.requires_grad) for net in nets for n, v in (*net.named_parameters(), *net.named_buffers())]
    return [*values, *((n, m.training, type(m)) for net in nets for n, m in net.named_modules())]


def assert_unchanged(before: list[tuple], after: list[tuple]) -> None:
    assert len(before) == len(after)
    for one, other in zip(before, after, strict=True):
        assert one[0] == other[0]
        assert torch.equal(one[1], other[1]) if isinstance(one[1], torch.Tensor) else one[1] == other[1]
        assert one[2] == other[2]


@pytest.mark.parametrize("barrier", [SandwichBarrier, LMIBarrier])
def test_an_agent_of_networks_in_training_is_a_copy_and_changes_nothing(barrier):
    nets = networks(barrier)
    before = state(nets)
    agent = Agent.from_networks(*nets, level=0.1, description={"note": [1]})
    assert_unchanged(before, state(nets))
    own = {v.data_ptr() for net in nets for v in net.parameters()}
    assert not own & {v.data_ptr() for v in agent.parameters()}
    kept = {k: v.clone() for k, v in agent.state_dict().items()}
    with torch.no_grad():
        for net in nets:
            for value in net.parameters():
                value.add_(1.0)
    for name, value in agent.state_dict().items():
        assert torch.equal(value, kept[name]), name


def test_networks_in_training_stay_on_their_device(monkeypatch):
    nets, moved, cpu = networks(), [], nn.Module.cpu
    monkeypatch.setattr(nn.Module, "cpu", lambda net: moved.append(net) or cpu(net))
    Agent.from_networks(*nets)
    assert len(moved) == 4
    assert not any(net is other for net in nets for other in moved)


@pytest.mark.parametrize("barrier", [SandwichBarrier, LMIBarrier])
def test_its_level_becomes_zero_and_its_bound_is_proved(barrier):
    nets = networks(barrier)
    z = torch.rand(50, 2) * 2 - 1
    with torch.no_grad():
        expected = nets[2](z) - 0.125
    agent = Agent.from_networks(*nets, level=0.125)
    torch.testing.assert_close(agent.barrier(z), expected, rtol=1e-5, atol=1e-6)
    assert agent.lipschitz_bound == 1.5
    assert agent.description["lipschitz"]["proved"], agent.description["lipschitz"]["reason"]
    assert not any(p.requires_grad for p in agent.parameters())


def test_an_agent_of_a_loss_has_the_networks_of_the_loss():
    nets = networks()
    salad = SaLaD(*nets[:3])
    loss = SSPLLoss(*salad, nets[3])
    before, given = state(nets), {"mine": 1}
    agent = Agent.from_loss(loss, level=-0.05, description=given)
    assert_unchanged(before, state(nets))
    assert given == {"mine": 1}
    expected = Agent.from_networks(*nets, level=-0.05)
    for name, value in expected.state_dict().items():
        assert torch.equal(value, agent.state_dict()[name]), name
    assert {p.data_ptr() for p in loss.parameters()}.isdisjoint(p.data_ptr() for p in agent.parameters())
    loss(_batch())  # the loss still works
    table = torch.tensor([[-1.0], [1.0]])
    observing = Agent.from_loss(loss, gain=0.3, choices=table, choice_margin=0.01)
    assert torch.equal(observing.policy.actions, table)
    assert torch.equal(observing.gain, 0.3 * torch.eye(observing.latent_dim))


def _batch():
    from tensordict import TensorDict

    return TensorDict(
        frames=torch.randint(0, 256, (6, 3, 3, 32, 32), dtype=torch.uint8),
        action=torch.zeros(6, 1),
        region=torch.arange(6)[:, None] % 3,
        batch_size=6,
    )


def test_an_agent_of_networks_is_saved_and_found_again(tmp_path):
    agent = Agent.from_networks(*networks(), level=0.1, description={"config": {"seed": 3}})
    again = Agent.load(agent.save(tmp_path))
    for name, value in agent.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name
    assert again.description["config"] == {"seed": 3}


def test_encoders_are_built_by_name_with_the_sizes_that_they_take():
    sizes = {"latent_dim": 4, "image_size": 64, "pool_to": 16, "velocity_gain": 2.0}
    frame, moment = build_encoder("FrameEncoder", **sizes), build_encoder("MomentEncoder", **sizes)
    assert isinstance(frame, FrameEncoder)
    assert isinstance(moment, MomentEncoder)
    assert frame(torch.zeros(2, 6, 64, 64, dtype=torch.uint8)).shape == (2, 4)
    with pytest.raises(ConfigError, match=r"network\.encoder to be one of .*FrameEncoder.*or package.module:Class.*received 'nobody:No'"):
        build_encoder("nobody:No", **sizes)
    with pytest.raises(ConfigError, match="a function latent_dim -> module, received a module; give its class, Identity"):
        call_with(nn.Identity(), sizes)
    with pytest.raises(ConfigError, match="one that raises TypeError"):
        call_with(lambda: None, sizes)
    assert call_with(lambda size: nn.Linear(6, size), sizes).out_features == 4  # whatever it calls it


OWN = """
import torch
from torch import nn


class Outer:
    class Encoder(nn.Module):
        def __init__(self, latent_dim, pool_to=4):
            super().__init__()
            self.net = nn.Sequential(nn.AdaptiveAvgPool2d(pool_to), nn.Flatten(), nn.Linear(6 * pool_to**2, latent_dim), nn.Tanh())

        def forward(self, pixels):
            return self.net(pixels.float() / 255)


class Policy(nn.Module):
    def __init__(self, latent_dim):
        super().__init__()
        self.net = nn.Linear(latent_dim, 1)

    def forward(self, latent):
        return self.net(latent).tanh()


if __name__ == "__main__":
    from torchrl_sspl.lipschitz import SandwichBarrier
    from torchrl_sspl.modules import LatentDynamics
    from torchrl_sspl.modules.agent import Agent

    nets = Outer.Encoder(2), LatentDynamics(2, 1, (8,)), SandwichBarrier(2, (8,)), Policy(2)
    agent = Agent.from_networks(*nets)
    agent.save("agent")
"""


@pytest.fixture
def own_module(tmp_path, monkeypatch):
    """A folder with a module of the user's, in which one works."""
    (tmp_path / "my_networks.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    yield "my_networks"
    sys.modules.pop("my_networks", None)


def test_networks_of_ones_own_are_found_by_their_import_path(own_module, tmp_path, monkeypatch):
    encoder = build_encoder(f"{own_module}:Outer.Encoder", latent_dim=2, pool_to=3, velocity_gain=4.0)
    policy = call_with(sys.modules[own_module].Policy, {"latent_dim": 2})  # a name that the library has too
    agent = Agent.from_networks(encoder, networks()[1], networks()[2], policy)
    described = agent.description["networks"]
    assert described["encoder"] == {"class": "my_networks:Outer.Encoder", "arguments": {"latent_dim": 2, "pool_to": 3}}
    assert described["policy"]["class"] == "my_networks:Policy"
    again = Agent.load(agent.save(tmp_path / "agent"))
    pixels = torch.randint(0, 256, (4, 6, 16, 16), dtype=torch.uint8)
    for one, other in zip(agent.act(pixels), again.act(pixels), strict=True):
        assert torch.equal(one, other)
    sys.modules.pop("my_networks")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    with pytest.raises(CheckpointError, match=r"'my_networks:Outer\.Encoder' cannot be built.*run from the folder that holds"):
        Agent.load(tmp_path / "agent")


class Scaled(nn.Module):
    def __init__(self, latent_dim, scale=1.0):
        super().__init__()
        self.scale, self.net = scale, nn.Linear(latent_dim, 1)

    def forward(self, latent):
        return self.scale * self.net(latent)


class Bare(nn.Module):
    def __init__(self):
        super().__init__()
        self.net = nn.Linear(2, 1)

    def forward(self, latent):
        return self.net(latent)


def test_a_network_of_ones_own_that_would_be_read_as_another_is_not_saved(tmp_path):
    with pytest.raises(ConfigError, match=r"policy: .* that does not \(it has and would have: \{'scale': \(10\.0, 1\.0\)\}\); set self\.arguments = .* in Scaled\.__init__"):
        Agent.from_networks(*networks()[:3], policy := Scaled(2, 10.0)).save(tmp_path)
    with pytest.raises(ConfigError, match=r"policy: expected a network that can be built again .*latent_dim.*; set self\.arguments"):
        Agent.from_networks(*networks()[:3], Bare()).save(tmp_path)
    with pytest.raises(ConfigError, match=r"policy: .* computes the same"):  # within one of the library's
        Agent.from_networks(*networks()[:3], Scaled(2, 10.0), choices=[[0.0], [1.0]]).save(tmp_path)
    assert not list(tmp_path.iterdir())
    policy.arguments, policy.saved = {"latent_dim": 2, "scale": 10.0}, True  # what changes nothing is not asked
    agent = Agent.from_networks(*networks()[:3], policy)
    again = Agent.load(agent.save(tmp_path))
    assert torch.equal(agent.policy(torch.ones(2)), again.policy(torch.ones(2)))


def test_an_agent_written_by_a_program_names_the_programs_file(own_module, tmp_path):
    runpy.run_path(f"{own_module}.py", run_name="__main__")
    agent = Agent.load(tmp_path / "agent")
    assert agent.description["networks"]["encoder"]["class"] == "my_networks:Outer.Encoder"
    assert agent.act(torch.zeros(2, 6, 16, 16, dtype=torch.uint8))[0].shape == (2, 1)


def test_the_constructor_and_from_loss_leave_a_training_alone():
    salad, policy = SaLaD.from_sizes(2, 1, action_scale=10.0, pool_to=8), Policy(2, 1, action_scale=10.0)
    encoder, dynamics, barrier = salad
    agent = Agent(encoder, dynamics, mlp_barrier(2, [8]), policy, 2.0)
    loss = SSPLLoss(encoder, dynamics, barrier, policy)
    Agent.from_loss(loss)
    networks = [getattr(net, "module", net) for net in (encoder, dynamics, barrier, policy)]
    assert all(p.requires_grad for net in networks for p in net.parameters())
    assert all(net.training for net in networks)
    before = agent.policy(torch.zeros(1, 2))
    with torch.no_grad():
        next(policy.parameters()).add_(1.0)
    assert torch.equal(agent.policy(torch.zeros(1, 2)), before)
    assert not any(p.requires_grad for p in agent.parameters())


def test_a_barrier_in_training_is_named_and_where_it_belongs():
    with pytest.raises(ConfigError, match=r"plain barrier.*received SandwichBarrier; Agent\.from_networks"):
        Agent(FrameEncoder(2, 32), LatentDynamics(2, 1), SandwichBarrier(2, (8,)), Policy(2, 1), 2.0)


def test_a_barrier_that_would_be_read_as_another_one_is_not_saved(saved, tmp_path):
    agent = Agent.load(saved)
    agent.barrier = nn.Sequential(*(nn.Tanh() if isinstance(layer, nn.ReLU) else layer for layer in agent.barrier))
    with pytest.raises(ConfigError, match="as which its description would be read"):
        agent.save(tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_what_was_proved_of_other_weights_is_not_proved(saved, tmp_path):
    agent = make_agent(networks=NETWORKS, tolerated_error=0.1, lipschitz={"proved": True})
    assert (agent.tolerated_error, agent.lipschitz_proved) == (0.1, True)
    again = Agent.load(agent.save(tmp_path / "same"))
    assert (again.tolerated_error, again.lipschitz_proved) == (0.1, True)
    assert Agent.load(again.double().save(tmp_path / "double")).tolerated_error == 0.1  # the same numbers
    with torch.no_grad():
        agent.barrier[-1].weight.mul_(5.0)
    with pytest.warns(UserWarning, match="proved of other weights"):
        other = Agent.load(agent.save(tmp_path / "other"))
    assert (other.tolerated_error, other.held_error, other.lipschitz_proved) == (0.0, 0.0, False)
    with pytest.raises(ConfigError, match="one without"):
        Shield(other)
    other.tolerated_error = 0.05  # found anew; that its bound was proved is not known
    assert (other.tolerated_error, other.lipschitz_proved) == (0.05, False)
    found = Agent.load(other.save(tmp_path / "anew"))
    assert (found.tolerated_error, found.lipschitz_proved) == (0.05, False)


def test_a_description_of_another_agent_proves_nothing():
    torch.manual_seed(1)
    networks = FrameEncoder(2, 32), LatentDynamics(2, 1), SandwichBarrier(2, (8,), 1.5), Policy(2, 1)
    first = Agent.from_networks(*networks)
    first.tolerated_error = 0.1
    assert Agent.from_networks(*networks, description=first.description).tolerated_error == 0.1
    networks[3].net[-1].weight.data.neg_()
    other = Agent.from_networks(*networks, description=first.description)
    assert (other.tolerated_error, other.lipschitz_proved) == (0.0, True)  # the bound is proved each time
    for wrong in (-0.1, float("nan"), "0.1"):
        with pytest.raises(ConfigError, match="tolerated error that is finite"):
            other.tolerated_error = wrong


def test_weights_that_change_lose_what_was_proved_of_them_at_once():
    first, other = sspl.load("pendulum"), sspl.load("pendulum")
    with torch.no_grad():
        other.barrier[-1].bias.sub_(1.0)
    assert (other.tolerated_error, other.held_error, other.lipschitz_proved, other.of_other_weights) == (0.0, 0.0, False, True)
    first.load_state_dict(other.state_dict())
    assert first.of_other_weights
    rounded = sspl.load("pendulum").bfloat16()
    assert rounded.tolerated_error == 0.0
    with pytest.raises(ConfigError, match="one without"):
        Shield(rounded)
    assert sspl.load("pendulum").double().tolerated_error > 0.0  # the same numbers

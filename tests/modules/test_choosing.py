"""Policies that choose: what they take, what they refuse, and that they travel with their agent."""

from __future__ import annotations

import copy
import json
import math

import pytest
import torch
from choosing import LEFT_OR_RIGHT, chosen_by_hand, linear, road, road_barrier, road_dynamics, steering
from safetensors.torch import load_file
from tensordict import TensorDict
from torch import nn

import torchrl_sspl.modules.agent as agents
from torchrl_sspl.configs.schema import SynthesisConfig
from torchrl_sspl.errors import CheckpointError, ConfigError
from torchrl_sspl.lipschitz import SandwichBarrier
from torchrl_sspl.modules import ChoosingPolicy, FrameEncoder, LatentDynamics, Policy
from torchrl_sspl.modules.agent import Agent
from torchrl_sspl.trainers import FineTune, Workspace


def points(n: int, p: int = 2, seed: int = 0) -> torch.Tensor:
    return 2 * torch.rand(n, p, generator=torch.Generator().manual_seed(seed)) - 1


def tiny(margin: float = 0.02, actions=((-2.0,), (0.5,), (2.0,))) -> Agent:
    torch.manual_seed(0)
    nets = FrameEncoder(3, 32), LatentDynamics(3, 1, (16,), 2.0), SandwichBarrier(3, (8,), 1.5), Policy(3, 1, (16,), 2.0)
    with torch.no_grad():
        nets[1].net[-1].weight.mul_(3.0)
    return Agent.from_networks(*nets, choices=torch.tensor(actions), choice_margin=margin)


@pytest.mark.parametrize("margin", [0.0, 0.1, 0.5, 9.0])
def test_it_takes_its_own_action_where_that_is_accepted_else_the_best_of_the_table(margin):
    policy, z = road([[-2.0], [0.0], [1.0]], margin)["policy"], points(500)
    taken = policy(z)
    assert torch.equal(taken, chosen_by_hand(policy, z))
    own = (taken == policy.policy(z)).all(1)
    table = (taken[:, None] == policy.actions).all(2).any(1)
    assert bool((own | table).all())
    assert bool(own.all()) is False
    assert bool((own & ~table).any()) is (margin < 0.8)


def test_its_own_action_is_accepted_at_exactly_the_margin():
    dynamics, barrier = road_dynamics(), nn.Sequential(linear([[0.0, 1.0]]))  # B = y
    policy = ChoosingPolicy(steering(0.0), [[-2.0]], 0.25).bind(dynamics, barrier)
    above = math.nextafter(-0.25, 0.0)
    z = torch.tensor([[0.0, -0.25], [0.0, float(torch.tensor(-0.25).nextafter(torch.tensor(0.0)))]])
    assert above > -0.25
    assert policy(z).flatten().tolist() == [0.0, -2.0]


def test_the_first_of_several_best_actions_is_taken():
    middle = torch.tensor([[0.4, 0.0]])
    for actions in ([[-2.0], [2.0]], [[2.0], [-2.0]], [[0.0], [2.0], [-2.0], [2.0]]):
        taken = road(actions)["policy"](middle)
        assert taken.item() == next(a[0] for a in actions if abs(a[0]) == 2.0)


@pytest.mark.parametrize("shape", [(), (1,), (7,), (2, 3), (0,)])
def test_batches_of_any_shape_are_chosen_for_alike(shape):
    policy, z = road()["policy"], points(math.prod(shape)).reshape(*shape, 2)
    taken = policy(z)
    assert taken.shape == (*shape, 1)
    assert torch.equal(taken.reshape(-1, 1), policy(z.reshape(-1, 2)))


@pytest.mark.parametrize(
    ("actions", "margin", "message"),
    [
        ([[math.nan]], 0.0, "finite actions"),
        ([[math.inf]], 0.0, "finite actions"),
        ([[1.0, 1.0]], 0.0, r"\(K, 1\)"),
        ([1.0], 0.0, r"\(K, 1\)"),
        (torch.zeros(0, 1), 0.0, "K >= 1"),
        ([[2.5]], 0.0, "the policy's range"),
        ([[1.0]], -0.1, "a margin"),
        ([[1.0]], math.nan, "a margin"),
        ([[1.0]], math.inf, "a margin"),
        ([[1.0]], "0.1", "a margin"),
        ([[1.0]], True, "a margin"),
    ],
)
def test_tables_and_margins_that_are_not_valid_are_refused(actions, margin, message):
    with pytest.raises(ConfigError, match=message):
        ChoosingPolicy(steering(), actions, margin)


def test_a_policy_that_is_not_bound_or_chooses_twice_is_refused():
    policy = ChoosingPolicy(steering(), LEFT_OR_RIGHT)
    with pytest.raises(ConfigError, match="bind"):
        policy(points(2))
    with pytest.raises(ConfigError, match="does not choose"):
        ChoosingPolicy(policy, LEFT_OR_RIGHT)


def test_an_agent_binds_its_policy_to_its_own_networks():
    parts = road()
    agent = Agent(nn.Identity(), road_dynamics(), parts["barrier"], parts["policy"], 2.0)
    assert agent.policy.loop[0] is agent.dynamics
    assert agent.policy.loop[1] is agent.barrier
    assert parts["policy"].loop[0] is parts["dynamics"], "the one that was given stays as it is"
    twin = copy.deepcopy(agent)
    assert twin.policy.loop[0] is twin.dynamics
    assert twin.policy.loop[1] is twin.barrier
    assert twin.policy.loop[1] is not agent.barrier
    z = points(100)
    assert torch.equal(twin.policy(z), agent.policy(z))
    twin.barrier[-1].bias.add_(10.0)  # now nothing is accepted
    assert not torch.equal(twin.policy(z), agent.policy(z))
    assert torch.equal(agent.double().policy(z.double()).float(), parts["policy"](z))


def test_nothing_is_saved_twice():
    agent = tiny()
    names = {k for k in agent.state_dict() if k.startswith("policy.")}
    inner = {f"policy.policy.{k}" for k in Policy(3, 1, (16,), 2.0).state_dict()}
    assert names == inner | {"policy.actions", "policy.margin"}
    assert len({q.data_ptr() for q in agent.parameters()}) == len(list(agent.parameters()))
    assert sum(1 for m in agent.modules() if m is agent.barrier) == 1


def test_it_travels_with_its_agent(tmp_path):
    agent, z = tiny(), points(300, 3)
    again = Agent.load(agent.save(tmp_path))
    assert torch.equal(again.policy(z), agent.policy(z))
    assert again.policy.loop == (again.dynamics, again.barrier)
    assert torch.equal(again.policy.actions, agent.policy.actions)
    assert torch.equal(again.policy.margin, agent.policy.margin)
    written = json.loads((tmp_path / "agent.json").read_text())["networks"]["policy"]
    assert written["class"] == "ChoosingPolicy"
    assert written["arguments"]["policy"]["class"] == "Policy"
    assert load_file(tmp_path / "agent.safetensors")["policy.actions"].tolist() == [[-2.0], [0.5], [2.0]]
    assert len(agent.policy(z).unique()) > 3, "its own actions and those of the table"


def test_a_description_that_is_none_is_refused(tmp_path):
    tiny().save(tmp_path)
    body = json.loads((tmp_path / "agent.json").read_text())
    for change in ({"class": "Unknown"}, {"arguments": {"latent_dim": 9, "action_dim": 1, "hidden": [16], "action_scale": [2.0]}}):
        broken = copy.deepcopy(body)
        broken["networks"]["policy"]["arguments"]["policy"] |= change
        (tmp_path / "agent.json").write_text(json.dumps(broken))
        with pytest.raises(CheckpointError):
            Agent.load(tmp_path)


def test_the_level_moves_what_is_accepted():
    torch.manual_seed(0)
    nets = FrameEncoder(3, 32), LatentDynamics(3, 1, (16,), 2.0), SandwichBarrier(3, (8,), 1.5), Policy(3, 1, (16,), 2.0)
    low, high = (Agent.from_networks(*nets, level=s, choices=torch.tensor(LEFT_OR_RIGHT)) for s in (-5.0, 5.0))
    z = points(50, 3)
    assert torch.equal(high.policy(z), high.policy.policy(z)), "everything is accepted"
    assert set(low.policy(z).flatten().tolist()) <= {-2.0, 2.0}


def test_measurements_in_host_memory_choose_by_the_copies(monkeypatch):
    agent = tiny()
    monkeypatch.setattr(agents, "next", lambda _: type("Elsewhere", (), {"device": torch.device("cuda")}), raising=False)
    copied = agents.on_host(agent)
    assert copied.policy.loop == (copied.dynamics, copied.barrier)
    assert copied.barrier is not agent.barrier


def test_controllers_and_filters_run_it():
    agent = tiny()
    frames = torch.randint(256, (4, 6, 32, 32), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    out = agent.controller(batch_size=4).step(frames)
    assert torch.equal(out.action, agent.policy(out.latent))
    from torchrl_sspl.runtime.filter import Shield

    shield = Shield(agent, margin=0.02)
    assert torch.equal(shield.scale, agent.policy.policy.action_scale)
    assert shield(points(6, 3), torch.zeros(6, 1)).action.shape == (6, 1)


def test_an_exported_program_chooses(tmp_path):
    agent = tiny()
    agent.gain.mul_(0.1)  # what it remembers decides, as noise looks all the same
    path = agent.export(tmp_path / "agent.pt2")
    n = 40
    frames = torch.randint(256, (n, 6, 32, 32), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    latent, begins = points(n, 3), torch.zeros(n, dtype=torch.bool)
    made = torch.export.load(path).module()(frames, latent, torch.zeros(n, 1), begins)
    wanted = agent.policy(made[-1])
    assert torch.allclose(made[0], wanted, atol=1e-5)
    assert len(wanted.unique()) > 3


@pytest.mark.slow  # the exported program does
def test_an_exported_onnx_file_chooses(tmp_path):
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    assert tiny().export(tmp_path / "agent.onnx").exists()  # and compared with the agent


def test_actions_that_rounding_decides_between_are_no_difference_of_an_exported_file():
    from torchrl_sspl.modules.export import _tied

    parts = road()
    agent = Agent(nn.Identity(), parts["dynamics"], road_barrier(), parts["policy"], 2.0)
    now = {"next_latent": torch.tensor([[0.4, 0.0], [0.4, 0.4]])}
    left, right = (now | {"next_action": torch.full((2, 1), u)} for u in (-2.0, 2.0))
    assert _tied(agent, left, right, 1.0).tolist() == [True, False]
    assert not bool(_tied(agent, left, left, 1.0).any())
    agent.policy = agent.policy.policy
    assert not bool(_tied(agent, left, right, 1.0).any())


def test_the_worst_error_of_the_fine_tuning_is_that_after_the_action_that_is_taken(monkeypatch):
    class Line(nn.Module):
        latent_dim = action_dim = 1
        action_scale = torch.tensor([0.3])

        def __init__(self, value=None):
            super().__init__()
            self.value = nn.Parameter(torch.tensor([value or 0.0]))

    class Adds(Line):
        def forward(self, latent, action):
            return latent + action

    class Hill(Line):
        lipschitz_bound = 1.0

        def forward(self, latent):
            return 0.2 - (latent - 0.05).abs() + self.value

    class Same(Line):
        def forward(self, latent):
            return 0 * latent + self.value

    config = SynthesisConfig(batch=16, tune_steps=1, counterexamples=0, choices=3, tolerated_error=0.02, lr=1e-9)
    work = Workspace(nn.Linear(1, 1), Adds(), Hill(), Same(0.02), config=config)  # its own action ends on one side of the hill, the chosen one on the other
    z, n = torch.full((50, 1), 0.04), 50
    table = TensorDict(
        latent=z, barrier_target=z - 0.2, inside=z > 0, action_target=0 * z, action_weight=1 + 0 * z, region=2 * (torch.arange(n)[:, None] < 5).long(), batch_size=n
    )
    rim, added = TensorDict(latent=z, residual=torch.zeros(n, 16, 1), batch_size=n), []
    monkeypatch.setattr("torchrl_sspl.trainers.synthesis.targets", lambda work, number: (table, rim))
    monkeypatch.setattr("torchrl_sspl.trainers.synthesis.worst_error", lambda barrier, after, most: added.append(after) or 0 * after)
    FineTune(0).run(work)
    torch.testing.assert_close(added[0], work.dynamics(z[:1], work.acting(z[:1])).detach().expand_as(added[0]))
    assert not torch.allclose(added[0], work.dynamics(z[:1], work.policy(z[:1])))

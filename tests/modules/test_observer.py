"""The latent observer: its arithmetic, its memory in collectors, and the controller that watches the proof's premise."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.modules.utils import get_env_transforms_from_module

from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import CheckpointError, ConfigError, DTypeError, NonFiniteError, ShapeError
from torchrl_sspl.evaluation.controllers import AgentController
from torchrl_sspl.evaluation.simulation import simulate
from torchrl_sspl.modules import BearingEncoder, FrameEncoder, LatentDynamics, LatentObserver, Policy, Predict
from torchrl_sspl.modules.agent import Agent, load, mlp_barrier
from torchrl_sspl.modules.controller import Memory, meets_premise, premise_met
from torchrl_sspl.modules.observer import completed, corrected, filtered, gain_matrix, held


def small_agent(gain: float | Tensor = 0.2, error: float = 0.05) -> Agent:
    torch.manual_seed(0)
    nets = FrameEncoder(3, 16, pool_to=8), LatentDynamics(3, 1, (8,), 10.0), mlp_barrier(3, [8]), Policy(3, 1, (8,), 10.0)
    return Agent(*nets, 2.0, {"tolerated_error": error}, gain)


def frames(n: int, seed: int = 0) -> Tensor:
    return torch.randint(256, (n, 6, 16, 16), dtype=torch.uint8, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(
    "gain", [0.0, -0.1, 2.1, math.nan, math.inf, torch.eye(2), torch.zeros(3, 3), 3.0 * torch.eye(3), torch.full((3, 3), math.nan)]
)
def test_gains_that_are_none_are_refused(gain):
    with pytest.raises(ConfigError, match="gain"):
        gain_matrix(gain, 3)


def test_gain_one_is_what_is_seen_to_the_last_bit():
    prior, seen = torch.randn(2, 100, 3).tanh()
    assert torch.equal(corrected(prior, seen, torch.eye(3))[0], seen)


def test_the_posterior_lies_between_prior_and_observation():
    prior, seen = torch.randn(2, 100, 3).tanh()
    latent, innovation = corrected(prior, seen, gain_matrix(0.25, 3))
    assert torch.allclose(latent, 0.75 * prior + 0.25 * seen, atol=1e-6)
    assert torch.allclose(innovation, seen - prior)
    beyond, _ = corrected(torch.full((1, 3), -3.0), torch.full((1, 3), -3.0), torch.eye(3))
    assert torch.equal(beyond, -torch.ones(1, 3))


def test_a_matrix_corrects_each_direction_by_its_own_share():
    gain = torch.tensor([[0.5, 0.1], [0.0, 1.0]])
    latent, _ = corrected(torch.zeros(1, 2), torch.tensor([[0.2, 0.4]]), gain)
    assert torch.allclose(latent, torch.tensor([[0.5 * 0.2 + 0.1 * 0.4, 0.4]]))


def test_recorded_episodes_are_filtered_as_a_loop_filters_them():
    torch.manual_seed(1)
    dynamics, gain = LatentDynamics(3, 1, (8,), 10.0), gain_matrix(0.3, 3)
    lengths = (1, 4, 2, 7)
    seen, after, action, continues, expected = [], [], [], [], []
    for n in lengths:
        z, u = torch.randn(n + 1, 3).tanh(), torch.randn(n, 1)
        seen.append(z[:-1]), after.append(z[1:]), action.append(u)
        continues.append(torch.arange(n) > 0)
        latent = z[0]
        for k in range(n):
            follow = corrected(dynamics(latent[None], u[k : k + 1]), z[k + 1 : k + 2], gain)[0][0]
            expected.append((latent, follow))
            latent = follow
    found = filtered(dynamics, gain, *(torch.cat(v) for v in (seen, after, action, continues)))
    for k in (0, 1):
        assert torch.allclose(found[k], torch.stack([e[k] for e in expected]), atol=1e-6)


@pytest.mark.filterwarnings("ignore:Nested TransformedEnvs")
def test_collectors_carry_the_memory_and_forget_it_at_resets():
    agent = small_agent()
    policy = TensorDictSequential(
        LatentObserver(agent.encoder, 0.2, 3), TensorDictModule(agent.policy, ["latent"], ["action"]), Predict(agent.dynamics)
    )
    env = PendulumEnv(batch_size=[4], image_size=16, seed=0)
    collector = Collector(env, policy, frames_per_batch=48, total_frames=48, max_frames_per_traj=5, auto_register_policy_transforms=True)
    data = next(iter(collector))
    collector.shutdown()
    begins, prior = data["is_init"][..., 0], data["prior"]
    assert begins.sum() == 4 * 3
    seen = agent.encode(data["pixels"])
    latent, _ = corrected(torch.where(begins[..., None], seen, prior), seen, agent.gain)
    assert torch.allclose(data["latent"], latent, atol=1e-6)
    on = ~begins[:, 1:]
    assert torch.equal(data["next", "prior"][:, :-1][on], prior[:, 1:][on])
    assert torch.allclose(data["next", "prior"], agent.dynamics(data["latent"], data["action"]), atol=1e-6)


def test_a_missing_primer_is_named():
    observer = LatentObserver(FrameEncoder(3, 16, pool_to=8), 0.2, 3)
    env = PendulumEnv(batch_size=[2], image_size=16, seed=0)
    data = TransformedEnv(env, get_env_transforms_from_module(observer)).reset()
    assert observer(data)["latent"].shape == (2, 3)
    with pytest.raises(ShapeError, match="primer"):
        observer(data.set("prior", torch.zeros(2, 4)))


def test_the_controller_is_the_closed_loop_that_is_measured():
    agent, env = small_agent(), PendulumEnv(batch_size=[3], image_size=16, seed=0)
    start = env.sample_states(3)
    run = simulate(AgentController(agent), env, start=start, horizon=6)
    controller, before = agent.controller(3), env.previous_state(start)
    for t in range(6):
        out = controller.step(env.observe(run.states[t], before))
        assert torch.allclose(out.action, run.actions[t], atol=1e-5)
        assert torch.allclose(out.barrier, run.barrier[t], atol=1e-5)
        assert torch.equal(out.inside, out.barrier <= 0)
        assert torch.allclose(out.innovation, run.innovation[t].norm(dim=-1), atol=1e-5)
        if t:
            assert torch.allclose(out.error, run.prediction_error[t - 1], atol=1e-5)
        before = run.states[t]


class Script(nn.Module):
    """Shows given latents, one after the other."""

    def __init__(self, latents: Tensor) -> None:
        super().__init__()
        self.latents, self.k = latents, -1

    def forward(self, pixels: Tensor) -> Tensor:
        self.k += 1
        return self.latents[self.k].expand(len(pixels), 1)


class Still(LatentDynamics):
    """Nothing moves."""

    def forward(self, latent: Tensor, action: Tensor) -> Tensor:
        return latent


def watched(latents: list[float], *, error: float = 0.11, gain: float = 0.5) -> list[bool]:
    """Whether the proof applies, step by step, to what is seen; B(z) = z - 0.5."""
    barrier = nn.Sequential(nn.Linear(1, 1))
    with torch.no_grad():
        barrier[0].weight.fill_(1.0)
        barrier[0].bias.fill_(-0.5)
    script = Script(torch.tensor(latents)[:, None])
    agent = Agent(script, Still(1, 1), barrier, Policy(1, 1), 1.0, {"tolerated_error": error}, gain)
    controller = agent.controller(1)
    return [bool(controller.step(torch.zeros(1, 6, 8, 8, dtype=torch.uint8)).applies) for _ in latents]


@pytest.mark.parametrize(
    ("latents", "applies"),
    [
        ([0.0, 0.2, 0.3], [True, True, True]),
        ([0.0, 0.49, 0.3], [True, True, True]),  # corrected by much, and still inside
        ([0.6, 0.4], [False, False]),  # it began outside
        ([0.4, 0.55, 0.4], [True, False, False]),  # looks like U, the correction is small
        ([0.4, 0.9, 0.4], [True, False, False]),
        ([0.0, math.nan], [True, False]),
        ([0.0] * 5, [True] * 5),
    ],
)
def test_the_premise_is_watched_and_never_met_again_once_it_was_not(latents, applies):
    assert watched(latents) == applies


def test_memory_and_observation_both_have_to_lie_in_the_set():
    inside, outside, none = torch.tensor([-0.1]), torch.tensor([0.1]), torch.zeros(1)
    agent = small_agent(error=0.01)
    met = [bool(meets_premise(agent, *pair, none)) for pair in ((inside, inside), (outside, inside), (inside, outside))]
    assert met == [True, False, False]


def test_without_a_memory_no_correction_may_be_larger_than_what_is_tolerated():
    assert watched([0.0, 0.1, 0.2], gain=1.0) == [True, True, True]
    assert watched([0.0, 0.2, 0.2], gain=1.0) == [True, False, False]


def test_a_correction_that_would_leave_the_set_is_cut_to_what_is_tolerated():
    prior, wanted = torch.tensor([[0.4, 0.0]] * 3 + [[0.6, 0.0]]), torch.tensor([[0.9, 0.5], [0.45, 0.9], [0.55, 0.0], [0.9, 0.0]])
    latent, cut = held(lambda z: z[..., :1] - 0.5, prior, wanted, 0.2)
    # Led out far; moved far inside; led out by less than is tolerated; outside before.
    assert cut.tolist() == [True, False, False, False]
    assert torch.equal(latent[1:], wanted[1:])
    assert torch.allclose(latent[0], prior[0] + 0.2 * torch.tensor([0.5, 0.5]) / math.sqrt(0.5))


def test_the_same_corrections_are_cut_in_a_collector_and_in_a_controller():
    agent = small_agent(error=0.01)
    with torch.no_grad():
        agent.barrier[-1].bias.add_(-agent.barrier(agent.encode(frames(64)))[:, 0].median())
    agent.tolerated_error = 0.01  # of the barrier as it is now
    observer = LatentObserver(agent.encoder, agent.gain, agent.latent_dim, agent.barrier, agent.held_error)
    prior, seen = agent.encode(frames(64)), agent.encode(frames(64, 1))
    memory = Memory(agent)
    memory.correct(prior)
    memory.expect(prior)
    latent, _, cut, _ = memory.correct(seen)
    assert bool(cut.any())
    begins = torch.zeros(64, 1, dtype=torch.bool)
    found = observer(TensorDict(pixels=frames(64, 1), prior=prior, is_init=begins, batch_size=[64]))
    assert torch.equal(found["latent"], latent)


def test_an_observer_that_holds_needs_a_set():
    with pytest.raises(ConfigError, match="barrier"):
        LatentObserver(FrameEncoder(3, 16, pool_to=8), 0.2, 3, error=0.1)


def test_where_nothing_is_proved_no_premise_is_met():
    assert watched([0.0, 0.0], error=0.0) == [False, False]


def test_a_picture_without_a_batch_is_not_taken_for_six_systems():
    controller = small_agent().controller(6)
    with pytest.raises(ShapeError, match=r"of 6 systems, \(6, 6, H, W\), received \(6, 16, 16\)"):
        controller.step(frames(1)[0])
    assert controller.step(frames(6)).action.shape == (6, 1)


def test_resets_forget_some_or_all():
    agent = small_agent()
    controller = agent.controller(4)
    first = controller.step(frames(4))
    controller.step(frames(4, 1))
    last = controller.step(None)
    controller.reset(torch.tensor([1, 3]))
    assert not bool(last.applies.any())  # what was said of the steps before stays said
    again = controller.step(frames(4))
    for rows in ([1, 3], torch.tensor([False, True, False, True])):
        assert torch.allclose(again.latent[rows], first.latent[rows], atol=1e-6)
    assert not torch.allclose(again.latent[[0, 2]], first.latent[[0, 2]], atol=1e-6)
    controller.reset()
    assert torch.equal(controller.step(frames(4)).latent, first.latent)


def test_what_is_no_tensor_and_no_row_is_refused():
    controller = small_agent().controller(4)
    with pytest.raises(DTypeError, match=r"pixels as a tensor .*received ndarray; torch\.as_tensor"):
        controller.step(frames(4).numpy())
    with pytest.raises(ShapeError, match=r"expected rows of 4 systems.* received \[7\]"):
        controller.reset([7])


def test_wrong_batches_are_refused():
    with pytest.raises(ConfigError, match="batch_size"):
        small_agent().controller(0)
    with pytest.raises(ShapeError, match="4 systems"):
        small_agent().controller(4).step(frames(3))


def test_the_memory_goes_on_from_what_was_really_done():
    agent = small_agent()
    controller, pushes = agent.controller(2), torch.full((2, 1), 3.0)
    latent = controller.step(frames(2)).latent
    controller.took(pushes)
    seen, prior = agent.encode(frames(2, 1)), agent.dynamics(latent, pushes)
    assert torch.allclose(controller.step(frames(2, 1)).innovation, (seen - prior).norm(dim=-1), atol=1e-6)
    with pytest.raises(ShapeError, match=r"actions \(2, 1\)"):
        controller.took(torch.zeros(3, 1))
    controller.reset()
    with pytest.raises(ConfigError, match="a step before"):
        controller.took(pushes)


def test_without_pixels_the_memory_goes_on_and_the_premise_is_not_met():
    agent = small_agent(error=0.01)
    controller = agent.controller(2)
    assert controller.begins.all()
    blind = controller.step(None)  # nothing was expected yet
    assert not blind.latent.any()
    assert controller.begins.all()
    first = controller.step(frames(2))
    blind = controller.step(None)
    assert torch.equal(blind.latent, agent.dynamics(first.latent, first.action))
    assert blind.innovation.isnan().all()
    assert not blind.applies.any()
    assert not controller.begins.any()


def test_the_premise_at_another_level_and_without_held_corrections():
    barrier, seen, error = torch.tensor([-0.3, -0.1]), torch.tensor([-0.3, -0.3]), torch.tensor([0.02, 0.005])
    assert premise_met(barrier, seen, error, 0.01, held=True, level=-0.2).tolist() == [True, False]
    assert premise_met(barrier, seen, error, 0.01, held=False, level=-0.2).tolist() == [False, True]
    assert not premise_met(barrier, barrier, error, 0.0, held=True).any()


def test_the_gain_travels_with_the_agent(tmp_path):
    shipped = load("pendulum")
    changed = Agent(
        shipped.encoder, shipped.dynamics, shipped.barrier, shipped.policy, shipped.lipschitz_bound, shipped.description, 0.37
    )
    with pytest.warns(UserWarning, match="proved of other weights"):  # of the gain that was shipped
        read = Agent.load(changed.save(tmp_path / "agent"))
    assert torch.equal(read.gain, gain_matrix(0.37, shipped.latent_dim))


@pytest.mark.parametrize("error", [-0.1, math.inf, math.nan, "0.1", True])
def test_a_tolerated_error_that_is_none_is_refused(error):
    with pytest.raises(ConfigError, match="tolerated error"):
        small_agent(error=error)


def test_an_agent_with_a_gain_that_is_none_cannot_be_read(tmp_path):
    from safetensors.torch import load_file, save_file

    path = load("pendulum").save(tmp_path / "agent")
    weights = load_file(path / "agent.safetensors")
    save_file(weights | {"gain": 3.0 * torch.eye(3)}, path / "agent.safetensors")
    with pytest.raises(CheckpointError, match="gain"):
        Agent.load(path)


def test_what_no_picture_shows_is_what_was_expected():
    gain = gain_matrix(0.25, 3, 2)
    assert gain.diag().tolist() == [0.25, 0.25, 0.0]
    prior, seen = torch.tensor([[0.0, 0.0, 0.7]]), torch.tensor([[0.4, -0.4, 0.0]])
    whole = completed(seen, prior, gain)
    assert whole.tolist() == [[pytest.approx(0.4), pytest.approx(-0.4), pytest.approx(0.7)]]
    latent, innovation = corrected(prior, whole, gain)
    assert torch.allclose(latent, torch.tensor([[0.1, -0.1, 0.7]]))
    assert innovation[0, 2] == 0.0


def test_a_memory_keeps_the_last_action_and_judges_pictures_with_it():
    encoder = BearingEncoder(3, 32, pool_to=16)
    dynamics = LatentDynamics(3, 1, (8,), 2.0, remembers=True)
    inside_where_it_turned = nn.Sequential(nn.Linear(3, 1))
    nn.utils.vector_to_parameters(torch.tensor([0.0, 0.0, -1.0, 0.4]), inside_where_it_turned.parameters())
    policy = Policy(3, 1, (4,), 2.0)
    agent = Agent(encoder, dynamics, inside_where_it_turned, policy, 1.0, {"tolerated_error": 0.1}, gain_matrix(0.3, 3, 2))
    controller, pixels = agent.controller(1), torch.zeros(1, 6, 32, 32, dtype=torch.uint8)
    assert float(controller.step(pixels).latent[0, 2]) == 0.0
    controller.took(torch.tensor([[1.5]]))
    step = controller.step(pixels)
    assert float(step.latent[0, 2]) == float(step.seen[0, 2]) == 0.75
    assert float(step.barrier) == pytest.approx(-0.35)


def test_a_picture_of_u_is_judged_with_whatever_the_memory_may_hold():
    barrier = nn.Sequential(nn.Linear(3, 1))  # below zero where it turned right by more than half
    nn.utils.vector_to_parameters(torch.tensor([0.0, 0.0, 1.0, 0.5]), barrier.parameters())
    nets = BearingEncoder(3, 32, pool_to=16), LatentDynamics(3, 1, (8,), 2.0, remembers=True), barrier, Policy(3, 1, (4,), 2.0)
    agent, seen = Agent(*nets, 1.0, gain=gain_matrix(0.3, 3, 2)), torch.zeros(4, 3)
    assert agent.barrier(seen)[:, 0].tolist() == [0.5] * 4
    assert agent.least_barrier(seen).tolist() == [-0.5] * 4
    shows_all = Agent(*nets, 1.0, gain=0.3)
    assert torch.equal(shows_all.least_barrier(seen), shows_all.barrier(seen)[:, 0])


def test_an_episode_without_a_first_picture_knows_nothing_of_the_one_before():
    controller = load("pendulum").controller(batch_size=2)
    first = controller.step(None)
    controller.reset()
    controller.step(torch.zeros(2, 6, 64, 64, dtype=torch.uint8))
    controller.step(torch.full((2, 6, 64, 64), 200, dtype=torch.uint8))
    controller.reset(torch.tensor([0]))
    again = controller.step(None)
    assert torch.equal(again.latent[0], first.latent[0])
    assert not torch.equal(again.latent[1], first.latent[1])


class Blank(nn.Module):
    def forward(self, pixels: Tensor) -> Tensor:
        return torch.full((len(pixels), 3), math.nan)


def test_numbers_that_are_none_are_refused_and_forgotten():
    agent = load("pendulum")
    controller, pixels = agent.controller(), torch.zeros(1, 6, 64, 64, dtype=torch.uint8)
    first = controller.step(pixels)
    with pytest.raises(NonFiniteError, match="memory stays as it was"):
        controller.took(torch.full((1, 1), math.nan))
    seen, agent.encoder = agent.encoder, Blank()
    assert not controller.step(pixels).latent.isfinite().any()
    agent.encoder = seen
    step = controller.step(pixels)
    assert torch.equal(step.latent, first.latent)  # as of an episode that begins
    assert not bool(step.applies)


def test_an_agent_in_float64_runs():
    agent = load("pendulum").double()
    controller = agent.controller()
    assert controller.step(None).latent.dtype == torch.float64
    assert controller.step(torch.zeros(1, 6, 64, 64, dtype=torch.uint8)).action.dtype == torch.float64


def test_the_proof_ends_with_actions_that_nobody_has_checked():
    agent = small_agent(error=0.01)
    agent.barrier[-1].bias.data.sub_(100.0)  # everything is inside
    agent.tolerated_error = 0.01
    controller = agent.controller(3)
    out = controller.step(frames(3))
    assert out.applies.all()
    assert controller.took(out.action).all()  # its own
    other = out.action.clone()
    other[1] += 1e-6
    checked = agent.dynamics(out.latent, other)
    assert controller.took(other, checked).all()  # a filter's
    assert controller.took(other).tolist() == [True, False, True]
    again = controller.step(frames(3, 1))
    assert again.applies.tolist() == [True, False, True]
    controller.reset(torch.tensor([1]))
    again.action[1] += 1.0
    assert controller.took(again.action).all()  # row 1 was of an episode that is over
    out = controller.step(frames(3))
    assert out.applies.all()
    out.action.neg_()  # what was told stays what was told
    assert not controller.took(out.action).any()


def test_a_gain_of_float64_is_not_rounded():
    third = torch.eye(2, dtype=torch.float64) / 3
    assert torch.equal(gain_matrix(third, 2), third)
    assert gain_matrix(torch.eye(2, dtype=torch.int64), 2).dtype == torch.float32

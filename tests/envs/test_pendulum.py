"""The pendulum environment: dynamics, frames, regions, resets."""

from __future__ import annotations

import math
import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import ConfigError, DTypeError, NonFiniteError, OverlapError, ShapeError
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE, Box


@pytest.mark.parametrize("integrator", ["semi_implicit", "explicit"])
@pytest.mark.parametrize("batch_size", [[], [3]])
def test_specs_hold(integrator, batch_size):
    check_env_specs(PendulumEnv(batch_size=batch_size, integrator=integrator, image_size=32, seed=0), seed=0)


def test_dynamics_are_the_papers_formula():
    state, action = torch.tensor([[0.3, -0.7]]), torch.tensor([[4.0]])
    speed = -0.7 + (9.0 / 0.5 * math.sin(0.3) + 4.0 / (2.0 * 0.25)) * 0.02
    kw = dict(mass=2.0, length=0.5, gravity=9.0, dt=0.02)
    explicit = PendulumEnv(integrator="explicit", **kw).dynamics(state, action)
    semi = PendulumEnv(**kw).dynamics(state, action)
    torch.testing.assert_close(explicit, torch.tensor([[0.3 - 0.7 * 0.02, speed]]))
    torch.testing.assert_close(semi, torch.tensor([[0.3 + speed * 0.02, speed]]))


def test_semi_implicit_dynamics_agree_with_gymnasium():
    """gymnasium's coefficients are 3 g / (2 l) and 3 / (m l^2): a rod, not a point mass."""
    gymnasium = pytest.importorskip("gymnasium")
    env = PendulumEnv(mass=0.75, length=2 / 3, max_torque=2.0)
    reference = gymnasium.make("Pendulum-v1").unwrapped
    reference.reset(seed=0)
    for angle, speed, torque in ((0.3, -0.5, 1.5), (-2.0, 3.0, -2.0), (3.0, 0.1, 5.0)):
        reference.state = torch.tensor([angle, speed]).double().numpy()
        reference.step(torch.tensor([torque]).numpy())
        found = env.dynamics(torch.tensor([[angle, speed]]), torch.tensor([[torque]]))
        torch.testing.assert_close(found[0].double(), torch.as_tensor(reference.state), atol=1e-5, rtol=0)


def test_actions_beyond_the_bound_are_clamped():
    env = PendulumEnv(max_torque=3.0)
    state = torch.zeros(1, 2)
    assert torch.equal(env.dynamics(state, torch.tensor([[50.0]])), env.dynamics(state, torch.tensor([[3.0]])))


def test_two_frames_determine_the_state_with_the_semi_implicit_integrator():
    env = PendulumEnv()
    before = env.sample_states(200, torch.Generator().manual_seed(0))
    after = env.dynamics(before, 10 * torch.rand(200, 1) - 5)
    torch.testing.assert_close(env.previous_state(after)[:, 0], before[:, 0], atol=1e-5, rtol=0)


def test_with_the_explicit_integrator_the_torque_hides_part_of_the_speed():
    env = PendulumEnv(integrator="explicit")
    before = env.sample_states(200, torch.Generator().manual_seed(0))
    unforced = env.dynamics(before, torch.zeros(200, 1))
    torch.testing.assert_close(env.previous_state(unforced), before, atol=1e-4, rtol=0)
    forced = env.dynamics(before, torch.full((200, 1), 10.0))
    gap = (env.previous_state(forced)[:, 0] - before[:, 0]).abs().max()
    assert 0.01 < gap < 0.04  # max_torque dt^2 / (m l^2) = 0.025, bent by gravity


@pytest.mark.parametrize("integrator", ["semi_implicit", "explicit"])
def test_rollouts_show_the_true_previous_frame(integrator):
    env = PendulumEnv(batch_size=[4], integrator=integrator, seed=0)
    rollout = env.rollout(6, break_when_any_done=False)
    done = rollout["next", "done"].squeeze(-1)
    state, following = rollout["state"], rollout["next", "state"]
    frames = env.draw(state.reshape(-1, 2)).reshape(4, 6, 3, 64, 64)
    assert torch.equal(rollout["pixels"][:, :, 3:], frames)
    assert torch.equal(rollout["next", "pixels"][:, :, :3], frames)
    expected = env.wrap(env.dynamics(state, rollout["action"]))
    torch.testing.assert_close(expected, following)
    assert torch.equal(rollout["pixels"][:, 1:][~done[:, :-1]], rollout["next", "pixels"][:, :-1][~done[:, :-1]])


def test_observe_gives_the_previous_frame_first():
    env = PendulumEnv()
    state, previous = torch.tensor([[0.5, 2.0]]), torch.tensor([[1.0, 0.0]])
    pixels = env.observe(state)
    assert pixels.shape == (1, 6, 64, 64)
    assert pixels.dtype == torch.uint8
    assert torch.equal(pixels[:, :3], env.draw(torch.tensor([[0.5 - 2.0 * 0.05, 0.0]])))
    assert torch.equal(pixels[:, 3:], env.draw(torch.tensor([[0.5, 0.0]])))
    assert torch.equal(env.observe(state, previous)[:, :3], env.draw(torch.tensor([[1.0, 0.0]])))


def test_gymnasiums_pictures_agree_with_its_own():
    pytest.importorskip("pygame")
    env = PendulumEnv()
    state = env.sample_states(10, torch.Generator().manual_seed(0))
    ours, theirs = env.draw(state), env.renderers()["gymnasium"](state)
    assert (ours.int() - theirs.int()).abs().max() <= 24


def test_regions_are_the_papers():
    env = PendulumEnv()
    cases = {
        (0.0, 0.0): SAFE,
        (0.26, -0.24): SAFE,
        (2 * math.pi + 0.1, 0.0): SAFE,
        (0.3, 0.0): UNLABELLED,
        (0.0, 0.3): UNLABELLED,
        (1.5, 1.4): UNLABELLED,
        (1.6, 0.0): UNSAFE,
        (0.0, -1.6): UNSAFE,
        (math.pi, 0.0): UNSAFE,
        (0.0, 3.6): UNSAFE,
    }
    found = env.region(torch.tensor(list(cases)))
    assert found.shape == (len(cases), 1)
    assert found.dtype == torch.int64
    assert found.squeeze(1).tolist() == list(cases.values())


def test_leaving_the_speed_range_ends_the_episode_as_unsafe():
    env = PendulumEnv(batch_size=[2])
    reset = env.reset(TensorDict({"state": torch.tensor([[1.57, 3.4], [0.0, 0.0]])}, [2]), set_state=True)
    after = env.step(reset.set("action", torch.full((2, 1), 10.0)))["next"]
    assert after["terminated"].squeeze(1).tolist() == [True, False]
    assert after["done"].squeeze(1).tolist() == [True, False]
    assert after["region"].squeeze(1).tolist() == [UNSAFE, UNLABELLED]
    assert after["reward"].squeeze(1).tolist() == [-1.0, 0.0]


def test_the_horizon_truncates():
    env = PendulumEnv(batch_size=[2], horizon=3, initial_set=Box([-0.1, -0.1], [0.1, 0.1]), seed=0)
    rollout = env.rollout(7, break_when_any_done=False)
    assert rollout["next", "truncated"][0].squeeze(1).tolist() == [False, False, True] * 2 + [False]
    assert not rollout["next", "terminated"].any()


def test_a_partial_reset_leaves_the_others_alone():
    env = PendulumEnv(batch_size=[3], seed=0)
    before = env.rollout(2, auto_reset=True, break_when_any_done=False)[:, -1]["next"]
    mask = torch.tensor([[True], [False], [True]])
    after = env.reset(before.clone().set("_reset", mask).set("done", ~mask & mask).set("terminated", ~mask & mask))
    assert torch.equal(after["state"][1], before["state"][1])
    assert torch.equal(after["pixels"][1], before["pixels"][1])
    assert (after["state"][[0, 2]] != before["state"][[0, 2]]).all()
    assert torch.equal(after["pixels"][[0, 2]], env.observe(after["state"][[0, 2]]))
    step = env.step(after.set("action", torch.zeros(3, 1)))["next"]
    assert torch.equal(step["pixels"][:, :3], after["pixels"][:, 3:])


def test_reset_starts_at_given_states_wrapped():
    env = PendulumEnv(batch_size=[2])
    given = torch.tensor([[2 * math.pi + 0.5, 0.1], [-0.5, -0.2]])
    state = env.reset(TensorDict({"state": given}, [2]), set_state=True)["state"]
    torch.testing.assert_close(state, torch.tensor([[0.5, 0.1], [-0.5, -0.2]]))


def test_seeds_repeat_and_differ():
    def run(seed):
        env = PendulumEnv(batch_size=[2], seed=seed)
        return torch.cat([env.reset()["state"] for _ in range(3)])

    assert torch.equal(run(1), run(1))
    assert not torch.equal(run(1), run(2))
    assert not torch.equal(run(None), run(None))


def test_the_global_random_state_is_not_touched():
    torch.manual_seed(0)
    before = torch.get_rng_state()
    env = PendulumEnv(batch_size=[2])
    env.reset()
    env.sample_states(5)
    assert torch.equal(torch.get_rng_state(), before)


def test_samples_lie_in_the_region_asked_for():
    env = PendulumEnv(seed=0)
    for region in (env.safe_set, env.unsafe_set, env.state_space):
        states = env.sample_states(500, region=region)
        assert states.shape == (500, 2)
        assert region.contains(states).all()


def test_the_environment_can_be_sent_to_another_process():
    env = PendulumEnv(batch_size=[2], seed=3)
    copy = pickle.loads(pickle.dumps(env))
    assert torch.equal(env.reset()["pixels"], copy.reset()["pixels"])


def test_bad_parameters_are_named():
    with pytest.raises(ConfigError, match=r"\['semi_implicit', 'explicit'\], received 'semi'"):
        PendulumEnv(integrator="semi")
    for name in ("mass", "length", "gravity", "dt", "max_torque"):
        with pytest.raises(ConfigError, match=rf"{name}: expected a positive finite number, received -1"):
            PendulumEnv(**{name: -1.0})
    with pytest.raises(ConfigError, match="horizon"):
        PendulumEnv(horizon=0)
    with pytest.raises(ConfigError, match="batch_size"):
        PendulumEnv(batch_size=[2, 2])
    with pytest.raises(OverlapError):
        PendulumEnv(safe_set=Box([-2.0, -2.0], [2.0, 2.0]))


def test_bad_states_and_actions_are_named():
    env = PendulumEnv()
    with pytest.raises(ShapeError, match=r"\(\*batch, 2\), received \(4, 3\)"):
        env.observe(torch.zeros(4, 3))
    with pytest.raises(DTypeError, match="int64"):
        env.observe(torch.zeros(4, 2, dtype=torch.int64))
    with pytest.raises(NonFiniteError, match="1 of 2 rows"):
        env.dynamics(torch.tensor([[0.0, float("nan")], [0.0, 0.0]]), torch.zeros(2, 1))
    with pytest.raises(ShapeError, match=r"action: expected shape \(\*batch, 1\)"):
        env.dynamics(torch.zeros(2, 2), torch.zeros(2, 2))
    with pytest.raises(NonFiniteError, match="action"):
        env.step(env.reset().set("action", torch.full((1, 1), float("inf"))))
    with pytest.raises(ShapeError, match="previous_state"):
        env.observe(torch.zeros(2, 2), torch.zeros(3, 2))
    with pytest.raises(ConfigError, match="state"):
        env.reset(TensorDict({}, [1]), set_state=True)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_frames_and_dynamics_are_the_same_on_the_gpu():
    cpu, gpu = PendulumEnv(batch_size=[16]), PendulumEnv(batch_size=[16], device="cuda", seed=0)
    check_env_specs(gpu)
    state = cpu.sample_states(16, torch.Generator().manual_seed(0))
    difference = gpu.observe(state.cuda()).cpu().int() - cpu.observe(state).int()
    assert difference.abs().max() <= 24  # a corner may round to the next pixel
    assert (difference != 0).float().mean() < 0.01
    assert gpu.sample_states(3, torch.Generator().manual_seed(0)).is_cuda
    assert gpu.rollout(3, break_when_any_done=False)["pixels"].is_cuda

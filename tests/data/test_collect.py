"""Collection through TorchRL collectors: exact numbers, seeds, start sets, episodes."""

from __future__ import annotations

import copy
import pickle
import tempfile
from multiprocessing import connection, current_process, util

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import DoubleToFloat, DTypeCastTransform, SerialEnv, TransformedEnv

from torchrl_sspl.data import TransitionStore, collect, collect_random, collect_rollouts
from torchrl_sspl.data.collect import ExploringPolicy, RandomActions
from torchrl_sspl.envs import PendulumEnv
from torchrl_sspl.errors import ConfigError
from torchrl_sspl.sets import SAFE


@pytest.fixture
def env():
    return PendulumEnv(batch_size=[8], image_size=16, seed=0)


@pytest.mark.parametrize("n", [1, 50, 203])
def test_exactly_n_transitions_are_collected(env, n):
    assert len(collect_random(env, n, seed=0)) == n


def test_transitions_are_the_environments(env):
    data = collect_random(env, 300, seed=0, keep_state=True).get(slice(None))
    state, following = data["info", "state"], data["info", "next_state"]
    torch.testing.assert_close(env.wrap(env.dynamics(state, data["action"])), following)
    assert torch.equal(data["frames"][:, :2].flatten(1, 2), env.observe(state))
    assert torch.equal(data["frames"][:, 2], env.draw(following))
    assert torch.equal(data["region"], env.region(state))
    assert torch.equal(data["next", "region"], env.region(following))
    assert torch.equal(data["next", "terminated"], following[:, 1:].abs() > 3.5)


def test_random_actions_fill_their_bounds(env):
    action = collect_random(env, 500, seed=0).get(slice(None))["action"]
    assert action.abs().max() <= 10
    assert action.max() > 9
    assert action.min() < -9
    assert action.mean().abs() < 1


def test_the_same_seed_gives_the_same_data(env):
    first, again = collect_random(env, 120, seed=3), collect_random(env, 120, seed=3)
    other = collect_random(env, 120, seed=4)
    assert (first.get(slice(None)) == again.get(slice(None))).all()
    assert not torch.equal(first.get(slice(None))["action"], other.get(slice(None))["action"])


def test_episodes_start_in_the_region_and_the_environment_is_left_as_it_was(env):
    before = env.initial_set
    store = collect_random(env, 100, seed=0, steps=1, region=env.safe_set)
    assert (store.get(slice(None))["region"] == SAFE).all()
    assert store.n_frames == 300  # independent transitions share no frame
    assert env.initial_set is before
    assert len(env.rollout(2)) == 8  # it still runs


def test_episodes_of_a_transformed_environment_start_in_the_region(env):
    before, changed = env.initial_set, TransformedEnv(TransformedEnv(env, DTypeCastTransform(torch.uint8, torch.uint8, in_keys=["pixels"])), DoubleToFloat(), auto_unwrap=False)
    for collected in (collect_random(changed, 100, seed=0, steps=1, region=env.safe_set), collect_rollouts(changed, RandomActions(env), 40, steps=1, region=env.safe_set)):
        assert (collected.get(slice(None))["region"] == SAFE).all()
    assert env.initial_set is before
    with pytest.raises(ConfigError, match=r"region: expected a SafetyEnv, with transforms or without.*received SerialEnv; leave region out"):
        collect_random(SerialEnv(1, _small_environment), 10, region=env.safe_set)


def test_episodes_are_no_longer_than_asked(env):
    store = collect_random(env, 80, seed=0, steps=10, region=env.safe_set, keep_state=True)
    state = store.get(slice(None))["info", "state"].reshape(8, 10, 2)
    assert env.safe_set.contains(state[:, 0]).all()


def test_rollouts_follow_the_policy_and_add_to_a_store(env):
    policy = TensorDictModule(lambda pixels: pixels[:, 0, 0, :1].float() * 0 + 2.5, ["pixels"], ["action"])
    store = TransitionStore(500)
    collect_random(env, 60, seed=0, store=store)
    same = collect_rollouts(env, policy, 90, seed=1, steps=20, region=env.safe_set, store=store)
    assert same is store
    assert len(store) == 150
    assert (store.get(slice(60, 150))["action"] == 2.5).all()


def test_an_environment_function_works(env):
    store = collect_random(lambda: PendulumEnv(batch_size=[4], image_size=16), 30, seed=0)
    assert len(store) == 30


def _small_environment():
    return PendulumEnv(batch_size=[4], image_size=16)


@pytest.mark.slow
def test_worker_processes_collect_different_data():
    store = collect_random(_small_environment, 400, seed=0, backend="process", num_collectors=2, sync=True)
    assert len(store) == 400
    assert store.get(slice(None))["action"].unique().numel() > 390


def test_bad_arguments_are_named(env):
    with pytest.raises(ConfigError, match="n >= 1"):
        collect_random(env, 0)
    with pytest.raises(ConfigError, match="steps"):
        collect_random(env, 5, steps=0)
    with pytest.raises(ConfigError, match="region"):
        collect_random(lambda: env, 5, region=env.safe_set)


def exploring(exploration: float, random_share: float, value: float = 0.0) -> ExploringPolicy:
    policy = TensorDictModule(lambda pixels: torch.full((*pixels.shape[:-1], 1), value), ["pixels"], ["action"])
    return ExploringPolicy(policy, torch.tensor([-2.0]), torch.tensor([2.0]), exploration, random_share)


def actions(policy: ExploringPolicy, n: int, times: int) -> torch.Tensor:
    torch.manual_seed(0)
    return torch.stack([policy(TensorDict(pixels=torch.zeros(n, 3), batch_size=n))["action"] for _ in range(times)])


def test_without_exploration_the_policy_is_itself():
    assert (actions(exploring(0.0, 0.0, 0.75), 4, 10) == 0.75).all()


def test_a_share_of_the_environments_acts_at_random_and_always_the_same_ones():
    found = actions(exploring(0.0, 0.25), 8, 400)
    assert (found[:, 2:] == 0).all()
    assert found[:, :2].abs().max() <= 2.0
    assert float(found[:, :2].std()) == pytest.approx(4 / 12**0.5, rel=0.05)  # uniform on an interval of length 4
    assert (actions(exploring(0.0, 1.0), 8, 10) != 0).all()


def test_a_single_environment_is_random_in_a_share_of_its_steps():
    found = actions(exploring(0.0, 0.5), 1, 400)
    assert float((found == 0).float().mean()) == pytest.approx(0.5, abs=0.08)


def test_noise_is_a_share_of_half_the_range_and_stays_in_the_bounds():
    found = actions(exploring(0.1, 0.0), 50, 200)
    assert float(found.std()) == pytest.approx(0.2, rel=0.03)
    assert abs(float(found.mean())) < 0.01
    at_the_edge = actions(exploring(0.1, 0.0, 2.0), 50, 20)
    assert at_the_edge.max() == 2.0
    assert float((at_the_edge == 2.0).float().mean()) == pytest.approx(0.5, abs=0.05)


def test_it_writes_nothing_but_the_action_and_leaves_the_policys_output_alone():
    policy = exploring(0.1, 0.5)
    data = TensorDict(pixels=torch.zeros(4, 3), other=torch.ones(4), batch_size=4)
    assert set(policy(data).keys()) == {"pixels", "other", "action"}
    assert policy.in_keys == ["pixels"]
    assert policy.out_keys == ["action"]


@pytest.mark.parametrize("before", [0, 3])
def test_random_actions_go_on_where_they_were(env, before):
    def draw(policy: RandomActions) -> torch.Tensor:
        return policy(TensorDict(batch_size=[8]))["action"]

    policy, other = RandomActions(env, 5), RandomActions(env, 5)
    for _ in range(before):
        draw(policy)
    draw(other)
    other.load_state_dict(policy.state_dict())
    assert torch.equal(draw(policy), draw(other))
    assert torch.equal(draw(policy), draw(other))


def test_random_actions_are_those_of_the_seed_whatever_process_makes_them(env, monkeypatch):
    def draw(policy: RandomActions, *process: int) -> torch.Tensor:
        monkeypatch.setattr(current_process(), "_identity", process)
        return policy(TensorDict(batch_size=[8]))["action"]

    drawn, workers = [], []
    for home in ((), (1,), (2,)):
        monkeypatch.setattr(current_process(), "_identity", home)
        policy = RandomActions(env, 5)
        sent = pickle.dumps(policy)
        workers.append([draw(kind(sent), *home, k) for k in (1, 2) for kind in (pickle.loads, lambda body: copy.deepcopy(pickle.loads(body)))])
        drawn.append(draw(policy, *home))
    expected = torch.Generator().manual_seed(5), torch.Generator().manual_seed(5 + 1_000_003)
    alone, first = (-10 + torch.rand(8, 1, generator=generator) * 20 for generator in expected)
    for own, of_workers in zip(drawn, workers, strict=True):
        assert torch.equal(own, alone)
        assert torch.equal(of_workers[0], first)
        assert torch.equal(of_workers[0], of_workers[1])
        assert torch.equal(of_workers[2], of_workers[3])
        assert not torch.equal(of_workers[0], of_workers[2])


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """A function that moves temporary files into a folder whose name has so many bytes more."""

    def move(longer):
        folder = tmp_path.joinpath(*["x" * 50] * (longer // 50))
        folder.mkdir(parents=True, exist_ok=True)
        monkeypatch.setattr(tempfile, "tempdir", str(folder))
        return folder

    monkeypatch.delitem(current_process()._config, "tempdir", raising=False)
    monkeypatch.setitem(current_process()._config, "tempdir", None)  # so that it is put back afterwards
    return move


def test_sockets_have_names_that_fit_however_long_the_folder_of_temporary_files(temporary):
    temporary(150)
    collect._shorten_sockets()
    with connection.Listener(family="AF_UNIX"):
        pass


def test_sockets_stay_where_they_fit(temporary, monkeypatch):
    monkeypatch.setattr(collect, "_SOCKET", 400)
    folder = temporary(150)
    collect._shorten_sockets()
    assert util.get_temp_dir().startswith(str(folder))


def test_without_room_for_sockets_nothing_waits_for_them(temporary, monkeypatch):
    temporary(150)
    util.get_temp_dir()

    def refuse(**options):
        raise PermissionError

    monkeypatch.setattr(tempfile, "mkdtemp", refuse)
    with pytest.raises(ConfigError, match="TMPDIR: expected a folder whose name has at most 71 bytes"):
        collect._shorten_sockets()

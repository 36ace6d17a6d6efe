"""Foreign environments through their own pictures: frames, labels, actions, seeds, and what is refused."""

from __future__ import annotations

import gc
import os
import signal
import time
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_sspl.data import collect_random
from torchrl_sspl.envs import games
from torchrl_sspl.envs.games import area_averaged
from torchrl_sspl.envs.gymnasium import GymnasiumPixels
from torchrl_sspl.errors import ConfigError, NonFiniteError, OverlapError, WorkerError
from torchrl_sspl.sets import SAFE, UNLABELLED, UNSAFE


class Slider(gymnasium.Env):
    """A white column on black moves by the action; state and info tell where it is."""

    render_mode = "rgb_array"
    observation_space = spaces.Box(-50, 50, (1,), np.float64)

    def __init__(self, action_space=None, lifetime: int = 10**6) -> None:
        self.action_space = action_space or spaces.Box(0.0, 4.0, (1,), np.float32)
        self.lifetime, self.actions = lifetime, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.age = float(self.np_random.integers(4, 12)), 0
        self.x = (options or {}).get("x", self.x)
        return np.array([self.x]), {"x": self.x}

    def step(self, action):
        self.actions.append(action)
        self.x, self.age = float(np.clip(self.x + float(np.sum(action)) - 2, 0, 15)), self.age + 1
        return np.array([self.x]), self.x, self.age >= self.lifetime, False, {"x": self.x}

    def render(self):
        picture = np.zeros((32, 32, 3), np.uint8)
        at = 2 * round(self.x)
        picture[:, at : at + 2] = 255
        return picture


def slider(n=2, *, make=Slider, **options):
    options = {"safe": lambda state, info: info["x"] < 5, "unsafe": lambda state, info: state[0] > 10, **options}
    return GymnasiumPixels(make, batch_size=[n], image_size=16, **{"seed": 0, **options})


def position(frame: torch.Tensor) -> torch.Tensor:
    return frame.float().mean((-3, -2)).argmax(-1)


def test_specs_hold():
    check_env_specs(slider())
    sets = {"safe": lambda state, info: abs(state[2]) < 0.05, "unsafe": lambda state, info: abs(state[2]) > 0.1}
    check_env_specs(slider(1, make=lambda: gymnasium.make("CartPole-v1", render_mode="rgb_array"), **sets))


def test_second_frame_shows_now_and_first_frame_shows_one_step_before():
    data = slider(3).rollout(6, break_when_any_done=False)
    now = position(data["next", "pixels"][:, :, 3:])
    assert torch.equal(now, data["next", "state"][..., 0].round().long())
    assert torch.equal(data["next", "pixels"][:, :, :3], data["pixels"][:, :, 3:])


def test_labels_follow_the_predicates_on_info_and_on_state():
    env = slider(1)
    for x, region in ((2.0, SAFE), (7.0, UNLABELLED), (13.0, UNSAFE)):
        env.reset_options = {"x": x}
        assert env.reset()["region"].item() == region


def test_first_frames_show_the_motion_of_one_step():
    env = slider(1, reset_options={"x": 6.0}, make=lambda: Slider(spaces.Box(0.0, 10.0, (1,), np.float32)))
    pixels = env.reset()["pixels"][0]
    assert (position(pixels[:3]).item(), position(pixels[3:]).item()) == (6, 9)  # middle action 5, less 2


def test_systems_at_rest_start_where_they_are_put():
    env = slider(1, reset_options={"x": 6.0}, settle=False)
    data = env.reset()
    assert torch.equal(data["pixels"][0, :3], data["pixels"][0, 3:])
    assert data["state"].item() == 6.0
    assert not env._games.games[0].env.actions


def test_reset_options_may_be_drawn():
    env = slider(4, reset_options=lambda random: {"x": float(random.integers(0, 3))})
    assert env.reset()["state"].max() <= 3
    assert len({env.reset()["state"].sum().item() for _ in range(8)}) > 1


def test_actions_are_distances_from_the_middle_of_the_box_and_clamped():
    env = slider(1)
    env.reset()
    for action, native in ((0.0, 2.0), (-2.0, 0.0), (1.5, 3.5), (99.0, 4.0)):
        env.step(TensorDict(action=torch.tensor([[action]]), batch_size=[1]))
        assert env._games.games[0].env.actions[-1] == pytest.approx(native)
    assert env.max_action == 2.0


def test_components_keep_their_own_ranges():
    env = slider(1, make=lambda: Slider(spaces.Box(np.array([0.0, -1.0]), np.array([4.0, 1.0]), dtype=np.float64)))
    assert env.max_action == [2.0, 1.0]
    assert env.action_spec.space.high.tolist() == [[2.0, 1.0]]


def test_whole_numbers_are_the_nearest():
    env = slider(1, make=partial(Slider, spaces.Box(0, 10, (1,), np.int64)), settle=False)
    env.reset()
    game = env._games.games[0].env
    for action in (-5.0, 0.6, 4.9, 5.0):
        env.step(TensorDict(action=torch.tensor([[action]]), batch_size=[1]))
    assert [int(a[0]) for a in game.actions] == [0, 6, 10, 10]


@pytest.mark.parametrize(("action", "choice"), [(-1.0, 5), (-0.4, 5), (-0.2, 6), (0.2, 6), (0.4, 7), (1.0, 7), (9.0, 7)])
def test_discrete_actions_cut_the_interval_into_equal_parts(action, choice):
    env = slider(1, make=lambda: Slider(spaces.Discrete(3, start=5)))
    env.reset()
    env.step(TensorDict(action=torch.tensor([[action]]), batch_size=[1]))
    assert env._games.games[0].env.actions[-1] == choice


@pytest.mark.parametrize(
    ("action", "choices"),
    [(-1.0, [5, 5]), (-0.7, [5, 5]), (-0.5, [6, 5]), (-0.3, [6, 5]), (0.0, [6, 6]), (0.3, [7, 6]), (0.9, [7, 7]), (2.0, [7, 7])],
)
def test_neighbouring_numbers_mix_where_actions_repeat(action, choices):
    env = slider(1, make=lambda: Slider(spaces.Discrete(3, start=5)), action_repeat=2, settle=False)
    env.reset()
    env.step(TensorDict(action=torch.tensor([[action]]), batch_size=[1]))
    assert env._games.games[0].env.actions == choices


def test_same_seed_gives_the_same_episodes_and_another_seed_others():
    store = [collect_random(slider(2), 40, seed=seed, steps=5).get(slice(None))["frames"] for seed in (3, 3, 4)]
    assert torch.equal(store[0], store[1])
    assert not torch.equal(store[0], store[2])


def test_horizon_truncates_and_gymnasium_terminates():
    data = slider(1, horizon=4).rollout(10)
    assert data["next", "truncated"].flatten().tolist() == [False] * 3 + [True]
    data = slider(1, make=lambda: Slider(lifetime=4)).rollout(10)
    assert data["next", "terminated"].flatten().tolist() == [False, False, True]  # one step has passed in the reset


def test_repeated_actions_lie_between_two_frames():
    env = slider(1, action_repeat=3, reset_options={"x": 2.0}, settle=False)
    data = env.rollout(2, policy=lambda td: td.set("action", torch.full((1, 1), 1.0)))  # each of the three moves by 1
    assert data["next", "state"].flatten().tolist() == [5.0, 8.0]
    assert torch.equal(data["next", "pixels"][:, :, :3], data["pixels"][:, :, 3:])
    short = slider(1, make=lambda: Slider(lifetime=4), action_repeat=3, settle=False).rollout(5)
    assert short["next", "terminated"].flatten().tolist() == [False, True]


def test_episodes_may_go_on_where_gymnasium_ends_them():
    make = {"make": lambda: Slider(lifetime=3)}
    data = slider(1, ignore_termination=True, horizon=8, **make).rollout(20)
    assert not data["next", "terminated"].any()
    assert data["next", "truncated"].flatten().tolist() == [False] * 7 + [True]
    with pytest.raises(ConfigError, match=r"horizon.*ignore_termination"):
        slider(1, ignore_termination=True, **make)


def test_ended_environments_restart_alone():
    env = slider(2)
    env.reset()
    steps = env.step(TensorDict(action=torch.ones(2, 1), batch_size=[2]))["next"]
    steps["_reset"] = torch.tensor([[False], [True]])
    again = env.reset(steps)
    assert torch.equal(again["pixels"][0], steps["pixels"][0])
    assert env._steps == [1, 0]


def test_what_cannot_work_is_refused():
    with pytest.raises(ConfigError, match="render_mode='rgb_array'"):
        slider(make=lambda: gymnasium.make("CartPole-v1"))
    with pytest.raises(ConfigError, match="finite bounds"):
        slider(make=lambda: Slider(spaces.Box(-np.inf, np.inf, (1,), np.float32)))
    closed = []

    class Closed(Slider):
        def close(self):
            closed.append(True)

    largest = float(np.finfo(np.float32).max)
    with pytest.raises(ConfigError, match="finite bounds"):
        slider(1, make=lambda: Closed(spaces.Box(-largest, largest, (1,), np.float32)))
    assert closed == [True]
    with pytest.raises(ConfigError, match="finite bounds"):
        slider(make=lambda: Slider(spaces.MultiBinary(3)))
    with pytest.raises(ConfigError, match=r"safe: expected a predicate .* AttributeError"):
        slider(safe=lambda state, info: state.angle > 0).reset()
    for space in (None, spaces.Discrete(3)):
        env = slider(2, make=partial(Slider, space))
        env.reset()
        with pytest.raises(NonFiniteError, match="NaN"):
            env.step(TensorDict(action=torch.full((2, 1), torch.nan), batch_size=[2]))
    with pytest.raises(OverlapError, match="exclude each other"):
        slider(unsafe=lambda state, info: True, reset_options={"x": 1.0}).reset()
    with pytest.raises(ConfigError, match="survives one step"):
        slider(make=lambda: Slider(lifetime=1)).reset()
    with pytest.raises(ConfigError, match="batch_size"):
        slider(0)
    with pytest.raises(ConfigError, match="horizon"):
        slider(horizon=0)
    with pytest.raises(ConfigError, match="action_repeat"):
        slider(action_repeat=0)
    with pytest.raises(ConfigError, match="image_size"):
        GymnasiumPixels(Slider, safe=bool, unsafe=bool, image_size=2)


class Camera(Slider):
    """Observes the picture; what it would render shows more."""

    observation_space = spaces.Box(0, 255, (32, 32, 3), np.uint8)
    render_mode = None

    def reset(self, *, seed=None, options=None):
        info = super().reset(seed=seed, options=options)[1]
        return Slider.render(self), info

    def step(self, action):
        rest = super().step(action)[1:]
        return Slider.render(self), *rest

    def render(self):
        raise AssertionError


def test_an_observation_that_is_a_picture_is_what_the_networks_see():
    env = slider(1, make=Camera, reset_options={"x": 6.0}, settle=False, unsafe=lambda picture, info: info["x"] > 10)
    assert "state" not in env.observation_spec
    check_env_specs(env)
    data = env.rollout(3, policy=lambda td: td.set("action", torch.full((1, 1), 1.0)))
    assert position(data["pixels"][0, :, :3]).tolist() == [6, 6, 7]
    assert position(data["next", "pixels"][0, :, 3:]).tolist() == [7, 8, 9]


@pytest.mark.parametrize("shape", [(400, 600), (65, 70), (500, 500), (30, 40), (64, 300), (720, 1280)])
@pytest.mark.parametrize("size", [32, 64, 96])
def test_pictures_are_averaged_as_torch_does_it_bit_for_bit(shape, size):
    rng = np.random.default_rng(0)
    for picture in (rng.integers(0, 256, (*shape, 3), dtype=np.uint8), np.full((*shape, 3), 255, np.uint8)):
        channels = torch.from_numpy(picture).permute(2, 0, 1)[None].float()
        area = torch.nn.functional.interpolate(channels, size=(size, size), mode="area")[0].add(0.5).to(torch.uint8)
        by_columns = np.ascontiguousarray(picture.transpose(1, 0, 2)).transpose(1, 0, 2)
        for same in (picture, by_columns):
            assert torch.equal(torch.from_numpy(area_averaged(same, size)).permute(2, 0, 1), area)


spread = pytest.mark.skipif(not hasattr(os, "fork"), reason="environments are spread by forking")


@spread
def test_environments_in_other_processes_show_the_same():
    def drawn(random):
        return {"x": float(random.integers(0, 16))}

    def seen(workers):
        make = partial(Slider, lifetime=5)  # some end, and begin again by themselves
        env = slider(5, make=make, workers=workers, reset_options=drawn, horizon=7)
        env.set_seed(3)
        data = env.rollout(12, policy=lambda td: td.set("action", torch.linspace(-2, 2, 5)[:, None]), break_when_any_done=False)
        env.close()
        return data

    here, elsewhere = seen(1), seen(3)
    assert (here == elsewhere).all()


def running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@spread
@pytest.mark.parametrize("end", [GymnasiumPixels.close, lambda env: None], ids=["closed", "forgotten"])
def test_processes_end_with_the_environment(end):
    env = slider(4, workers=2)
    processes = env._games.processes
    assert [running(pid) for pid in processes] == [True, True]
    end(env)
    del env
    gc.collect()
    assert not any(map(running, processes))


@spread
def test_without_a_further_process_signals_reach_the_parent_again(monkeypatch):
    def fail():
        raise BlockingIOError("no more processes")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fork", fail)
        with pytest.raises(WorkerError, match="expected 2 processes, received no more processes for number 1"):
            slider(2, workers=2)
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ())


@spread
def test_a_process_that_does_not_end_is_killed(monkeypatch):
    class Stubborn(Slider):
        def close(self):
            time.sleep(60)

    monkeypatch.setattr(games, "_PATIENCE", 0.1)
    env, began = slider(2, make=Stubborn, workers=2), time.monotonic()
    processes = env._games.processes
    env.close()
    assert not any(map(running, processes))
    assert time.monotonic() - began < 30


@spread
def test_a_fork_of_the_parent_leaves_them_alone():
    env = slider(2, workers=2)
    fork = os.fork()
    if fork == 0:
        env._games.close()
        os._exit(0)
    os.waitpid(fork, 0)
    assert env.reset()["state"].shape == (2, 1)
    env.close()


@spread
def test_signals_are_for_the_parent():
    # Whoever has drawn with pygame does not end on SIGTERM anyway.
    before = {number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGINT, signal.SIGTERM)}
    env = slider(2, workers=2)
    for number, handler in before.items():
        for pid in env._games.processes:
            os.kill(pid, number)
        signal.signal(number, handler)
    assert env.reset()["state"].shape == (2, 1)
    env.close()


@spread
def test_what_is_printed_is_printed_once_and_a_child_has_one_thread(tmp_path, monkeypatch):
    def unsafe(state, info):
        print("judged", end="")
        return torch.get_num_threads() > 1

    threads, stdout = torch.get_num_threads(), os.dup(1)
    with (tmp_path / "printed").open("w") as file:
        os.dup2(file.fileno(), 1)  # the only open files that a child keeps are those of every process
    with open(1, "w", closefd=False) as stream:
        monkeypatch.setattr("sys.stdout", stream)
        print("before", end="")
        torch.set_num_threads(2)
        env = slider(2, workers=2, unsafe=unsafe)
        torch.set_num_threads(threads)
        assert (env.reset()["region"] != UNSAFE).all()
        env.close()
    os.dup2(stdout, 1)
    os.close(stdout)
    printed = (tmp_path / "printed").read_text()
    assert printed.count("before") == 1
    assert printed.count("judged") >= 2


@spread
def test_processes_end_with_their_parent():
    read, write = os.pipe()
    parent = os.fork()
    if parent == 0:  # one that is killed has no time to close anything
        env = slider(4, workers=2)
        os.write(write, repr(env._games.processes).encode())
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(parent, 0)
    processes = eval(os.read(read, 100))
    until = time.monotonic() + 10
    while any(map(running, processes)) and time.monotonic() < until:
        time.sleep(0.05)
    assert len(processes) == 2
    assert not any(map(running, processes))


@spread
def test_what_goes_wrong_in_another_process_is_told():
    with pytest.raises(ConfigError, match="render_mode='rgb_array'"):
        slider(2, make=lambda: gymnasium.make("CartPole-v1"), workers=2)
    with pytest.raises(OverlapError, match="exclude each other"):
        slider(workers=2, unsafe=lambda state, info: True, reset_options={"x": 1.0}).reset()
    with pytest.raises(ConfigError, match="survives one step"):
        slider(make=lambda: Slider(lifetime=1), workers=2).reset()
    with pytest.raises(ConfigError, match="workers"):
        slider(workers=0)
    env = slider(workers=2)
    env.reset()
    os.kill(env._games.processes[1], signal.SIGKILL)
    with pytest.raises(WorkerError, match="workers=1"):
        env.step(TensorDict(action=torch.zeros(2, 1), batch_size=[2]))


@spread
def test_an_interrupted_question_leaves_no_answer_to_the_next():
    env = slider(2, workers=2, reset_options={"x": 6.0}, settle=False)
    env.reset()
    env._games._pipes[0].send((env._games._asked, "step", {0: ([4.0],)}))  # asked, and its answer never fetched
    data = env.step(TensorDict(action=torch.full((2, 1), 1.0), batch_size=[2]))["next"]
    assert data["state"].flatten().tolist() == [9.0, 7.0]

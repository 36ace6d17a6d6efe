"""The robot in full physics: it walks where it is told, its contacts are seen, and faults are named."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest
import torch

from torchrl_sspl.envs import DubinsEnv
from torchrl_sspl.errors import ConfigError, DTypeError, MissingDependencyError, NonFiniteError, ShapeError, SolverError

pytest.importorskip("pybullet")
from torchrl_sspl.envs.quadruped import world
from torchrl_sspl.envs.quadruped.camera import RenderError, TopCamera
from torchrl_sspl.envs.quadruped.env import QuadrupedEnv
from torchrl_sspl.envs.quadruped.robot import WalkingRobot

pytestmark = pytest.mark.pybullet


@pytest.fixture(scope="module")
def env():
    made = QuadrupedEnv()
    yield made
    made.close()


def test_start_is_where_it_was_asked_for_and_frames_agree_with_the_model(env):
    pose = [-1.4, 1.2, 0.7]
    pixels, info = env.reset(options={"pose": pose, "phase": 0.0})
    assert pixels.shape == (6, 128, 128)
    assert pixels.dtype == np.uint8
    np.testing.assert_allclose(info["pose"], pose, atol=0.03)
    model = DubinsEnv(batch_size=[1], seed=0)
    drawn = model.observe(torch.as_tensor(info["pose"], dtype=torch.float32)[None])[0, 3:]
    differs = (drawn.int() - torch.as_tensor(pixels[3:]).int()).abs().amax(0) > 60
    assert float(differs.float().mean()) < 0.006  # legs in another phase: some dozen pixels
    assert not any(info[name] for name in ("unsafe", "contact", "fallen", "left"))


def test_an_arena_of_another_size_is_seen_as_the_model_draws_it():
    model = DubinsEnv(arena_half_size=3.0, safe_half_size=2.2, image_size=64)
    world_ = model.physics()(render_mode="rgb_array")
    pixels, info = world_.reset(options={"pose": [2.7, -2.6, 0.7], "phase": 0.0})
    drawn = model.observe(torch.as_tensor(info["pose"], dtype=torch.float32)[None])[0, 3:].numpy()
    large = world_.render()
    world_.close()
    for red in (lambda f: (f[0] > 150) & (f[1] < 100), lambda f: (f[2] > 150) & (f[1] < 100)):  # the obstacle, the robot
        (there, here, shown) = (np.argwhere(red(f.astype(int))) for f in (pixels[3:], drawn, large.transpose(2, 0, 1)))
        np.testing.assert_allclose(there.mean(0), here.mean(0), atol=1.0)
        np.testing.assert_allclose(shown.mean(0) / 8, here.mean(0), atol=1.0)
        assert len(there) == pytest.approx(len(here), rel=0.2, abs=3)


def test_walks_a_metre_a_second_and_turns_as_told(env):
    _, info = env.reset(options={"pose": [-1.5, -1.7, 0.0], "phase": 0.3})
    first = info["pose"]
    for _ in range(10):
        _, _, terminated, _, info = env.step(np.array([0.0]))
        assert not terminated
    assert np.hypot(*(info["pose"] - first)[:2]) == pytest.approx(1.0, abs=0.06)
    heading = info["pose"][2]
    for _ in range(10):
        _, _, _, _, info = env.step(np.array([1.0]))
    assert info["pose"][2] - heading == pytest.approx(1.0, abs=0.15)


def test_at_another_speed_it_starts_in_the_gait_of_that_speed():
    slow = QuadrupedEnv(speed=0.5, image_size=16)
    _, info = slow.reset(options={"pose": [-1.8, 0.0, 0.0], "phase": 0.0})
    places = [info["pose"][0], *(slow.step(np.array([0.0]))[4]["pose"][0] for _ in range(2))]
    slow.close()
    np.testing.assert_allclose(places, [-1.8, -1.75, -1.7], atol=0.01)


def test_touching_the_obstacle_is_seen_and_costs(env):
    env.reset(options={"pose": [-1.1, 0.0, 0.0]})
    for _ in range(8):
        _, reward, _, _, info = env.step(np.array([0.0]))
        if info["contact"]:
            break
    assert info["contact"]
    assert info["unsafe"]
    assert reward == -1.0


def test_leaving_the_arena_ends_the_episode_safely(env):
    env.reset(options={"pose": [1.85, 1.0, 0.0]})
    for _ in range(4):
        _, reward, terminated, _, info = env.step(np.array([0.0]))
        if terminated:
            break
    assert info["left"]
    assert reward == 0.0


def test_actions_beyond_the_bound_are_clipped(env):
    poses = []
    for rate in (2.0, 50.0):
        env.reset(options={"pose": [-1.5, -1.7, 0.0], "phase": 0.0})
        poses.append(env.step(np.array([rate]))[4]["pose"])
    np.testing.assert_allclose(*poses, atol=1e-9)


@pytest.mark.parametrize(
    ("action", "error"), [([math.nan], NonFiniteError), ([math.inf], NonFiniteError), ([0.0, 1.0], ShapeError)]
)
def test_bad_actions_are_refused_and_nothing_moves(env, action, error):
    _, info = env.reset(options={"pose": [-1.5, -1.7, 0.0]})
    with pytest.raises(error):
        env.step(np.array(action))
    np.testing.assert_array_equal(env._robot.pose, info["pose"])


def test_a_push_moves_the_robot_to_its_left_once(env):
    moved = []
    for impulse in (0.0, 12.0, -12.0):
        env.reset(options={"pose": [-1.5, -1.7, 0.0], "phase": 0.0})
        env.push(impulse)
        found = [env.step(np.array([0.0]))[4]["pose"] for _ in range(4)]
        moved.append((found[0][1], float(env._robot.measured.velocity[1])))
    (still, calm), (left, after), (right, _) = moved
    assert left - still > 0.03
    assert still - right > 0.03
    assert abs(after - calm) < 0.3  # the push is over, and what it gave is gone
    env.push(12.0)
    env.reset(options={"pose": [-1.5, -1.7, 0.0], "phase": 0.0})  # forgotten
    assert env.step(np.array([0.0]))[4]["pose"][1] == still
    with pytest.raises(NonFiniteError, match="impulse"):
        env.push(math.inf)


def test_ground_that_is_too_slippery_makes_it_fall(env):
    ice = DubinsEnv(batch_size=[1]).physics()(friction=0.05)
    fell = []
    for world_ in (env, ice):
        world_.reset(options={"pose": [-1.5, -1.7, 0.0], "phase": 0.0})
        fell.append(any(world_.step(np.array([1.5]))[4]["fallen"] for _ in range(8)))
    ice.close()
    assert fell == [False, True]
    with pytest.raises(ConfigError, match="friction"):
        QuadrupedEnv(friction=0.0)


def test_gymnasium_finds_it_and_several_live_in_one_process(env):
    made = gymnasium.make("SSPL/QuadrupedObstacle-v0", obstacle_shape="disc", render_mode="rgb_array")
    pixels, info = made.reset(seed=3)
    again, same = made.reset(seed=3)
    np.testing.assert_array_equal(info["pose"], same["pose"])
    np.testing.assert_array_equal(pixels, again)
    assert info["safe"]
    assert made.observation_space.contains(pixels)
    before = env._robot.pose.copy()
    made.step(made.action_space.sample())
    np.testing.assert_array_equal(env._robot.pose, before)
    assert made.render().shape == (512, 512, 3)
    made.close()
    made.unwrapped.close()  # twice does no harm


def test_bad_parameters_are_named():
    for arguments, words in (
        ({"max_yaw_rate": math.nan}, "max_yaw_rate"),
        ({"obstacle_half_size": 0.9}, "obstacle <= unsafe"),
        ({"arena_half_size": 1.0}, "safe < arena"),  # no start would ever be found
        ({"obstacle_centre": [math.nan, 0.0]}, "obstacle_centre"),
        ({"obstacle_centre": [0.0]}, "obstacle_centre"),
        ({"obstacle_centre": [9.0, 0.0]}, "obstacle_centre"),
        ({"render_mode": "film"}, "render_mode"),
        ({"obstacle_shape": "star"}, "obstacle_shape"),
    ):
        with pytest.raises(ConfigError, match=words):
            QuadrupedEnv(**arguments)


def test_options_and_order_are_checked(env):
    with pytest.raises(ConfigError, match="pose"):
        env.reset(options={"place": [0, 0, 0]})
    with pytest.raises(ShapeError, match="pose"):
        env.reset(options={"pose": [0.0]})
    fresh = object.__new__(QuadrupedEnv)
    fresh._frames = None
    with pytest.raises(ConfigError, match="reset"):
        fresh.step(np.array([0.0]))


def test_missing_display_mesh_and_package_are_clear_errors(monkeypatch, tmp_path):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(ConfigError, match="display"):
        QuadrupedEnv(render_mode="human")
    monkeypatch.setattr(world, "import_pybullet", lambda: (None, str(tmp_path)))
    (tmp_path / "a1").mkdir()
    (tmp_path / "a1" / "a1.urdf").write_text('<robot><mesh filename="meshes/trunk.obj"/></robot>')
    with pytest.raises(MissingDependencyError, match=r"trunk\.obj"):
        world.add_robot(None, meshes=True)


def test_camera_that_does_not_see_the_robot_says_so(env):
    away = TopCamera(env._client, 64, centre=(50.0, 0.0))
    with pytest.raises(RenderError, match="robot"):
        away.capture(env._robot.body_id)


def walk(robot: WalkingRobot, steps: int) -> None:
    for _ in range(steps):
        robot.step([1.0, 0.0, 0.0])


def test_unsolved_programs_fall_back_for_a_while_and_then_raise():
    client = world.connect()
    robot = WalkingRobot(client, solver=lambda hessian, *_: (np.zeros(len(hessian)), -1))
    with pytest.raises(SolverError):
        walk(robot, 2000)
    assert robot.controller.mpc.failures > 1
    client.disconnect()


def test_what_is_no_phase_and_no_pose_and_an_environment_that_is_closed_are_named(env):
    for key, value, error in (("phase", "x", DTypeError), ("phase", math.nan, NonFiniteError), ("pose", "abc", DTypeError), ("pose", [0.0], ShapeError)):
        with pytest.raises(error, match=f"{key}: expected"):
            env.reset(options={key: value})
    with pytest.raises(RenderError):
        env.reset(options={"pose": [50.0, 0.0, 0.0]})
    closed = QuadrupedEnv(image_size=16)
    closed.reset(seed=0)
    closed.close()
    for call in (closed.reset, lambda: closed.step([0.0])):
        with pytest.raises(ConfigError, match=r"received one after close\(\)"):
            call()

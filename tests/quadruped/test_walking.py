"""The walking controller: it tracks, does not fall, and says what is wrong."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("pybullet")
pytest.importorskip("daqp")
from torchrl_sspl.envs.quadruped.controller import check_command
from torchrl_sspl.envs.quadruped.gait import PERIOD
from torchrl_sspl.envs.quadruped.kinematics import SHOULDER, cross, forward_kinematics, inverse_kinematics
from torchrl_sspl.envs.quadruped.robot import WalkingRobot
from torchrl_sspl.envs.quadruped.world import connect
from torchrl_sspl.errors import NonFiniteError, ShapeError

pytestmark = pytest.mark.pybullet


@pytest.fixture(scope="module")
def robot():
    client = connect()
    made = WalkingRobot(client)
    yield made
    client.disconnect()


@pytest.fixture(scope="module")
def gait(robot):
    return robot.steady_gait()


def test_products_of_vectors_are_those_of_numpy():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=3), rng.normal(size=(4, 3))
    assert np.array_equal(cross(a, b), np.cross(a, b))
    assert np.array_equal(cross(a, b[0]), np.cross(a, b[0]))


def test_inverse_kinematics_undo_forward_kinematics():
    rng = np.random.default_rng(0)
    joints = np.stack([rng.uniform(-0.5, 0.5, 4), rng.uniform(0.3, 1.2, 4), rng.uniform(-2.2, -1.0, 4)], axis=1)
    feet, _ = forward_kinematics(joints)
    np.testing.assert_allclose(inverse_kinematics(feet), joints, atol=1e-6)
    assert np.abs(feet - SHOULDER).max() < 0.45


def test_leg_jacobians_are_derivatives():
    joints = np.tile([0.1, 0.8, -1.6], (4, 1))
    feet, jacobians = forward_kinematics(joints)
    for k in range(3):
        moved = joints.copy()
        moved[:, k] += 1e-6
        np.testing.assert_allclose((forward_kinematics(moved)[0] - feet) / 1e-6, jacobians[:, :, k], atol=1e-4)


@pytest.mark.parametrize("yaw_rate", [0.0, 2.0, -3.0])
def test_tracks_speed_and_yaw_rate(robot, gait, yaw_rate):
    robot.place(gait[0], 0.0, 0.0, 0.0)
    cycle = round(PERIOD / robot.dt)
    for _ in range(4 * cycle):
        robot.step([1.0, 0.0, yaw_rate])
    headings, speeds = [], []
    for _ in range(cycle):
        headings.append(robot.pose[2])
        speeds.append(float(robot.measured.velocity @ robot.measured.rotation[:, 0]))
        robot.step([1.0, 0.0, yaw_rate])
    turned = (robot.pose[2] - headings[0] + math.pi) % (2 * math.pi) - math.pi
    assert np.mean(speeds) == pytest.approx(1.0, abs=0.06)
    assert turned / (cycle * robot.dt) == pytest.approx(yaw_rate, abs=0.05)
    assert not robot.fallen


def test_sudden_changes_of_the_command_do_not_fell_it(robot, gait):
    rng = np.random.default_rng(1)
    robot.place(gait[3], 0.0, 0.0, 1.0)
    for _ in range(20):
        rate = rng.choice([-2.0, 2.0])
        for _ in range(50):
            robot.step([1.0, 0.0, rate])
        assert not robot.fallen


def test_a_moved_gait_continues_as_it_would_have(robot, gait):
    paths = []
    for x, y, heading in ((0.0, 0.0, 0.0), (1.0, -0.5, 1.2)):
        robot.place(gait[0], x, y, heading)
        start = robot.pose
        for _ in range(100):
            robot.step([1.0, 0.0, 0.5])
        moved = robot.pose[:2] - start[:2]
        cos, sin = math.cos(heading), math.sin(heading)
        paths.append([cos * moved[0] + sin * moved[1], cos * moved[1] - sin * moved[0], robot.pose[2] - start[2]])
    np.testing.assert_allclose(paths[0], paths[1], atol=0.01)


@pytest.mark.parametrize(("command", "error"), [([1.0, 0.0], ShapeError), ([1.0, 0.0, math.nan], NonFiniteError)])
def test_bad_commands_are_refused(command, error):
    with pytest.raises(error):
        check_command(command)


def test_lying_robot_counts_as_fallen(robot, gait):
    robot.place(gait[0], 0.0, 0.0, 0.0)
    measured = gait[0].measured
    low = type(measured)(np.array([0.0, 0.0, 0.1]), *[getattr(measured, n) for n in ("rotation", "velocity", "angular_velocity", "joints", "joint_velocities")])
    robot.pose_as(low)
    assert robot.fallen

"""The A1 in a PyBullet world, with its walking controller."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchrl_sspl.envs.quadruped.controller import Body, Measurement, Memory, WalkingController
from torchrl_sspl.envs.quadruped.gait import GRAVITY, HEIGHT, PERIOD
from torchrl_sspl.envs.quadruped.kinematics import (
    LEGS,
    SHOULDER,
    TOE_RADIUS,
    Array,
    cross,
    inverse_kinematics,
    rotation_z,
)
from torchrl_sspl.envs.quadruped.mpc import Solver, solve_daqp
from torchrl_sspl.envs.quadruped.world import add_ground, add_robot

_FALLEN_HEIGHT, _FALLEN_TILT = 0.15, 0.8  # m, rad
_SETTLING_PERIODS = 8


@dataclass(frozen=True)
class Snapshot:
    """A moment of walking: state of the body and memory of the controller."""

    measured: Measurement
    memory: Memory


class WalkingRobot:
    """An A1 on level ground that walks as it is told, in the world of a PyBullet client from ``connect``.

    Gravity and the time step ``dt`` (s) are set here; ``meshes``: draw the robot's meshes. Raises
    MissingDependencyError without PyBullet's data or daqp.
    """

    def __init__(self, client: Any, *, dt: float = 0.002, solver: Solver = solve_daqp, meshes: bool = False) -> None:
        self.client, self.dt = client, dt
        self.measured: Measurement
        client.setGravity(0, 0, -GRAVITY)
        client.setTimeStep(dt)
        client.setPhysicsEngineParameter(numSolverIterations=30, enableConeFriction=0)
        self.ground = add_ground(client)
        self.body_id = add_robot(client, meshes=meshes)
        names = {client.getJointInfo(self.body_id, i)[1].decode(): i for i in range(client.getNumJoints(self.body_id))}
        self._joints = [names[f"{leg}_{part}_joint"] for leg in LEGS for part in ("hip", "upper", "lower")]
        self.toe_links = frozenset(names[f"{leg}_toe_fixed"] for leg in LEGS)
        # Positions of the base refer to its centre of mass and, as inertia is read from the file, to the principal
        # axes of its inertia; this is where they lie in the base frame.
        info = client.getDynamicsInfo(self.body_id, -1)
        self._offset, self._offset_turn = np.array(info[3]), _matrix(client, info[4])
        self._set_standing()
        self.controller = WalkingController(self._mass_distribution(), dt=dt, solver=solver)
        self.stand()

    def stand(self, x: float = 0.0, y: float = 0.0, heading: float = 0.0) -> None:
        """Stand still with the feet on the ground, at (x, y) in m with a heading in rad."""
        self._set_standing(x, y, heading, centre=float(self.controller.body.centre[0]))
        self.controller.reset(self.measured)

    def push(self, force: float) -> None:
        """Push the base to its left with a horizontal force in N, during the next ``dt``; a negative one to its right."""
        heading = self.pose[2]
        place = self.client.getBasePositionAndOrientation(self.body_id)[0]  # of the centre of mass
        aside = [-force * math.sin(heading), force * math.cos(heading), 0.0]
        self.client.applyExternalForce(self.body_id, -1, aside, place, self.client.WORLD_FRAME)

    def step(self, command: Array | list[float]) -> None:
        """Walk for ``dt`` at a command ``(3,)``: forward and lateral velocity in m/s, yaw rate in rad/s.

        Raises as ``WalkingController.torques``; the robot has not moved then.
        """
        torques = self.controller.torques(self.measured, command)
        self.client.setJointMotorControlArray(
            self.body_id, self._joints, self.client.TORQUE_CONTROL, forces=torques.ravel().tolist()
        )
        self.client.stepSimulation()
        self.measured = self._measure()

    @property
    def pose(self) -> Array:
        """``(3,)`` position x, y of the base in m and heading in rad."""
        return np.array([*self.measured.position[:2], self.measured.roll_pitch_yaw[2]])

    @property
    def fallen(self) -> bool:
        """Whether the base is below 0.15 m or tilted by more than 0.8 rad."""
        tilt = np.abs(self.measured.roll_pitch_yaw[:2]).max()
        return bool(self.measured.position[2] < _FALLEN_HEIGHT or tilt > _FALLEN_TILT)

    def place(self, snapshot: Snapshot, x: float, y: float, heading: float) -> None:
        """Continue a snapshot with the base at (x, y) in m and with a heading in rad."""
        then = snapshot.measured
        angle = heading - float(then.roll_pitch_yaw[2])
        turn = rotation_z(angle)
        shift = np.array([x, y, then.position[2]]) - turn @ then.position
        rotation, velocity, angular = (turn @ v for v in (then.rotation, then.velocity, then.angular_velocity))
        position = turn @ then.position + shift
        self.pose_as(Measurement(position, rotation, velocity, angular, then.joints, then.joint_velocities))
        self.controller.reset(self.measured, snapshot.memory.moved(angle, shift))

    def steady_gait(self, interval: int = 5, *, speed: float = 1.0) -> list[Snapshot]:
        """One period of walking straight ahead at a speed in m/s, after 2.9 s in which the gait settles.

        Snapshots are ``interval`` time steps apart, at phases 0, interval dt / period, ... of the gait.
        """
        self.stand()
        period, straight = round(PERIOD / self.dt), np.array([speed, 0.0, 0.0])
        for _ in range(_SETTLING_PERIODS * period):
            self.step(straight)
        snapshots = []
        for k in range(period):
            if k % interval == 0:
                snapshots.append(Snapshot(self.measured, self.controller.memory))
            self.step(straight)
        return snapshots

    def _set_standing(self, x: float = 0.0, y: float = 0.0, heading: float = 0.0, centre: float = 0.0) -> None:
        # The centre of mass is above the middle of the feet.
        joints = inverse_kinematics(SHOULDER + np.array([centre, 0.0, TOE_RADIUS - HEIGHT]))
        position, still = np.array([x, y, HEIGHT]), np.zeros(3)
        self.pose_as(Measurement(position, rotation_z(heading), still, still, joints, np.zeros((4, 3))))

    def pose_as(self, state: Measurement) -> None:
        """Put the body in a state, without the controller: for pictures."""
        client = self.client
        offset = state.rotation @ self._offset
        turned = state.rotation @ self._offset_turn
        client.resetBasePositionAndOrientation(
            self.body_id, (state.position + offset).tolist(), _quaternion(turned).tolist()
        )
        velocity = state.velocity + cross(state.angular_velocity, offset)
        client.resetBaseVelocity(self.body_id, velocity.tolist(), state.angular_velocity.tolist())
        for joint, angle, speed in zip(
            self._joints, state.joints.ravel().tolist(), state.joint_velocities.ravel().tolist(), strict=True
        ):
            client.resetJointState(self.body_id, joint, angle, speed)
        # PyBullet's own joint motors hold every joint until they are switched off.
        client.setJointMotorControlArray(self.body_id, self._joints, client.VELOCITY_CONTROL, forces=[0.0] * 12)
        self.measured = self._measure()

    def _measure(self) -> Measurement:
        client = self.client
        position, orientation = client.getBasePositionAndOrientation(self.body_id)
        velocity, angular = client.getBaseVelocity(self.body_id)
        states = client.getJointStates(self.body_id, self._joints)
        rotation = _matrix(client, orientation) @ self._offset_turn.T
        offset = rotation @ self._offset
        angular = np.array(angular)
        return Measurement(
            np.array(position) - offset,
            rotation,
            np.array(velocity) - cross(angular, offset),
            angular,
            np.array([s[0] for s in states]).reshape(4, 3),
            np.array([s[1] for s in states]).reshape(4, 3),
        )

    def _mass_distribution(self) -> Body:
        """Mass, centre of mass and inertia of the whole robot as it stands."""
        client, masses, places, inertias = self.client, [], [], []
        for link in range(-1, client.getNumJoints(self.body_id)):
            info = client.getDynamicsInfo(self.body_id, link)
            if link < 0:
                place, orientation = client.getBasePositionAndOrientation(self.body_id)
            else:
                place, orientation = client.getLinkState(self.body_id, link, computeForwardKinematics=1)[:2]
            turn = _matrix(client, orientation)
            masses.append(info[0])
            places.append(np.array(place))
            inertias.append(turn @ np.diag(info[2]) @ turn.T)
        mass = float(sum(masses))
        centre = sum(m * place for m, place in zip(masses, places, strict=True)) / mass
        inertia = np.zeros((3, 3))
        for m, place, own in zip(masses, places, inertias, strict=True):
            r = place - centre
            inertia += own + m * (r @ r * np.eye(3) - np.outer(r, r))
        return Body(mass, centre - self.measured.position, inertia)


def _matrix(client: Any, quaternion: Any) -> Array:
    return np.array(client.getMatrixFromQuaternion(quaternion)).reshape(3, 3)


def _quaternion(rotation: Array) -> Array:
    """Quaternion (x, y, z, w) of a rotation matrix."""
    r = rotation
    symmetric = np.array([
        [1 + r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
        [r[0, 1] + r[1, 0], 1 - r[0, 0] + r[1, 1] - r[2, 2], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
        [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 - r[0, 0] - r[1, 1] + r[2, 2], r[1, 0] - r[0, 1]],
        [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1 + r[0, 0] + r[1, 1] + r[2, 2]],
    ])  # fmt: skip
    q = symmetric[np.argmax(np.diag(symmetric))]
    return q / np.linalg.norm(q)

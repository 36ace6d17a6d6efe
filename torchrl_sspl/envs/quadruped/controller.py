"""Walking controller of the A1: trot, convex MPC for standing legs, joint control for swinging ones."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from torchrl_sspl.envs.quadruped import gait
from torchrl_sspl.envs.quadruped.kinematics import (
    SHOULDER,
    TOE_RADIUS,
    Array,
    Mask,
    clip,
    cross,
    forward_kinematics,
    inverse_kinematics,
    rotation_z,
    wrap_angle,
)
from torchrl_sspl.envs.quadruped.mpc import HORIZON, STEP, ConvexMPC, Solver, solve_daqp
from torchrl_sspl.errors import NonFiniteError, ShapeError

_MAX_TORQUE = 33.5  # N m, of every joint
_STIFFNESS, _DAMPING = 60.0, 1.5  # of swinging legs, N m/rad and N m s/rad
_MAX_JOINT_SPEED = 25.0  # rad/s, of the reference of swinging legs
_PRESS = 0.004  # m; footholds lie below the ground, so that the foot arrives in time
_INTEGRATOR_GAIN, _INTEGRATOR_LIMIT = 1.0, 0.2  # 1/s and m/s
_MPC_INTERVAL = 5  # calls per solution of the MPC
_ACCELERATION, _YAW_SLEW = 2.0, 40.0  # m/s^2 and rad/s^2, largest changes of the command
_HEADING_LEAD = 0.3  # rad, by which the reference may run ahead of the robot


@dataclass(frozen=True)
class Measurement:
    """State of the robot; arrays in the world frame unless said otherwise."""

    position: Array  # (3,) base origin in m
    rotation: Array  # (3, 3) base to world
    velocity: Array  # (3,) of the base origin in m/s
    angular_velocity: Array  # (3,) in rad/s
    joints: Array  # (4, 3) in rad
    joint_velocities: Array  # (4, 3) in rad/s

    @property
    def roll_pitch_yaw(self) -> Array:
        """Euler angles ``(3,)`` of the base, in rad."""
        r = self.rotation
        pitch = -np.arcsin(min(max(r[2, 0], -1.0), 1.0))
        return np.array([np.arctan2(r[2, 1], r[2, 2]), pitch, np.arctan2(r[1, 0], r[0, 0])])


@dataclass(frozen=True)
class Body:
    """Mass in kg, centre of mass ``(3,)`` in the base frame in m, inertia ``(3, 3)`` about it in kg m^2."""

    mass: float
    centre: Array
    inertia: Array


@dataclass(frozen=True)
class Memory:
    """What the controller remembers between two steps; with it, walking can be continued elsewhere."""

    steps: int
    command: Array
    heading: float
    integral: Array
    forces: Array
    footholds: Array
    lift_off: Array
    standing: Mask

    def moved(self, angle: float, shift: Array) -> Memory:
        """The same after a turn by an angle in rad about the vertical through the origin, then a shift in m."""
        turn = rotation_z(angle)
        return replace(
            self,
            heading=self.heading + angle,
            forces=self.forces @ turn.T,
            footholds=self.footholds @ turn.T + shift,
            lift_off=self.lift_off @ turn.T + shift,
        )


class WalkingController:
    r"""Joint torques that make the A1 walk at a commanded velocity and yaw rate.

    Standing legs: tau = -J' R' f with forces f of ``ConvexMPC``, solved at 100 Hz. Swinging legs: joint control
    towards the arc of the trot that ends at its foothold. Commands are slew limited, without which sudden changes
    of the yaw rate make the robot fall; integrators on velocity and heading remove what the model misses.

    ``body`` is the mass distribution of the whole robot, standing, ``dt`` the time between calls of ``torques`` in s.

    Source: Di Carlo et al. (2018). Deviation: slew limits and integrators.

    Example:
        >>> body = Body(12.0, np.zeros(3), np.diag([0.05, 0.15, 0.18]))
        >>> stance = inverse_kinematics(SHOULDER + [0.0, 0.0, 0.02 - 0.28])
        >>> still = np.zeros(3)
        >>> robot = Measurement(np.array([0.0, 0.0, 0.28]), np.eye(3), still, still, stance, np.zeros((4, 3)))
        >>> controller = WalkingController(body)
        >>> controller.reset(robot)
        >>> controller.torques(robot, [0.0, 0.0, 0.0]).shape
        (4, 3)
    """

    def __init__(self, body: Body, *, dt: float = 0.002, solver: Solver = solve_daqp) -> None:
        self.body, self.dt = body, dt
        self.mpc = ConvexMPC(body.mass, body.inertia, solver)
        self._slew = np.array([_ACCELERATION, _ACCELERATION, _YAW_SLEW]) * dt

    def reset(self, measured: Measurement, memory: Memory | None = None) -> None:
        """Start anew from standing, or continue from what is remembered."""
        if memory is None:
            feet = measured.position + forward_kinematics(measured.joints)[0] @ measured.rotation.T
            memory = Memory(
                steps=0, command=np.zeros(3), heading=float(measured.roll_pitch_yaw[2]), integral=np.zeros(2),
                forces=np.zeros((4, 3)), footholds=feet, lift_off=feet, standing=np.ones(4, bool),
            )  # fmt: skip
        self.memory = memory
        self.mpc.reset(memory.forces)

    def torques(self, measured: Measurement, command: Array | list[float]) -> Array:
        """Torques ``(4, 3)`` in N m for the next ``dt``.

        The command is ``(3,)``: forward and lateral velocity in m/s, yaw rate in rad/s. Raises ShapeError or
        NonFiniteError for anything else; SolverError if the quadratic program was not solved many times in a row.
        """
        wanted = check_command(command)
        m = self.memory
        now = m.steps * self.dt
        used = m.command + clip(wanted - m.command, -self._slew, self._slew)
        angles = measured.roll_pitch_yaw
        yaw = angles[2]
        lead = wrap_angle(m.heading + used[2] * self.dt - yaw)
        lead = min(max(lead, -_HEADING_LEAD), _HEADING_LEAD)
        rotation = measured.rotation
        forward = rotation_z(yaw)
        error = used[:2] - (forward.T @ measured.velocity)[:2]
        integral = clip(m.integral + _INTEGRATOR_GAIN * self.dt * error, -_INTEGRATOR_LIMIT, _INTEGRATOR_LIMIT)

        phase = gait.phases(now)
        standing = phase < gait.DUTY
        feet_base, jacobians = forward_kinematics(measured.joints)
        feet = measured.position + feet_base @ rotation.T
        lift_off = np.where((m.standing & ~standing)[:, None], feet, m.lift_off)
        footholds = m.footholds
        if not standing.all():
            targets = gait.footholds(now, measured.position, measured.velocity, yaw, used)
            targets[:, 2] = TOE_RADIUS - _PRESS
            footholds = np.where(standing[:, None], footholds, targets)
        forces = m.forces
        if m.steps % _MPC_INTERVAL == 0:
            follow = used + np.array([integral[0], integral[1], 0.0])
            forces = self._forces(measured, angles, feet, footholds, follow, lead, now)
        torques = -np.matmul(jacobians.transpose(0, 2, 1), (forces @ rotation)[..., None])[..., 0]
        if not standing.all():
            progress = np.where(standing, 0.0, (phase - gait.DUTY) / (1 - gait.DUTY))
            position, velocity = gait.swing(lift_off, footholds, progress)
            away = position - measured.position
            velocity = (velocity - measured.velocity - cross(measured.angular_velocity, away)) @ rotation
            joints = inverse_kinematics(away @ rotation)
            speeds = clip(_solve(jacobians, velocity), -_MAX_JOINT_SPEED, _MAX_JOINT_SPEED)
            torque = _STIFFNESS * (joints - measured.joints) + _DAMPING * (speeds - measured.joint_velocities)
            torques = np.where(standing[:, None], torques, torque)
        self.memory = Memory(m.steps + 1, used, float(yaw + lead), integral, forces, footholds, lift_off, standing)
        return clip(torques, -_MAX_TORQUE, _MAX_TORQUE)

    def _forces(
        self, measured: Measurement, angles: Array, feet: Array, footholds: Array, follow: Array, lead: float,
        now: float,
    ) -> Array:  # fmt: skip
        """Solve the MPC in world axes turned by the heading; forces ``(4, 3)`` in the world."""
        arm = measured.rotation @ self.body.centre
        centre = measured.position + arm
        turn = rotation_z(angles[2])
        velocity = measured.velocity + cross(measured.angular_velocity, arm)
        state = np.concatenate(
            [angles[:2], [0.0, 0.0, 0.0, centre[2]], measured.angular_velocity @ turn, velocity @ turn]
        )
        reference = np.zeros((HORIZON, 12))
        yaw = reference[:, 2] = lead + follow[2] * STEP * np.arange(1, HORIZON + 1)
        cos, sin = np.cos(yaw), np.sin(yaw)
        reference[:, 9], reference[:, 10] = cos * follow[0] - sin * follow[1], sin * follow[0] + cos * follow[1]
        reference[:, 3:5] = np.cumsum(reference[:, 9:11], axis=0) * STEP
        reference[:, 5] = gait.HEIGHT + self.body.centre[2]
        reference[:, 8] = follow[2]

        # Feet seen from the centre of mass of the reference at the beginning of each step: those that stand stay
        # where they are until they are lifted, those that swing land on their footholds, later ones are nominal.
        times = np.asarray(now + STEP * np.arange(HORIZON) + 0.5 * self.dt, dtype=np.float64)
        phase = gait.phases(times)
        contacts = phase < gait.DUTY
        before = np.vstack([np.zeros(3), reference[:-1, 3:6] * [1.0, 1.0, 0.0]])
        cycle = np.floor(times[:, None] / gait.PERIOD + gait.PHASE_OFFSET)
        since = cycle - cycle[0]
        first = contacts[0]
        on_ground = -centre[2] + TOE_RADIUS
        planned = np.where(first[:, None], feet - centre, footholds - centre) @ turn
        planned[:, 2] = np.where(first, planned[:, 2], on_ground)
        known = np.where(first, since == 0, since <= 1)
        heading = np.concatenate([yaw[:1], yaw[:-1]])
        ahead = 0.5 * gait.STANCE_TIME - phase * gait.PERIOD  # time to the middle of the stance
        angle = heading[:, None] + follow[2] * ahead
        nominal = np.empty((HORIZON, 4, 3))
        nominal[..., 0] = np.cos(angle) * SHOULDER[:, 0] - np.sin(angle) * SHOULDER[:, 1]
        nominal[..., 1] = np.sin(angle) * SHOULDER[:, 0] + np.cos(angle) * SHOULDER[:, 1]
        nominal[..., 0] += ahead * (np.cos(heading) * follow[0] - np.sin(heading) * follow[1])[:, None]
        nominal[..., 1] += ahead * (np.sin(heading) * follow[0] + np.cos(heading) * follow[1])[:, None]
        nominal[..., 2] = on_ground
        places = np.where(known[..., None], planned[None] - before[:, None], nominal)
        return self.mpc.solve(state, reference, places, contacts) @ turn.T


def check_command(command: Array | list[float]) -> Array:
    """Command ``(3,)`` as float64 array; ShapeError or NonFiniteError for anything but three finite numbers."""
    array: Array = np.asarray(command, dtype=np.float64)
    if array.shape != (3,):
        raise ShapeError(f"command: expected shape (3,), (m/s, m/s, rad/s), received {array.shape}.")
    if not np.isfinite(array).all():
        raise NonFiniteError(f"command: expected finite numbers, received {array.tolist()}; check the policy's output.")
    return array


def _solve(jacobians: Array, velocities: Array) -> Array:
    """Joint velocities ``(4, 3)`` for foot velocities; zero where a leg is singular."""
    try:
        return np.asarray(np.linalg.solve(jacobians, velocities[..., None])[..., 0], dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.zeros((4, 3))

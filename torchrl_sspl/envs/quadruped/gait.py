"""The trot: which feet stand when, where the others land, and how they swing.

Diagonal pairs are half a period apart; a foot stands while its phase is below ``DUTY``, and swings for the rest.
"""

from __future__ import annotations

import numpy as np

from torchrl_sspl.envs.quadruped.kinematics import SHOULDER, Array, columns, rotation_z

GRAVITY = 9.81  # m/s^2
HEIGHT = 0.28  # m, at which the base is held
PERIOD = 0.36  # s, of a full cycle
DUTY = 0.55  # part of the cycle that a foot stands; above 1/2 both pairs overlap
STANCE_TIME = DUTY * PERIOD
PHASE_OFFSET = np.array([0.0, 0.5, 0.5, 0.0])

_SWING_TIME = (1 - DUTY) * PERIOD
_SWING_HEIGHT = 0.07  # m, how high a foot is lifted
_FEEDBACK = 0.05  # s, shift of the foothold per velocity error (Raibert's gain)


def phases(time: float | Array) -> Array:
    """Phases in [0, 1) of the four feet at times ``(*batch,)`` in s, as ``(*batch, 4)``.

    Example:
        >>> (phases(np.array([0.0, 0.18, 0.205])) < DUTY).astype(int).tolist()  # who stands
        [[1, 1, 1, 1], [1, 1, 1, 1], [0, 1, 1, 0]]
    """
    return (np.asarray(time)[..., None] / PERIOD + PHASE_OFFSET) % 1.0


def footholds(time: float, position: Array, velocity: Array, heading: float, command: Array) -> Array:
    r"""Where each foot should next touch the ground, ``(4, 3)`` in the world, in m (z = 0).

    ``p + R(psi + w T / 2) shoulder + T v / 2 + k (v - v_command) + height / (2 g) v x omega``, all taken at touch-down
    and T the time of stance to come.

    Args:
        time: now, in s.
        position, velocity: ``(3,)`` of the base in the world, in m and m/s.
        heading: yaw of the base, in rad.
        command: ``(3,)`` forward and lateral velocity in m/s, yaw rate in rad/s, in the base frame.

    Source: Di Carlo et al. (2018), "Dynamic locomotion in the MIT Cheetah 3 through convex model-predictive control".
    Deviation: the last term, which compensates turning, is of Bledt et al. (2018).
    """
    rate = command[2]
    left = (1.0 - phases(time)) * PERIOD
    turned = rate * left
    planar = np.array([velocity[0], velocity[1]])
    wanted = rotation_z(heading)[:2, :2] @ command[:2]
    half = 0.5 * rate * STANCE_TIME
    velocity_then = _turn(turned + half, planar)
    out = np.zeros((4, 3))
    out[:, :2] = (
        position[:2]
        + left[:, None] * _turn(0.5 * turned, planar)
        + _turn(heading + turned + half, SHOULDER[:, :2])
        + 0.5 * STANCE_TIME * velocity_then
        + _FEEDBACK * _turn(turned, planar - wanted)
        + 0.5 * HEIGHT / GRAVITY * rate * columns(velocity_then[:, 1], -velocity_then[:, 0])
    )
    return out


def swing(start: Array, target: Array, progress: Array) -> tuple[Array, Array]:
    """Positions in m and velocities in m/s, both ``(n, 3)``, of feet on smooth arcs to their footholds.

    The arcs go from ``start`` to ``target``, ``(n, 3)`` in m; ``progress`` ``(n,)`` is the part of the swing that has
    passed, in [0, 1]. At both ends velocity and acceleration of the horizontal motion vanish.

    Example:
        >>> position, velocity = swing(np.zeros((1, 3)), np.array([[0.2, 0.0, 0.0]]), np.array([0.5]))
        >>> position.round(3).tolist()
        [[0.1, 0.0, 0.07]]
    """
    s = progress[:, None]
    way = target - start
    position = start + s**3 * (10 - 15 * s + 6 * s * s) * way
    velocity = 30 * (s * (1 - s)) ** 2 / _SWING_TIME * way
    arch = (s * (1 - s))[:, 0]
    position[:, 2] += 64 * _SWING_HEIGHT * arch**3
    velocity[:, 2] += 192 * _SWING_HEIGHT * arch**2 * (1 - 2 * progress) / _SWING_TIME
    return position, velocity


def _turn(angle: float | Array, vectors: Array) -> Array:
    """Rotate planar vectors by angles; both broadcast over the four feet."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return columns(cos * x - sin * y, sin * x + cos * y)

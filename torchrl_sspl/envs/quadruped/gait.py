"""The trot: which feet stand when, and how the others swing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_sspl.envs.quadruped.kinematics import SHOULDER, Array, rotation_z

GRAVITY = 9.81
"""In m/s^2."""


@dataclass(frozen=True)
class Trot:
    r"""Trot with diagonal pairs half a period apart.

    A foot stands while its phase, ``(t / period + offset) mod 1``, is below ``duty``, and swings for the rest.

    Args:
        period: time of a full cycle, in s.
        duty: part of the cycle that a foot stands; above 1/2 both pairs overlap.
        swing_height: how high a foot is lifted, in m.
        feedback: shift of the foothold per velocity error, in s (Raibert's gain).

    Source: Di Carlo et al. (2018), "Dynamic locomotion in the MIT Cheetah 3 through convex model-predictive
        control". Deviation: the term of the foothold that compensates turning, ``height / (2 g) v x omega``, is
        Bledt et al. (2018).

    Example:
        >>> Trot().contacts(np.array([0.0, 0.18, 0.205])).astype(int).tolist()
        [[1, 1, 1, 1], [1, 1, 1, 1], [0, 1, 1, 0]]
    """

    period: float = 0.36
    duty: float = 0.55
    swing_height: float = 0.07
    feedback: float = 0.05

    @property
    def stance_time(self) -> float:
        """Time that a foot stands in a cycle, in s."""
        return self.duty * self.period

    @property
    def swing_time(self) -> float:
        """Time that a foot swings in a cycle, in s."""
        return (1 - self.duty) * self.period

    def phases(self, time: float | Array) -> Array:
        """Phases in [0, 1) of the four feet at times ``(*batch,)`` in s, as ``(*batch, 4)``."""
        return (np.asarray(time)[..., None] / self.period + _OFFSET) % 1.0

    def contacts(self, time: float | Array) -> NDBool:
        """Which of the four feet stand at times ``(*batch,)`` in s, bool ``(*batch, 4)``."""
        return self.phases(time) < self.duty

    def footholds(
        self, time: float, position: Array, velocity: Array, heading: float, command: Array, height: float
    ) -> Array:
        r"""Where each foot should next touch the ground.

        ``p + R(psi + w T / 2) shoulder + T v / 2 + k (v - v_command) + height / (2 g) v x omega``, all taken at
        touch-down and T the time of stance to come.

        Args:
            time: now, in s.
            position: ``(3,)`` base in the world, in m.
            velocity: ``(3,)`` base velocity in the world, in m/s.
            heading: yaw of the base, in rad.
            command: ``(3,)`` forward and lateral velocity in m/s, yaw rate in rad/s, in the base frame.
            height: height at which the base is held, in m.

        Returns:
            ``(4, 3)`` in the world, in m, on the ground (z = 0).
        """
        rate = command[2]
        left = (1.0 - self.phases(time)) * self.period
        turned = rate * left
        planar = np.array([velocity[0], velocity[1]])
        wanted = rotation_z(heading)[:2, :2] @ command[:2]
        half = 0.5 * rate * self.stance_time
        velocity_then = _turn(turned + half, planar)
        out = np.zeros((4, 3))
        out[:, :2] = (
            position[:2]
            + left[:, None] * _turn(0.5 * turned, planar)
            + _turn(heading + turned + half, SHOULDER[:, :2])
            + 0.5 * self.stance_time * velocity_then
            + self.feedback * _turn(turned, planar - wanted)
            + 0.5 * height / GRAVITY * rate * np.stack([velocity_then[:, 1], -velocity_then[:, 0]], axis=1)
        )
        return out

    def swing(self, start: Array, target: Array, progress: Array) -> tuple[Array, Array]:
        """Feet on smooth arcs from where they left the ground to their footholds.

        Args:
            start, target: ``(n, 3)`` ends of the arcs, in m.
            progress: ``(n,)`` part of the swing that has passed, in [0, 1].

        Returns:
            positions ``(n, 3)`` in m and velocities ``(n, 3)`` in m/s; at both ends velocity and acceleration of
            the horizontal motion vanish.

        Example:
            >>> position, velocity = Trot().swing(np.zeros((1, 3)), np.array([[0.2, 0.0, 0.0]]), np.array([0.5]))
            >>> position.round(3).tolist()
            [[0.1, 0.0, 0.07]]
        """
        s = progress[:, None]
        way = target - start
        position = start + s**3 * (10 - 15 * s + 6 * s * s) * way
        velocity = 30 * (s * (1 - s)) ** 2 / self.swing_time * way
        arch = (s * (1 - s))[:, 0]
        position[:, 2] += 64 * self.swing_height * arch**3
        velocity[:, 2] += 192 * self.swing_height * arch**2 * (1 - 2 * progress) / self.swing_time
        return position, velocity


def _turn(angle: float | Array, vectors: Array) -> Array:
    """Rotate planar vectors by angles; both broadcast over the four feet."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


_OFFSET = np.array([0.0, 0.5, 0.5, 0.0])
NDBool = np.typing.NDArray[np.bool_]

__all__ = ["GRAVITY", "Trot"]

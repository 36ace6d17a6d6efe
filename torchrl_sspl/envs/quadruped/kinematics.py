"""Closed-form kinematics of the four legs of the Unitree A1.

Everywhere in this package: legs in the order FR, FL, RR, RL, three joints each (abduction, hip, knee), arrays
``(4, 3)``; base frame x forward, y left, z up.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEGS = ("FR", "FL", "RR", "RL")
_SIDE = np.array([-1.0, 1.0, -1.0, 1.0])
_ABDUCTION = np.array([[0.183, -0.047, 0.0], [0.183, 0.047, 0.0], [-0.183, -0.047, 0.0], [-0.183, 0.047, 0.0]])
_LINK, _THIGH, _SHANK, TOE_RADIUS = 0.08505, 0.2, 0.2, 0.02  # m; a foot is the centre of the spherical toe
SHOULDER = _ABDUCTION + np.stack([0 * _SIDE, _LINK * _SIDE, 0 * _SIDE], axis=1)
"""Where the feet are below when the robot stands, in the base frame, in m."""
_REACH = 0.995 * (_THIGH + _SHANK)
_KNEE = (-2.69, -0.92)
_LIMIT = 0.8


def forward_kinematics(joints: Array) -> tuple[Array, Array]:
    """Feet ``(4, 3)`` in the base frame in m, and Jacobians ``(4, 3, 3)``, foot velocity per joint velocity.

    The joint angles are ``(4, 3)`` in rad. Source: geometry of the robot's URDF.

    Example:
        >>> feet, jacobian = forward_kinematics(np.zeros((4, 3)))
        >>> feet[1].round(3).tolist()
        [0.183, 0.132, -0.4]
    """
    sin, cos = np.sin(joints), np.cos(joints)
    knee = joints[:, 1] + joints[:, 2]
    sin_knee, cos_knee = np.sin(knee), np.cos(knee)
    # In the plane of the leg: x forward, down along -z; the abduction joint turns that plane about x.
    x = -_THIGH * sin[:, 1] - _SHANK * sin_knee
    z = -_THIGH * cos[:, 1] - _SHANK * cos_knee
    y = _SIDE * _LINK
    s, c = sin[:, 0], cos[:, 0]
    feet = _ABDUCTION + columns(x, c * y - s * z, s * y + c * z)
    jacobian = np.zeros((4, 3, 3))
    jacobian[:, 1, 0], jacobian[:, 2, 0] = _ABDUCTION[:, 2] - feet[:, 2], feet[:, 1] - _ABDUCTION[:, 1]
    dx, dz = -_SHANK * cos_knee, _SHANK * sin_knee
    jacobian[:, 0, 1], jacobian[:, 0, 2] = z, dx
    jacobian[:, 1, 1], jacobian[:, 1, 2] = s * x, -s * dz
    jacobian[:, 2, 1], jacobian[:, 2, 2] = -c * x, c * dz
    return feet, jacobian


def inverse_kinematics(feet: Array) -> Array:
    """Joint angles ``(4, 3)`` in rad that put feet ``(4, 3)`` in the base frame in m, or as near as the legs reach.

    Within the joint limits, knees bent backwards. Source: geometry of the robot's URDF.

    Example:
        >>> feet = SHOULDER + [0.05, 0.02, -0.28]
        >>> bool(np.allclose(forward_kinematics(inverse_kinematics(feet))[0], feet))
        True
    """
    x, y, z = (feet - _ABDUCTION).T
    side = _SIDE * _LINK
    depth = np.sqrt(np.maximum(y * y + z * z - side * side, 1e-4))
    abduction = np.arctan2(z, y) - np.arctan2(-depth, side)
    abduction = (abduction + np.pi) % (2 * np.pi) - np.pi
    squared = np.minimum(x * x + depth * depth, _REACH**2)
    bend = (squared - _THIGH**2 - _SHANK**2) / (2 * _THIGH * _SHANK)
    knee = -np.arccos(clip(bend, -1.0, 1.0))
    hip = np.arctan2(-x, depth) - np.arctan2(_SHANK * np.sin(knee), _THIGH + _SHANK * np.cos(knee))
    return columns(clip(abduction, -_LIMIT, _LIMIT), hip, clip(knee, *_KNEE))


def rotation_z(angle: float) -> Array:
    """Rotation matrix ``(3, 3)`` about the vertical by an angle in rad."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def cross(a: Array, b: Array) -> Array:
    """Products ``a x b`` ``(*batch, 3)`` of one vector ``(3,)`` with others ``(*batch, 3)``.

    To the bit ``np.cross``, whose checks of shapes cost ten times as much as its products.

    Example:
        >>> cross(np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])).tolist()
        [0.0, 0.0, 1.0]
    """
    x, y, z = a
    out = np.empty(b.shape)
    out[..., 0] = y * b[..., 2] - z * b[..., 1]
    out[..., 1] = z * b[..., 0] - x * b[..., 2]
    out[..., 2] = x * b[..., 1] - y * b[..., 0]
    return out


def columns(*entries: Array) -> Array:
    """``np.stack(entries, axis=-1)`` of arrays ``(n,)``, without its checks, which cost more than the copy.

    Example:
        >>> columns(np.zeros(2), np.ones(2)).tolist()
        [[0.0, 1.0], [0.0, 1.0]]
    """
    out = np.empty((len(entries[0]), len(entries)))
    for k, entry in enumerate(entries):
        out[:, k] = entry
    return out


def clip(values: Array, low: float | Array, high: float | Array) -> Array:
    """``np.clip``, without its checks, which cost more than the comparisons.

    Example:
        >>> clip(np.array([-2.0, 0.5]), -1.0, 1.0).tolist()
        [-1.0, 0.5]
    """
    return np.minimum(np.maximum(values, low), high)


def skew(vectors: Array) -> Array:
    """Cross-product matrices ``(*batch, 3, 3)`` of vectors ``(*batch, 3)``: ``skew(a) @ b = a x b``."""
    out = np.zeros((*vectors.shape, 3))
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    out[..., 0, 1], out[..., 0, 2] = -z, y
    out[..., 1, 0], out[..., 1, 2] = z, -x
    out[..., 2, 0], out[..., 2, 1] = -y, x
    return out


def wrap_angle(angle: float) -> float:
    """Angle in [-pi, pi), in rad."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)

"""Computes rotations and poses: Rodrigues' formula, and exponential, logarithm and left Jacobian of SO(3).

A rotation is a 3x3 matrix or a rotation vector (axis times angle [rad]). A pose is a 4x4 matrix, body to world, for
column vectors. Angles are right-handed: seen against the axis, positive ones turn counter-clockwise. SO(3) follows
Sola, Deray & Atchuthan, "A micro Lie theory for state estimation in robotics" (2018).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qsim.optics.camera import Vector

Array = NDArray[np.float64]


ORIGIN: Vector = (0.0, 0.0, 0.0)
UP: Vector = (0.0, 1.0, 0.0)


def vector(value: ArrayLike) -> Vector:
    """Return three finite floats as a tuple; `ValueError` for anything else."""
    v = np.asarray(value, dtype=np.float64).reshape(-1)
    if v.shape != (3,) or not np.isfinite(v).all():
        raise ValueError(f"expected three finite numbers (x, y, z), got {value!r}")
    return float(v[0]), float(v[1]), float(v[2])


def unit(axis: ArrayLike) -> Array:
    """Return the unit vector along `axis`, float64 [3]; `ValueError` for a zero axis."""
    a = np.asarray(vector(axis))
    length = float(np.linalg.norm(a))
    if length == 0:
        raise ValueError("an axis of rotation must not be (0, 0, 0)")
    return a / length


def cross_matrix(v: ArrayLike) -> Array:
    """Return the cross-product matrix [v]x, float64 [3, 3]: [v]x p = v x p."""
    x, y, z = np.asarray(v, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_matrix(axis: ArrayLike, angle: float) -> Array:
    """Return the rotation by `angle` [rad] about `axis` through the origin (Rodrigues), float64 [3, 3]."""
    k = cross_matrix(unit(axis))
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)


def pose_matrix(rotation: Array | None = None, position: ArrayLike = ORIGIN) -> Array:
    """Return the pose [4, 4] of a rotation [3, 3] (None: identity) followed by a shift [m]."""
    pose = np.eye(4)
    if rotation is not None:
        pose[:3, :3] = rotation
    pose[:3, 3] = position
    return pose


def rotation_between(start: ArrayLike, end: ArrayLike) -> Array:
    """Return the shortest rotation from direction `start` to direction `end`, float64 [3, 3]."""
    a = unit(start)
    b = unit(end)
    axis = np.cross(a, b)
    cosine = float(np.clip(a @ b, -1, 1))
    if np.linalg.norm(axis) < 1e-12:
        if cosine > 0:
            return np.eye(3)
        # Opposite directions: any axis across will do, and the one farthest from `a` is the surest.
        axis = np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
    return rotation_matrix(axis, float(np.arccos(cosine)))


def exponential(turn: ArrayLike) -> Array:
    """Return the rotation [3, 3] of a rotation vector [rad]; accurate down to angle 0."""
    k = cross_matrix(turn)
    angle = float(np.linalg.norm(turn))
    return np.eye(3) + np.sinc(angle / np.pi) * k + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (k @ k)


def logarithm(rotation: ArrayLike) -> Array:
    """Return the rotation vector [rad] of a rotation [3, 3]; its length is at most pi."""
    r = np.asarray(rotation, dtype=np.float64)
    # The unit quaternion (w, v), from its largest component so that half turns stay accurate
    squares = np.array([1 + np.trace(r), *(1 + 2 * np.diag(r) - np.trace(r))])
    largest = int(np.argmax(squares))
    skew = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    if largest == 0:
        w = squares[0]
        v = skew
    else:
        w = skew[largest - 1]
        v = (r + r.T)[largest - 1].copy()
        v[largest - 1] = squares[largest]
    if w < 0:
        w = -w
        v = -v
    length = float(np.linalg.norm(v))
    return v * (2 * np.arctan2(length, w) / length) if length > 0 else np.zeros(3)


def left_jacobian(turn: ArrayLike) -> Array:
    """Return J [3, 3] with angular velocity = J(turn) d(turn)/dt, in world axes."""
    k = cross_matrix(turn)
    angle = float(np.linalg.norm(turn))
    if angle < 1e-4:  # series: sin and cos would cancel
        return np.eye(3) + k / 2 + (k @ k) / 6
    return np.eye(3) + (1 - np.cos(angle)) / angle**2 * k + (angle - np.sin(angle)) / angle**3 * (k @ k)


def about(rotation: Array, center: ArrayLike) -> Array:
    """Return the pose [4, 4] of a rotation [3, 3] about the point `center` [m]."""
    return pose_matrix(rotation, np.asarray(center) - rotation @ np.asarray(center))

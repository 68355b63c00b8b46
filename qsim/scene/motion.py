"""Defines motions in closed form: pose and velocity of a body as functions of time.

    t [s] -> pose (4x4, body to world) and velocity (linear [m/s] of the body's origin, angular [rad/s], world's axes)

Every motion is a frozen record: times can be evaluated in any order, and two of them give the exact motion between
them. Nothing is random. `deformation.py` has motions that change the mesh.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from qsim.optics.camera import Vector
from qsim.optics.hermite import interval, slopes, value_at
from qsim.scene.rotation import (
    ORIGIN,
    UP,
    Array,
    about,
    exponential,
    left_jacobian,
    logarithm,
    pose_matrix,
    rotation_matrix,
    unit,
    vector,
)

GRAVITY: Vector = (0.0, -9.80665, 0.0)  # m s^-2, standard acceleration (CGPM 1901); y is up


class Motion(ABC):
    """A rigid motion with `pose(t)` and `velocity(t)`.

    `ValueError` for parameters that are not finite, vectors without three components, and axes of length zero.
    """

    def __post_init__(self) -> None:
        check_numbers(self)

    @abstractmethod
    def pose(self, t: float) -> Array:
        """Return the body-to-world matrix at time t [s], float64 [4, 4]."""

    @abstractmethod
    def velocity(self, t: float) -> tuple[Array, Array]:
        """Return the velocity of the body's origin [m/s] and its angular velocity [rad/s], float64 [3], world axes."""

    def __matmul__(self, inner: Motion) -> Composition:
        """Return `outer @ inner`: the inner motion in the frame that the outer one moves; see `Composition`."""
        return Composition(self, inner)


@dataclass(frozen=True)
class Still(Motion):
    """At rest at `position` [m], rotated by the rotation vector `turn` (axis times angle) [rad]."""

    position: Vector = ORIGIN
    turn: Vector = ORIGIN

    def pose(self, t: float) -> Array:
        return pose_matrix(exponential(np.asarray(self.turn)), self.position)

    def velocity(self, t: float) -> tuple[Array, Array]:
        return np.zeros(3), np.zeros(3)

    @classmethod
    def turned(cls, rotation: Array, position: ArrayLike = ORIGIN) -> Still:
        """Return a body at rest with the orientation of a rotation matrix [3, 3]."""
        return cls(vector(position), vector(logarithm(rotation)))


@dataclass(frozen=True)
class Translation(Motion):
    """Uniform linear motion: position + speed * t."""

    speed: Vector  # m/s
    position: Vector = ORIGIN  # m, at t = 0

    def pose(self, t: float) -> Array:
        return pose_matrix(None, np.asarray(self.position) + np.asarray(self.speed) * t)

    def velocity(self, t: float) -> tuple[Array, Array]:
        return np.asarray(self.speed, dtype=np.float64), np.zeros(3)


@dataclass(frozen=True)
class Spin(Motion):
    """Uniform rotation about the axis through `center`; a pan is a spin of the camera about its own position."""

    axis: Vector
    rate: float  # rad/s
    phase: float = 0.0  # rad, angle at t = 0
    center: Vector = ORIGIN  # m

    def pose(self, t: float) -> Array:
        return about(rotation_matrix(self.axis, self.phase + self.rate * t), self.center)

    def velocity(self, t: float) -> tuple[Array, Array]:
        return _swing(self.pose(t), self.rate * unit(self.axis), self.center)


@dataclass(frozen=True)
class Ballistic(Motion):
    """Free fall of the centre, with uniform rotation about an axis through it."""

    position: Vector  # m, at t = 0
    speed: Vector  # m/s, at t = 0
    axis: Vector = UP
    rate: float = 0.0  # rad/s
    phase: float = 0.0  # rad
    gravity: Vector = GRAVITY  # m/s^2

    def pose(self, t: float) -> Array:
        place = np.asarray(self.position) + np.asarray(self.speed) * t + np.asarray(self.gravity) * (t * t / 2)
        return pose_matrix(rotation_matrix(self.axis, self.phase + self.rate * t), place)

    def velocity(self, t: float) -> tuple[Array, Array]:
        return np.asarray(self.speed) + np.asarray(self.gravity) * t, self.rate * unit(self.axis)


@dataclass(frozen=True)
class Pendulum(Motion):
    """Swing about an axis through `pivot`: angle = amplitude * sin(2 pi frequency t + phase)."""

    pivot: Vector  # m
    axis: Vector
    amplitude: float  # rad
    frequency: float  # Hz
    phase: float = 0.0  # rad

    def pose(self, t: float) -> Array:
        angle = self.amplitude * np.sin(2 * np.pi * self.frequency * t + self.phase)
        return about(rotation_matrix(self.axis, float(angle)), self.pivot)

    def velocity(self, t: float) -> tuple[Array, Array]:
        omega = 2 * np.pi * self.frequency
        return _swing(
            self.pose(t), self.amplitude * omega * np.cos(omega * t + self.phase) * unit(self.axis), self.pivot
        )


@dataclass(frozen=True)
class Oscillation(Motion):
    """Linear oscillation: position + amplitude * sin(2 pi frequency t + phase)."""

    amplitude: Vector  # m
    frequency: float  # Hz
    phase: float = 0.0  # rad
    position: Vector = ORIGIN  # m

    def pose(self, t: float) -> Array:
        wave = np.sin(2 * np.pi * self.frequency * t + self.phase)
        return pose_matrix(None, np.asarray(self.position) + np.asarray(self.amplitude) * wave)

    def velocity(self, t: float) -> tuple[Array, Array]:
        omega = 2 * np.pi * self.frequency
        return np.asarray(self.amplitude) * (omega * np.cos(omega * t + self.phase)), np.zeros(3)


@dataclass(frozen=True)
class Wave:
    """One sinusoid of a shake: amplitude * sin(2 pi frequency t + phase), in rad for turns and m for shifts."""

    amplitude: Vector
    frequency: float  # Hz
    phase: float = 0.0  # rad

    def __post_init__(self) -> None:
        check_numbers(self)


@dataclass(frozen=True)
class Shake(Motion):
    """A hand-held or vibrating mount: sums of waves rotate it about `center` (rotation vector) and shift it."""

    turns: tuple[Wave, ...] = ()
    shifts: tuple[Wave, ...] = ()
    center: Vector = ORIGIN  # m

    def pose(self, t: float) -> Array:
        pose = about(exponential(_sum(self.turns, t)), self.center)
        pose[:3, 3] += _sum(self.shifts, t)
        return pose

    def velocity(self, t: float) -> tuple[Array, Array]:
        angle = _sum(self.turns, t)
        # Rotation vectors do not add: the left Jacobian turns the rate of the vector
        # into an angular velocity (Solà, Deray and Atchuthan, arXiv:1812.01537).
        angular = left_jacobian(angle) @ _sum_rate(self.turns, t)
        linear, _ = _swing(about(exponential(angle), self.center), angular, self.center)
        return linear + _sum_rate(self.shifts, t), angular


@dataclass(frozen=True)
class Keyframes(Motion):
    """Given positions at given times: cubic Hermite paths with finite-difference slopes, uniform rotation between.

    Before the first and after the last key the body rests. `turns` are rotation vectors [rad], one per key, or
    empty for none; the angular velocity jumps at keys, the linear velocity does not (except at the ends).
    """

    times: tuple[float, ...]  # s, increasing
    positions: tuple[Vector, ...]  # m
    turns: tuple[Vector, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.times)
        if n < 2 or len(self.positions) != n or len(self.turns) not in (0, n):
            raise ValueError(
                f"Keyframes needs two or more times and as many positions (and turns, or none), "
                f"got {n} times, {len(self.positions)} positions, {len(self.turns)} turns"
            )
        if not np.isfinite(self.times).all() or (np.diff(self.times) <= 0).any():
            raise ValueError(f"Keyframes.times must be finite and increase, got {self.times}")
        for place in (*self.positions, *self.turns):
            vector(place)

    def pose(self, t: float) -> Array:
        place = value_at(self.times, np.asarray(self.positions), t)
        if not self.turns:
            return pose_matrix(None, place)
        i, s, _ = interval(self.times, t)
        start, step = self._turn(i)
        return pose_matrix(exponential(s * step) @ start, place)

    def velocity(self, t: float) -> tuple[Array, Array]:
        if not self.times[0] <= t <= self.times[-1]:
            return np.zeros(3), np.zeros(3)
        i, s, length = interval(self.times, t)
        p = np.asarray(self.positions)
        # Derivatives of the four cubic Hermite polynomials in s, whose slopes are per interval.
        m = slopes(self.times, np.asarray(self.positions)) * length
        rate = (
            6 * (s**2 - s) * (p[i] - p[i + 1]) + (3 * s**2 - 4 * s + 1) * m[i] + (3 * s**2 - 2 * s) * m[i + 1]
        ) / length
        return rate, self._turn(i)[1] / length if self.turns else np.zeros(3)

    def _turn(self, i: int) -> tuple[Array, Array]:
        """Return the rotation at key i [3, 3], and the rotation vector [3] in world axes from it to key i + 1."""
        start, end = (exponential(np.asarray(self.turns[j])) for j in (i, i + 1))
        # end = step @ start, so that the step turns about axes that stay in the world while the body turns.
        return start, logarithm(end @ start.T)


@dataclass(frozen=True)
class Composition(Motion):
    """`inner` in the frame that `outer` moves: pose = outer.pose @ inner.pose.

    `ValueError` for motions that deform a mesh: a composition has a pose only and would leave the mesh at rest.
    """

    outer: Motion
    inner: Motion

    def __post_init__(self) -> None:
        super().__post_init__()
        for part in (self.outer, self.inner):
            if hasattr(part, "deform"):
                name = type(part).__name__
                raise ValueError(f"{name} deforms a mesh, which @ would lose; move it by {name}(..., carrier=...)")

    def pose(self, t: float) -> Array:
        return self.outer.pose(t) @ self.inner.pose(t)

    def velocity(self, t: float) -> tuple[Array, Array]:
        turn = self.outer.pose(t)[:3, :3]
        linear, angular = self.outer.velocity(t)
        inner_linear, inner_angular = self.inner.velocity(t)
        # A point in a turning frame: the frame's own velocity, omega x arm, and the velocity within the frame.
        arm = turn @ self.inner.pose(t)[:3, 3]
        return linear + np.cross(angular, arm) + turn @ inner_linear, angular + turn @ inner_angular


def check_numbers(record: Any) -> None:
    """Raise `ValueError` for the first number or vector of a record that is not finite, and for axes of length zero."""
    for field in fields(record):
        value = getattr(record, field.name)
        try:
            if field.name == "axis":
                unit(value)
            elif field.type == "Vector":
                vector(value)
            elif field.type == "float" and not np.isfinite(value):
                raise ValueError(f"expected a finite number, got {value!r}")
        except TypeError:
            raise ValueError(f"{type(record).__name__}.{field.name}: expected numbers, got {value!r}") from None
        except ValueError as error:
            raise ValueError(f"{type(record).__name__}.{field.name}: {error}") from None


# Shared arithmetic -------------------------------------------------------------------------------------------------


def _swing(pose: Array, angular: Array, center: ArrayLike) -> tuple[Array, Array]:
    """Return the velocity [m/s] of a body's origin that rotates about `center`, and its angular velocity [rad/s]."""
    return np.cross(angular, pose[:3, 3] - np.asarray(center)), angular


def _sum(waves: tuple[Wave, ...], t: float) -> Array:
    total = np.zeros(3)
    for w in waves:
        total += np.asarray(w.amplitude) * np.sin(2 * np.pi * w.frequency * t + w.phase)
    return total


def _sum_rate(waves: tuple[Wave, ...], t: float) -> Array:
    total = np.zeros(3)
    for w in waves:
        omega = 2 * np.pi * w.frequency
        total += np.asarray(w.amplitude) * (omega * np.cos(omega * t + w.phase))
    return total

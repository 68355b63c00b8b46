"""Interpolates keys over time: steps, straight lines, spherical rotations and cubic splines, as glTF 2.0 defines them.

    keys at times [s] -> value at any time; before the first and after the last key, the value of that key

A `Clock` relates the time of an animation to the time of the scene: from a start, at a speed, repeated or held.
Source: Khronos, glTF 2.0 specification, appendix C (interpolation).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from qsim.scene.motion import check_numbers
from qsim.scene.rotation import Array

KINDS = ("step", "linear", "cubic")


@dataclass(frozen=True)
class Clock:
    """The time of an animation: start + speed * t, from 0 to its length, where it starts again or holds its last pose.

    It repeats after t = 0 only. Before, in the first half of the exposure of frame 0, an end that it meets is held: the
    exposure would else mix in the other end. So a closed cycle that starts at an end rests for half an exposure.
    Without a length it runs without end.
    """

    speed: float = 1.0  # seconds of the animation per second; negative: backwards
    start: float = 0.0  # s, of the animation at t = 0
    length: float | None = None  # s
    repeat: bool = True  # start again at the end; else the poses of both ends are held

    def __post_init__(self) -> None:
        check_numbers(self)
        if self.length is not None and not 0 <= self.length < np.inf:
            raise ValueError(f"Clock.length: seconds from 0 are needed, or None, got {self.length!r}")

    def at(self, t: float) -> float:
        """Return the time of the animation [s] at the time t [s] of the scene."""
        moment = self.start + self.speed * t
        if self.length is None:
            return moment
        if self.repeat and self.length > 0:
            if t > 0:
                return moment % self.length
            moment = self.start % self.length + self.speed * t
        return min(max(moment, 0.0), self.length)


@dataclass(frozen=True, eq=False)
class Track:
    """Keys of one quantity with N numbers. One key alone is a constant.

    `ValueError` for times that do not increase, and for shapes that do not match.
    """

    times: Array  # s, [K]
    values: Array  # [K, N]
    kind: str = "linear"  # between the keys: "step", "linear" or "cubic"
    tangents: Array | None = None  # per second, [2, K, N]: before and after each key; for "cubic"

    def __post_init__(self) -> None:
        times = np.asarray(self.times, np.float64)
        values = np.asarray(self.values, np.float64)
        if times.ndim != 1 or values.ndim != 2 or not len(times) or len(values) != len(times):
            raise ValueError(
                f"Track: times [K] and values [K, N] of one or more keys are needed, got {times.shape}, {values.shape}"
            )
        if not (np.isfinite(times).all() and np.isfinite(values).all()):
            raise ValueError("Track: every time and value must be finite")
        if (np.diff(times) <= 0).any():
            key = int(np.argmax(np.diff(times) <= 0))
            raise ValueError(f"Track.times must increase, got {times[key]:g} s and then {times[key + 1]:g} s")
        if self.kind not in KINDS:
            raise ValueError(f"Track.kind: one of {', '.join(KINDS)} is needed, got {self.kind!r}")
        if (self.kind == "cubic") != (self.tangents is not None):
            raise ValueError("Track.tangents: a cubic track needs them, any other has none")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "values", values)
        if self.tangents is not None:
            tangents = np.asarray(self.tangents, np.float64)
            if tangents.shape != (2, *values.shape) or not np.isfinite(tangents).all():
                raise ValueError(f"Track.tangents: finite [2, {len(values)}, {values.shape[1]}] needed")
            object.__setattr__(self, "tangents", tangents)

    @classmethod
    def constant(cls, value: ArrayLike) -> Track:
        """Return a track of one value [N] at all times."""
        return cls(np.zeros(1), np.asarray(value, np.float64).reshape(1, -1))

    def at(self, t: float) -> Array:
        """Return the value at time t [s], float64 [N]."""
        i, s = self._locate(t)
        if s == 0 or self.kind == "step":
            return self.values[i].copy()
        if self.tangents is None:
            return (1 - s) * self.values[i] + s * self.values[i + 1]
        # glTF 2.0, appendix C: cubic Hermite, whose stored tangents are per second.
        length = self.times[i + 1] - self.times[i]
        leave = self.tangents[1, i] * length
        arrive = self.tangents[0, i + 1] * length
        return (
            (2 * s**3 - 3 * s**2 + 1) * self.values[i]
            + (s**3 - 2 * s**2 + s) * leave
            + (3 * s**2 - 2 * s**3) * self.values[i + 1]
            + (s**3 - s**2) * arrive
        )

    def quaternion_at(self, t: float) -> Array:
        """Return a track of quaternions (x, y, z, w) at time t [s], float64 [4], of length 1.

        Between linear keys it turns uniformly and on the shorter way.
        """
        i, s = self._locate(t)
        if s == 0 or self.kind != "linear":
            return _unit(self.at(t))
        start = _unit(self.values[i])
        end = _unit(self.values[i + 1])
        # q and -q are one rotation; the nearer of them gives the shorter way.
        end = end if start @ end >= 0 else -end
        angle = 2 * np.arctan2(np.linalg.norm(end - start), np.linalg.norm(end + start))  # at most pi / 2
        # sin(x a) / sin(a) as a ratio of sincs, which stays exact where the angle vanishes.
        shares = [x * np.sinc(x * angle / np.pi) / np.sinc(angle / np.pi) for x in (1 - s, s)]
        return _unit(shares[0] * start + shares[1] * end)

    def largest(self) -> float:
        """Return a size that no number of the value exceeds at any time."""
        found = float(np.abs(self.values).max())
        if self.tangents is not None and len(self.times) > 1:  # both weights of a tangent are at most 4/27
            found += 8 / 27 * float(np.diff(self.times).max() * np.abs(self.tangents).max())
        return found

    def _locate(self, t: float) -> tuple[int, float]:
        """Return the key at or before t and the fraction 0..1 of the way to the next; times outside are clipped."""
        i = int(np.searchsorted(self.times, t, side="right")) - 1
        if i < 0 or i >= len(self.times) - 1:
            return max(i, 0), 0.0
        return i, float((t - self.times[i]) / (self.times[i + 1] - self.times[i]))


@dataclass(frozen=True, eq=False)
class Keyed:
    """A placement by keys: scaled, then rotated, then shifted."""

    translation: Track  # m, [K, 3]
    rotation: Track  # quaternions x, y, z, w, [K, 4]
    scale: Track  # [K, 3]

    def __post_init__(self) -> None:
        for name, count in (("translation", 3), ("rotation", 4), ("scale", 3)):
            found = getattr(self, name).values.shape[1]
            if found != count:
                raise ValueError(f"Keyed.{name}: {count} numbers per key are needed, got {found}")

    def pose(self, t: float) -> Array:
        """Return the matrix at time t [s], float64 [4, 4]; its axes have the lengths of the scale."""
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_of(self.rotation.quaternion_at(t)) * self.scale.at(t)
        matrix[:3, 3] = self.translation.at(t)
        return matrix

    def bounds(self) -> tuple[float, float]:
        """Return by which factor lengths grow at most, and the longest shift [m], over all times."""
        return self.scale.largest(), math.sqrt(3) * self.translation.largest()


@dataclass(frozen=True, eq=False)
class Fixed:
    """A placement by one matrix at all times; unlike `Still` it may scale."""

    matrix: Array  # [4, 4]

    def pose(self, t: float) -> Array:
        """Return the matrix, float64 [4, 4]."""
        return np.asarray(self.matrix, np.float64)

    def bounds(self) -> tuple[float, float]:
        """Return by which factor lengths grow at most, and the shift [m]."""
        return float(np.linalg.norm(self.matrix[:3, :3], 2)), float(np.linalg.norm(self.matrix[:3, 3]))


def rotation_of(quaternion: ArrayLike) -> Array:
    """Return the rotation [3, 3] of a quaternion (x, y, z, w) of length 1."""
    x, y, z, w = np.asarray(quaternion, np.float64)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _unit(quaternion: Array) -> Array:
    """Return a quaternion [4] of length 1; one of length 0, which a spline may pass, is no rotation."""
    length = float(np.linalg.norm(quaternion))
    return quaternion / length if length > 0 else np.array([0.0, 0.0, 0.0, 1.0])

"""Defines motions that deform the mesh: cloth in the wind as travelling waves in closed form.

A `Flag` is a rigid motion (of its pole) that also moves the vertices of its mesh in body coordinates. Position and
velocity are exact at any time. Left out: stretching, self-contact, gravity.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from qsim.scene.motion import Motion, Still, check_numbers
from qsim.scene.rotation import Array


@dataclass(frozen=True)
class Ripple:
    """A wave away from the pole: amplitude * x / width * sin(2 pi (x / wavelength - f t) + slant y + phase)."""

    amplitude: float  # m, at the free edge
    wavelength: float  # m, along x
    frequency: float  # Hz
    slant: float = 0.0  # rad/m along y: crests lean
    phase: float = 0.0  # rad

    def __post_init__(self) -> None:
        check_numbers(self)
        if not self.wavelength > 0:
            raise ValueError(f"Ripple.wavelength: a positive length [m] is needed, got {self.wavelength!r}")

    def angle(self, places: Array, t: float) -> Array:
        """Return the phase [rad] at the points [V, 3] in m at time t [s], float64 [V]."""
        x = places[:, 0]
        y = places[:, 1]
        return 2 * np.pi * (x / self.wavelength - self.frequency * t) + self.slant * y + self.phase


@dataclass(frozen=True, eq=False)
class Flag(Motion):
    """A sheet in the plane z = 0, fixed at x = 0, free at x = width; ripples displace it in z."""

    rest: Array  # m, vertices [V, 3] of the sheet at rest
    ripples: tuple[Ripple, ...]
    carrier: Motion = field(default_factory=Still)  # of the pole

    def __post_init__(self) -> None:
        if np.ndim(self.rest) != 2 or np.shape(self.rest)[1] != 3 or not self.width > 0:
            raise ValueError(
                f"Flag.rest: vertices [V, 3] from the pole at x = 0 to x > 0 are needed, got {np.shape(self.rest)}"
            )

    @property
    def width(self) -> float:
        """Distance [m] from the pole to the free edge."""
        return float(self.rest[:, 0].max())

    def pose(self, t: float) -> Array:
        return self.carrier.pose(t)

    def velocity(self, t: float) -> tuple[Array, Array]:
        return self.carrier.velocity(t)

    def deform(self, t: float) -> Array:
        """Return vertices [m] in body coordinates at time t [s], float64 [V, 3]."""
        moved = np.array(self.rest, dtype=np.float64)
        for ripple in self.ripples:
            moved[:, 2] += ripple.amplitude * self.rest[:, 0] / self.width * np.sin(ripple.angle(self.rest, t))
        return moved

"""Describes a lens that changes while the camera films: focal length, distortion, principal point over time."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.kinds import Number, Positive
from qsim.optics.hermite import value_at
from qsim.optics.lens import Lens

TERMS = ("k1", "k2", "k3", "k4", "p1", "p2", "aspect")  # of a lens that pass smoothly from time to time


@dataclass(frozen=True)
class Zoom:
    """Views at given times; between them every number passes on a cubic Hermite curve, as the positions of `Keyframes`.

    Before the first and after the last time the view rests. The f-number stays.
    """

    times: tuple[Number, ...]  # s, increasing
    distances: tuple[Positive, ...]  # of the pixels from the lens, `Camera.image_distance`, in heights of the picture
    lenses: tuple[Lens, ...]  # all with the same falloff

    def __post_init__(self) -> None:
        n = len(self.times)
        if n < 2 or len(self.distances) != n or len(self.lenses) != n:
            raise ValueError(
                "Zoom needs two or more times and as many distances and lenses, got "
                f"{n}, {len(self.distances)} and {len(self.lenses)}"
            )
        if not np.isfinite(self.times).all() or (np.diff(self.times) <= 0).any():
            raise ValueError(f"Zoom.times must be finite and increase, got {self.times}")
        if not all(0 < distance < math.inf for distance in self.distances):
            raise ValueError(f"Zoom.distances must be numbers above 0, got {self.distances}")
        if len({lens.falloff for lens in self.lenses}) > 1:
            raise ValueError("Zoom.lenses: all need the same falloff")

    def at(self, t: float) -> tuple[float, Lens]:
        """Return the distance [heights of the picture] and the lens at time t [s]."""
        distance, x, y, *terms = (float(value) for value in value_at(self.times, self._numbers, t))
        changes: dict[str, Any] = dict(zip(TERMS, terms, strict=True))
        return distance, replace(self.lenses[0], shift=(x, y), **changes)

    def moments(self) -> list[float]:
        """Return the times and the middles between them [s]: where a camera is checked."""
        between = [(early + late) / 2 for early, late in zip(self.times, self.times[1:], strict=False)]
        return sorted([*self.times, *between])

    @functools.cached_property
    def _numbers(self) -> Array:
        rows = [
            (distance, *lens.shift, *(getattr(lens, name) for name in TERMS))
            for distance, lens in zip(self.distances, self.lenses, strict=True)
        ]
        return np.array(rows, np.float64)

"""Simulates dark and flat frames of sensors with known parameters, to test `qsim calibrate` with.

Only NumPy and the definitions of the sensors: nothing is imported from qsim. A SPAD pixel avalanches at random, and
each effect is drawn event by event:

    arrivals = light x efficiency + dark counts     Poisson, or one bit per plane
    dead time                                       arrivals within it are lost (counters)
    afterpulses                                     each detection causes one in the next frame with a probability
    crosstalk                                       each avalanche fires each of its four neighbours with a probability
    saturation                                      a code ends at 2^bits - 1
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

WARM_UP = 4  # frames before the first, so that it has afterpulses of its predecessors


def vignetting(shape: tuple[int, int], loss: float, centre: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Return the relative light [H, W] of a lens that loses `loss` in the corners, with a mean of 1.

    It falls as cos^4: (1 + r^2)^-2. `centre` (y, x) is in half sides of the field.
    """
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    radius = ((y - centre[0]) ** 2 + (x - centre[1]) ** 2) / 2
    field = (1 + ((1 - loss) ** -0.5 - 1) * radius) ** -2.0
    return field / field.mean()


def drift(frames: int, amount: float) -> Array:
    """Return the relative light [T] of a lamp that changes linearly by `amount`, with a mean of 1."""
    return 1 + amount * np.linspace(-0.5, 0.5, frames) if frames > 1 else np.ones(1)


@dataclass(frozen=True, eq=False)
class SPADArray:
    """One SPAD array: its pixels and effects."""

    efficiency: Array  # [H, W] avalanches per photon
    dark_rate: Array  # [H, W] 1/s
    bits: int  # of a code; 1: binary planes
    dead_time: float = 0.0  # s, of a counter; not paralyzable
    afterpulsing: float = 0.0  # chance that a detection causes one in the next frame
    crosstalk: float = 0.0  # chance that an avalanche fires one given neighbour of the four

    def frames(
        self, rng: np.random.Generator, light: Array, exposure: float, frames: int, drift_amount: float = 0.0
    ) -> Array:
        """Return codes [T, H, W] at `light` [H, W] photons per exposure [s]; uint8."""
        factors = np.concatenate([np.ones(WARM_UP), drift(frames, drift_amount)])
        codes = np.empty((frames, *self.dark_rate.shape), np.uint8)
        before = np.zeros(self.dark_rate.shape, np.int64)
        for t, factor in enumerate(factors):
            arrivals = light * self.efficiency * factor + self.dark_rate * exposure
            if self.bits == 1:
                before = self._plane(rng, arrivals, before)
            else:
                before = self._counts(rng, arrivals, exposure, before)
            if t >= WARM_UP:
                codes[t - WARM_UP] = np.minimum(before, 2**self.bits - 1)
        return codes

    def _plane(self, rng: np.random.Generator, arrivals: Array, before: Array) -> Array:
        """Return one plane [H, W] of 0 and 1."""
        fired = rng.random(arrivals.shape) < -np.expm1(-arrivals)
        if self.afterpulsing:
            fired |= (rng.random(arrivals.shape) < self.afterpulsing) & (before > 0)
        plane = fired.copy()
        if self.crosstalk:
            for source, target in neighbours():
                plane[target] |= fired[source] & (rng.random(fired[source].shape) < self.crosstalk)
        return plane.astype(np.int64)

    def _counts(self, rng: np.random.Generator, arrivals: Array, exposure: float, before: Array) -> Array:
        """Return the counts [H, W] of one exposure, not yet clipped."""
        counts = counted(rng, arrivals, self.dead_time / exposure)
        if self.afterpulsing:
            counts = counts + rng.binomial(before, self.afterpulsing)
        total = counts.copy()
        if self.crosstalk:
            for source, target in neighbours():
                total[target] += rng.binomial(counts[source], self.crosstalk)
        return total


def neighbours() -> list[tuple[tuple[slice, slice], tuple[slice, slice]]]:
    """Return the four pairs (source, target) of slices of an image [H, W] that shift it by one pixel."""
    first, last, whole = slice(None, -1), slice(1, None), slice(None)
    return [
        ((first, whole), (last, whole)),
        ((last, whole), (first, whole)),
        ((whole, first), (whole, last)),
        ((whole, last), (whole, first)),
    ]


def counted(rng: np.random.Generator, arrivals: Array, dead_time: float) -> Array:
    """Return how many arrivals [H, W] of an exposure of length 1 are counted: each blocks the pixel for `dead_time`."""
    if dead_time == 0:
        return rng.poisson(arrivals)
    counts = np.zeros(arrivals.size, np.int64)
    rate = np.maximum(arrivals.ravel(), 1e-12)
    time = rng.exponential(1 / rate)
    live = np.flatnonzero(time < 1)
    while live.size:
        counts[live] += 1
        time[live] += dead_time + rng.exponential(1 / rate[live])
        live = live[time[live] < 1]
    return counts.reshape(arrivals.shape)

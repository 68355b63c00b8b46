"""Flicker: the strength of a light as a function of time, and its exact mean over an exposure.

    strength(t), mean 1 over a period  ->  mean over [start, stop] in closed form, no sampling

The radiance or intensity of a light is its mean over time; a flicker multiplies it. Lamps on alternating current vary
with twice the frequency of the mains: 100 or 120 Hz. Dimmed LEDs are switched, mostly at 200 Hz to some kHz. Each
integral is taken within one period, with phases reduced before they are subtracted: at 1e8 frames per second the mean
still has ten digits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.records import convert


@dataclass(frozen=True)
class Mains:
    """A lamp whose strength is 1 + depth cos(2 pi frequency t + phase): warm filaments, lamps with a smoothed supply.

    `depth` 0 is steady, 1 goes down to no light (the percent flicker of IEEE 1789 over 100).
    """

    frequency: float = 100.0  # Hz, of the light: twice that of the mains
    depth: float = 0.3  # 0..1
    phase: float = 0.0  # rad

    def __post_init__(self) -> None:
        _check(self)
        if not 0 <= self.depth <= 1:
            raise ValueError(f"Mains.depth: the swing of the strength around 1, 0 to 1, got {self.depth!r}")

    def mean(self, start: Array, stop: Array) -> Array:
        """Return the mean strength over the times from `start` to `stop` [s], float64 of their shape."""
        # The mean of a cosine over an interval is that at its middle times sinc of its length.
        middle = np.mod(self.frequency * (np.asarray(start) + stop) / 2, 1.0) + self.phase / math.tau
        return 1 + self.depth * np.cos(math.tau * middle) * np.sinc(self.frequency * np.subtract(stop, start))


@dataclass(frozen=True)
class RectifiedSine:
    """A lamp without any smoothing: pi / 2 |sin(pi frequency t + phase / 2)|, dark at every zero of the mains."""

    frequency: float = 100.0  # Hz, of the light: twice that of the mains
    phase: float = 0.0  # rad, of the light

    def __post_init__(self) -> None:
        _check(self)

    def mean(self, start: Array, stop: Array) -> Array:
        """Return the mean strength over the times from `start` to `stop` [s], float64 of their shape."""
        first, turns = _turns(self, start, stop)
        last = first + turns
        whole = np.floor(last)
        # 1/2 - cos(pi u) / 2 is the integral of pi / 2 sin(pi u) from 0 to u < 1. A sum of cosines is written as a
        # product: short exposures would cancel.
        inside = np.sin(math.pi * (first + last) / 2) * np.sin(math.pi * turns / 2)
        # From the start to the end of its period, then whole periods of mean 1, then the rest.
        across = whole + (np.cos(math.pi * first) - np.cos(math.pi * (last - whole))) / 2
        return np.where(whole == 0, inside, across) / turns


@dataclass(frozen=True)
class PulseWidth:
    """A switched LED: on for the share `duty` of a period, at 1 / duty times its mean, and dark for the rest.

    A period begins at times (n - phase / 2 pi) / frequency.
    """

    frequency: float = 1000.0  # Hz
    duty: float = 0.5  # share of a period, above 0 to 1
    phase: float = 0.0  # rad

    def __post_init__(self) -> None:
        _check(self)
        if not 0 < self.duty <= 1:
            raise ValueError(f"PulseWidth.duty: the share of a period with light, above 0 to 1, got {self.duty!r}")

    def mean(self, start: Array, stop: Array) -> Array:
        """Return the mean strength over the times from `start` to `stop` [s], float64 of their shape."""
        first, turns = _turns(self, start, stop)
        last = first + turns
        whole = np.floor(last)
        on = np.maximum(np.minimum(last, self.duty) - first, 0)  # within the first period
        rest = whole * self.duty + np.minimum(last - whole, self.duty) - np.minimum(first, self.duty)
        return np.where(whole == 0, on, rest) / (turns * self.duty)


Flicker = Mains | RectifiedSine | PulseWidth


def check_flicker(light: Any) -> None:
    """Raise `ValueError` if the flicker of a light is not one of this module's."""
    if not (light.flicker is None or isinstance(light.flicker, Flicker)):
        kinds = "Mains, RectifiedSine or PulseWidth"
        raise ValueError(f"{type(light).__name__}.flicker: {kinds} is expected, got {light.flicker!r}")


def _turns(flicker: RectifiedSine | PulseWidth, start: Array, stop: Array) -> tuple[Array, Array]:
    """Return the place in its period at which an exposure starts, 0..1, and its length in periods."""
    first = np.mod(np.mod(flicker.frequency * np.asarray(start), 1.0) + flicker.phase / math.tau, 1.0)
    return first, np.asarray(flicker.frequency * np.subtract(stop, start))


def _check(flicker: Flicker) -> None:
    kind = type(flicker).__name__
    for name in ("frequency", "phase"):
        value = convert(getattr(flicker, name), float, f"{kind}.{name}")
        if not math.isfinite(value) or (name == "frequency" and not 0 < value <= 1e9):
            wanted = "Hz above 0 to 1e9" if name == "frequency" else "finite radians"
            raise ValueError(f"{kind}.{name}: {wanted} expected, got {value!r}")

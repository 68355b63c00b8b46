"""Simulates dark and flat frames of sensors with known parameters, to test `qsim calibrate` with.

Only NumPy and the definitions of the sensors: nothing is imported from qsim. A SPAD pixel avalanches at random, and
each effect is drawn event by event:

    arrivals = light x efficiency + dark counts     Poisson, or one bit per plane
    dead time                                       arrivals within it are lost (counters)
    afterpulses                                     each detection causes one in the next frame with a probability
    crosstalk                                       each avalanche fires each of its four neighbours with a probability
    saturation                                      a code ends at 2^bits - 1

A camera or a QIS counts Poisson electrons, adds normal read noise, and rounds in its ADC.
"""

from __future__ import annotations

from dataclasses import dataclass, field

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
    first = slice(None, -1)
    last = slice(1, None)
    whole = slice(None)
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


@dataclass(frozen=True)
class Field:
    """Differences between pixels, and of the light between frames. All of them may be 0."""

    shape: tuple[int, int]
    prnu: float = 0.0  # relative, normal
    vignetting: float = 0.0  # share of the light that is lost in the corners
    drift: float = 0.0  # relative rms of the light from frame to frame and from stack to stack
    hot: float = 0.0  # share of the pixels, at 5 to 30 times the dark rate
    saturated: float = 0.0  # share of the hot pixels that count as much as they can

    def light(self, rng: np.random.Generator) -> Array:
        """Return the relative light of every pixel [H, W], PRNU included; its mean is 1 before PRNU."""
        return vignetting(self.shape, self.vignetting) * np.maximum(1 + self.prnu * rng.standard_normal(self.shape), 0)

    def dark(self, rng: np.random.Generator, largest: float = 1e6) -> Array:
        """Return the relative dark rate of every pixel [H, W]: 1, and more in hot pixels."""
        rates = np.ones(self.shape)
        hot = rng.random(self.shape) < self.hot
        rates[hot] = np.exp(rng.uniform(np.log(5), np.log(30), int(hot.sum())))
        rates[hot & (rng.random(self.shape) < self.saturated)] = largest
        return rates

    def frames(self, rng: np.random.Generator, count: int) -> Array:
        """Return the relative light of every frame [T]: a factor of the stack, a slope and a factor of the frame.

        Each of the three has a third of the variance of the drift.
        """
        part = self.drift / np.sqrt(3)
        slope = rng.standard_normal() * np.linspace(-1, 1, count) * np.sqrt(3)
        return np.maximum(1 + part * (rng.standard_normal() + slope + rng.standard_normal(count)), 0)


@dataclass(frozen=True)
class Camera:
    """A QIS or a conventional camera: Poisson electrons, normal read noise, an ADC."""

    gain: float  # codes/e-
    offset: float  # codes
    read_noise: float  # e-
    dark_current: float  # e-/s
    bits: int
    efficiency: float  # e-/photon
    frames: int
    dark_exposures: tuple[float, ...]  # s
    flat_exposure: float  # s
    lights: tuple[float, ...]  # e- per pixel and exposure
    field: Field = field(default_factory=lambda: Field((24, 24)))

    def stack(self, rng: np.random.Generator, light: Array | float, rates: Array, exposure: float) -> Array:
        """Return the codes [T, H, W] of light [H, W] in electrons and of dark rates [H, W], relative."""
        drift = self.field.frames(rng, self.frames)[:, None, None] if np.any(light) else np.ones((self.frames, 1, 1))
        expected = drift * np.asarray(light) + np.minimum(self.dark_current * exposure * rates, 1e7)
        electrons = rng.poisson(np.broadcast_to(expected, (self.frames, *self.field.shape)))
        signal = electrons + self.read_noise * rng.standard_normal(electrons.shape)
        codes = np.clip(np.rint(self.gain * signal + self.offset), 0, 2**self.bits - 1)
        return codes.astype(np.uint8 if self.bits <= 8 else np.uint16)

    def measure(self, rng: np.random.Generator) -> tuple[list[tuple[Array, float]], list[tuple[Array, float, float]]]:
        """Return darks (codes, exposure) and flats (codes, exposure, photons per pixel)."""
        light = self.field.light(rng)
        longest = max(self.dark_exposures)
        rates = self.field.dark(rng, 1e8 / (self.dark_current * longest))
        darks = [(self.stack(rng, 0.0, rates, t), t) for t in self.dark_exposures]
        flats = [
            (self.stack(rng, level * light, rates, self.flat_exposure), self.flat_exposure, level / self.efficiency)
            for level in self.lights
        ]
        return darks, flats

    def truth(self) -> dict[str, float]:
        """Return the true value of everything that a calibration prints with an interval."""
        return {
            "gain": self.gain,
            "offset": self.offset,
            "read_noise": self.read_noise,
            "dark_current": self.dark_current,
            "prnu": self.field.prnu,
            "quantum_efficiency": self.efficiency,
            "gain_transfer": self.gain,
            "read_noise_transfer": self.read_noise,
            "dark_current_transfer": self.dark_current,
        }


def random_camera(rng: np.random.Generator, noise_codes: tuple[float, float] = (0.1, 12.0)) -> Camera:
    """Draw a camera and its measurement: gain x read noise within `noise_codes`, 2 to 12 bits, 12 to 64 px a side."""

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    read_codes = between(*noise_codes)
    while True:
        read_noise = between(0.12, 5.0)
        gain = read_codes / read_noise
        bits = int(rng.integers(2, 13))
        top = 2**bits - 1
        offset = float(rng.uniform(0, min(6 * read_codes + 1, 0.3 * top)))
        well = (top - offset) / gain
        if 2.0 <= well <= 4000 and well > 4 * read_noise:
            break
    exposure = between(1e-6, 1.0)
    levels = int(rng.integers(3, 6))
    lights = tuple(float(x) for x in well * np.linspace(0.12, rng.uniform(0.4, 0.65), levels))
    several = rng.random() < 0.6
    dark = between(0.1, min(0.2 * well, 4.0))  # e- in the longest dark exposure
    exposures = (exposure, exposure * between(4, 300)) if several else (exposure,)
    if several and rng.random() < 0.5:
        exposures = (exposures[0], float(np.sqrt(exposures[0] * exposures[1])), exposures[1])
    shape = tuple(int(rng.integers(12, 65)) for _ in range(2))
    return Camera(
        gain=gain,
        offset=offset,
        read_noise=read_noise,
        dark_current=dark / exposures[-1],
        bits=bits,
        efficiency=float(rng.uniform(0.3, 0.9)),
        frames=int(rng.integers(4, 41)),
        dark_exposures=exposures,
        flat_exposure=exposure,
        lights=lights,
        field=Field(
            shape=(shape[0], shape[1]),
            prnu=between(0.005, 0.04),
            vignetting=float(rng.uniform(0, 0.5)),
            drift=0.005 * float(rng.integers(0, 2)),
            hot=float(rng.choice([0.0, 0.005, 0.01, 0.02])),
            saturated=float(rng.choice([0.0, 0.3])),
        ),
    )

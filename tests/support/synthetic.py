"""Synthetic dark and flat frames of sensors with known parameters, the truth for calibration."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from qsim.calibration.frame_statistics import FrameStatistics, measure
from qsim.calibration.qis import calibrate_qis
from qsim.calibration.results import Calibration
from qsim.calibration.spad import calibrate_spad
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.spad import BinarySPAD

PLANE = (12, 14)  # height and width of `draw_planes`


def draw_planes(rng: np.random.Generator, planes: int, rate: float, prnu: float = 0.0) -> np.ndarray:
    """Draw planes [T, 12, 14] of a SPAD array with a spread of dark counts."""
    arrivals = rate * np.maximum(1 + prnu * rng.standard_normal(PLANE), 0) * rng.lognormal(0, 0.3, PLANE)
    return rng.random((planes, *PLANE)) < -np.expm1(-arrivals)


def statistics_of(codes: np.ndarray, bits: int = 3, photons: float | None = 0.0) -> FrameStatistics:
    """Return the statistics of frames of 1 ms."""
    return measure([codes], bits=bits, exposure=1e-3, photons=photons)


@dataclass(frozen=True)
class QISCase:
    """A few-electron sensor with a fine ADC, and its measurement."""

    gain: float = 8.0  # codes/e-
    offset: float = 40.0  # codes
    read_noise: float = 0.25  # e-
    dark_current: float = 20.0  # e-/s
    prnu: float = 0.03
    bits: int = 8
    frames: int = 20
    side: int = 24  # px
    lights: tuple[float, ...] = (0.5, 2.0, 6.0)  # e- per exposure
    exposures: tuple[float, ...] = (1e-3, 5e-2)  # s, of the darks

    def codes(self, light: float, exposure: float, pattern: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw codes with NumPy from the definition, not with our sensor."""
        expected = np.maximum(light * (1 + self.prnu * pattern), 0) + self.dark_current * exposure
        shape = (self.frames, *pattern.shape)
        electrons = rng.poisson(expected, shape) + self.read_noise * rng.standard_normal(shape)
        return np.clip(np.rint(self.gain * electrons + self.offset), 0, 2**self.bits - 1).astype(np.int64)

    def stacks(self, rng: np.random.Generator) -> tuple[list[FrameStatistics], list[FrameStatistics]]:
        pattern = rng.standard_normal((self.side, self.side))
        darks = [
            measure([self.codes(0.0, t, pattern, rng)], bits=self.bits, exposure=t, photons=0.0) for t in self.exposures
        ]
        flats = [
            measure([self.codes(light, 1e-3, pattern, rng)], bits=self.bits, exposure=1e-3, photons=light / 0.8)
            for light in self.lights
        ]
        return darks, flats

    def calibrate(self, rng: np.random.Generator) -> tuple[Calibration, dict[str, float]]:
        truth = {
            "gain": self.gain,
            "offset": self.offset,
            "read_noise": self.read_noise,
            "dark_current": self.dark_current,
            "prnu": self.prnu,
            "quantum_efficiency": 0.8,
            "gain_transfer": self.gain,
            "read_noise_transfer": self.read_noise,
            "dark_current_transfer": self.dark_current,
        }
        return calibrate_qis(*self.stacks(rng), bits=self.bits), truth


@dataclass(frozen=True)
class SPADCase:
    """A SPAD array with a spread of dark counts and of efficiency."""

    bits: int = 1
    dead_time: float = 0.05  # of the exposure
    paralyzable: bool = False
    pde: float = 0.4
    dark_rate: float = 20.0  # 1/s
    prnu: float = 0.05
    frames: int = 40
    side: int = 24
    photons: tuple[float, ...] = (0.5, 1.5, 3.0)
    exposure: float = 1e-3
    afterpulsing: float = 0.0  # of a count, into the next frame; it moves all other parameters

    def calibrate(
        self, rng: np.random.Generator, *, ignore_dead_time: bool = False
    ) -> tuple[Calibration, dict[str, float]]:
        sensor = (
            BinarySPAD(1.0, 0.0, 1)
            if self.bits == 1
            else CountingSPAD(1.0, 0.0, self.dead_time * self.exposure, self.bits, self.paralyzable)
        )
        shape = (self.side, self.side)
        pattern = 1 + self.prnu * rng.standard_normal(shape)
        pattern /= pattern.mean()
        rates = self.dark_rate * rng.lognormal(0, 0.5, shape)

        def stack(light: float, frames: int) -> FrameStatistics:
            arrivals = light * self.pde * pattern + rates * self.exposure
            cdf = sensor.cdf(arrivals, self.exposure)[..., :-1]
            early = int(self.afterpulsing > 0)  # a frame before the first, for its afterpulses
            codes = np.stack([(rng.random((*shape, 1)) >= cdf).sum(axis=-1) for _ in range(early + frames)])
            for before, frame in pairwise(codes) if early else ():
                frame[:] = np.minimum(frame + rng.binomial(before, self.afterpulsing), 2**self.bits - 1)
            return measure([codes[early:]], bits=self.bits, exposure=self.exposure, photons=light)

        darks = [stack(0.0, 4 * self.frames)]
        flats = [stack(light, self.frames) for light in self.photons]
        found = calibrate_spad(
            darks, flats, bits=self.bits, dead_time=not ignore_dead_time, paralyzable=self.paralyzable
        )
        if self.afterpulsing:
            return found, {"afterpulsing": self.afterpulsing}
        # Afterpulsing of 0 is left out: an interval that ends at 0 holds it 97.5 times in 100.
        truth = {"dark_count_rate": float(rates.mean()), "pde_fill": self.pde, "prnu": self.prnu}
        if self.bits > 1:
            truth["dead_time"] = self.dead_time * self.exposure
        return found, truth


COUNTER = SPADCase(bits=5, photons=(2.0, 6.0, 14.0))


@dataclass(frozen=True)
class RandomArray:
    """An array with a fixed pattern, vignetting and hot pixels, and its measurement, all drawn at random."""

    readout: str  # "qis", "planes" or "counts"
    prnu: float  # 0.01 ... 0.3
    vignetting: float  # light lost in the corner, 0 ... 0.6
    centre: tuple[float, float]  # of the vignetting, -0.3 ... 0.3 of the half side
    hot: float  # share of the pixels, 0 ... 0.15
    side: int
    frames: int
    light: float  # electrons or avalanches per exposure, in the middle

    @classmethod
    def draw(cls, rng: np.random.Generator) -> RandomArray:
        readout = str(rng.choice(["qis", "planes", "counts"]))
        light = {"qis": (0.5, 8.0), "planes": (0.2, 1.2), "counts": (1.0, 14.0)}[readout]
        return cls(
            readout=readout,
            prnu=float(np.exp(rng.uniform(np.log(0.01), np.log(0.3)))),
            vignetting=float(rng.uniform(0, 0.6)),
            centre=tuple(rng.uniform(-0.3, 0.3, 2)),
            hot=float(rng.uniform(0, 0.15)),
            side=int(rng.integers(10, 41)),
            frames=int(np.exp(rng.uniform(np.log(2), np.log(60)))) * (10 if readout == "planes" else 1),
            light=float(np.exp(rng.uniform(*np.log(light)))),
        )

    def calibrate(self, rng: np.random.Generator, *, darks: bool = True) -> Calibration:
        shape = (self.side, self.side)
        y, x = np.meshgrid(*[np.linspace(-1, 1, self.side)] * 2, indexing="ij")
        radius = ((y - self.centre[0]) ** 2 + (x - self.centre[1]) ** 2) / 2
        fall = (1 - self.vignetting) ** -0.5 - 1  # cos^4 = (1 + r^2)^-2, so much lost at r = 1
        light = self.light * (1 + fall * radius) ** -2.0
        light = light * np.maximum(1 + self.prnu * rng.standard_normal(shape), 0)
        dark = 0.002 * rng.lognormal(0, 0.5, shape)
        hot = rng.random(shape) < self.hot
        dark[hot] = 0.002 * np.exp(rng.uniform(np.log(10), np.log(1000), int(hot.sum())))

        def stack(electrons: np.ndarray, exposure: float, photons: float | None, frames: int) -> FrameStatistics:
            drawn = rng.poisson(electrons * exposure / 1e-3, (frames, *shape))
            bits = {"qis": 8, "planes": 1, "counts": 7}[self.readout]
            if self.readout == "qis":
                drawn = np.rint(6 * (drawn + 0.3 * rng.standard_normal(drawn.shape)) + 20)
            codes = np.clip(drawn, 0, 2**bits - 1).astype(np.int64)
            return measure([codes], bits=bits, exposure=exposure, photons=photons)

        flats = [stack(level * light + dark, 1e-3, None, self.frames) for level in (1.0, 0.4)]
        taken = [stack(dark, t, 0.0, max(self.frames, 10)) for t in (1e-3, 1e-2)] if darks else []
        if self.readout == "qis":
            return calibrate_qis(taken, flats, bits=8)
        return calibrate_spad(taken, flats, bits=1 if self.readout == "planes" else 7)

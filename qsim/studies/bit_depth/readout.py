"""How a frame of b bits is read, as 2^b - 1 binary planes or once: estimates and exact moments of both.

MODELS names the two ways. A study's settings say which depths, sensors and light are compared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy import ndarray as Array

from qsim.sensor import devices
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD

MODELS = ("planes", "multibit")
GRID = 600  # light levels at which estimates are tabled


@dataclass(frozen=True)
class StudySettings:
    """What to compare; the clip is given apart."""

    bits: tuple[int, ...] = (1, 2, 3, 4, 5)
    sensor: str = "quiver-physical"  # of the multi-bit read
    plane: str | None = None  # of a binary plane; None: a clocked SPAD of the same efficiency and dark rate
    ppp: float | None = None  # photons per pixel and clip frame; None: light as it is
    speed: int = 1  # every so many-th clip frame is a plane: the motion of the clip, so many times faster
    instants: int = 8  # at most: output frames that are drawn and scored
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.bits or not all(1 <= b <= 10 for b in self.bits):
            raise ValueError(f"tradeoff: bits are 1 ... 10 here, got {list(self.bits)}")
        for name in ("speed", "instants"):
            if getattr(self, name) < 1:
                raise ValueError(f"tradeoff: {name} is a whole number of at least 1, got {getattr(self, name)}")
        object.__setattr__(self, "bits", tuple(sorted(set(self.bits))))

    @property
    def longest(self) -> int:
        """Clip frames that the deepest frame spans."""
        return (2 ** self.bits[-1] - 2) * self.speed + 1


@dataclass(frozen=True)
class Readout:
    """One way to form a b-bit frame: estimates of its light for each code, and their exact moments over light."""

    model: str
    bits: int
    sensor: Sensor  # one binary plane, or the multi-bit read
    exposure: float  # s, of one read

    @property
    def planes(self) -> int:
        """Clip frames in one frame."""
        return 2**self.bits - 1

    @cached_property
    def estimates(self) -> Array:
        """Maximum-likelihood light of the whole frame for codes 0 ... M, photons."""
        if self.model == "multibit":
            some = np.append(0.0, np.geomspace(1e-6, 1e2, 800)) * self.sensor.white(self.exposure)
            possible = self.sensor.pmf(some, self.exposure).max(axis=0) > 0  # without read noise, some codes never come
            result = np.zeros(self.planes + 1)
            result[possible] = self.sensor.maximum_likelihood(np.eye(self.planes + 1)[possible], self.exposure).photons
            return result
        k = np.arange(self.planes + 1)
        return self.planes * self.sensor.maximum_likelihood(np.stack([k[::-1], k], 1), self.exposure).photons

    def pmf(self, photons: Array) -> Array:
        """P(code) at light of the whole frame: [G] -> [G, M + 1]."""
        if self.model == "multibit":
            return self.sensor.pmf(photons, self.exposure)
        from scipy.stats import binom

        fires = self.sensor.pmf(photons / self.planes, self.exposure)[:, 1]
        return np.asarray(binom.pmf(np.arange(self.planes + 1), self.planes, fires[:, None]))

    def moments(self, photons: Array) -> tuple[Array, Array]:
        """Mean and variance of the estimate at light of the whole frame [...], interpolated in a table."""
        top = float(photons.max())
        grid = np.append(0.0, np.geomspace(max(float(photons.min()), 1e-5 * top), 1.0001 * top, GRID))
        pmf = self.pmf(grid)
        mean = pmf @ self.estimates
        variance = (pmf * (self.estimates - mean[:, None]) ** 2).sum(axis=1)
        return np.interp(photons, grid, mean), np.interp(photons, grid, variance)

    def snr_db(self, photons: float) -> float:
        """20 log10 of photons sqrt(Fisher information) at light of the whole frame."""
        if self.model == "multibit":
            information = float(self.sensor.fisher_information(np.array(photons), self.exposure))
        else:
            per_plane = self.sensor.fisher_information(np.array(photons / self.planes), self.exposure)
            information = float(per_plane) / self.planes
        return 20 * math.log10(photons * math.sqrt(information)) if information > 0 else -math.inf

    def noiseless(self) -> Readout:
        """The same without read noise."""
        return replace(self, sensor=replace(self.sensor, read_noise=0.0)) if isinstance(self.sensor, QIS) else self


def plane_sensor(settings: StudySettings, ppp: float, exposure: float) -> Sensor:
    """The sensor of one binary plane; `ValueError` if the named one has more than one bit."""
    if settings.plane is not None:
        return devices.load(settings.plane, ppp=ppp, bits=1, exposure=exposure)
    read = devices.load(settings.sensor, ppp=ppp, bits=1, exposure=exposure)
    return BinarySPAD(read.efficiency, read.dark_rate, 1)


def readouts(settings: StudySettings, ppp: float, exposure: float) -> list[Readout]:
    """Both models of every bit depth, at `ppp` photons per clip frame of `exposure` seconds."""
    plane = plane_sensor(settings, ppp, exposure)
    result = [Readout("planes", b, plane, exposure) for b in settings.bits]
    for b in settings.bits:
        m = 2**b - 1
        sensor = devices.load(settings.sensor, ppp=m * ppp, bits=b, exposure=m * exposure)
        result.append(Readout("multibit", b, sensor, m * exposure))
    return result

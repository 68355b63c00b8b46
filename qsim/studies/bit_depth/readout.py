"""Describes how a frame of b bits is read, as 2^b - 1 binary planes or once: estimates and their exact moments.

`StudySettings` holds the depths, sensors and light that a study compares. `Readout` is one of them, M = 2^b - 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy import ndarray as Array

from qsim.sensor import colour_filter, devices
from qsim.sensor.defects import defect_table
from qsim.sensor.file_laws import Conditions
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD

MODELS = ("planes", "multibit")  # M binary planes, or one read of b bits
GRID = 600  # light levels at which moments are tabulated


@dataclass(frozen=True)
class StudySettings:
    """The bit depths, sensors and light that a study compares on a clip."""

    bits: tuple[int, ...] = (1, 2, 3, 4, 5)
    sensor: str = "quiver-physical"  # of the multi-bit read
    plane: str | None = None  # of a binary plane; None: a clocked SPAD of the same efficiency and dark rate
    ppp: float | None = None  # photons per pixel and clip frame; None: light unchanged
    speed: int = 1  # every so many-th clip frame is a plane: the motion is so many times faster
    instants: int = 8  # largest number of output frames that are drawn and scored
    seed: int = 0
    moving: bool = False  # score the pixels that move at the scored instant, not the whole frame
    temperature: float | None = None  # degrees C of sensor files with dark_doubling; None: that of the file
    colour: str | None = None  # mask over the pixels of a colour clip, a name of qsim.sensor.colour_filter.MASKS

    def __post_init__(self) -> None:
        if not self.bits or not all(1 <= b <= 10 for b in self.bits):
            raise ValueError(f"tradeoff: bits must be 1 ... 10, got {list(self.bits)}")
        for name in ("speed", "instants"):
            if getattr(self, name) < 1:
                raise ValueError(f"tradeoff: {name} must be a whole number of at least 1, got {getattr(self, name)}")
        object.__setattr__(self, "bits", tuple(sorted(set(self.bits))))
        if self.temperature is not None and not any(_is_file(name) for name in (self.sensor, self.plane or "")):
            raise ValueError(
                f"tradeoff: temperature {self.temperature:g}: {self.sensor} has no law of temperature; name a sensor "
                "file with dark_doubling, or leave the temperature out"
            )

    @property
    def longest(self) -> int:
        """The number of clip frames that the deepest frame spans."""
        return (2 ** self.bits[-1] - 2) * self.speed + 1


@dataclass(frozen=True)
class Readout:
    """One way to form a b-bit frame: the estimate of its light for each code, and the exact moments of that."""

    model: str
    bits: int
    sensor: Sensor  # one binary plane, or the multi-bit read
    exposure: float  # s, of one read

    @property
    def planes(self) -> int:
        """The number M of clip frames in one frame."""
        return 2**self.bits - 1

    @cached_property
    def estimates(self) -> Array:
        """The maximum-likelihood light [photons per frame] for codes 0 ... M, float64 [M + 1]."""
        if self.model == "multibit":
            # Without read noise some codes have probability 0 at any light, and no estimate.
            some = np.append(0.0, np.geomspace(1e-6, 1e2, 800)) * self.sensor.white(self.exposure)
            possible = (
                self.sensor.pmf(some, self.exposure).max(axis=0) > 0
            )  # without read noise, some codes have probability 0
            result = np.zeros(self.planes + 1)
            result[possible] = self.sensor.maximum_likelihood(np.eye(self.planes + 1)[possible], self.exposure).photons
            return result
        k = np.arange(self.planes + 1)
        return self.planes * self.sensor.maximum_likelihood(np.stack([k[::-1], k], 1), self.exposure).photons

    def pmf(self, photons: Array) -> Array:
        """Return P(code) at light [photons per frame]: [G] -> [G, M + 1]."""
        if self.model == "multibit":
            return self.sensor.pmf(photons, self.exposure)
        from scipy.stats import binom

        fires = self.sensor.pmf(photons / self.planes, self.exposure)[:, 1]
        return np.asarray(binom.pmf(np.arange(self.planes + 1), self.planes, fires[:, None]))

    def moments(self, photons: Array) -> tuple[Array, Array]:
        """Return mean [photons] and variance of the estimate at light [photons per frame], both shaped like `photons`.

        They are interpolated between `GRID` light levels.
        """
        top = float(photons.max())
        grid = np.append(0.0, np.geomspace(max(float(photons.min()), 1e-5 * top), 1.0001 * top, GRID))
        # The geometric grid starts low enough that pixels between it and 0 do not matter to a mean error.
        pmf = self.pmf(grid)
        mean = pmf @ self.estimates
        variance = (pmf * (self.estimates - mean[:, None]) ** 2).sum(axis=1)
        return np.interp(photons, grid, mean), np.interp(photons, grid, variance)

    def snr_db(self, photons: float) -> float:
        """Return 20 log10(photons sqrt(Fisher information)) at light [photons per frame]."""
        if self.model == "multibit":
            information = float(self.sensor.fisher_information(np.array(photons), self.exposure))
        else:
            # M planes add their information; with light / M in each, the change of variable divides it by M^2.
            per_plane = self.sensor.fisher_information(np.array(photons / self.planes), self.exposure)
            information = float(per_plane) / self.planes
        return 20 * math.log10(photons * math.sqrt(information)) if information > 0 else -math.inf

    def noiseless(self) -> Readout:
        """Return the same readout without read noise."""
        return replace(self, sensor=self.sensor.without_read_noise())


def _is_file(name: str) -> bool:
    return name.endswith(".toml")


def at_depth(name: str, bits: int, ppp: float, exposure: float, temperature: float | None = None) -> Sensor:
    """Return a named sensor, or that of a file, with so many bits at `ppp` photons per pixel and exposure.

    A file of a SPAD, or of a QIS with gain 1 and no offset, is taken at every depth. `ValueError` for another file
    whose sensor has other bits, because gain and offset belong to them. Spike cameras, defects and colour filters are
    refused, too. `temperature` [degrees C] is that of a file; a named sensor has one.
    """
    if not _is_file(name):
        return devices.load(name, ppp=ppp, bits=bits, exposure=exposure)
    sensor = _of_file(name, bits, temperature)
    found = sensor.at_depth(bits)
    if found is not None:
        return found
    if sensor.bits != bits:
        raise ValueError(
            f"{name}: its gain and offset belong to its {sensor.bits} bits, and {bits} are asked for; give a QIS of "
            f"gain 1 without offset, a SPAD, or for sensor= its own depth alone: bits={sensor.bits}"
        )
    return sensor


def _of_file(name: str, bits: int, temperature: float | None) -> Sensor:
    """Return the sensor of a file; `ValueError` for what the laws of this study do not hold for.

    `bits` are those of a file that states none.
    """
    sensor = devices.from_toml(name, bits, Conditions(temperature))
    if sensor.keeps_charge:
        raise ValueError(
            f"{name}: planes of a spike camera depend on each other, which this study does not model; name another "
            "sensor"
        )
    for table, found in (("defects", defect_table.from_toml(name)), ("colour", colour_filter.from_toml(name))):
        if found is not None:
            raise ValueError(
                f"{name}: this study is of perfect pixels without colour filters; name a file without the table "
                f"[{table}]"
            )
    return sensor


def plane_sensor(settings: StudySettings, ppp: float, exposure: float) -> Sensor:
    """Return the sensor of one binary plane; raise `ValueError` if the named one has more than one bit.

    Unless one is named, efficiency and dark rate are those of the multi-bit read, whatever its bits. `ValueError` too
    where this read has dark electrons per frame, so that no plane has its rate.
    """
    if settings.plane is not None:
        return at_depth(settings.plane, 1, ppp, exposure, settings.temperature)
    file = _is_file(settings.sensor)
    read, longer = (
        _of_file(settings.sensor, settings.bits[0], settings.temperature)
        if file
        else devices.load(settings.sensor, ppp=ppp, exposure=seconds)
        for seconds in (exposure, 2 * exposure)
    )
    if read.dark_rate != longer.dark_rate:
        raise ValueError(
            f"{settings.sensor}: its dark electrons are per frame, whatever the exposure, so that planes have no dark "
            "rate; name their sensor with plane_sensor=, or take quiver-physical"
        )
    return BinarySPAD(read.efficiency, read.dark_rate, 1)


def readouts(settings: StudySettings, ppp: float, exposure: float) -> list[Readout]:
    """Return both models of every bit depth, at `ppp` photons per clip frame of `exposure` seconds."""
    plane = plane_sensor(settings, ppp, exposure)
    result = [Readout("planes", b, plane, exposure) for b in settings.bits]
    for b in settings.bits:
        m = 2**b - 1
        read = at_depth(settings.sensor, b, m * ppp, m * exposure, settings.temperature)
        result.append(Readout("multibit", b, read, m * exposure))
    return result

"""Describes at which light level a sensor sees a clip, and builds that sensor.

light level, sensor's name or file -> sensor, and everything that decides the codes of a clip
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from qsim.sensor import devices
from qsim.sensor.defects.defect_table import Defects, from_toml
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.streams.clip import Clip
from qsim.streams.sensing import Sensing, prepare
from qsim.streams.simulation import Draw


@dataclass(frozen=True)
class Illumination:
    """A light level and the sensor that receives it."""

    sensor: str = "quiver-physical"  # a named device of qsim, or a TOML file
    ppp: float | None = 3.25  # mean photons per pixel and exposure over the clip; None = the clip's own light
    bits: int | None = 3  # None = the device's own

    def device(self, exposure: float) -> Sensor:
        """Return the sensor for clips with this exposure [s]."""
        return _device(self, exposure)

    def sensing(self, seed: int = 0) -> Sensing:
        """Return the same light level and sensor as settings of `qsim sense`."""
        return Sensing(self.sensor, bits=self.bits, ppp=self.ppp, seed=seed)

    def draw(self, clip: Clip, seed: int = 0) -> Draw:
        """Return everything that decides the codes of a clip, with the defects of a sensor file. `ValueError` if it
        does not fit the clip.
        """
        return prepare(clip, self.sensing(seed))

    @property
    def level(self) -> str:
        """Return light and bits as text: `3.25 PPP, 3 bit`."""
        return ", ".join(
            (
                "own light" if self.ppp is None else f"{self.ppp:g} PPP",
                "own bits" if self.bits is None else f"{self.bits} bit",
            )
        )

    @property
    def label(self) -> str:
        """Return the text of tables: `3.25 PPP, 3 bit`."""
        return self.level


def read_sensor(source: str | Mapping[str, Any], bits: int | None = None) -> tuple[Sensor, Defects | None]:
    """Return the sensor of a file with its defects, or the sensor of a record. `ValueError` if its bits differ."""
    if isinstance(source, str):
        return devices.load(source, bits=bits), from_toml(source)
    return devices.from_dict(source), None


@lru_cache(maxsize=256)
def is_known(sensor: Sensor) -> bool:
    """Return whether a sensor is of a model of qsim, not of a class of one's own."""
    return devices.is_known(sensor)


def _device(light: Illumination, exposure: float) -> Sensor:
    return devices.load(light.sensor, ppp=light.ppp, bits=light.bits, exposure=exposure)


def follows_light(sensor: str) -> bool:
    """Return whether the gain of a named sensor is set from the photons per pixel."""
    return sensor in devices.DEVICES and devices.DEVICES[sensor].follows_light


def ideal_counter(bits: int) -> Sensor:
    """Return a sensor that counts every photon up to 2^bits - 1, for measured photon counts."""
    return QIS(quantum_efficiency=1.0, dark_current=0.0, read_noise=0.0, bits=bits)

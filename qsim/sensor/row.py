"""States how a row of a batch becomes codes: its sensor, exposure, key, light level and place (rows.py draws it)."""

from __future__ import annotations

from dataclasses import dataclass

from qsim.keys import Key
from qsim.sensor.sensor import Sensor


@dataclass(frozen=True)
class Row:
    """How one row of a batch, light [T, H, W], becomes codes."""

    sensor: Sensor  # of at most 8 bits
    exposure: float  # s, of one code
    key: Key  # of its first frame: frame t is drawn under `key.at(key.frame + t)`
    scale: float = 1.0  # expected photons per unit of light
    origin: tuple[int, int] = (0, 0)  # (y, x) of its first pixel in the full frame
    at_once: bool = False  # a sum of planes is drawn from one number per pixel, as training windows draw it

"""Finds dead and hot pixels, and the sensor whose response the other ones have.

Light is estimated from codes by one response for all pixels. The mean dark rate of a map belongs mostly to its hot
pixels. Subtracted from every pixel, it makes the light of the good ones too low by their share of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import files
from qsim.sensor.defects.defect_table import Defects, from_dict
from qsim.sensor.defects.pixel_array import PixelArray
from qsim.sensor.sensor import Sensor

HOT = 0.1  # dark detections over those of the mean light, from which on a pixel counts as hot
_DARK = "dark rates of single pixels"
_WORDS = {"dark": _DARK, "dark_map": _DARK}  # of keys of a table; others stand for themselves
_NO_EFFECT = ("device_seed", "afterpulse_delay")  # keys of a table that change no mean code alone


def defective(
    defects: Defects | None,
    sensor: Sensor,
    exposure: float,
    light: float,
    shape: tuple[int, int],
    origin: tuple[int, int] = (0, 0),
) -> Array | None:
    """Return the dead and the hot pixels, bool [H, W], of a sensor with defects; None without any.

    A pixel is hot if its dark detections per exposure [s] exceed HOT times those of the mean light [photons]. Of a
    clocked sum, `sensor` and `exposure` are those of the sum. `origin` (y, x) places a crop in the full frame.
    """
    if defects is None:
        return None
    array = PixelArray.of(defects, sensor, *shape, origin)
    bad = np.zeros(shape, bool) if array.maps.dead is None else np.array(array.maps.dead)
    if array.maps.dark is not None:
        bad |= array.maps.dark * array.sensor.dark_rate * exposure > HOT * light * array.sensor.efficiency
    return bad if bad.any() else None


def behind(
    bad: Array | None,
    defects: Defects | None,
    sensor: Sensor,
    shape: tuple[int, int],
    origin: tuple[int, int] = (0, 0),
) -> Sensor:
    """Return the sensor of filled codes: its dark rate is the mean of the good pixels of its frames [H, W].

    `bad`, bool [H, W], is true at the others; None: all are good. The mean over all pixels, or over those of a measured
    map that the frames do not cover, belongs mostly to hot ones: restored light would be too dark by their share of it.
    """
    if defects is None:
        return sensor
    good = np.ones(shape, bool) if bad is None else ~bad
    array = PixelArray.of(defects, sensor, *shape, origin)
    if array.maps.dark is None or not good.any():
        return sensor
    return sensor.with_dark_rate(array.sensor.dark_rate * float(array.maps.dark[good].mean()))


def of_table(
    sensor: Sensor,
    table: Mapping[str, Any],
    light: float | None,
    exposure: float,
    shape: tuple[int, int],
    origin: tuple[int, int] = (0, 0),
) -> tuple[Sensor, str]:
    """Return the sensor of the good pixels behind a table [defects], and which defects its response leaves out.

    The text is empty without defects. The sensor stays as it is where the mean `light` [photons] of an `exposure` [s]
    is unknown (None) or a map is missing. `shape` is that of the frames [H, W], `origin` (y, x) their place.
    """
    left = [_WORDS.get(key, key) for key in table if key not in _NO_EFFECT]
    if not left:
        return sensor, ""
    try:
        found = from_dict(table)
        if light is not None:
            bad = defective(found, sensor, exposure, light, shape, origin)
            sensor = behind(bad, found, sensor, shape, origin)
    except (OSError, ValueError) as error:  # a measured map is missing or has changed
        return sensor, f"no defect is inverted: {files.wording(error)}"
    return sensor, f"not inverted: {', '.join(left)}"

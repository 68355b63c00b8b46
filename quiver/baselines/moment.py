"""Restores by the moment inverse: the mean code of a window through the sensor's exact inverse response.

    photons = mu^-1(min(mean(codes), top - 1/(2 window)))

Source: method of moments, textbook. Clipping, rounding, dark counts and dead time are taken into account, because mu
comes from the sensor's exact distribution. Space and motion are not.
"""

from __future__ import annotations

from numpy import ndarray as Array

from qsim.sensor.sensor import Sensor
from quiver.baselines.sliding_window import restore_by_mean


def restore(
    codes: Array,
    sensor: Sensor,
    exposure: float,
    *,
    window: int = 11,
    photons_per_unit: float = 1.0,
    frames: range | None = None,
) -> Array:
    """Restore codes [T, H, W] from `window` frames around each: float32 [T, H, W], in units of this many photons.

    `ValueError` for codes that the sensor cannot produce, an empty window and an impossible unit.
    """
    table = sensor.response(exposure)

    def photons_of(mean_code: Array) -> Array:
        return table.invert(mean_code, window)

    return restore_by_mean(codes, sensor, window, photons_of, photons_per_unit, frames)

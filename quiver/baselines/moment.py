"""Moment inverse: the mean code of a window, sent back through the sensor's exact mean response.

    photons = mu^-1(min(mean(codes), top - 1/(2 window)))

Source: method of moments, textbook. Knows clipping, rounding, dark counts and dead time, because mu comes from the
sensor's exact distribution; knows nothing about space or motion.
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
    """Codes [T, H, W] -> restored [T, H, W], float32, from `window` frames around each, in units of so many photons.

    Raises ValueError for codes the sensor cannot produce, an empty window and an impossible unit.
    """
    table = sensor.response(exposure)

    def photons_of(mean_code: Array) -> Array:
        return table.invert(mean_code, window)

    return restore_by_mean(codes, sensor, window, photons_of, photons_per_unit, frames)

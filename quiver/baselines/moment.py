"""Restores by the moment inverse: the sum of a window's codes through the sensor's exact inverse response.

    photons = mu^-1(mean(codes)), corrected for the bias of a curved response   (few_codes.py)

Source: method of moments, textbook. Clipping, rounding, dark counts and dead time are taken into account, because mu
comes from the sensor's exact distribution. Space and motion are not.
"""

from __future__ import annotations

from numpy import ndarray as Array

from qsim.sensor.sensor import Sensor
from quiver.baselines import few_codes
from quiver.baselines.sliding_window import check_window, restore_by_sums


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

    Below the mean code of a dark pixel it is negative, so that noise adds no light. `ValueError` for codes that the
    sensor cannot produce, a window that does not resolve its response, and an impossible unit.
    """
    check_window(window)
    sensor.response(exposure).cap(window)

    def table_of(count: int) -> Array:
        return few_codes.of_sums(sensor, exposure, ((1.0, count),))

    return restore_by_sums(codes, sensor, window, table_of, photons_per_unit, frames)

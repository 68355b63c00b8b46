"""The reference draw at single pixels anywhere in a clip: what `Sensor.sample` gives there, without the rest.

The compiled engine asks here about pixels that it cannot decide itself (kernels.py).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key, philox4x32, uniform
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD


def draw_at(sensor: Sensor, photons: Array, exposure: float, key: Key, origin: tuple[int, int], at: Array) -> Array:
    """The reference draw at single pixels: `at` int [3, p] = (t, y, x) in photons [T, H, W] -> codes [p].

    `ValueError` if any of these photons is no light level (all such pixels are among the doubtful ones).
    """
    t, y, x = at
    light = np.asarray(photons[t, y, x], np.float64)
    if not (np.isfinite(light) & (light >= 0)).all():
        sensor.arrivals(photons, exposure)
    frames, rows, columns = key.frame + t, y + origin[0], x + origin[1]
    if not (isinstance(sensor, BinarySPAD) and sensor.bits > 1):
        return _draw(sensor, light, exposure, key, (columns, rows, frames))
    single, m = replace(sensor, bits=1), sensor.planes
    planes = (_draw(single, light / m, exposure / m, key, (columns, rows, frames * m + plane)) for plane in range(m))
    return np.sum(list(planes), axis=0)


def _draw(sensor: Sensor, light: Array, exposure: float, key: Key, place: tuple[Array, Array, Array]) -> Array:
    first = _words(key, place, 0)
    drawn, tail = sensor.decide(uniform(first), light, exposure)
    if tail.any():
        x, y, frame = (np.broadcast_to(axis, tail.shape)[tail] for axis in place)
        drawn[tail] = sensor.codes_at(first[tail], _words(key, (x, y, frame), 1), light[tail], exposure)
    return drawn


def _words(key: Key, place: tuple[Array, Array, Array], redraw: int) -> Array:
    """The words of single pixels (x, y, frame) of the full frame: uint32 [p]."""
    x, y, frame = place
    blocks = philox4x32(np.stack(np.broadcast_arrays(x >> 2, y, frame, redraw)), key.philox_key)
    return blocks[x & 3, np.arange(x.size)]

"""Gives the noise of codes at every mean, for networks that take it as an input, from the exact law of their sensor.

One table serves training windows and restored streams alike.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.sensor import Sensor

NODES = 4097  # of a table; between nodes the variance is read along straight lines


@lru_cache(maxsize=64)
def noise_table(sensor: Sensor, exposure: float) -> Array:
    """Return the variance of one code over 2^b - 1 at equal steps of its mean over 2^b - 1, float32 [NODES].

    Codes of `exposure` seconds. Below the mean of a dark pixel the variance is that of a dark pixel, and above the
    largest mean that of the brightest light. The array is shared and read-only. `ValueError` for a sensor whose mean
    code does not rise with light.
    """
    response = sensor.response(exposure)
    top = sensor.levels - 1
    steps = np.linspace(0, top, NODES)
    table = (np.interp(steps, response.mean, response.variance) / top**2).astype(np.float32)
    table.setflags(write=False)
    return table

"""A method: the mean of the codes that are given, scaled to photons as if the sensor were linear."""

import numpy as np


def restore(codes, sensor, exposure, *, window=11, photons_per_unit=1.0, frames=None):
    """The mean of all codes that are given."""
    mean = codes.mean(axis=0, dtype=np.float32) / (sensor.levels - 1)
    count = len(codes if frames is None else frames)
    return np.repeat(mean[None], count, axis=0) * np.float32(sensor.white(exposure) / photons_per_unit)

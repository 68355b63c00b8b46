"""Sensors whose windows are merged, and merged frames as NumPy has them."""

from dataclasses import fields

import numpy as np
from scipy.ndimage import gaussian_filter
from torch import Tensor

from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.devices import quiver_physical
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD

EXPOSURE = 5e-4


def random_sensor(rng):
    """A sensor of 1 to 8 bits."""
    bits = int(rng.integers(1, 9))
    match rng.integers(4):
        case 0:
            return QIS(rng.uniform(0.2, 1), float(rng.choice([0, 1.6, 3200])), rng.uniform(0.15, 0.5), bits)
        case 1:
            return BinarySPAD(rng.uniform(0.05, 1), float(rng.choice([0, 25])), min(bits, 7))
        case 2:
            return CountingSPAD(rng.uniform(0.05, 1), 25.0, float(rng.choice([0, 1e-6])), min(bits, 5))
        case _:
            return quiver_physical(float(rng.choice([0.3, 3.25, 100])), bits)


def window_of(rng, sensor, shape):
    """Codes of a texture that moves by up to 12 px/frame, at 0.1 to 200 photons, with hot pixels or without."""
    frames, height, width = shape
    texture = gaussian_filter(rng.normal(size=(height + 40, width + 40)), rng.uniform(0.5, 4), mode="wrap")
    light = 10 ** rng.uniform(-1, 2.3) * np.exp(texture / texture.std() * rng.uniform(0.1, 1.2))
    speed = rng.uniform(-12, 12, 2) * rng.choice([0.0, 0.1, 1.0])
    moved = [np.roll(light, tuple(int(s) for s in np.round(speed * t)), (0, 1)) for t in range(frames)]
    photons = np.stack(moved)[:, :height, :width]
    photons = photons + 50 * (rng.random((height, width)) < rng.choice([0, 0.01]))
    return sensor.sample(photons, EXPOSURE, key=Key(0, int(rng.integers(10**6))), engine="reference")


def one_frame(merged):
    """A record of tensors [1, ...] with arrays [...] in their place."""
    values = {field.name: getattr(merged, field.name) for field in fields(merged)}
    return type(merged)(**{name: x[0].numpy() if isinstance(x, Tensor) else x for name, x in values.items()})

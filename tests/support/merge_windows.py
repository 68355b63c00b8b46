"""Sensors whose windows are merged, and merged frames as NumPy has them."""

from dataclasses import fields

from torch import Tensor

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


def one_frame(merged):
    """A record of tensors [1, ...] with arrays [...] in their place."""
    values = {field.name: getattr(merged, field.name) for field in fields(merged)}
    return type(merged)(**{name: x[0].numpy() if isinstance(x, Tensor) else x for name, x in values.items()})

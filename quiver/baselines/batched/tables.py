"""Reads functions of one variable from the tables of a sensor as `numpy.interp` does, on any device.

Places are found by a search in the table, in float64, so that values are those of NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from numpy import ndarray as Array
from torch import Tensor

from qsim.sensor.estimation import Response
from qsim.sensor.sensor import Sensor
from quiver.baselines import vst


@dataclass(frozen=True, eq=False)
class Table:
    """A function by its values at rising points, constant beyond their ends."""

    points: Tensor  # float64 [G]
    values: Tensor  # float64 [G]

    def __call__(self, x: Tensor) -> Tensor:
        """Return the values, float32 [...], at numbers [...]."""
        x = x.to(torch.float64)
        right = torch.searchsorted(self.points, x, right=True).clamp_(1, len(self.points) - 1)
        points, values = ((table[right - 1], table[right]) for table in (self.points, self.values))
        share = ((x - points[0]) / (points[1] - points[0])).clamp_(0, 1)
        return torch.lerp(values[0], values[1], share).to(torch.float32)


def table(points: Array, values: Array, device: torch.device) -> Table:
    """Return a table of NumPy on a device."""
    found = [torch.tensor(one, dtype=torch.float64).to(device) for one in (points, values)]
    return Table(*found)


@lru_cache(maxsize=16)
def variance_of_code(sensor: Sensor, exposure: float, device: torch.device) -> Table:
    """Return the variance of a code [codes^2] over its mean."""
    response = sensor.response(exposure)
    return table(response.mean, response.variance, device)


@dataclass(frozen=True, eq=False)
class Light:
    """The photons over the mean code of a sensor."""

    photons: Table
    response: Response

    def __call__(self, mean_code: Tensor, samples: float | Tensor) -> Tensor:
        """Return the photons, float32 [...], of the mean [...] of so many codes; see `Response.invert`."""
        return self.photons(mean_code.to(torch.float64).clamp(max=self.response.highest(samples)))


@lru_cache(maxsize=32)
def light(sensor: Sensor, exposure: float, device: torch.device) -> Light:
    """Return the photons over the mean code of a sensor, on a device."""
    response = sensor.response(exposure)
    return Light(table(response.mean, response.photons, device), response)


@dataclass(frozen=True, eq=False)
class Stabiliser:
    """What quiver/baselines/vst.py states, with its tables on a device."""

    forward: Table
    inverse: Table
    deviation: float
    peak: float


@lru_cache(maxsize=32)
def stabiliser(
    sensor: Sensor, exposure: float, times: tuple[int, ...], kind: vst.Kind, device: torch.device
) -> Stabiliser:
    """Return the stabiliser for the mean of codes of this sensor, each taken `times` times."""
    own = vst.stabiliser(sensor, exposure, times, kind)
    return Stabiliser(
        table(own.mean_code, own.stabilised, device),
        table(own.expected, own.photons, device),
        own.deviation,
        own.peak,
    )

"""Tabulates the law of any pixel that takes one uniform number, for kernels that know no model: F_k over light.

    sensor, exposure -> cells of equal width in x = sqrt(arrivals) -> two polynomials per cell and step F_k

In x all Poisson laws fall over the same width, so sixteen cells per unit serve dim and bright steps. The cubic decides
nearly every pixel in float32. The polynomial of degree seven decides the others in float64. Behind the last cell more
light changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array
from numpy.polynomial import chebyshev

from qsim.sensor.distribution import MOST_EVENTS, Distribution

NODES = 8  # of a cell; coefficients of its exact polynomial
FAST = 4  # coefficients of its cubic
_CELLS = 16.0  # per unit of x
_MOST_CELLS = 16.0 * 2**12
_SETTLED = 1e-15  # of a step that more light no longer changes
_FAST_ERROR = 1e-6  # of a cubic, at most
_LAST = 3e-13  # of the last coefficient of an exact polynomial: those left out are a hundred times smaller
_ROUNDING = 8e-7  # of coefficients, cubic and uniform number in float32, several times
_LARGEST = 1 << 21  # polynomials of a table: 170 MB
_TOGETHER = 1 << 20  # values of a cdf held at a time
_NEVER = 2.0  # a step that no uniform number passes


@dataclass(frozen=True, eq=False)
class LawTable:
    """The steps of a law. Polynomials are in s = 2 (x rate - cell) - 1, from -1 to 1 in each cell, constant first."""

    rate: float  # cells per x
    fast: Array  # float32 [cells, steps, 4]
    exact: Array  # float64 [cells, steps, 8]
    margin: float  # distance to a step below which the cubics do not decide

    @classmethod
    def of(cls, sensor: Distribution, exposure: float) -> LawTable | None:
        """Return the table of a sensor at an exposure [s]; None where it would be too large."""
        settled = _settled(sensor, exposure)
        rate = _CELLS
        while rate <= _MOST_CELLS:
            cells = int(np.ceil(settled * rate))
            if cells * (sensor.levels - 1) > _LARGEST:
                return None
            series = _series(sensor, exposure, rate, cells)
            error = float(np.abs(series[..., FAST:]).sum(axis=-1).max())
            if error <= _FAST_ERROR and float(np.abs(series[..., -1]).max()) <= _LAST:
                return cls(rate, _powers(series[..., :FAST]).astype(np.float32), _powers(series), error + _ROUNDING)
            rate *= 2
        return None

    @property
    def steps(self) -> int:
        """Return the number of steps: codes beside 0."""
        return self.fast.shape[1]

    @property
    def bits(self) -> int:
        """Return the bits of a code."""
        return self.steps.bit_length()

    def padded(self, steps: int) -> LawTable:
        """Return the same with so many steps; no number passes those that are added."""
        more = ((0, 0), (0, steps - self.steps), (0, 0))
        fast = np.pad(self.fast, more)
        exact = np.pad(self.exact, more)
        fast[:, self.steps :, 0] = _NEVER
        exact[:, self.steps :, 0] = _NEVER
        return LawTable(self.rate, fast, exact, self.margin)


def _settled(sensor: Distribution, exposure: float) -> float:
    """Return x from which on more light changes no step."""
    x = 2.0 ** np.arange(-20, np.log2(MOST_EVENTS) / 2, 0.125)
    cdf = sensor.cdf_of(np.append(x * x, MOST_EVENTS), exposure)
    changes = np.abs(cdf[:-1] - cdf[-1]).max(axis=1) > _SETTLED
    return float(x[min(int(np.flatnonzero(np.append(True, changes))[-1]), len(x) - 1)])


def _series(sensor: Distribution, exposure: float, rate: float, cells: int) -> Array:
    """Return Chebyshev series of the steps, float64 [cells + 1, steps, NODES]; in the last cell they are constant."""
    angles = np.pi * (np.arange(NODES) + 0.5) / NODES
    x = (np.arange(cells)[:, None] + (np.cos(angles) + 1) / 2) / rate
    fit = 2 / NODES * np.cos(np.arange(NODES)[:, None] * angles)
    fit[0] /= 2
    found = np.zeros((cells + 1, sensor.levels - 1, NODES))
    some = max(1, _TOGETHER // (NODES * sensor.levels))
    for first in range(0, cells, some):
        part = x[first : first + some]
        cdf = sensor.cdf_of((part * part).ravel(), exposure)[:, :-1].reshape(*part.shape, -1)
        found[first : first + len(part)] = np.einsum("kj,njs->nsk", fit, cdf)
    found[cells, :, 0] = sensor.cdf_of(np.array([MOST_EVENTS]), exposure)[0, :-1]
    return found


def _powers(series: Array) -> Array:
    """Return the coefficients of powers of Chebyshev series [..., n], constant first."""
    count = series.shape[-1]
    powers = np.zeros((count, count))
    for n in range(count):
        powers[n, : n + 1] = chebyshev.cheb2poly(np.eye(count)[n])
    return series @ powers

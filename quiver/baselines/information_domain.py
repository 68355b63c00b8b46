"""Maps mean codes to a scale on which every code of a sensor carries the same information about light.

    phi(light) = integral from 0 to light of sqrt(I),    I = Fisher information of one code about light

Codes are pooled first; the exact response inverts their mean, and phi of that light has a deviation close to
1 / sqrt(codes), whatever the sensor, the light and the number of bits. For a binary SPAD phi is an arcsine, for many
photons twice a square root. Where the mean code tells less than all codes together, the deviation is larger by a known
factor: deviation = sqrt(V) dphi/dmu, by the delta method.

Below the mean code of a dark pixel phi continues as a straight line, to negative values: cut off there, the noise of
dark counts and of reading would on average be light.

Where codes tell nothing (below a high threshold, at saturation) phi stands still while light grows: `slope` is large.

Of many codes (`Sensor.many_codes`) the mean code keeps nearly all information, and I is that of the mean code,
(dmu/dlight)^2 / V.

Source: the root of the information as a stabiliser of variance is Fisher's; the tables are ours, from the exact law.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.estimation import pieces
from qsim.sensor.sensor import Sensor

LEAST = 1e-9  # of phi between two points of the table: phi stays invertible where codes tell nothing
FLOOR = 1e-3  # of the variance of a code [codes^2], below which the deviation is taken as that of an efficient mean


@dataclass(frozen=True, eq=False)
class InformationDomain:
    """Tables of one sensor over light, from darkness to the end of its rise. Equal only to itself, so that what is made
    from it can be kept by it.
    """

    photons: Array  # [G], rising from 0
    mean_code: Array  # [G], rising
    phi: Array  # [G], rising from 0
    deviation: Array  # [G], of phi from one code; divided by sqrt(n) for the mean of n codes
    variance: Array  # [G], of a code [codes^2]
    slope: Array  # [G], photons per unit of phi: the deviation of the light that one code tells
    top: int  # the largest code

    @property
    def dark_slope(self) -> float:
        """Return the slope of phi over the mean code below that of a dark pixel."""
        return float(self.deviation[0] / np.sqrt(max(self.variance[0], FLOOR)))

    def forward(self, mean_code: Array) -> Array:
        """Return phi, float32 [...], of mean codes [...]; negative below that of a dark pixel."""
        below = self.dark_slope * np.minimum(mean_code - self.mean_code[0], 0)
        return (np.interp(mean_code, self.mean_code, self.phi) + below).astype(np.float32)

    def noise(self, mean_code: Array) -> Array:
        """Return the deviation of phi from one code, float32 [...], at mean codes [...]."""
        return np.interp(mean_code, self.mean_code, self.deviation).astype(np.float32)

    def inverse(self, phi: Array) -> Array:
        """Return photons, float32 [...], of phi [...]; from 0 to the brightest light of the table."""
        return np.interp(phi, self.phi, self.photons).astype(np.float32)


@lru_cache(maxsize=256)
def information_domain(sensor: Sensor, exposure: float) -> InformationDomain:
    """Return the tables of a sensor for codes of `exposure` seconds; made once per sensor.

    `ValueError` for a sensor whose mean code does not rise with light, and for a law that loses small probabilities.
    """
    table = sensor.response(exposure)
    root = np.sqrt(table.photons)
    variance = (table.variance[1:] + table.variance[:-1]) / 2
    if sensor.many_codes:
        steps = np.maximum(np.diff(table.mean) / np.sqrt(np.maximum(variance, FLOOR)), LEAST)
    else:
        middle = ((root[1:] + root[:-1]) / 2) ** 2
        parts = pieces(middle, sensor.levels)
        information = np.concatenate([sensor.fisher_information(part, exposure) for part in parts])
        lost = ~np.isfinite(information)
        if lost.any():  # of a law of one's own, which takes small probabilities as differences of large ones
            raise ValueError(
                f"{type(sensor).__name__}: at {middle[lost][0]:.3g} photons log_pmf_of states a probability of 0 for a "
                "code whose slope_of is not 0; keep the digits of small probabilities, or choose a method that needs "
                "no information, as qbp-bm3d"
            )
        # d light = 2 sqrt(light) d sqrt(light): the integrand stays finite at 0, where I may not
        steps = np.maximum(2 * np.sqrt(information * middle) * np.diff(root), LEAST)
    with np.errstate(over="ignore"):
        # The delta method at the middles of the table's intervals; 1
        # where all codes are alike, as for an efficient mean.
        deviation = np.where(variance > FLOOR, np.sqrt(variance) * steps / np.diff(table.mean), 1.0)
    return InformationDomain(
        photons=table.photons,
        mean_code=table.mean,
        phi=np.append(0.0, np.cumsum(steps)),
        deviation=_at_points(deviation),
        variance=table.variance,
        slope=_at_points(np.diff(table.photons) / steps),
        top=table.top,
    )


def _at_points(middles: Array) -> Array:
    """Return values at the points [G] of a table from those at the middles of its intervals [G - 1]."""
    return np.concatenate([middles[:1], (middles[1:] + middles[:-1]) / 2, middles[-1:]])

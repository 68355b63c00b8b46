"""A sensor's response as a table: photons -> mean code and variance, and back.

    mean code m, averaged over n codes -> photons,  mu^-1(min(m, top - 1/(2n)))

The only source is the sensor's exact distribution (`sensor.mean`, `sensor.variance`): no baseline holds a sensor
model of its own. An all-saturated pixel has no finite estimate, so the mean code is limited to half a count below the
top of the response (cap).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.sensor import Sensor

POINTS = 4096  # of a table; linear interpolation then errs by less than 1e-6 of the full scale
TOGETHER = 1 << 22  # probabilities held at a time
DOUBLINGS = 44  # of light in which a response must end
FLAT = 1e-7  # a response this close to its top (relative to the full scale) has ended


@dataclass(frozen=True)
class ResponseTable:
    """Exact mean and variance of one code over a grid of photons, evenly spaced in sqrt(photons), rising in mean."""

    photons: Array  # [G], expected photons per pixel and exposure, from 0
    mean: Array  # [G], codes, strictly rising
    variance: Array  # [G], codes^2
    top: int  # the largest code of the sensor
    sensor: str  # in words

    def cap(self, samples: int) -> float:
        """The largest estimate [photons] from the mean of `samples` codes: half a count below saturation.

        `ValueError` where that is no light at all.
        """
        if self.mean[-1] - 0.5 / samples <= self.mean[0]:
            raise ValueError(
                f"{self.sensor}: its mean code rises from {self.mean[0]:.4g} in the dark to {self.mean[-1]:.4g} at "
                f"{self.photons[-1]:.4g} photons, which the mean of {samples} codes does not resolve; use a longer "
                "window, or the method naive"
            )
        return float(np.interp(self.mean[-1] - 0.5 / samples, self.mean, self.photons))

    def invert(self, mean_code: Array, samples: int) -> Array:
        """Photons whose mean code is this; 0 below the mean of a dark pixel, cap(samples) at saturation. Any shape.

        `ValueError` as for `cap`.
        """
        self.cap(samples)
        return np.interp(np.minimum(mean_code, self.mean[-1] - 0.5 / samples), self.mean, self.photons)


def brightest(sensor: Sensor, exposure: float) -> float:
    """Photons at which the mean code stops rising: at the top code, or before (full well, dead time).

    `ValueError` for a sensor whose mean code does not rise from darkness.
    """
    top, limit = sensor.levels - 1, sensor.brightest(exposure)

    def mean_at(photons: float) -> float:
        return float(sensor.mean(np.array([photons]), exposure)[0])

    dark, photons = mean_at(0.0), sensor.white(exposure) / 16
    here = mean_at(photons) if photons < limit else dark
    for _ in range(DOUBLINGS):  # one by one: the brightest light takes the longest tables
        if 2 * photons >= limit:
            if mean_at(max(limit, 0.0)) > dark:
                return limit
            break
        there = mean_at(2 * photons)
        risen = here - dark > FLAT * top  # a high threshold keeps codes dark for long
        if top - here < FLAT * top or (risen and there - here < FLAT * top):
            if here > dark:
                return photons
            break
        photons, here = 2 * photons, there
    raise ValueError(f"{sensor}: its mean code is {dark:.4g} in the dark and does not rise with light")


def pieces(photons: Array, values: int) -> list[Array]:
    """Photons in pieces whose distributions, of this many values each, fit into memory together."""
    return np.array_split(photons, -(-len(photons) * values // TOGETHER))


def response_table(sensor: Sensor, exposure: float, points: int = POINTS) -> ResponseTable:
    """Tabulate a sensor's response from darkness to the end of its rise.

    Where the response falls again (a paralyzable counter) the table holds its rising branch only. `ValueError` for a
    sensor whose mean code does not rise.
    """
    photons = np.linspace(0, np.sqrt(brightest(sensor, exposure)), points) ** 2
    parts = pieces(photons, sensor.levels)
    mean = np.concatenate([sensor.mean(part, exposure) for part in parts])
    variance = np.concatenate([sensor.variance(part, exposure) for part in parts])
    rising = np.concatenate([[True], mean[1:] > np.maximum.accumulate(mean)[:-1]])
    return ResponseTable(photons[rising], mean[rising], variance[rising], sensor.levels - 1, str(sensor))

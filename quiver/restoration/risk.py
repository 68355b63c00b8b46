"""Estimates the error of restored light from the codes alone, so that methods can be compared without a truth.

    restored f of a frame with codes y; f' of the same frame after a share of its codes was drawn again, y'
    -> per pixel an unbiased score: its mean is E (f - x)^2, x the light, but for a constant that all methods share

A code y reads the light as u = c + (y - mu(c)) / mu'(c), about a light c near x: E u = x up to the curvature of mu. So

    E (f - x)^2 = E (f - u)^2 - Var u + 2 Cov(f, u)

The covariance penalty (Efron, "The estimation of prediction error", JASA 99, 2004) is what a method gains by fitting
the noise of the frame that it restores. Cov(f, u) = E (u - u')(f - f') / 2 if u' is an independent draw of the same
law. Few codes are drawn again, so that f' still restores the recorded frame; the law is that of the fitted light c.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key
from quiver.data.codes import Sensor

SHARE = 1 / 16  # of the codes of a frame that are drawn again
FLATTEST = 0.1  # of the steepest rise of the mean code: a flatter one counts as this, as saturated codes read no light
BLOCK = 16  # px, side of the squares whose sums are taken as independent
PAIRED = math.sqrt(2)  # measured with BM3D on ten street clips: estimates scatter by 1.7 of the errors without it


@dataclass(frozen=True)
class Reading:
    """Reads light from single codes of a sensor, linearly about a given light."""

    photons: Array  # [G]
    mean: Array  # [G], codes
    slope: Array  # [G], codes per photon
    variance: Array  # [G], codes^2

    @classmethod
    def of(cls, sensor: Sensor, exposure: float) -> Reading:
        """Return the reading of a sensor's codes; `ValueError` where its mean code does not rise with light."""
        table = sensor.response(exposure)
        slope = np.gradient(table.mean, table.photons)
        return cls(table.photons, table.mean, np.maximum(slope, FLATTEST * slope.max()), table.variance)

    def about(self, light: Array) -> tuple[Array, Array]:
        """Return the mean code at a light [photons, ...] and its rise [codes per photon], both [...]."""
        return np.interp(light, self.photons, self.mean), np.interp(light, self.photons, self.slope)

    def noise(self, light: Array) -> Array:
        """Return the variance of a code at a light [photons, ...]: codes^2 [...]."""
        found: Array = np.interp(light, self.photons, self.variance)
        return found


@dataclass(frozen=True)
class Redrawn:
    """A frame of which a share of the codes was drawn again."""

    before: Array  # codes [H, W]
    after: Array  # codes [H, W]
    where: Array  # bool [H, W]
    light: Array  # photons [H, W], at which they were drawn

    def covariance(self, restored: Array, again: Array, reading: Reading) -> Array:
        """Return the covariance of restored light and the light that codes read [photons^2, H, W]; 0 elsewhere.

        `restored` and `again` are the light [photons, H, W] of a method before and after. Codes differ by more than two
        draws of one law, as the fitted light is not the true one: their change counts in units of what it would be.
        """
        _, slope = reading.about(self.light)
        change = np.where(self.where, (self.before.astype(np.float64) - self.after) / slope, 0.0)
        expected = (reading.noise(self.light) / slope**2)[self.where].sum()
        ratio = expected / max(0.5 * (change**2).sum(), 1e-300)
        found: Array = change * (restored.astype(np.float64) - again) * (ratio / (2 * SHARE))
        return found


def redraw(codes: Array, light: Array, sensor: Sensor, exposure: float, key: Key) -> Redrawn:
    """Draw a share of the codes [H, W] of a frame again, by the sensor's law at a fitted light [photons, H, W]."""
    where = np.random.default_rng(key.philox_key).random(codes.shape) < SHARE
    drawn = sensor.sample(light[where][None].astype(np.float64), exposure, key=key, engine="reference")[0]
    changed = codes.copy()
    changed[where] = drawn
    return Redrawn(codes, changed, where, light)


def scores(restored: Array, again: Array, redrawn: Redrawn, reading: Reading) -> Array:
    """Return the score of every pixel [photons^2, H, W]: the mean is that of (restored - light)^2, less a constant.

    `restored` and `again` are the light [photons, H, W] that a method restored from a frame and from the redrawn one.
    The constant belongs to the light at which codes were drawn, about which they are read: one for all methods.
    """
    mean, slope = reading.about(redrawn.light)
    offset = restored.astype(np.float64) - redrawn.light
    fit = offset * (offset - 2 * (redrawn.before - mean) / slope)
    found: Array = fit + 2 * redrawn.covariance(restored, again, reading)
    return found


def block_sums(values: Array) -> Array:
    """Return the sums [n] of values [H, W] over squares of BLOCK px; those at the far edges are smaller."""
    rows, columns = (np.arange(0, length, BLOCK) for length in values.shape)
    found: Array = np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1).ravel()
    return found


def mean_and_error(sums: Array, pixels: int) -> tuple[float, float]:
    """Return the mean of a score over so many pixels and its standard error, from the sums of blocks [n].

    Blocks are taken as independent. Where a method averages pixels of two blocks, both scores hold the product of their
    noise, which widens the true deviation by up to the root of two: PAIRED.
    """
    count = len(sums)
    if count < 2:
        return float(sums.sum()) / pixels, float("inf")
    return float(sums.sum()) / pixels, PAIRED * float(np.std(sums, ddof=1)) * math.sqrt(count) / pixels

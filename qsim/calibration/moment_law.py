"""Evaluates the likelihood of mean and variance of bright cells, without the shape of their histograms.

    mean = gain m + offset,   variance in time = gain^2 (m + read_noise^2) + 1/12      codes

The codes of a bright cell repeat a pattern of electrons and of rounding. Its likelihood has a maximum wherever the
electrons of a cell are miscounted by a whole number. Where the variance does not tell that number, mean and variance
are all that is used. They follow no pattern, and need no law of the light between pixels and frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.cells import Cell

ADC = 1 / 12  # codes^2, variance of rounding
ERROR = 0.25  # e-^2 and codes^2 of the variance: a larger error does not tell whole electrons apart
BRIGHT = 150.0  # e-; above, no sum over electrons is made
LEAST_VARIANCE = 1.0  # codes^2, of a cell whose rounding is 1/12
CLIPPED = 1e-4  # most share of codes at either end of the scale


def by_moments(cell: Cell, gain: float, bits: int) -> bool:
    """Return whether mean and variance are all that is used of a cell, by a first gain [codes/e-]."""
    ends = np.count_nonzero((cell.codes == 0) | (cell.codes == (1 << bits) - 1))
    if ends > CLIPPED * cell.codes.size or cell.variance < LEAST_VARIANCE:
        return False
    error = cell.variance * sqrt(2 / _freedom(cell))
    return cell.variance > BRIGHT * gain**2 or error > ERROR * max(1.0, gain**2)


def _freedom(cell: Cell) -> int:
    """Return the degrees of freedom of the variance in time."""
    return (len(cell.codes) - 1) * (cell.codes.shape[1] - 1)


class MomentLaw:
    """Mean and variance of some cells, as a function of gain, offset, read noise and expected electrons."""

    def __init__(self, cells: Sequence[Cell]) -> None:
        self.cells = tuple(cells)
        self.size = np.array([float(cell.codes.size) for cell in cells])
        self.frames = np.array([float(len(cell.codes)) for cell in cells])
        self.freedom = np.array([float(_freedom(cell)) for cell in cells])
        self.mean = np.array([cell.mean for cell in cells])
        self.variance = np.array([cell.variance for cell in cells])
        self.error = np.array([float(cell.in_time.var(ddof=1)) / cell.in_time.size for cell in cells])  # of `variance`

    def laws(self, gain: float, offset: float, noise: float, electrons: Array) -> tuple[Array, Array]:
        """Return mean and variance [R] at expected electrons [R]."""
        return gain * electrons + offset, gain**2 * (electrons + noise**2) + ADC

    def value(self, mean: Array, variance: Array) -> float:
        """Return the log likelihood, of normal means and of chi-square variances."""
        means = self.size * (self.mean - mean) ** 2 / self.variance
        variances = self.freedom * (np.log(variance) + self.variance / variance)
        return -0.5 * float(means.sum() + variances.sum())

    def slopes(self, gain: float, noise: float, electrons: Array) -> tuple[Array, Array]:
        """Return the derivatives [4, R] of mean and variance by ln gain, offset, ln read noise and electrons."""
        one = np.ones_like(electrons)
        zero = np.zeros_like(electrons)
        of_mean = np.stack([gain * electrons, one, zero, gain * one])
        squared = gain**2 * one
        of_variance = np.stack([2 * squared * (electrons + noise**2), zero, 2 * squared * noise**2, squared])
        return of_mean, of_variance

    def score(self, mean: Array, variance: Array, of_mean: Array, of_variance: Array) -> Array:
        """Return the derivatives [4, R] of the log likelihood."""
        by_mean = self.size * (self.mean - mean) / self.variance
        by_variance = 0.5 * self.freedom * (self.variance / variance - 1) / variance
        return of_mean * by_mean + of_variance * by_variance

    def information(self, variance: Array, of_mean: Array, of_variance: Array) -> Array:
        """Return the information [4, 4, R]."""
        means = self.size / self.variance
        variances = 0.5 * self.freedom / variance**2
        return of_mean[:, None] * of_mean * means + of_variance[:, None] * of_variance * variances

    def pushes(self, r: int, mean: Array, variance: Array, of_mean: Array, of_variance: Array) -> Array:
        """Return the score [4, n] of every pixel of a cell."""
        cell = self.cells[r]
        # Derivatives of a normal log-likelihood: the mean over frames has
        # variance v / n, the variance in time v^2 2 / (n - 1).
        by_mean = self.frames[r] * (cell.level - mean[r]) / self.variance[r]
        by_variance = 0.5 * (self.frames[r] - 1) * (cell.in_time / variance[r] - 1) / variance[r]
        return np.outer(of_mean[:, r], by_mean) + np.outer(of_variance[:, r], by_variance)

    def misfit(self, variance: Array) -> float:
        """Return the chi-square of the variances, by their scatter between pixels."""
        return float(np.sum((self.variance - variance) ** 2 / np.maximum(self.error, 1e-300)))

"""Approximates the steps F_k of any memoryless sensor by curves over light where sums are too long.

A step falls from F_k(0) to F_k(infinity) within about 13 of the variable 2 sqrt(lambda), in which all Poisson laws have
the same width. Each step has its own grid over that fall: cells of equal width in sqrt(lambda). In each cell a cubic
has value and slope of F_k at both ends. Its error is largest halfway between the nodes and is measured there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

_NEGLIGIBLE = 1e-10  # share of a fall that is left out at either end
# sqrt(lambda) between which a fall is searched: 6e-11 to 1e18 arrivals
_LOW = 2.0**-17
_HIGH = 2.0**30
_CELLS = 128
_MOST_CELLS = 2048
_ERROR = 5e-7  # of a curve, at most
_ROUNDING = 6e-7  # of coefficients, cubic and uniform number in float32, several times
_PHOTONS = 1.2e-7  # relative, of light rounded to float32, twice

Steps = Callable[[Array], Array]  # Poisson means [K, n], a row per step -> [K, n]


@dataclass(frozen=True, eq=False)
class Curves:
    """K steps over x = sqrt(lambda): step k at (x - start) rate cells from the beginning of its grid."""

    start: Array  # [K]
    rate: Array  # [K] cells per x
    cubics: Array  # float32 [K, cells, 4]: coefficients in the share of the cell, constant first
    margin: float  # distance to a step below which the curves do not decide
    brightest: float  # x up to which the curves hold


def by_pairs(step: Callable[[Array, Array], Array], count: int) -> Steps:
    """Return F_0 ... F_(count - 1) of rows of Poisson means, from a function of pairs.

    The function takes codes int [p] and Poisson means [p] and returns [p].
    """
    codes = np.arange(count)[:, None]
    return lambda mean: step(np.broadcast_to(codes, mean.shape).ravel(), mean.ravel()).reshape(mean.shape)


def falling(cdf: Steps, slope: Steps, count: int) -> Curves | None:
    """Return curves of `count` steps that only fall with light, from F_k and dF_k/dlambda.

    None if no grid is fine enough.
    """
    dark = cdf(np.zeros((count, 1)))
    bright = cdf(np.full((count, 1), _HIGH**2))
    start = _last(lambda x: dark - cdf(x * x) < _NEGLIGIBLE, count)
    start[start <= _LOW] = 0.0
    stop = np.maximum(_last(lambda x: cdf(x * x) - bright >= _NEGLIGIBLE, count) * 1.001, start + 1e-3)
    return _fitted(cdf, slope, start, stop, np.inf)


def below(cdf: Steps, slope: Steps, count: int, brightest: float, settled: bool = False) -> Curves | None:
    """Return curves of any steps for at most `brightest` arrivals, all on one grid; None if no grid is fine enough.

    `settled`: more light changes nothing, and the curves hold for all light.
    """
    x = float(np.sqrt(brightest))
    return _fitted(cdf, slope, np.zeros((count, 1)), np.full((count, 1), x), np.inf if settled else x)


def _fitted(cdf: Steps, slope: Steps, start: Array, stop: Array, brightest: float) -> Curves | None:
    cells = _CELLS
    while cells <= _MOST_CELLS:
        width = (stop - start) / cells
        x = start + width * np.arange(cells + 1)
        per_x = slope(x * x) * 2 * x
        # In x = sqrt(photons), where steps have the same width at any light.
        cubic = _hermite(cdf(x * x), per_x * width)
        middle = (x[:, 1:] + x[:, :-1]) / 2
        error = float(np.abs(cubic @ 0.5 ** np.arange(4) - cdf(middle * middle)).max())
        if error <= _ERROR:
            # A relative error of the photons moves the chance by |slope| x / 2, since photons = x^2.
            margin = _ROUNDING + 2 * error + float(np.abs(per_x * x).max()) / 2 * _PHOTONS
            return Curves(start[:, 0], 1 / width[:, 0], cubic.astype(np.float32), margin, brightest)
        cells *= 2
    return None


def _last(holds: Callable[[Array], Array], count: int) -> Array:
    """Return the largest x at which a condition holds that holds for small x alone: [count, 1], to 1e-4 of x."""
    low = np.full((count, 1), np.log2(_LOW))
    high = np.full((count, 1), np.log2(_HIGH))
    for _ in range(18):
        middle = (low + high) / 2
        good = holds(2.0**middle)
        low = np.where(good, middle, low)
        high = np.where(good, high, middle)
    return 2.0**low


def _hermite(value: Array, slope: Array) -> Array:
    """Return the cubics' coefficients between neighbours: values and slopes per cell [K, n + 1] -> [K, n, 4]."""
    v0 = value[:, :-1]
    v1 = value[:, 1:]
    d0 = slope[:, :-1]
    d1 = slope[:, 1:]
    return np.stack([v0, d0, 3 * (v1 - v0) - 2 * d0 - d1, 2 * (v0 - v1) + d0 + d1], axis=-1)

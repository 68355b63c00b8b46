"""Estimates median and percentiles of the dark rate over pixels from noisy counts, and finds hot pixels.

    counts of every pixel -> law of rates over pixels, without counting noise -> median, percentiles

A pixel of few counts says little about its own rate, and percentiles of the noisy map are those of the noise. Where the
counts of a typical pixel are few, a law of rates is fitted to them:

    rate = m (1 + k s z)^(1/k), z normal    log-normal for k = 0, normal for k = 1, and between
    a share h of hot pixels, uniform in ln rate above m

and the interval of the median holds all laws within 1.92 of the largest log-likelihood. Where the counts are many, the
noise moves percentiles by less than their sampling error, and order statistics are used. Median and percentiles
describe the population of pixels: their intervals hold the sampling of the pixels too.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, log, sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.quantiles import binomial_quantile
from qsim.calibration.results import Value

PERCENTILES = (1, 10, 25, 75, 90, 99, 99.9)  # in addition to the median
RESOLVED = 100.0  # counts of the median pixel, from which on order statistics are used
_LEAST_COUNTS = 20.0  # of a pixel at a percentile
_NARROW = 0.25  # noise over spread, both as variances, below which noise hardly moves the median
_MOST_SHIFT = 0.3  # of half an interval, by which noise may move a percentile
_DROP = 1.92  # of the log-likelihood: half the 95 % quantile of chi-square with one degree of freedom
_SHAPES = (-0.5, 0.0, 0.5, 1.0)  # k
_LIKELY = 8.0  # of the log-likelihood, within which laws are looked at closely
_MOST_COUNTS = 400  # different totals, above which they are rounded to whole counts
_HOTTEST = 1e4  # medians, end of the law of hot pixels
_UNIT = "1/s"


@dataclass(frozen=True, eq=False)
class Counts:
    """Dark counts of every pixel and the time that they took."""

    total: Array  # [n] counts, without afterpulses and crosstalk
    time: float  # s
    spread: float = 1.0  # variance of a total over that of a Poisson number; afterpulses raise it
    saturated: Array | None = None  # bool [n]: the total is a lower limit


@dataclass(frozen=True, eq=False)
class Distribution:
    """Median and percentiles by name, the median rate for finding hot pixels, and the percentiles left out."""

    values: dict[str, Value]
    median: float  # 1/s
    unresolved: tuple[str, ...]


def distribution(counts: Counts) -> Distribution:
    """Return the median and the percentiles of the dark rate that the counts resolve."""
    ordered = np.sort(counts.total)
    typical = float(np.median(ordered))
    noise = counts.spread / max(typical, 1e-9)
    spread = _spread(ordered, counts)
    if noise < 1 / RESOLVED or noise < min(1 / _LEAST_COUNTS, _NARROW * spread):
        median, low, high = _order_statistic(ordered, 50.0, counts)
        skewed = counts.spread / 6 * noise / (noise + spread)  # of a Poisson law the median is below the mean
        median = median + skewed
        low = low + skewed
        high = high + skewed
        method = "order statistics"
    else:
        median, low, high = _fitted_median(counts)
        method = "fit of the distribution of rates"
    values = {}
    if high < inf:
        values["dark_count_rate_median"] = _rate(median, low, high, counts, method)
    unresolved = [] if high < inf else ["median"]
    for percent in PERCENTILES:
        found = _order_statistic(ordered, percent, counts)
        if _resolved(percent, found, ordered, counts):
            values[f"dark_count_rate_p{percent:g}"] = _rate(*found, counts, "order statistics")
        else:
            unresolved.append(f"p{percent:g}")
    return Distribution(values, median / counts.time, tuple(unresolved))


def _rate(value: float, low: float, high: float, counts: Counts, method: str) -> Value:
    return Value(value / counts.time, low / counts.time, high / counts.time, _UNIT, method)


def _order_statistic(ordered: Array, percent: float, counts: Counts) -> tuple[float, float, float]:
    """Return a percentile of the totals and its exact 95 % interval; the interval is infinite if too few are beyond."""
    n = ordered.size
    share = percent / 100
    value = float(np.percentile(ordered, percent))
    # The rank of a percentile is binomial, whatever the law: an interval without any assumption.
    first = binomial_quantile(0.025, n, share) - 1
    last = binomial_quantile(0.975, n, share)
    low = float(ordered[first]) if first >= 0 else 0.0
    high = float(ordered[last]) if last < n else inf
    saturated = 0 if counts.saturated is None else int(counts.saturated.sum())
    if last >= n - saturated:  # the totals of saturated pixels are lower limits
        high = inf
    if first < 0:
        low = -inf
    return value, low, high


def _resolved(percent: float, found: tuple[float, float, float], ordered: Array, counts: Counts) -> bool:
    """Return whether noise moves a percentile by little of its interval.

    Noise of the variance 1/K of the logarithm moves the percentile z of a normal law of spread s by z/(2 K s).
    """
    value, low, high = found
    if not (low > 0 and high < inf) or value < _LEAST_COUNTS * counts.spread:
        return False
    noise = counts.spread / value
    spread = _spread(ordered, counts)
    if spread <= 0:
        return False
    from scipy.special import ndtri

    shift = abs(float(ndtri(percent / 100))) * noise / (2 * sqrt(spread))
    return shift < _MOST_SHIFT * 0.5 * log(high / low)


def _spread(ordered: Array, counts: Counts) -> float:
    """Return the variance of the logarithm of the rate between the quartiles, without noise; 0 if noise explains it."""
    typical = max(float(np.median(ordered)), 1.0)
    quarter = float(np.percentile(ordered, 75)) / max(float(np.percentile(ordered, 25)), 1.0)
    # Quartiles of a normal law are 1.349 deviations apart; the noise of the logarithm of a count is 1 / count.
    return max((log(max(quarter, 1.0)) / 1.349) ** 2 - counts.spread / typical, 0.0)


def _fitted_median(counts: Counts) -> tuple[float, float, float]:
    """Return the median total of the fitted laws and its interval, in counts."""
    if not counts.total.any():
        return 0.0, 0.0, inf
    pixels = _Pixels(counts)
    laws = pixels.laws(*_coarse(pixels.bulk, counts.total.size))
    for _ in range(2):
        laws = pixels.laws(*_finer(laws))
    value = float(laws.median[np.argmax(laws.likelihood)])
    low, high = _profile(laws)
    return value * counts.spread, min(low, value) * counts.spread, max(high, value) * counts.spread


@dataclass(frozen=True, eq=False)
class _Laws:
    """Laws of the rates with their log-likelihood and the median of all pixels, each [law]; rates in counts."""

    m: Array
    s: Array
    k: Array
    likelihood: Array
    median: Array


def _mesh(medians: Array, spreads: Array, shapes: Array) -> tuple[Array, Array, Array]:
    """Return all combinations; laws that would be mostly at 0 are left out, and all but one of no spread."""
    m, s, k = (a.ravel() for a in np.meshgrid(medians, spreads, shapes, indexing="ij"))
    allowed = ((k <= 0.5) | (s <= 0.6)) & ((s > 0) | (k == shapes[0]))
    return m[allowed], s[allowed], k[allowed]


def _coarse(bulk: float, pixels: int) -> tuple[Array, Array, Array]:
    """Return laws around a mean of the bulk of the pixels."""
    reach = min(max(8 * sqrt(1 / (bulk * pixels) + 1 / pixels), 0.1), 2.0)
    medians = bulk * np.exp(np.linspace(-reach - 0.8, reach, 41))
    return _mesh(medians, np.array([0.0, 0.15, 0.3, 0.45, 0.6, 0.8, 1.1, 1.5]), np.array(_SHAPES))


def _finer(laws: _Laws) -> tuple[Array, Array, Array]:
    """Return laws between and beside those of high likelihood."""
    likely = laws.likelihood > laws.likelihood.max() - _LIKELY

    def between(values: Array, points: int, least: float) -> Array:
        steps = np.unique(values)
        low, high = (int(np.searchsorted(steps, edge(values[likely]))) for edge in (np.min, np.max))
        ends = steps[max(low - 1, 0)], steps[min(high + 1, steps.size - 1)]
        return np.linspace(max(ends[0], least), ends[1], points)

    medians = np.exp(between(np.log(laws.m), 33, -inf))
    return _mesh(medians, between(laws.s, 13, 0.0), between(laws.k, 5, _SHAPES[0]))


def _profile(laws: _Laws) -> tuple[float, float]:
    """Return the medians between which the profile of the likelihood is within `_DROP` of its maximum."""
    steps = np.unique(laws.m)
    best = [np.flatnonzero(laws.m == m)[np.argmax(laws.likelihood[laws.m == m])] for m in steps]
    height = laws.likelihood[best] - laws.likelihood.max() + _DROP
    place = np.log(laws.median[best])
    inside = np.flatnonzero(height >= 0)

    def crossing(edge: int, beyond: int) -> float:
        if not 0 <= beyond < steps.size:
            return float(place[edge])
        # Straight between two points of the grid, in the logarithm of the median.
        share = height[edge] / (height[edge] - height[beyond])
        return float(place[edge] + share * (place[beyond] - place[edge]))

    return float(np.exp(crossing(inside[0], inside[0] - 1))), float(np.exp(crossing(inside[-1], inside[-1] + 1)))


class _Pixels:
    """Counts of pixels, as far as laws of rates need them."""

    def __init__(self, counts: Counts) -> None:
        total = np.maximum(counts.total, 0.0) / counts.spread
        self.bulk = max(_bulk_mean(total), 0.5 / total.size)
        rounded = np.round(total, 2) if np.unique(np.round(total, 2)).size < _MOST_COUNTS else np.round(total)
        observed, times = np.unique(rounded, return_counts=True)
        kept = observed <= max(30 * self.bulk, self.bulk + 12 * sqrt(self.bulk) + 12)
        self.times = times[kept]
        self.beyond = int(times[~kept].sum())  # pixels that are hot under every law
        hottest = max(_HOTTEST * self.bulk, 10.0)
        self.grid = np.geomspace(self.bulk * 1e-3, hottest, 700)
        self.table = _poisson(observed[kept], self.grid)  # [count, rate]
        self.hot = self.table[:, self.grid > 2 * self.bulk].mean(axis=1)  # uniform in ln rate

    def laws(self, m: Array, s: Array, k: Array) -> _Laws:
        """Return the likelihood of laws, each with its best share of hot pixels."""
        from scipy.special import ndtri

        bulk = self.table @ _weights(self.grid, m, s, k)
        likelihood, share = _with_hot(bulk, self.hot, self.times, self.beyond)
        # The median of all pixels lies higher in the law of the bulk, as hot pixels fill the upper end.
        z = ndtri(np.minimum(0.5 / (1 - share), 0.999))
        return _Laws(m, s, k, likelihood, quantile(m, s, k, z))


def _bulk_mean(total: Array) -> float:
    """Return the mean total of the pixels that are not far above the others."""
    mean = float(np.mean(total))
    for _ in range(30):
        kept = total[total <= 4 * mean + 4 * sqrt(mean) + 1]
        if kept.size == 0 or float(kept.mean()) == mean:
            break
        mean = float(kept.mean())
    return mean


def quantile(m: Array, s: Array, k: Array, z: Array) -> Array:
    """Return the rate at a normal deviate z of laws of median m, spread s and shape k."""
    root = np.maximum(1 + k * s * z, 1e-9)
    safe = np.where(k == 0, 1.0, k)
    return np.asarray(m * np.where(k == 0, np.exp(s * z), root ** (1 / safe)))


def _weights(grid: Array, m: Array, s: Array, k: Array) -> Array:
    """Return the probability of every rate of the grid under each law: [rate, law].

    A law is a sum of 41 rates of equal probability; each is shared by its two neighbours on the grid, so that the mean
    is kept.
    """
    from scipy.special import ndtri

    z = ndtri((np.arange(41) + 0.5) / 41)
    z = z / z.std()
    weights = np.zeros((grid.size, m.size))
    law = np.arange(m.size)
    for one in z:
        rate = np.clip(quantile(m, s, k, np.full_like(m, one)), grid[0], grid[-1])
        place = np.clip(np.searchsorted(grid, rate) - 1, 0, grid.size - 2)
        share = (rate - grid[place]) / (grid[place + 1] - grid[place])
        np.add.at(weights, (place, law), (1 - share) / z.size)
        np.add.at(weights, (place + 1, law), share / z.size)
    return weights


def _poisson(observed: Array, grid: Array) -> Array:
    """Return the Poisson probability of every count at every rate: [count, rate]."""
    from scipy.special import gammaln

    k = observed[:, None]
    return np.asarray(np.exp(k * np.log(grid) - grid - gammaln(k + 1)))


def _with_hot(bulk: Array, hot: Array, times: Array, beyond: int) -> tuple[Array, Array]:
    """Return the log-likelihood of every law at its best share of hot pixels, and that share, both [law].

    `beyond` pixels have so many counts that only a hot pixel has them.
    """
    n = float(times.sum()) + beyond
    share = np.full(bulk.shape[1], (beyond + 0.5) / (n + 1))
    for _ in range(25):  # expectation and maximisation
        is_hot = share * hot[:, None]
        mixed = (1 - share) * bulk + is_hot
        share = np.clip((times @ (is_hot / np.maximum(mixed, 1e-300)) + beyond) / n, 0, 0.4)
    mixed = (1 - share) * bulk + share * hot[:, None]
    value = times @ np.log(np.maximum(mixed, 1e-300))
    if beyond:
        value = value + beyond * np.log(np.maximum(share, 1e-300))
    return value, share

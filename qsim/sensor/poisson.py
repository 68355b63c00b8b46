"""Sums Poisson mixtures: sensors whose code depends on light only through a number n of electrons or arrivals.

    P(code = k | lambda) = sum_n Pois(n; lambda) P(code = k | n)

The second factor does not depend on the light, so it is one table per sensor, made once. Every term is positive: sums
lose no digits, and the logarithm of a probability is as good at 1e-280 as at 1/2. The derivative is another such sum,
d/dlambda sum_n Pois(n) C(n) = sum_n Pois(n) [C(n+1) - C(n)], if the differences are made without cancellation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy import ndarray as Array

from qsim.keys import normal

_UNDERFLOW = 1e-290  # below it, products of two representable factors may lose terms; logarithms are summed instead
_DIM = 600.0  # Poisson mean up to which the recursion from exp(-mean) does not underflow; n steps lose n 1e-16
_CHUNK = 1 << 21  # numbers in one block of work (16 MiB)


def poisson_log_pmf(mean: Array, n: Array) -> Array:
    """Return log Pois(n; mean), broadcast; exact at mean 0, else with an error of about 1e-16 |n - mean| and rounding.

    Loader's form ("Fast and accurate computation of binomial probabilities", 2000): -(n log(n / mean) - n + mean)
    - log(2 pi n) / 2 - (Stirling's error of log n!). Around the mean, where n log(mean) and log n! are huge and cancel,
    its terms stay small.
    """
    from scipy.special import gammaln, xlog1py, xlogy

    mean = np.asarray(mean, float)
    n = np.asarray(n, float)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        excess = (n - mean) / mean
        # n log(n / mean) - n + mean = mean [(1 + x) log(1 + x) - x], x = n / mean - 1.
        deviance = mean * (xlog1py(1 + excess, excess) - excess)
        result = -deviance - 0.5 * np.log(2 * np.pi * np.maximum(n, 1)) - _stirling_error(n)
    # Where n / mean overflows nothing cancels
    return np.where((n == 0) | (mean < 1e-200), xlogy(n, mean) - mean - gammaln(n + 1), result)


def _stirling_error(n: Array) -> Array:
    """Return log n! - (n + 1/2) log n + n - log(2 pi) / 2 for n >= 1."""
    from scipy.special import gammaln

    n = np.maximum(n, 1.0)
    direct = gammaln(n + 1) - (n + 0.5) * np.log(n) + n - 0.5 * np.log(2 * np.pi)
    # Stirling's series, which has 16 digits from n = 20 on.
    series = (1 / 12 - (1 / 360 - (1 / 1260 - (1 / 1680 - 1 / (1188 * n**2)) / n**2) / n**2) / n**2) / n
    return np.where(n < 20, direct, series)


def poisson_quantile(mean: Array, below: Array, above: Array) -> Array:
    """Return the smallest n with P(N <= n) > u as float64, from (u, 1 - u), broadcast: as exact as the cdf.

    A normal approximation gives the first guess. Galloping steps and bisection on the regularised gamma function give
    the answer, from the smaller side of the distribution.
    """
    from scipy.special import pdtr, pdtrc

    def enough(n: Array) -> Array:  # P(N <= n) > u
        with np.errstate(invalid="ignore"):
            return (n >= 0) & np.where(below < 0.5, pdtr(n, mean) > below, pdtrc(n, mean) < above)

    z = normal(below, above)
    guess = np.maximum(np.floor(mean + np.sqrt(mean) * z + (z * z - 1) / 6), 0.0)
    # wanted: not enough(low), enough(high)
    low = guess - 1
    high = guess
    step = 1.0
    while (missing := ~enough(high)).any():
        low = np.where(missing, high, low)
        high = np.where(missing, high + step, high)
        step *= 2
    step = 1.0
    while (excess := enough(low)).any():
        high = np.where(excess, low, high)
        low = np.where(excess, np.maximum(low - step, -1.0), low)
        step *= 2
    while (high - low > 1).any():
        middle = np.floor((low + high) / 2)
        good = enough(middle)
        low = np.where(good, low, middle)
        high = np.where(good, middle, high)
    return high


@dataclass(frozen=True, eq=False)
class Mixture:
    """P(code | n) for n = first ... first + m - 1 and some codes: arrays [m, levels] and [levels].

    Below `first` every code is beneath those of the block (cdf 1, pmf 0). From `first` + m on the tail rows hold.
    """

    first: int
    cdf: Array  # P(code <= k | n)
    log_pmf: Array  # log P(code = k | n)
    slope: Array  # P(code <= k | n + 1) - P(code <= k | n)
    tail_cdf: Array  # for n >= first + m
    tail_log_pmf: Array

    @cached_property
    def _pmf(self) -> tuple[Array, Array]:
        return np.exp(self.log_pmf), np.exp(self.tail_log_pmf)

    def evaluate_cdf(self, mean: Array) -> Array:
        """Return P(code <= k): Poisson means [p] -> [p, levels]."""
        # Codes that are reached whatever n is have exactly 1, not a sum that rounds.
        certain = (self.tail_cdf == 1) & (self.cdf == 1).all(axis=0)  # the top code
        result = self._mix(mean, self.cdf, np.where(certain, 0.0, self.tail_cdf))
        if self.first:
            result += self._below(mean)[:, None]
        result[:, certain] = 1.0
        return np.minimum(result, 1.0)

    def evaluate_slope(self, mean: Array) -> Array:
        """Return dcdf/dmean: Poisson means [p] -> [p, levels]."""
        return self._mix(mean, self.slope, None)

    def evaluate_log_pmf(self, mean: Array, wanted: Array | None = None) -> Array:
        """Return log P(code = k): Poisson means [p] -> [p, levels]; -inf only where no n of the table gives the code.

        Probabilities below 1e-290 are summed in logarithms, which is slow. `wanted`, bool [p, levels], limits these
        sums.
        """
        pmf = self._mix(mean, *self._pmf)
        deep = pmf < _UNDERFLOW
        if wanted is not None:
            deep &= wanted
        with np.errstate(divide="ignore"):
            result = np.log(pmf)
        rows = np.flatnonzero(deep.any(axis=1))
        step = max(1, _CHUNK // (len(self.log_pmf) + 1) // 16)
        for start in range(0, len(rows), step):
            block = rows[start : start + step]
            within, codes = np.nonzero(deep[block])
            result[block[within], codes] = self._log_sum(mean[block], within, codes)
        return result

    def _log_sum(self, mean: Array, rows: Array, codes: Array) -> Array:
        """Return the same sum in logarithms for pairs (rows, codes) of means [r] and codes: [pairs]."""
        from scipy.special import gammaincc

        n = np.arange(self.first, self.first + len(self.log_pmf))
        above = self._above(mean)
        with np.errstate(divide="ignore"):
            # gammainc near 1 is better as 1 - gammaincc; near 0 it is exact
            log_above = np.where(above > 0.5, np.log1p(-gammaincc(max(self._last, 1), mean)), np.log(above))
        weights = np.column_stack([poisson_log_pmf(mean[:, None], n), log_above])
        table = np.vstack([self.log_pmf, self.tail_log_pmf]).T
        result = np.empty(len(rows))
        step = max(1, _CHUNK // table.shape[1])
        for start in range(0, len(rows), step):
            pairs = slice(start, start + step)
            terms = weights[rows[pairs]] + table[codes[pairs]]
            # log sum exp, from its largest term.
            largest = np.maximum(terms.max(axis=1), -1e300)  # keeps -inf - -inf away
            with np.errstate(divide="ignore"):
                result[pairs] = largest + np.log(np.exp(terms - largest[:, None]).sum(axis=1))
        return result

    def _mix(self, mean: Array, table: Array, tail: Array | None) -> Array:
        result = np.empty((len(mean), table.shape[1]))
        step = max(1, _CHUNK // max(len(table), 1))
        for start in range(0, len(mean), step):
            result[start : start + step] = self._weights(mean[start : start + step]).T @ table
        if tail is not None and tail.any():
            result += self._above(mean)[:, None] * tail
        return result

    def _weights(self, mean: Array) -> Array:
        """Return Pois(n; mean) of the table's n: [p] -> [m, p]."""
        n = np.arange(self.first, self._last)
        bright = mean > _DIM
        if self.first or not len(n) or (bright.any() and self._last > _DIM):
            return np.exp(poisson_log_pmf(mean, n[:, None]))
        weights = np.empty((len(n), len(mean)))
        weights[0] = np.exp(-mean)
        for i in n[1:]:
            np.multiply(weights[i - 1], mean / i, out=weights[i])
        if bright.any():  # then every n is below the mean: from the last one down
            some = mean[bright]
            weight = np.exp(poisson_log_pmf(some, n[-1]))
            for i in n[::-1]:
                weights[i, bright] = weight
                weight = weight * (i / some)
        return weights

    @property
    def _last(self) -> int:
        return self.first + len(self.log_pmf)

    def _below(self, mean: Array) -> Array:
        """Return P(n < first), first > 0."""
        from scipy.special import gammaincc

        return gammaincc(self.first, mean)

    def _above(self, mean: Array) -> Array:
        """Return P(n >= first + m)."""
        from scipy.special import gammainc

        return gammainc(self._last, mean) if self._last else np.ones_like(mean)

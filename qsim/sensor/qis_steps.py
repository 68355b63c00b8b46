"""Computes the steps F_k of a QIS one by one: P(code <= k) for pairs of code and light level, without a table.

Given n electrons, P(code <= k | n) is 1 for few of them, and 0 or a constant (full well) for many. It lies in between
only where read noise blurs the threshold:

    F_k = P(N < first_k) + sum over the blurred n of Pois(n) weight_k(n) + tail_k P(N >= last_k)

So a step costs the width of the blur, 17 read noises, however many electrons a code holds. `decide` finds the code of a
uniform number in about three such steps; the compiled engine's curves (curves.py) are made of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.poisson import poisson_log_pmf

NOISY = 20.0  # e- of read noise, from which few cumulants state the law of the electrons read
_CHUNK = 1 << 13  # pairs of one block of work: its arrays stay in the cache


@dataclass(frozen=True, eq=False)
class Thresholds:
    """P(code <= k | n) of K codes below the top one: 1 for n < first, weights [K, W] from there on, then the tail."""

    first: Array  # int [K]
    weights: Array  # [K, W]
    tail: Array  # [K]

    def cdf(self, codes: Array, mean: Array) -> Array:
        """Return F of pairs: codes int [p], Poisson means [p] -> [p]."""
        from scipy.special import gammainc, gammaincc

        def block(k: Array, some: Array) -> Array:
            first = self.first[k]
            last = self.first[k] + self.weights.shape[1]
            result = np.where(first > 0, gammaincc(np.maximum(first, 1), some), 0.0) + self._sum(self.weights, k, some)
            if self.tail[k].any():
                result += self.tail[k] * np.where(last > 0, gammainc(np.maximum(last, 1), some), 1.0)
            return np.minimum(result, 1.0)

        return _in_blocks(block, codes, mean)

    def slope(self, codes: Array, mean: Array) -> Array:
        """Return dF/dmean of pairs: codes int [p], Poisson means [p] -> [p]."""
        ends = np.column_stack([np.ones(len(self.first)), self.weights, self.tail])
        falls = np.diff(ends, axis=1)  # of P(code <= k | n) from n = first - 1 on

        def block(k: Array, some: Array) -> Array:
            before = self.first[k] - 1
            edge = np.where(before >= 0, np.exp(poisson_log_pmf(some, np.maximum(before, 0))) * falls[k, 0], 0.0)
            return edge + self._sum(falls[:, 1:], k, some)

        return _in_blocks(block, codes, mean)

    def _sum(self, table: Array, k: Array, mean: Array) -> Array:
        """Return the sum over n of Pois(n; mean) table[k, n - first]: [p].

        Electrons whose weight is below 1e-19 are left out.
        """
        width = table.shape[1]
        reach = 9 * np.sqrt(mean) + 25
        start = np.clip(np.floor(mean - reach) - self.first[k], 0, width).astype(np.intp)
        stop = np.clip(np.ceil(mean + reach) - self.first[k], 0, width).astype(np.intp)
        total = np.zeros(len(mean))
        n = (self.first[k] + start).astype(float)
        steps = int((stop - start).max(initial=0))
        if not steps:
            return total
        flat = np.column_stack([table, np.zeros(len(table))]).ravel()
        at = k * (width + 1) + start
        end = k * (width + 1) + width
        weight = np.exp(poisson_log_pmf(mean, n))
        for _ in range(steps):
            total += weight * flat[at]
            n += 1
            weight *= mean / n
            at = np.minimum(at + 1, end)
        return total


@dataclass(frozen=True, eq=False)
class BlurredSteps:
    """P(N + noise z <= t_k) of thresholds t_k [K] in electrons, for read noise of NOISY electrons or more.

    Edgeworth's series of the third order: all cumulants of N are its mean, and the error is below 1e-9.
    """

    places: Array  # [K], e-
    noise: float  # e- rms

    def cdf(self, codes: Array, mean: Array) -> Array:
        """Return F of pairs: codes int [p], Poisson means [p] -> [p]."""
        return self._below(self.places[np.asarray(codes, np.intp)], np.asarray(mean, float))

    def slope(self, codes: Array, mean: Array) -> Array:
        """Return dF/dmean of pairs: the change by one more electron."""
        places = self.places[np.asarray(codes, np.intp)]
        mean = np.asarray(mean, float)
        return self._below(places - 1, mean) - self._below(places, mean)

    def _below(self, places: Array, mean: Array) -> Array:
        from scipy.special import ndtr

        variance = mean + self.noise**2
        x = np.clip((places - mean) / np.sqrt(variance), -40, 40)
        k3, k4, k5 = (mean / variance ** (order / 2) for order in (3, 4, 5))
        h2 = x**2 - 1
        h3 = x**3 - 3 * x
        h4 = x**4 - 6 * x**2 + 3
        h5 = x**5 - 10 * x**3 + 15 * x
        h6 = x**6 - 15 * x**4 + 45 * x**2 - 15
        h8 = x**8 - 28 * x**6 + 210 * x**4 - 420 * x**2 + 105
        series = k3 / 6 * h2 + k4 / 24 * h3 + k3**2 / 72 * h5
        series += k5 / 120 * h4 + k3 * k4 / 144 * h6 + k3**3 / 1296 * h8
        return np.clip(ndtr(x) - np.exp(-x * x / 2) / np.sqrt(2 * np.pi) * series, 0.0, 1.0)


def decide(cdf: Callable[[Array, Array], Array], top: int, u: Array, mean: Array, guess: Array) -> tuple[Array, Array]:
    """Return the smallest codes k with u < F_k (`top` at most) and the distance of u to the nearest step.

    Both are [p], of uniform numbers, Poisson means and guesses [p].
    """
    near = np.full(len(u), np.inf)

    def passed(k: Array, left: Array) -> Array:
        distance = u[left] - cdf(k, mean[left])
        near[left] = np.minimum(near[left], np.abs(distance))
        return distance >= 0

    return search(passed, top, guess), near


def search(passed: Callable[[Array, Array], Array], top: int, guess: Array) -> Array:
    """Return the smallest codes [p] whose step is not passed, `top` at most.

    `passed`: codes [n] of the pixels int [n] -> bool [n]. The search goes from the guess on in growing strides, then by
    bisection; only undecided pixels are evaluated again.
    """
    low = np.full(len(guess), -1)
    high = np.full(len(guess), top)
    probe = np.clip(guess, 0, max(top - 1, 0)).astype(np.intp)
    left = np.flatnonzero(high - low > 1)
    stride = 1
    while left.size:
        k = probe[left]
        up = passed(k, left)
        low[left], high[left] = np.where(up, k, low[left]), np.where(up, high[left], k)
        below = low[left]
        above = high[left]
        probe[left] = np.where(
            up, np.minimum(k + stride, (below + above + 1) // 2), np.maximum(k - stride, (below + above) // 2)
        )
        left = left[above - below > 1]
        stride = 2 * stride
    return high


def _in_blocks(function: Callable[[Array, Array], Array], codes: Array, mean: Array) -> Array:
    codes = np.asarray(codes, np.intp)
    mean = np.asarray(mean, float)
    result = np.empty(len(mean))
    for start in range(0, len(mean), _CHUNK):
        some = slice(start, start + _CHUNK)
        result[some] = function(codes[some], mean[some])
    return result

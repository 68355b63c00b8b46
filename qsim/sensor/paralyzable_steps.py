"""Computes the steps F_k of a paralyzable counter one by one, at any light, by a contour integral.

An arrival at t is counted if none came in the dead time tau before it, whatever was counted until t - tau. So the
generating function g(t) = E[z^N(t)] obeys g'(t) = r (z - 1) g(t - tau), r = lambda exp(-lambda tau) per exposure. Its
Laplace transform has one pole s for each branch of Lambert's W, tau s = W(r tau (z - 1)), and

    g(T) = sum over the branches of lambda z exp(s T) / ((lambda + s) (1 + tau s)).

In exposures of many dead times the principal branch is the full sum. Then, on a circle inside or outside of |z| = 1,

    F_k = (1 / 2 pi) integral of g(z) z^-k / (1 - z) d theta,    outside: F_k - 1.

The integrand is smooth and falls like a normal law, so that equal steps of theta converge geometrically: 8 to 30 nodes
for a pixel, however many arrivals it has. The nodes serve all its steps. Error: below 1e-11 in any probability.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

from qsim.keys import normal
from qsim.sensor.qis_steps import search

LEAST = 48.0  # dead times in an exposure from which the principal branch is the full sum, to 1e-12
_RADIUS = 2.0  # distance of the circle from |z| = 1, in standard deviations of theta
_STEP = 0.45  # of theta, in those; the error is exp(-2 pi _RADIUS / _STEP)
_LEAST_VARIANCE = 16.0  # of a circle: the tail of a Poisson law of few counts is longer than a normal one
_FALL = 34.0  # of the logarithm of the integrand, where it ends
_FAR = 10.0  # standard deviations from the mean, beyond which F_k is 0 or 1 to 1e-18
_OTHER = 3.0  # likewise; beyond, F_k and u are on two sides of 1/2, and an outer circle is inexact
_BLOCK = 1 << 10  # pixels of one block of work


@dataclass(frozen=True, eq=False)
class Circle:
    """Half of the circle of each of p pixels: arrays [nodes, p] and [p].

    g(z) / (1 - z) d theta / pi = factor exp(power).
    """

    log_z: Array
    power: Array
    factor: Array
    inside: Array  # bool [p]
    first: Array  # mean of the count, approximately
    deviation: Array  # standard deviation of the count, at least 4
    turn: Array  # the contribution of the code one turn of the nodes further, which is certain

    def sums(self, codes: Array, some: Array) -> Array:
        """Return F_k inside of |z| = 1, F_k - 1 outside, of `codes` [n] of the pixels `some` int [n]: [n]."""
        inside = self.inside[some]
        away = (codes - self.first[some]) / self.deviation[some]
        result = np.where(inside, away > 0, -1.0 * (away < 0))  # far away
        close = np.where(inside, (away > -_FAR) & (away < _OTHER), (away > -_OTHER) & (away < _FAR))
        k = codes[close]
        at = some[close]
        z = self.factor[:, at] * np.exp(self.power[:, at] - k * self.log_z[:, at])
        result[close] = z.real.sum(axis=0) + np.where(inside[close], self.turn[at], -self.turn[at])
        return result


def generating(log_z: Array, mean: Array, ratio: float) -> tuple[Array, Array, Array]:
    """Return power, factor and slope of the generating function after `ratio` >= LEAST dead times.

    E[z^N] = exp(power) / factor; the slope is dlog E[z^N]/dmean. Log z and means broadcast. In multiples of the mean,
    the pole is s = mean (share - 1).
    """
    from scipy.special import lambertw

    a = 1 / ratio
    less = np.expm1(log_z)
    w = lambertw(mean * a * np.exp(-mean * a) * less)
    share = 1 + less * np.exp(-mean * a - w)
    change = (share - 1) * (1 - mean * a) / (1 + w)  # ds/dmean
    with np.errstate(divide="ignore", invalid="ignore"):
        rest = np.where(mean > 0, (share - 1 - change) / (mean * share), a * less)
    return log_z + w * ratio, share * (1 + w), change - a * change / (1 + w) + rest


def moments(mean: Array, ratio: float) -> tuple[Array, Array, Array]:
    """Return approximate mean, variance and third cumulant of the count: Poisson means [p] -> [p] each."""
    fill = mean / ratio * np.exp(-mean / ratio)  # counts per dead time
    first = -np.expm1(-mean / ratio) + fill * (ratio - 1)
    return first, first * (1 - 2 * fill), first * (1 - 6 * fill + 9 * fill * fill)


def circle(mean: Array, inside: Array, ratio: float) -> Circle:
    """Return the nodes of pixels of Poisson means [p], `inside` or outside of |z| = 1: bool [p]."""
    first, variance, _ = moments(mean, ratio)
    deviation = np.sqrt(np.maximum(variance, _LEAST_VARIANCE))
    end = 2 * np.arcsin(np.sqrt(np.minimum(_FALL / 2 / np.maximum(variance, 1.0), 1.0)))
    count = int(np.ceil((end * deviation).max(initial=_STEP) / _STEP))
    angle = end / count * (np.arange(count)[:, None] + 0.5)
    log_z = np.where(inside, -_RADIUS, _RADIUS) / deviation + 1j * angle
    power, factor, _ = generating(log_z, mean, ratio)
    factor = -end / count / np.pi / (factor * np.expm1(log_z))
    turn = np.exp(-2 * np.pi * _RADIUS / (end / count * deviation))
    return Circle(log_z, power, factor, inside, first, deviation, turn)


def decide(ratio: float, top: int, below: Array, above: Array, mean: Array) -> tuple[Array, Array]:
    """Return the smallest codes k with u < F_k (`top` at most) and the distance of u to the nearest step.

    Both are [p], of (u, 1 - u) and Poisson means [p].
    """
    first, variance, third = moments(mean, ratio)
    z = normal(below, above)
    skew = third / np.maximum(variance, 1e-9)
    guess = np.rint(first + np.sqrt(variance) * z + skew * (z * z - 1) / 6)
    codes = np.empty(len(mean), np.intp)
    near = np.full(len(mean), np.inf)
    order = np.argsort(variance)  # pixels of one block have as many nodes
    for start in range(0, len(mean), _BLOCK):
        block = order[start : start + _BLOCK]
        codes[block], near[block] = _block(ratio, top, below[block], above[block], mean[block], guess[block])
    return codes, near


def _block(ratio: float, top: int, below: Array, above: Array, mean: Array, guess: Array) -> tuple[Array, Array]:
    near = np.full(len(mean), np.inf)
    inside = below < 0.5
    nodes = circle(mean, inside, ratio)

    def passed(k: Array, left: Array) -> Array:
        sums = nodes.sums(k, left)
        distance = np.where(inside[left], below[left] - sums, -sums - above[left])
        near[left] = np.minimum(near[left], np.abs(distance))
        return distance >= 0

    return search(passed, top, guess), near


def steps(ratio: float, count: int, mean: Array) -> tuple[Array, Array]:
    """Return F_0 ... F_(count - 1) and dF/dmean of Poisson means [n], for grids of curves: [count, n] each.

    One circle serves all codes, so close to |z| = 1 that no code is amplified by more than exp(7): an error below
    1e-11.
    """
    half = max(64, 2 * (count + 1))
    log_z = -14 / half + 1j * np.pi / half * (np.arange(half)[:, None] + 0.5)
    turned = np.exp(-np.arange(count)[:, None] * log_z[:, 0]) / half
    results = np.empty((2, count, len(mean)))
    for start in range(0, len(mean), _BLOCK // 4):
        some = slice(start, start + _BLOCK // 4)
        power, factor, change = generating(log_z, mean[some], ratio)
        cdf = -np.exp(power) / (factor * np.expm1(log_z))
        results[0][:, some], results[1][:, some] = (turned @ cdf).real, (turned @ (cdf * change)).real
    return results[0], results[1]

"""Computes the law of the paralyzable counter: the number of counts from n arrivals.

An arrival is counted if none came in the dead time before it. The pixel is live at the start, so the code is 1 + the
number of gaps between successive arrivals that reach the dead time. Let n arrivals fall on an exposure that is R dead
times long. Choose which k - 1 of the n - 1 gaps are long and take one dead time out of each. There remain n uniform
points on a line l = R - k + 1 dead times long, whose m = n - k chosen gaps are all shorter than one:

    P(k counted | n) = C(n-1, k-1) (l / R)^n H(m, k; l),

H being the probability of the latter. The textbook sums this by inclusion and exclusion, which cancels. Here H comes
from a recursion of positive terms. With A = E[(l - S)+^k] / k! = H l^(m+k) / (m+k)!, S the sum of m uniform numbers
on [0, 1): integration by parts of E[(l - S) (l - S)+^(k-1)] gives

    (m + k) A(m, k; l) = l A(m, k-1; l) + m A(m-1, k; l-1),

which starts at the density of S (k = -1), itself a B-spline with the positive recursion of de Boor and Cox:
(m - 1) A(m, -1; l) = l A(m-1, -1; l) + (m - l) A(m-1, -1; l-1).

Light so bright that the table would be too long paralyses the pixel, if the dead time is not far below the exposure.
The few counts after the first then follow from the series of binomial moments, which no longer cancels.

The steps F_k of exposures of many dead times are also computed one by one, at any light, by a contour integral. An
arrival at t is counted if none came in the dead time tau before it, whatever was counted until t - tau. So the
generating function g(t) = E[z^N(t)] obeys g'(t) = r (z - 1) g(t - tau), r = lambda exp(-lambda tau) per exposure. Its
Laplace transform has one pole s for each branch of Lambert's W, tau s = W(r tau (z - 1)), and

    g(T) = sum over the branches of lambda z exp(s T) / ((lambda + s) (1 + tau s)).

In exposures of many dead times the principal branch is the full sum. Then, on a circle inside or outside of |z| = 1,

    F_k = (1 / 2 pi) integral of g(z) z^-k / (1 - z) d theta,    outside: F_k - 1.

The integrand is smooth and falls like a normal law, so that equal steps of theta converge geometrically: 8 to 30 nodes
for a pixel, however many arrivals it has. The nodes serve all its steps. Error: below 1e-11 in any probability.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from math import floor, gamma

import numpy as np
from numpy import ndarray as Array

from qsim.keys import normal
from qsim.sensor.code_search import search
from qsim.sensor.counting_moments import LONGER, SIGMAS, summed
from qsim.sensor.poisson import Mixture

_BEYOND_TOP = 64  # codes above the top one that are summed term by term
_LONGEST = 1 << 14  # arrivals in the longest table
_MOST = 120  # counts in the alternating series; 120 counts where 3 are expected have a probability of 1e-142
MANY = 256  # codes from which moments are closed forms
_SPARSE = 3.0  # expected counts after the first up to which the alternating series keeps 13 digits
LEAST = 48.0  # dead times in an exposure from which the principal branch is the full sum, to 1e-12
_RADIUS = 2.0  # distance of the circle from |z| = 1, in standard deviations of theta
_STEP = 0.45  # of theta, in those; the error is exp(-2 pi _RADIUS / _STEP)
_LEAST_VARIANCE = 16.0  # of a circle: the tail of a Poisson law of few counts is longer than a normal one
_FALL = 34.0  # of the logarithm of the integrand, where it ends
_FAR = 10.0  # standard deviations from the mean, beyond which F_k is 0 or 1 to 1e-18
_OTHER = 3.0  # likewise; beyond, F_k and u are on two sides of 1/2, and an outer circle is inexact
_BLOCK = 1 << 10  # pixels of one block of work


class Paralyzable:
    """Cdf, log_pmf and slope of the clipped count for Poisson means [p]; `ratio` = exposure / dead time."""

    def __init__(self, ratio: float, levels: int) -> None:
        self.ratio = ratio
        self.levels = levels
        self.possible = min(levels, most_counts(ratio) + 1)  # levels that can occur

    def cdf(self, mean: Array) -> Array:
        """Return P(code <= k): [p] -> [p, levels]."""
        result = np.ones((len(mean), self.levels))
        for rows, table in self._tables(mean, brief=True):
            result[rows, : self.possible] = (
                table.evaluate_cdf(mean[rows]) if table else self._paralysed(mean[rows]).cdf()
            )
        return result

    def log_pmf(self, mean: Array, wanted: Array | None = None) -> Array:
        """Return log P(code = k): [p] -> [p, levels]; `wanted` as in Mixture."""
        result = np.full((len(mean), self.levels), -np.inf)
        for rows, table in self._tables(mean):
            some = None if wanted is None else wanted[rows, : self.possible]
            part = table.evaluate_log_pmf(mean[rows], some) if table else self._paralysed(mean[rows]).log_pmf()
            result[rows, : self.possible] = part
        # No count at all means no arrival at all, since the pixel begins live: exp(-mean), exact in any light.
        result[:, 0] = -mean
        return result

    def slope(self, mean: Array) -> Array:
        """Return dcdf/dmean: [p] -> [p, levels]."""
        result = np.zeros((len(mean), self.levels))
        for rows, table in self._tables(mean):
            result[rows, : self.possible] = (
                table.evaluate_slope(mean[rows]) if table else self._paralysed(mean[rows]).slope()
            )
        return result

    def moments(self, mean: Array) -> tuple[Array, Array]:
        """Return mean and variance of the clipped count: [p] -> [p] each.

        Of many codes they are 1! B_1 and 2! B_2 + B_1 - B_1^2 (`_moments`), or sums over the counts near the top code.
        """
        if not self.by_steps or self.possible < MANY:
            law = self if self.possible == self.levels else Paralyzable(self.ratio, self.possible)
            codes = np.arange(self.possible)
            nothing = np.zeros((len(mean), self.possible), bool)
            pmf = np.exp(law.log_pmf(mean, nothing))
            first = pmf @ codes
            return first, np.sum(pmf * (codes - first[:, None]) ** 2, axis=1)
        light = np.maximum(mean, 1e-12)
        binomial, _ = _moments(light, 1 / self.ratio, 2)
        first = binomial[:, 0]
        second = 2 * binomial[:, 1] * light * np.exp(-light / self.ratio) + first - first**2
        reach = SIGMAS * np.sqrt(np.maximum(second, 0)) + LONGER
        clipped = first + reach >= self.possible - 1
        if clipped.any():
            first[clipped], second[clipped] = summed(
                light[clipped], first[clipped], reach[clipped], self.possible - 1, self._tail
            )
        first[mean == 0] = 0.0
        second[mean == 0] = 0.0
        return first, np.maximum(second, 0.0)

    def _tail(self, codes: Array, mean: Array, below: Array) -> Array:
        """Return P(N <= k) where `below`, else P(N > k), of pairs: codes int [n], means [n], bool [n] -> [n]."""
        result = np.empty(len(codes))
        for light in np.unique(mean):
            for inside in (True, False):
                some = np.flatnonzero((mean == light) & (below == inside))
                nodes = circle(np.array([light]), np.array([inside]), self.ratio)
                sums = nodes.sums(codes[some], np.zeros(len(some), np.intp))
                result[some] = sums if inside else -sums
        return result

    @property
    def by_steps(self) -> bool:
        """Return whether steps can be computed one by one, at any light.

        The exposure must hold enough dead times.
        """
        return self.ratio >= LEAST

    def _tables(self, mean: Array, brief: bool = False) -> Iterator[tuple[Array, Mixture | None]]:
        """Yield light levels in groups, each with a table just long enough (the Poisson tail left out is below 1e-30).

        `brief`: None instead of a table where the series gives the cdf as well, though not its far tails.
        """
        # Lengths are powers of two, so that all light levels share a few cached tables.
        length = np.exp2(np.ceil(np.log2(mean + 12 * np.sqrt(mean) + 60)))
        if brief and self.ratio < LEAST:  # few moments are quicker than a long table
            expected = mean * np.exp(-mean / self.ratio) * (1 - 1 / self.ratio)
            length[(mean > self.ratio) & (expected <= _SPARSE)] = np.inf
        for last in np.unique(length):
            table = arrival_table(self.ratio, self.possible, int(last)) if last <= _LONGEST else None
            yield np.flatnonzero(length == last), table

    def _paralysed(self, mean: Array) -> _Paralysed:
        return _Paralysed(mean, self.ratio, self.possible)


def most_counts(ratio: float) -> int:
    """Return the most counts that fit into an exposure of `ratio` dead times, the pixel being live at its start."""
    return floor(ratio) + 1


@lru_cache(maxsize=16)
def arrival_table(ratio: float, levels: int, last: int) -> Mixture:
    """Return P(code | n arrivals) for n < `last`; `ratio` = exposure / dead time; codes clip at levels - 1."""
    most = most_counts(ratio)
    counted = min(most, levels - 1 + _BEYOND_TOP, last - 1)
    log_pmf = _log_counts(ratio, counted, last)
    pmf = np.exp(log_pmf)
    top = levels - 1
    codes = np.zeros((last, levels))
    width = min(top, counted + 1)
    codes[:, :width] = pmf[:, :width]
    at_least_top = pmf[:, top:].sum(axis=1)
    below_top = codes[:, :top].sum(axis=1)
    # The top code is what the others leave, unless they leave little: then its own terms are summed.
    codes[:, top] = np.where((below_top < 0.5) & (counted < most), 1 - below_top, at_least_top)
    cdf = np.minimum(np.cumsum(codes, axis=1), 1.0)
    cdf[:, -1] = 1.0
    # 1 - cdf, summed from the top, where the cdf is near 1.
    survival = np.pad(np.cumsum(codes[:, :0:-1], axis=1)[:, ::-1], ((0, 0), (0, 1)))
    # A difference on the smaller side of the distribution
    slope = np.where(cdf[:-1] < 0.5, np.diff(cdf, axis=0), -np.diff(survival, axis=0))
    with np.errstate(divide="ignore"):
        log_codes = np.log(codes)
    log_codes[:, :width] = log_pmf[:, :width]
    return Mixture(0, cdf[:-1], log_codes[:-1], slope, cdf[-1], log_codes[-1])


def _log_counts(ratio: float, counted: int, last: int) -> Array:
    """Return log P(k counted | n), n = 0 ... last - 1 and k = 0 ... `counted`: [last, counted + 1]."""
    from scipy.special import gammaln

    log_shares = _log_shares(ratio, counted, last)
    n = np.arange(last)[:, None]
    k = np.arange(counted + 1)[None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        # The formula of the module's docstring: C(n-1, k-1) (l / R)^n H, in logarithms.
        log_choices = gammaln(n) - gammaln(k) - gammaln(n - k + 1)
        log_length = np.log1p(-np.minimum((k - 1) / ratio, 1.0))
        result = np.where((k >= 1) & (n >= k), log_choices + n * log_length + log_shares, -np.inf)
    result[0, 0] = 0.0
    return result


def _log_shares(ratio: float, counted: int, last: int) -> Array:
    """Return log H(n - k, k; ratio - k + 1) at [n, k]; zeros where n < k or k = 0."""
    # A column holds one l = R - c; the recursion from l to l - 1 is a step to the next column.
    lengths = ratio - np.arange(min(floor(ratio), counted + last) + 1)  # l of each column
    shorter = np.append(lengths[1:], -1.0)
    fits = shorter >= 0
    with np.errstate(divide="ignore", invalid="ignore"):
        shrink = np.where(fits, shorter / lengths, 0.0)  # (l - 1) / l
        per_length = np.where(lengths > 0, 1 / lengths, 0.0)
    powers = shrink ** np.arange(counted + 1)[:, None]  # shrink^k
    result = np.zeros((last, counted + 1))
    k = np.arange(1, counted + 1)
    columns = np.minimum(k - 1, len(lengths) - 1)
    h = np.ones((counted + 1, len(lengths)))  # m = 0
    density = ((lengths >= 0) & (lengths < 1)).astype(float)  # m = 1
    scale = np.ones(len(lengths))  # shrink^(m - 1)
    for m in range(1, last):
        if m > 1:
            # de Boor and Cox, scaled by l^(m-1), which keeps the numbers in range.
            growth = np.where(fits, (m - lengths) * per_length * scale, 0.0)
            density = np.where(lengths < m, density + growth * _next(density), 0.0)
            scale = scale * shrink
        # The recursion in H = A (m+k)! / l^(m+k): every step along k adds a positive term, hence the running sum.
        added = m * per_length * scale * powers * _next(h)
        h = density + np.cumsum(np.where(fits, added, 0.0), axis=0)
        fitting = k[k + m < last]
        with np.errstate(divide="ignore"):
            result[fitting + m, fitting] = np.log(h[fitting, columns[fitting - 1]])
    return result


def _next(values: Array) -> Array:
    """Return the values at l - 1, one column on."""
    return np.concatenate([values[..., 1:], np.zeros_like(values[..., :1])], axis=-1)


class _Paralysed:
    """The law in light so bright that long gaps are rare, from the binomial moments B_j = E[C(N, j)].

    With a = 1 / ratio and rate = mean exp(-mean a), the first count has the density mean exp(-mean min(x, a)) at x. A
    later count has the density `rate`, if it comes a or more after the one before. So

        B_j = rate^(j-1) [J(j-1, c) + rate (c - a)+^j / j!],   c = 1 - (j - 1) a,
        J(r, c) = integral from 0 to min(a, c) of mean exp(-mean x) (c - x)^r / r! dx;
        P(N = k) = sum_j (-1)^(j-k) C(j, k) B_j,   P(N > k) = sum_j (-1)^(j-k-1) C(j-1, k) B_j.

    `moments` holds B_j / rate^(j-1), j = 1, 2, ...: [p, j].
    """

    def __init__(self, mean: Array, ratio: float, levels: int) -> None:
        self.mean = mean
        self.levels = levels
        a = 1 / ratio
        self.log_rate = np.log(mean) - mean * a
        self.rate = np.exp(self.log_rate)
        if (self.rate * (1 - a) > _SPARSE).any():
            worst = float(mean[np.argmax(self.rate)])
            raise ValueError(
                f"CountingSPAD: {worst:.4g} arrivals in an exposure of {ratio:.6g} paralyzable dead times have no "
                "closed form here; shorten the exposure or lower the light"
            )
        self.j = np.arange(1, min(most_counts(ratio), _MOST) + 1)
        self.moments, change = _moments(mean, a, len(self.j))
        self.changes = change + self.moments * (self.j - 1) * (1 / mean - a)[:, None]  # of B_j / rate^(j-1) by the mean

    def log_pmf(self) -> Array:
        """Return log P(code = k): [p, levels]; the last code is this count or more."""
        from scipy.special import binom

        result = np.full((len(self.mean), self.levels), -np.inf)
        result[:, 0] = -self.mean
        for k in range(1, min(self.levels, len(self.j) + 1)):
            # Inclusion and exclusion. In this light the terms fall quickly,
            # so that the alternating signs cost no digits.
            ways = binom(self.j, k) if k < self.levels - 1 else binom(self.j - 1, k - 1)
            signed = np.where(self.j >= k, (-1.0) ** (self.j - k) * ways, 0.0)
            total = (signed * self.moments * self.rate[:, None] ** np.maximum(self.j - k, 0)).sum(axis=1)
            with np.errstate(divide="ignore"):
                result[:, k] = np.log(np.maximum(total, 0.0)) + (k - 1) * self.log_rate
        return result

    def cdf(self) -> Array:
        """Return P(code <= k): [p, levels]."""
        cdf = 1 - self._beyond(self.moments)
        cdf[:, 0] = np.exp(-self.mean)
        return cdf

    def slope(self) -> Array:
        """Return dcdf/dmean: [p, levels]."""
        slope = -self._beyond(self.changes)
        slope[:, 0] = -np.exp(-self.mean)
        return slope

    def _beyond(self, moments: Array) -> Array:
        """Return the series of P(N > k), or of its derivative, for every code below the last: [p, levels]."""
        from scipy.special import binom

        terms = moments * self.rate[:, None] ** (self.j - 1)
        result = np.zeros((len(self.mean), self.levels))
        for k in range(min(self.levels - 1, len(self.j))):
            result[:, k] = terms @ np.where(self.j > k, (-1.0) ** (self.j - k - 1) * binom(self.j - 1, k), 0.0)
        return result


def _moments(mean: Array, a: float, last: int) -> tuple[Array, Array]:
    """Return B_j / rate^(j-1) and the part of its derivative in which rate^(j-1) is kept.

    Both are [p, last], j = 1 ... last.
    """
    moments = np.empty((len(mean), last))
    slopes = np.empty((len(mean), last))
    factor = np.exp(-mean * a)
    for j in range(1, last + 1):
        c = 1 - (j - 1) * a
        end = min(a, c)
        rest = c - end
        fade = np.exp(-mean * end)
        # J(r - 1), J(r), here r = 0
        before = np.zeros_like(mean)
        integral = -np.expm1(-mean * end)
        for r in range(1, j):
            before = integral
            # By parts: J(r) = (c^r - fade rest^r) / r! - J(r-1) / mean.
            integral = (c**r - fade * rest**r) / gamma(r + 1) - integral / mean
        open_end = rest**j / gamma(j + 1)
        moments[:, j - 1] = integral + mean * factor * open_end
        slopes[:, j - 1] = (c * before - (j - 1) * integral) / mean + fade * end * rest ** (j - 1) / gamma(j)
        slopes[:, j - 1] += factor * (1 - mean * a) * open_end
    return moments, slopes


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
    # less = z - 1. The pole solves s = r (z - 1) exp(-s tau); with W, share = 1 + s / lambda.
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
    # |g| falls on the circle as exp(-2 variance sin(theta / 2)^2), as
    # of a Poisson number; behind `end` nothing is left.
    end = 2 * np.arcsin(np.sqrt(np.minimum(_FALL / 2 / np.maximum(variance, 1.0), 1.0)))
    count = int(np.ceil((end * deviation).max(initial=_STEP) / _STEP))
    angle = end / count * (np.arange(count)[:, None] + 0.5)
    log_z = np.where(inside, -_RADIUS, _RADIUS) / deviation + 1j * angle
    power, factor, _ = generating(log_z, mean, ratio)
    factor = -end / count / np.pi / (factor * np.expm1(log_z))
    # Equal steps of theta also count the codes that are a whole number of turns of the nodes
    # away. The nearest of them is certain to be 1; its weight is known and taken off.
    turn = np.exp(-2 * np.pi * _RADIUS / (end / count * deviation))
    return Circle(log_z, power, factor, inside, first, deviation, turn)


def decide(ratio: float, top: int, below: Array, above: Array, mean: Array) -> tuple[Array, Array]:
    """Return the smallest codes k with u < F_k (`top` at most) and the distance of u to the nearest step.

    Both are [p], of (u, 1 - u) and Poisson means [p].
    """
    # Cornish-Fisher to the third cumulant; where it misses, the search goes on from there.
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
    # A trapezoidal rule over the whole circle is a discrete Fourier transform:
    # with more nodes than codes it is exact but for the wrapped tail.
    half = max(64, 2 * (count + 1))
    log_z = -14 / half + 1j * np.pi / half * (np.arange(half)[:, None] + 0.5)
    turned = np.exp(-np.arange(count)[:, None] * log_z[:, 0]) / half
    results = np.empty((2, count, len(mean)))
    for start in range(0, len(mean), _BLOCK // 4):
        some = slice(start, start + _BLOCK // 4)
        power, factor, change = generating(log_z, mean[some], ratio)
        cdf = -np.exp(power) / (factor * np.expm1(log_z))
        results[0][:, some] = (turned @ cdf).real
        results[1][:, some] = (turned @ (cdf * change)).real
    return results[0], results[1]

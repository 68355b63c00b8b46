"""States the mean code of a SPAD pixel against its arrivals, with dead time, afterpulses and crosstalk, and inverts it.

Arrivals are avalanches of light and of dark counts. An afterpulse follows a detection in the next frame with
probability a; an avalanche fires each of its four neighbours with probability c. In an evenly lit array

    planes    1 - q = (1 - p) (1 - a q) (1 - c f)^4,   p = 1 - exp(-arrivals),   f: fired before crosstalk
    counts    code = min(n + Poisson(e), 2^bits - 1),  n: counts with dead time, e: mean afterpulses and crosstalk

Neighbours of other brightness are corrected to first order in c.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.frame_statistics import FrameStatistics
from qsim.sensor.counting import CountingSPAD

NEIGHBOURS = 4
_POINTS = 600  # of a table; linear interpolation errs by less than 1e-5 of the arrivals
_ITERATIONS = 60  # of a fixed point that contracts by a + 4 c
_LEAST_ROOM = 1e-9


@dataclass(frozen=True, eq=False)
class Arrivals:
    """Arrivals per exposure of every pixel and their variance, both [H, W], and the slope of the code by arrivals."""

    value: Array
    variance: Array
    slope: float  # at the mean code


@dataclass(frozen=True, eq=False)
class Response:
    """Exact curve of mean code against arrivals of one pixel, and its inverse."""

    bits: int
    ratio: float  # dead time in exposures of `exposure`; 0 for 1-bit planes
    paralyzable: bool
    exposure: float  # s
    afterpulsing: float = 0.0  # per detection, in the next frame; an estimate may be below 0
    crosstalk: float = 0.0  # per avalanche and neighbour

    def at(self, exposure: float) -> Response:
        """Return the curve of the same pixel at another exposure [s]."""
        return replace(self, ratio=self.ratio * (self.exposure / exposure), exposure=exposure)

    @property
    def levels(self) -> int:
        return 1 << self.bits

    @property
    def correlated(self) -> bool:
        """Whether afterpulses or crosstalk add counts."""
        return self.afterpulsing != 0 or self.crosstalk != 0

    def pmf(self, arrivals: Array) -> Array:
        """Return P(code): [p] -> [p, levels]."""
        if self.bits == 1:
            fired = self.mean(arrivals)
            return np.stack([1 - fired, fired], axis=-1)
        alone = np.diff(self._counter(self.bits).cdf(np.maximum(arrivals, 0.0), 1.0), axis=-1, prepend=0.0)
        if not self.correlated:
            return alone
        extra = self._extra(arrivals)
        change = _with_poisson(alone, np.abs(extra)) - alone
        return alone + np.sign(extra)[:, None] * change  # below 0 the law continues by its reflection

    def mean(self, arrivals: Array) -> Array:
        """Return the expected code at arrivals per exposure, any shape."""
        if self.bits > 1:
            if not self.correlated:
                return _mean_count(self._counter(self.bits), arrivals)
            return (self.pmf(arrivals.ravel()) @ np.arange(self.levels)).reshape(arrivals.shape)
        dark = np.exp(-arrivals)
        if not self.correlated:
            return 1 - dark
        code = 1 - dark
        for _ in range(_ITERATIONS):
            # A plane stays dark without arrival, without afterpulse of the
            # plane before, and without crosstalk of four neighbours.
            without = dark * (1 - self.afterpulsing * code)
            code = 1 - without * (1 - self.crosstalk * (1 - without)) ** NEIGHBOURS
        return code

    def variance(self, arrivals: Array) -> Array:
        """Return the variance of the code in time: [p] -> [p].

        Afterpulses of counts with dead time vary less than Poisson counts.
        """
        pmf = self.pmf(arrivals)
        codes = np.arange(self.levels, dtype=float)
        mean = pmf @ codes
        found = pmf @ codes**2 - mean**2
        if self.bits > 1 and self.ratio > 0 and self.correlated:
            counted = self._unclipped.cdf(np.maximum(arrivals, 0.0), 1.0)
            above = 1 - counted
            level = above.sum(axis=-1)
            spread = (above * (2 * np.arange(above.shape[-1]) + 1)).sum(axis=-1) - level**2
            shown = pmf[:, :-1].sum(axis=1) ** 2  # of a small change of the variance, below the top code
            found = found - (self.afterpulsing**2 + NEIGHBOURS * self.crosstalk**2) * (level - spread) * shown
        return np.asarray(found)

    def table(self, largest: float) -> tuple[Array, Array]:
        """Return (arrivals, mean code) [G], rising, up to a mean of `largest` or to the maximum of the mean."""
        top = 2 * largest + 10
        for _ in range(12):
            arrivals = np.linspace(0, np.sqrt(top), _POINTS) ** 2
            codes = self.mean(arrivals)
            end = int(np.argmax(codes))
            if codes[end] >= largest or end < len(codes) - 1:
                break
            top *= 2
        return arrivals[: end + 1], codes[: end + 1]

    def lag_correlation(self, mean: Array) -> Array:
        """Return the correlation of a pixel's neighbouring frames, at its mean code."""
        if self.bits > 1:
            return np.full_like(mean, self.afterpulsing)
        return np.asarray(self.afterpulsing * np.maximum(1 - mean, 0) / (1 - self.afterpulsing * mean))

    def excess(self, mean: Array) -> Array:
        """Return the variance of a mean over many frames, over that of independent frames, at a pixel's mean code."""
        rho = self.lag_correlation(mean)
        return np.asarray((1 + rho) / (1 - rho))

    def of_stack(self, stack: FrameStatistics) -> Arrivals:
        """Return the arrivals of every pixel of a stack; noise may make them negative.

        `value` is nearly unbiased for planes: sum of 1/j, j = zeros + 1 ... frames, in place of -ln(zeros / frames).
        For counts the bias of a curved inverse, f''/2 times the variance of the pixel's mean, is subtracted.
        """
        here = self.at(stack.exposure)
        return here._of_planes(stack) if self.bits == 1 else here._of_counts(stack)

    def _of_planes(self, stack: FrameStatistics) -> Arrivals:
        from scipy.special import digamma, polygamma

        t = stack.frames
        zeros = t - stack.total
        mean = stack.total / t
        # Sums of 1/j and of 1/j^2 by digamma and trigamma: the expectation of -ln(share of zeros), and its variance.
        found = digamma(t + 1) - digamma(zeros + 1)
        variance = polygamma(1, zeros + 1) - polygamma(1, t + 1)
        found = found + np.log1p(-self.afterpulsing * mean)
        if self.crosstalk:
            fired = self.before_crosstalk(mean)
            found = found + over_neighbours(np.log1p(-self.crosstalk * fired))
        lever = (1 - self.afterpulsing) / (1 - self.afterpulsing * mean)
        slope = (1 - stack.mean) / lever[0, 0] if lever.size == 1 else (1 - stack.mean) / float(lever.mean())
        return Arrivals(found, variance * lever**2 * self.excess(mean), slope)

    def before_crosstalk(self, mean: Array) -> Array:
        """Return the share of planes that fired before crosstalk, at a mean code of planes."""
        fired = np.asarray(mean, float)
        for _ in range(10):
            fired = 1 - (1 - mean) / (1 - self.crosstalk * fired) ** NEIGHBOURS
        return np.maximum(fired, 0.0)

    def _of_counts(self, stack: FrameStatistics) -> Arrivals:
        t = stack.frames
        mean = stack.total / t
        even = mean  # the code that an evenly lit array of this pixel's light would have
        if self.crosstalk:
            even = mean - self.crosstalk * (over_neighbours(mean) - NEIGHBOURS * mean)
        arrivals, codes = self.table(float(even.max()))
        # Noise makes some of them negative: cut off, they would raise the mean of dark pixels.
        found = np.interp(even, codes, arrivals) + np.minimum(even, 0.0) * (arrivals[1] / codes[1])
        slope_table = np.gradient(codes, arrivals)
        at = np.interp(stack.mean, codes, arrivals)
        variance = np.where(stack.pixel_variance > 0, stack.pixel_variance, 0.0) if t > 1 else mean
        variance = variance * self.excess(mean) / t
        slopes = np.maximum(np.interp(found, arrivals, slope_table), _LEAST_ROOM)
        curvature = np.interp(found, arrivals, np.gradient(slope_table, arrivals))
        # f'' of the inverse is -curvature / slope^3: its half times the
        # variance is what a curved inverse adds to the mean.
        found = found + 0.5 * curvature / slopes**3 * variance
        return Arrivals(found, variance / slopes**2, float(np.interp(at, arrivals, slope_table)))

    def _counter(self, bits: int) -> CountingSPAD:
        return CountingSPAD(1.0, 0.0, self.ratio, bits, self.paralyzable)

    @property
    def _unclipped(self) -> CountingSPAD:
        return self._counter(max(self.bits, 8))

    def _extra(self, arrivals: Array) -> Array:
        """Return the mean number of afterpulses and crosstalk counts in a frame: [p] -> [p]."""
        counted = arrivals if self.ratio == 0 else _mean_count(self._unclipped, arrivals)
        spread = 1 + NEIGHBOURS * self.crosstalk
        # Each avalanche has `spread` descendants by crosstalk, and each of
        # these an afterpulse with its own: a geometric series.
        return np.asarray(counted * (spread / (1 - self.afterpulsing * spread) - 1))


def _mean_count(sensor: CountingSPAD, arrivals: Array) -> Array:
    """Return the expected code, any shape: the sum of P(code > k)."""
    return np.asarray((1 - sensor.cdf(np.maximum(arrivals, 0.0), 1.0)).sum(axis=-1))


def over_neighbours(image: Array) -> Array:
    """Return the sum over the four neighbours of every pixel [H, W]; pixels of the border have fewer."""
    total = np.zeros_like(image)
    total[1:] += image[:-1]
    total[:-1] += image[1:]
    total[:, 1:] += image[:, :-1]
    total[:, :-1] += image[:, 1:]
    return total


def _with_poisson(pmf: Array, mean: Array) -> Array:
    """Return the law of min(code + Poisson(mean), top): [p, levels], [p] -> [p, levels]."""
    from scipy.special import gammaln, xlogy

    levels = pmf.shape[1]
    k = np.arange(levels)
    extra = np.exp(xlogy(k, mean[:, None]) - mean[:, None] - gammaln(k + 1))
    # Twice the length, so that the convolution does not wrap around.
    size = 2 * levels
    product = np.fft.irfft(np.fft.rfft(pmf, size) * np.fft.rfft(extra, size), size)[:, :levels]
    product = np.maximum(product, 0.0)
    product[:, -1] = np.maximum(1 - product[:, :-1].sum(axis=1), 0.0)
    return np.asarray(product)

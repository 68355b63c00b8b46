"""Measures the PRNU of a flat field, without shading of the light, noise, dark counts and hot pixels.

    mean code of every pixel - its own dark level  --smooth surface (shading of the light)-->  residuals
    residuals^2 - noise = spread that a PRNU s would cause, by the sensor's own curve of mean code against light -> s

Model: pixel p gets the light L_p (1 + s x_p); L is smooth over the field, x_p is normal with variance 1. The interval
is that of a difference of two variances (Ting et al., J. Stat. Comput. Simul. 35, 1990, without the cross term).

Hot pixels are left out. With dark frames they are found by their dark level (`hot_by_rate`, `hot_by_level`). Without,
they are found by a flat level above `OUTLIER` robust standard deviations. Variations slower than a polynomial of fourth
degree over the field count as light, not as PRNU.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite, sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.quantiles import chi2_quantile
from qsim.calibration.results import Value

HOT = 10.0  # times the median dark rate
OUTLIER = 6.0  # robust standard deviations (1.4826 times the median absolute deviation)
CERTAIN = 5.0  # standard errors; a hot pixel exceeds the median by more
WIDEST = 3.5  # the table of the response ends at this multiple of the brightest light of a flat
STEEPEST = 1.0  # largest PRNU that is searched for
_DEGREES = ((400, 6), (100, 4), (20, 2), (0, 0))  # of a smooth field: pixels from which on, and the degree
BY_DARK = "by the dark frames"
BY_FLAT = f"by the flat: {OUTLIER:g} robust sigmas above its smooth surface"


def normal_nodes(count: int) -> tuple[Array, Array]:
    """Return the nodes and weights [count] of Gauss-Hermite quadrature over a standard normal variable."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(count)
    return nodes, weights / weights.sum()


NODES, WEIGHTS = normal_nodes(9)


@dataclass(frozen=True, eq=False)
class Flat:
    """One flat field without dark levels: per pixel the mean code, the variance of that mean, and the response."""

    mean: Array  # [H, W] codes; the mean dark level of the good pixels is left in
    noise: Array  # [H, W] codes^2, variance of `mean` by the noise of flat and dark frames
    light: Array  # [G] rising light, in electrons or avalanches per exposure, from 0
    codes: Array  # [G] mean code of a pixel of average dark level at that light
    raw: Array  # [H, W] codes, the mean with its dark level


@dataclass(frozen=True, eq=False)
class Pattern:
    """PRNU of the good pixels and of all pixels, and the pixels left out."""

    prnu: Value
    with_hot: Value
    left_out: Array  # bool [H, W]
    rule: str  # by which pixels were left out
    shading: float  # rms of the smooth part of the light, relative to its mean

    def values(self) -> dict[str, Value]:
        """Return the values of a calibration; the PRNU of all pixels is one of them if some were left out."""
        count = float(self.left_out.sum())
        found = {"prnu": self.prnu}
        if count:
            found["prnu_with_hot_pixels"] = self.with_hot
        unit = f"of {self.left_out.size} pixels"
        return found | {
            "prnu_left_out": Value.exact(count, unit, f"hot {self.rule}"),
            "shading": Value.exact(self.shading, "rms, relative", "smooth surface, not in PRNU"),
        }


def robust_sigma(values: Array) -> float:
    """Return 1.4826 times the median absolute deviation: the standard deviation of a normal sample with outliers."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def hot_by_rate(counts: Array, median: float) -> Array:
    """Return the hot pixels by their counts over all dark frames [H, W]: significantly above 10 times the median."""
    return np.asarray(counts > np.maximum(HOT * median, median + CERTAIN * sqrt(median + 1)))


def hot_by_level(level: Array, error: float) -> Array:
    """Return the hot pixels by dark levels with an offset [H, W].

    They exceed the median by 6 robust sigmas and 5 standard errors.
    """
    median = float(np.median(level))
    return np.asarray(level > median + max(OUTLIER * robust_sigma(level), CERTAIN * error))


def surface(shape: tuple[int, int], pixels: int) -> Array:
    """Return polynomials over the field [H * W, terms], of the degree that so many pixels determine (_DEGREES)."""
    degree = next(degree for least, degree in _DEGREES if pixels >= least)
    y, x = (np.linspace(-1, 1, n) if n > 1 else np.zeros(1) for n in shape)
    terms = [
        np.outer(np.polynomial.legendre.legval(y, np.eye(j + 1)[j]), np.polynomial.legendre.legval(x, np.eye(i + 1)[i]))
        for j in range(min(degree, shape[0] - 1) + 1)
        for i in range(min(degree - j, shape[1] - 1) + 1)
    ]
    return np.stack([term.ravel() for term in terms], axis=1)


def smooth_part(basis: Array, values: Array, used: Array) -> Array:
    """Return the surface [n] of `basis` [n, terms] that is nearest to the values [n] that are `used` [n]."""
    some = basis[used]
    # the polynomials are nearly orthogonal, so the normal equations are as good as a decomposition and much quicker
    return np.asarray(basis @ np.linalg.lstsq(some.T @ some, some.T @ values[used], rcond=1e-12)[0])


def outliers(flat: Flat) -> Array:
    """Return the pixels of a flat [H, W] above its smooth surface by 6 robust sigmas: hot ones, without dark frames."""
    values = flat.mean.ravel()
    basis = surface(flat.mean.shape, values.size)
    good = np.abs(values - np.median(values)) <= OUTLIER * robust_sigma(values)
    for _ in range(20):
        if good.sum() <= 2 * basis.shape[1]:
            return np.zeros(flat.mean.shape, bool)
        fitted = smooth_part(basis, values, good)
        residual = (values - fitted) / np.maximum(fitted - flat.codes[0], 1e-12)
        now = residual <= np.median(residual) + OUTLIER * robust_sigma(residual)
        if np.array_equal(now, good):
            break
        good = now
    return ~good.reshape(flat.mean.shape)


def relative_noise(flat: Flat, good: Array) -> float:
    """Return the variance of a pixel's mean over the square of its slope by relative light; the smallest is best."""
    level = float(flat.mean[good].mean())
    light = float(np.interp(level, flat.codes, flat.light))
    slope = float(np.interp(light, flat.light, np.gradient(flat.codes, flat.light)))
    lever = slope * light
    return float(flat.noise[good].mean()) / lever**2 if lever > 0 else inf


def measure_pattern(flats: Sequence[Flat], hot: Array, rule: str = BY_DARK) -> Pattern | None:
    """Measure PRNU in the flat with the least relative noise; None if no flat has light above its dark level.

    All flats share one pattern. `hot` [H, W] are the pixels that are left out, and `rule` by what they were found.
    """
    best: tuple[float, Flat] | None = None
    for flat in flats:
        if (~hot).sum() < 3:
            continue
        score = relative_noise(flat, ~hot)
        if isfinite(score) and (best is None or score < best[0]):
            best = (score, flat)
    if best is None:
        return None
    _, flat = best
    prnu, shading = _of_good(flat, ~hot)
    return Pattern(prnu, _of_all(flat, ~hot), hot, rule, shading)


def _of_all(flat: Flat, good: Array) -> Value:
    """Return the spread of all pixels about the smooth surface of the good ones, relative to their light."""
    basis = surface(flat.raw.shape, int(good.sum()))
    fitted = smooth_part(basis, flat.raw.ravel(), good.ravel())
    residual = flat.raw.ravel() - fitted
    square = float(residual.var(ddof=basis.shape[1]))
    noise = float(flat.noise.mean())
    of_square = float(np.var((residual - residual.mean()) ** 2)) / residual.size
    lever = noise / relative_noise(flat, good) if noise > 0 else float(np.mean(fitted - flat.codes[0])) ** 2
    low, high = (max(v, 0.0) / lever for v in difference_interval(square, of_square, noise, 0.0))
    found = max(square - noise, 0.0) / lever
    return Value(sqrt(found), sqrt(low), sqrt(high), "of the signal", "spread of all pixels' means, hot ones included")


def _of_good(flat: Flat, good: Array) -> tuple[Value, float]:
    """Return the PRNU of the good pixels with its interval, and the rms of the shading."""
    basis = surface(flat.mean.shape, int(good.sum()))[good.ravel()]
    level = flat.mean[good]
    noise = flat.noise[good]
    model = _Model(flat)
    weights = np.ones_like(level)
    s = 0.1
    for _ in range(4):
        root = np.sqrt(weights)
        orthonormal, _ = np.linalg.qr(basis * root[:, None])
        # A fitted surface follows its pixels a little: residuals are (1 - leverage) of the variance too small.
        leverage = np.minimum((orthonormal**2).sum(axis=1), 0.99)
        fitted = (orthonormal @ (orthonormal.T @ (root * level))) / root
        squares = (level - fitted) ** 2 / (1 - leverage)
        share = np.maximum(fitted - flat.codes[0], 1e-12)
        even = float(noise.mean()) * share / float(share.mean())  # smooth, because each pixel's estimate would bias
        shape = np.maximum(model.variance(fitted, max(s, 0.01)), 1e-30)
        total = shape + even
        # Weights of a maximum of the normal likelihood in s: what PRNU adds to the variance, over the variance squared.
        gain = shape / total**2
        observed = float(gain @ squares)
        explained = float(gain @ noise)
        s = model.inverse(fitted, gain, observed - explained)
        weights = 1 / (np.maximum(model.variance(fitted, max(s, 0.01)), 1e-30) + even)
        weights /= weights.mean()
    n, terms = basis.shape
    # Variances of variances need the fourth moment; of a normal sample it scatters by root(24 / n).
    kurtosis = float(np.mean((squares / total) ** 2) / np.mean(squares / total) ** 2) - 3
    excess = kurtosis if kurtosis > 2 * sqrt(24 / n) else 0.0
    of_observed = (2 + excess) * float(gain**2 @ total**2) * (observed / float(gain @ total)) ** 2 * n / (n - terms)
    of_explained = float(gain**2 @ even**2) * float(np.var(noise / even)) if explained > 0 else 0.0
    low, high = difference_interval(observed, of_observed, explained, of_explained)
    ends = [model.inverse(fitted, gain, value) for value in (low, high)]
    light = np.interp(fitted, flat.codes, flat.light)
    shading = float(light.std() / max(float(light.mean()), 1e-12))
    return Value(s, ends[0], max(ends[1], s), "of the signal", "spread of pixel means"), shading


def difference_interval(first: float, of_first: float, second: float, of_second: float) -> tuple[float, float]:
    """Return the 95 % interval of a difference of two variance estimates; `of_...` are their variances."""

    def reach(value: float, variance: float) -> tuple[float, float]:
        """Return how far the true value may lie below and above by chi-square, relative."""
        if variance <= 0 or value <= 0:
            return 0.0, 0.0
        # Satterthwaite's degrees of freedom: those of a chi-square of the same mean and variance.
        freedom = max(2 * value**2 / variance, 1.0)
        return 1 - freedom / chi2_quantile(0.975, freedom), freedom / chi2_quantile(0.025, freedom) - 1

    down, up = reach(first, of_first)
    down_noise, up_noise = reach(second, of_second)
    low = first - second - sqrt((down * first) ** 2 + (up_noise * second) ** 2)
    most = max(first, second)  # the upper end is at least that of data without any pattern
    return low, most - second + sqrt((up * most) ** 2 + (down_noise * second) ** 2)


class _Model:
    """Variance between pixels of one expected code that a PRNU causes, from the response curve."""

    def __init__(self, flat: Flat) -> None:
        self.light = flat.light
        self.codes = flat.codes
        self.grid = np.linspace(0, np.sqrt(flat.light[-1] / WIDEST), 400) ** 2

    def variance(self, expected: Array, s: float) -> Array:
        """Return the variance between pixels [N], codes^2, at expected codes [N] for a PRNU `s`."""
        # A pixel of relative sensitivity 1 + s z at each light: nine of them stand for the normal law of z.
        light = self.grid[:, None] * np.maximum(1 + s * NODES, 0)
        codes = np.interp(light, self.light, self.codes)
        mean = codes @ WEIGHTS
        return np.interp(expected, mean, np.maximum(codes**2 @ WEIGHTS - mean**2, 0))

    def inverse(self, expected: Array, gain: Array, wanted: float) -> float:
        """Return the PRNU, 0 ... STEEPEST, at which the sum of gain x variance is `wanted`."""
        if wanted <= 0:
            return 0.0
        edges = np.linspace(float(expected.min()), float(expected.max()), 65)
        place = np.clip(np.searchsorted(edges, expected) - 1, 0, 63)
        middles = (edges[1:] + edges[:-1]) / 2
        sums = np.bincount(place, gain, 64)
        steps = np.linspace(0, sqrt(STEEPEST), 41) ** 2
        table = np.array([float(sums @ self.variance(middles, s)) for s in steps])
        end = int(np.argmax(table)) + 1
        return float(np.sqrt(np.interp(wanted, table[:end], steps[:end] ** 2)))

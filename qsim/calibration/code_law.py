"""Evaluates the distribution of a camera's codes, in bins, with its derivatives.

    code = clip(round(gain (N + read_noise z) + offset)),   N ~ Poisson(m),   m normal with variance `spread`

Two forms: the exact sum over electrons, and an Edgeworth series for light so bright that no electron shows. `spread` is
the variance of the expected electrons within a row, by fixed pattern and drift. It is an unbiased estimate and may
therefore be negative.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor, pi, sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.prnu import normal_nodes

REACH = 8.5  # standard deviations of the sum over electrons: 1e-17 is left out
MOST = 1000.0  # e-; brighter rows take the series, however it is asked for
FLOOR = 1e-6  # share of codes that no model describes, spread over all bins
NODES, WEIGHTS = normal_nodes(7)
NARROW = 0.25  # of the variance in time: a smaller spread is averaged over three points
LEAST = -0.3  # of the variance in time: no spread lies below


@dataclass(frozen=True)
class Law:
    """P(bin) of rows [R, B] and its derivatives by ln gain, offset, ln read noise, mean and spread, each [R, B]."""

    shares: Array
    by_gain: Array
    by_offset: Array
    by_noise: Array
    by_mean: Array
    by_spread: Array


def code_law(
    edges: Array, gain: float, offset: float, noise: float, mean: Array, spread: Array, *, smooth: bool
) -> Law:
    """Return the law of rows with expected electrons `mean` [R] and variance `spread` [R] of the expectation.

    `edges` [B - 1] are the highest codes of all bins but the last. `smooth` takes the Edgeworth series, whose relative
    error is of order mean^-1.5.
    """
    at = (edges + 0.5 - offset) / gain
    spread = np.maximum(spread, LEAST * (mean + noise**2))
    series = np.full(len(mean), smooth) | (mean > MOST)
    if series.all() or not series.any():
        found = _edgeworth(at, noise, mean, spread) if series.any() else _summed(at, noise, mean, spread)
    else:
        found = np.empty((5, len(mean), len(at)))
        found[:, series] = _edgeworth(at, noise, mean[series], spread[series])
        found[:, ~series] = _summed(at, noise, mean[~series], spread[~series])
    below, by_at, by_noise, by_mean, by_spread = found
    shares = np.maximum(_bins(below, 1.0), 0.0)
    return Law(
        # One odd pixel in a bin of no probability would decide the whole fit.
        (1 - FLOOR) * shares + FLOOR / shares.shape[1],
        _bins(-by_at * at, 0.0),
        _bins(-by_at / gain, 0.0),
        _bins(by_noise * noise, 0.0),
        _bins(by_mean, 0.0),
        _bins(by_spread, 0.0),
    )


def _bins(cdf: Array, top: float) -> Array:
    """Return the differences of a cdf [R, B - 1] that ends at `top`: [R, B]."""
    return np.diff(cdf, axis=1, prepend=0.0, append=top)


def _summed(at: Array, noise: float, mean: Array, spread: Array) -> Array:
    """Return the cdf at electrons `at`, and its derivatives by `at`, noise, mean and spread: [5, R, B - 1]."""
    from scipy.special import ndtr

    wide = REACH * np.sqrt(mean + np.maximum(spread, 0)) + 10
    electrons = np.arange(max(floor(float((mean - wide).min())), 0), ceil(float((mean + wide).max())) + 1, dtype=float)
    weights, by_mean, by_spread = _electrons(electrons, noise, mean, spread)
    window = ceil(2 * REACH * noise) + 2
    if len(electrons) <= 2 * window:
        z = (at - electrons[:, None]) / noise
        phi = ndtr(z)
        density = np.exp(-0.5 * z * z) / (sqrt(2 * pi) * noise)
        by_noise = -(weights @ (z * density))
        return np.stack([weights @ phi, weights @ density, by_noise, by_mean @ phi, by_spread @ phi])
    # few electrons lie near a threshold; of those below it only the total counts
    first = np.clip(np.floor(at - REACH * noise - electrons[0]), 0, len(electrons) - window).astype(int)
    near = first[:, None] + np.arange(window)
    z = (at[:, None] - electrons[near]) / noise
    phi = ndtr(z)
    density = np.exp(-0.5 * z * z) / (sqrt(2 * pi) * noise)

    def below(mass: Array) -> Array:
        total = np.concatenate([np.zeros((len(mass), 1)), np.cumsum(mass, axis=1)], axis=1)
        return np.asarray(total[:, first] + np.einsum("rbw,bw->rb", mass[:, near], phi))

    nearby = weights[:, near]
    by_at = np.einsum("rbw,bw->rb", nearby, density)
    by_noise = -np.einsum("rbw,bw->rb", nearby, z * density)
    return np.stack([below(weights), by_at, by_noise, below(by_mean), below(by_spread)])


def _electrons(electrons: Array, noise: float, mean: Array, spread: Array) -> tuple[Array, Array, Array]:
    """Return P(electrons) [R, N] with the spread of its mean, and its derivatives by mean and spread."""
    from scipy.special import gammaln

    variance = mean + noise**2
    wide = spread > NARROW * variance
    # three points at a fixed distance have any small variance, also a negative one
    step = np.minimum(np.sqrt(3 * np.maximum(spread, 0.1 * variance)), 0.9 * mean)
    step = np.maximum(step, 1e-9)
    # Weights of three points -d, 0, d with a variance of `spread`: share / 2 at each end.
    share = spread / step**2
    nodes = np.zeros((len(NODES), len(mean)))
    weight = np.zeros_like(nodes)
    nodes[:3] = np.array([[-1.0], [0.0], [1.0]]) * step
    weight[:3] = np.array([share / 2, 1 - share, share / 2])
    deviation = np.sqrt(np.maximum(spread, 0.0))
    nodes[:, wide] = NODES[:, None] * deviation[wide]
    weight[:, wide] = WEIGHTS[:, None]
    used = len(NODES) if wide.any() else 3
    rates = np.maximum(mean + nodes[:used], 1e-12)
    log_mass = electrons * np.log(rates)[:, :, None] - rates[:, :, None] - gammaln(electrons + 1)
    mass = np.exp(log_mass)
    slope = np.diff(mass, axis=2, prepend=0.0)  # d/dm of P(n) is P(n - 1) - P(n)
    slope = -slope
    total = np.einsum("kr,krn->rn", weight[:used], mass)
    by_mean = np.einsum("kr,krn->rn", weight[:used], slope)
    by_share = (mass[0] + mass[2] - 2 * mass[1]) / (2 * step**2)[:, None]
    if wide.any():
        # A node moves with the root of the spread: d(node) / d(spread) = NODES / (2 deviation).
        turn = NODES[:, None] / np.maximum(2 * deviation, 1e-12) * WEIGHTS[:, None]
        by_share[wide] = np.einsum("kr,krn->rn", turn[:, wide], slope[:, wide])
    return total, by_mean, by_share


def _edgeworth(at: Array, noise: float, mean: Array, spread: Array) -> Array:
    """Return the same as `_summed` by an Edgeworth series with skewness and kurtosis of the Poisson part."""

    def cdf(shift: Array | float, variance: Array) -> Array:
        from scipy.special import ndtr

        deviation = np.sqrt(variance)
        skew = mean / deviation**3
        kurtosis = mean / deviation**4
        y = (at - (mean + shift)[:, None]) / deviation[:, None]
        # Edgeworth's series in Hermite polynomials, to the second power of the skewness.
        series = skew[:, None] / 6 * (y**2 - 1) + kurtosis[:, None] / 24 * (y**3 - 3 * y)
        series += skew[:, None] ** 2 / 72 * (y**5 - 10 * y**3 + 15 * y)
        return ndtr(y) - np.exp(-0.5 * y * y) / sqrt(2 * pi) * series

    variance = mean + noise**2 + spread
    by_shift = 1e-4 * np.sqrt(variance)
    by_variance = 1e-4 * variance
    # Derivatives by central differences, exact to 1e-8 relative: enough for scores, whose zero decides.
    slope = (cdf(by_shift, variance) - cdf(-by_shift, variance)) / (2 * by_shift[:, None])
    wider = (cdf(0.0, variance + by_variance) - cdf(0.0, variance - by_variance)) / (2 * by_variance[:, None])
    return np.stack([cdf(0.0, variance), -slope, 2 * noise * wider, slope + wider, wider])

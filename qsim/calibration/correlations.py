"""Measures afterpulsing and crosstalk of a SPAD array from correlations between frames and between neighbours.

Counts: Cov(x_t, x_t+1) = a Var(x).  Planes: P(1 | 1 before) - P(1 | 0 before) = a (1 - P(1 | 0 before)).
Two neighbours i and j: counts Cov(x_i, x_j) = c (Var_i + Var_j), planes (1 - q_i)(1 - q_j) c (f_i + f_j), f being the
planes that fired before crosstalk. Light that drifts by 1 % adds less than 1e-5 to both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.frame_statistics import FrameStatistics
from qsim.calibration.results import Value, normal_interval
from qsim.calibration.spad_response import NEIGHBOURS, Response

LARGEST = 0.5  # of either probability
_LEAST = 1e-6


@dataclass(frozen=True)
class Chance:
    """A probability, estimated without a bound, and its variance; not measured where the variance is None."""

    value: float = 0.0
    variance: float | None = None

    @property
    def sigma(self) -> float:
        return 0.0 if self.variance is None else float(np.sqrt(self.variance))


@dataclass(frozen=True)
class Correlations:
    """Afterpulsing per detection and crosstalk per neighbour."""

    afterpulsing: Chance
    crosstalk: Chance

    def values(self) -> dict[str, Value]:
        """Return the measured ones of both, each at least 0."""
        found = {}
        for name, chance, unit, method in (
            ("afterpulsing", self.afterpulsing, "per count, next frame", "lag-1 correlation"),
            ("crosstalk", self.crosstalk, "per neighbour of four", "correlation of neighbouring pixels"),
        ):
            if chance.variance is not None:
                found[name] = normal_interval(chance.value, chance.variance, unit, method, floor=0.0)
        if "crosstalk" in found:
            one = found["crosstalk"]
            # The chance that any of the four neighbours fires, independently of each other.
            value, low, high = (1 - (1 - c) ** NEIGHBOURS for c in (one.value, one.low, one.high))
            found["crosstalk_total"] = Value(value, low, high, "to any of four neighbours", "as data sheets state it")
        return found


def measure_correlations(stacks: Sequence[FrameStatistics], bits: int) -> Correlations:
    """Return afterpulsing and crosstalk from all stacks; sums of planes and one or two frames tell neither."""
    after = Chance()
    cross = Chance()
    for _ in range(3):  # each changes the other a little
        after = _combined([_afterpulsing(stack, bits, after.value) for stack in stacks])
        cross = _combined([_crosstalk(stack, bits, cross.value) for stack in stacks])
    return Correlations(after, cross)


@dataclass(frozen=True)
class _Pairs:
    """Summed covariance of the pairs of one stack: its value is `expected` times the probability."""

    covariance: float
    expected: float
    noise: float  # variance of `covariance` without any
    per_event: float  # what one event of the effect adds to `covariance`


def _combined(pairs: Sequence[_Pairs | None]) -> Chance:
    """Return the weighted mean of the stacks' estimates.

    The variance counts one event more than expected: a stack of few counts cannot show that there are none.
    """
    used = [one for one in pairs if one is not None and one.expected > 0]
    if not used:
        return Chance()
    covariance, expected, noise, unit = np.array([[p.covariance, p.expected, p.noise, p.per_event] for p in used]).T
    value = 0.0
    variances = np.ones(len(used))
    for _ in range(10):  # the variances depend on the value
        events = max(value, 0.0) * expected / unit + 1
        variances = (noise + events * unit**2) / expected**2
        value = float(np.clip(np.average(covariance / expected, weights=1 / variances), -LARGEST, LARGEST))
    return Chance(value, 1 / float((1 / variances).sum()))


def _afterpulsing(stack: FrameStatistics, bits: int, value: float) -> _Pairs | None:
    """Return the covariance of neighbouring frames.

    Fitting the mean of T frames leaves the share `kept` of a small correlation, and as much of the variance 1/(T - 1)
    of one pixel.
    """
    t = stack.frames
    variance = stack.pixel_variance
    if t < 3 or not np.isfinite(stack.lagged).all() or not variance.any():
        return None
    mean = stack.total / t
    # Sum of (x_t - m)(x_(t+1) - m) from running sums: frames need not be kept.
    products = stack.lagged - mean * (2 * stack.total - stack.first - stack.last) + (t - 1) * mean**2
    # The fitted mean is common to both factors and takes 1 / T of the variance off: it is added again.
    covariance = float((products / (t - 1) + variance / t).sum())
    kept = (t - 2) ** 2 * (t + 1) / (t**2 * (t - 1))
    room = _room(stack, bits, value)
    square = _mean_square(variance, t)
    expected = float((variance * room).sum()) * kept
    return _Pairs(covariance, expected, stack.pixels * square * kept / (t - 1), float(room.mean()) / (t - 1))


def _mean_square(variance: Array, frames: int) -> float:
    """Return the mean square of the pixels' variances, without the noise of the estimates."""
    mean = float(variance.mean())
    # The estimate s^2 scatters by itself by 2 s^4 / (T - 1) and the fourth
    # cumulant over T, which for Poisson counts is the mean.
    square = (float((variance**2).mean()) - mean / frames) * (frames - 1) / (frames + 1)
    return max(square, mean**2)


def _room(stack: FrameStatistics, bits: int, afterpulsing: float) -> Array:
    """Return the share of afterpulses that show in a code [H, W]: those of planes that had not fired."""
    if bits > 1:
        return np.full(stack.total.shape, _shown(stack))
    mean = stack.total / stack.frames
    return np.asarray((1 - mean) / (1 - afterpulsing * mean))


def _shown(stack: FrameStatistics) -> float:
    """Return the covariance of clipped counts that one count of its cause gives, over their variance.

    The cause N counts without limit, and the effect shows in codes c below the top: P(c < top) Cov(c, N) / Var(c). The
    counts that the top code hides are those of a Poisson law of the same mean code.
    """
    top = stack.histogram.size - 1
    full = float(stack.histogram[-1] / stack.histogram.sum())
    if full == 0:
        return 1.0
    ratio = 1 + (top - stack.mean) * full * _hidden(stack.mean, top) / max(stack.variance, 1e-12)
    return max((1 - full) * ratio, _LEAST)


def _hidden(mean: float, top: int) -> float:
    """Return the counts above `top` that a full code hides in the mean, of Poisson counts N of this mean code.

    E[N - top | N >= top] = x - top P(N > top) / P(N >= top) at x arrivals. These are upper tails of a Poisson law:
    where few codes are full, one minus the cdf is rounding alone. Below their smallest number the ratio has its limit
    for little light, x / (top + 1).
    """
    from scipy.special import pdtrc

    arrivals = np.linspace(0.0, 3.0 * np.sqrt(top + 1), 400)[1:] ** 2
    above = pdtrc(np.arange(top), arrivals[:, None])  # P(N > k)
    full = above[:, -1]
    ratio = np.divide(pdtrc(top, arrivals), full, out=arrivals / (top + 1), where=full > 1e-200)
    return float(np.interp(mean, above.sum(axis=1), arrivals - top * ratio))


def _crosstalk(stack: FrameStatistics, bits: int, value: float) -> _Pairs | None:
    """Return the covariance of neighbouring pixels."""
    t = stack.frames
    variance = stack.pixel_variance
    if stack.adjacent is None or t < 3 or not variance.any() or max(stack.total.shape) < 2:
        return None
    mean = stack.total / t
    covariance = 0.0
    expected = 0.0
    noise = 0.0
    if bits == 1:
        fired = Response(1, 0.0, False, stack.exposure, crosstalk=value).before_crosstalk(mean)
        room = 1 - mean
    else:
        fired = variance / (1 + NEIGHBOURS * max(value, 0.0))
        room = np.full_like(mean, np.sqrt(_shown(stack)))
    for products, first, second in (
        (stack.adjacent[0, :-1], np.s_[:-1, :], np.s_[1:, :]),
        (stack.adjacent[1, :, :-1], np.s_[:, :-1], np.s_[:, 1:]),
    ):
        covariance += float((products - t * mean[first] * mean[second]).sum()) / (t - 1)
        expected += float((room[first] * room[second] * (fired[first] + fired[second])).sum())
        noise += float((variance[first] * variance[second]).sum()) / (t - 1)
    return _Pairs(covariance, expected, noise, float(room.mean()) ** 2 / (t - 1))

"""Estimates light from the few codes of a histogram that occur, by maximum likelihood, without tables of all codes.

The log-likelihood of a QIS below its full well is concave in the light: given the codes, the electrons are ultra
log-concave, so that their variance is at most their mean, and d^2 log P / dmean^2 = (Var - E) / mean^2. The root of its
derivative is therefore the one maximum. Beyond the full well it levels out, which may be higher (`Estimate`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import inf, log
from statistics import NormalDist

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.distribution import Distribution

_DOUBLINGS = 60  # of light, within which a sensor saturates
_LEAST = 1e-12  # arrivals that stand for darkness in derivatives
_PRECISION = 1e-13  # of roots, relative
_DARKEST = 1e-9  # arrivals that stand for none, where slopes are 0 over 0
_LEVEL = 1e-6  # of a log-likelihood: what rises by less has levelled out


class Impossible(ValueError):
    """A code of the histogram has probability 0 in any light."""

    def __init__(self, code: int) -> None:
        super().__init__(f"code {code}")
        self.code = code


@dataclass(frozen=True)
class _Codes:
    """The codes of a histogram and how often each occurred, as a function of the arrivals."""

    sensor: Distribution
    exposure: float
    codes: Array
    counts: Array

    def value(self, arrivals: float) -> float:
        """Return the log-likelihood."""
        return float(self.counts @ self._law(arrivals)[0])

    def score(self, arrivals: float) -> float:
        """Return its derivative by the arrivals; where a code is impossible, more light is better."""
        logs, slopes = self._law(arrivals)
        return inf if np.isneginf(logs).any() else float(self.counts @ slopes)

    def _law(self, arrivals: float) -> tuple[Array, Array]:
        return self.sensor.code_laws(self.codes, max(arrivals, _LEAST), self.exposure)


@lru_cache(maxsize=32)
def _saturated(sensor: Distribution, exposure: float) -> float:
    """Return arrivals from which the code has its final distribution."""
    end = sensor.white(exposure) * sensor.efficiency + sensor.dark_rate * exposure
    # Light is doubled until neither mean nor variance of the code changes any more.
    precision = 1e-15 * sensor.levels
    for _ in range(_DOUBLINGS):
        mean, variance = sensor.moments_of(np.array([0.0, end, 2 * end]), exposure)
        changed = abs(mean[2] - mean[1]) > precision or abs(variance[2] - variance[1]) > 1e-14 * (1 + variance[1])
        if not changed and mean[1] != mean[0]:
            break
        end *= 2
    return float(end)


def estimate(sensor: Distribution, exposure: float, histogram: Array, confidence: float) -> tuple[float, float, float]:
    """Return photons, lower and upper bound (`Estimate`) of one histogram [levels]."""
    codes = np.flatnonzero(histogram)
    likelihood = _Codes(sensor, exposure, codes, histogram[codes])
    dark = max(sensor.dark_rate * exposure, _DARKEST)
    end = _saturated(sensor, exposure)
    for code in _impossible(likelihood, dark, end):
        raise Impossible(code)
    best, one_sided = _highest(likelihood, dark, end)
    peak = likelihood.value(best)
    # Wilks: twice the fall of the log-likelihood is chi-square with one degree of freedom. At an end
    # the bound is the light that would give such codes with the chance 1 - confidence.
    fall = -log(1 - confidence) if one_sided else NormalDist().inv_cdf((1 + confidence) / 2) ** 2 / 2
    bright = best == end
    lower = dark if best == dark else _crossing(likelihood, peak - fall, best, dark, end)
    upper = inf if bright else _crossing(likelihood, peak - fall, best, inf, end)
    # Ever likelier with light: the estimate is where the likelihood is half of its limit (`Estimate`).
    if bright:
        best = _crossing(likelihood, peak - log(2), best, dark, end)

    def photons(arrivals: float) -> float:
        if arrivals == dark:
            return 0.0
        return (arrivals - sensor.dark_rate * exposure) / sensor.efficiency

    return photons(best), photons(lower), photons(upper)


def _impossible(likelihood: _Codes, dark: float, end: float) -> list[int]:
    middle = _typical(likelihood, dark, end)
    at = [likelihood.sensor.code_laws(likelihood.codes, light, likelihood.exposure)[0] for light in (middle, end)]
    return [int(code) for code in likelihood.codes[np.isneginf(at).all(axis=0)]]


def _highest(likelihood: _Codes, dark: float, end: float) -> tuple[float, bool]:
    """Return the arrivals of the highest likelihood, and whether that is at an end: in darkness or saturation."""
    if likelihood.score(dark) <= 0:
        return dark, True
    middle = _typical(likelihood, dark, end)
    low = high = middle
    factor = 1.1
    while low > dark and likelihood.score(low) < 0:
        low = max(dark, low / factor)
        factor = factor**2
    factor = 1.1
    while high < end and likelihood.score(high) > 0:
        high = min(end, high * factor)
        factor = factor**2
    if high == end and likelihood.score(end) >= 0:
        return end, True
    best = _root(likelihood.score, low, high)
    # Behind the full well the likelihood may rise again, to its value in all brighter light.
    if likelihood.value(end) >= likelihood.value(best) - _LEVEL:
        return end, True
    return best, False


def _typical(likelihood: _Codes, dark: float, end: float) -> float:
    """Return about the arrivals of the mean code, to begin at."""
    sensor = likelihood.sensor
    exposure = likelihood.exposure
    light = np.append(dark, np.geomspace(max(dark, 1e-3), max(end, 2e-3), 256))
    # A mean that falls again, of a paralyzable pixel, is kept level: only the rising branch is an answer.
    mean = np.maximum.accumulate(sensor.moments_of(light, exposure)[0])
    code = likelihood.counts @ likelihood.codes / likelihood.counts.sum()
    return float(np.clip(np.interp(code, mean, light), dark, end))


def _crossing(likelihood: _Codes, target: float, best: float, limit: float, end: float) -> float:
    """Return where the log-likelihood falls to `target` between `best` and `limit`; the limit if it does not."""
    down = limit < best
    inner = best
    factor = 1.05
    while True:
        outer = max(limit, inner / factor) if down else min(inner * factor, max(end, inner))
        if likelihood.value(outer) < target:
            break
        if outer in (limit, inner):
            return limit
        inner = outer
        factor = factor**2
    return _root(lambda x: likelihood.value(x) - target, outer, inner)


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    from scipy.optimize import brentq

    def bounded(x: float) -> float:
        return float(np.clip(function(x), -1e300, 1e300))

    if bounded(low) * bounded(high) >= 0:
        return low if abs(bounded(low)) < abs(bounded(high)) else high
    return float(brentq(bounded, low, high, xtol=1e-300, rtol=_PRECISION))

"""Estimates light from codes: the response of a sensor and its inverse, and maximum likelihood, for any sensor.

A sensor is read only through its exact law (distribution.py). A grid of light levels from 0 to saturation brackets
every answer; exact evaluations refine it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import log
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.host import own_numbers
from qsim.sensor import code_likelihood
from qsim.sensor.distribution import Distribution

# of the grid: linear interpolation between its points is good to 4e-5
_DECADES = 8
_PER_DECADE = 128
_FLAT = 1e-14  # change of the cdf per doubling of light, below which a sensor counts as saturated
_DOUBLINGS = 44  # of light: within these a sensor saturates, or its mean code stops rising
_NEVER = -1e290  # replaces log 0 where it may be multiplied by 0
POINTS = 4096  # of a response; linear interpolation then errs by less than 1e-6 of the full scale
_ENDED = 1e-7  # a response this close to its top (relative to the full scale) has ended
_TOGETHER = 1 << 22  # probabilities of a response held at a time
_STEPS = 200  # of root finding; 10 are usual
_HUGE = 1e300  # replaces infinity in root finding
_CHUNK = 1 << 12  # different histograms at a time
_TOO_DARK = "{}: dark counts alone exceed the light above which the mean code falls"
_IMPOSSIBLE = "histogram{} contains code {}, which has probability 0 at every light level for {!r}"


@own_numbers
@dataclass(frozen=True)
class Response:
    """Exact mean and variance of one code over a grid of photons, evenly spaced in sqrt(photons), rising in mean."""

    photons: Array  # [G], expected photons per pixel and exposure, from 0
    mean: Array  # [G], codes, strictly rising
    variance: Array  # [G], codes^2
    top: int  # the largest code of the sensor
    sensor: str  # its parameters, for messages

    def highest(self, samples: Any) -> Any:
        """Return the mean code to which estimates from `samples` codes go at most: half a count below saturation.

        `samples` may be an array of any library.
        """
        return float(self.mean[-1]) - 0.5 / samples

    @property
    def fewest(self) -> float:
        """Number of codes whose mean resolves half of the response."""
        return float(1 / (self.mean[-1] - self.mean[0]))

    def cap(self, samples: float) -> float:
        """Return the largest estimate [photons] from the mean of `samples` codes: half a count below saturation.

        `ValueError` unless `samples` is above 0, and if the mean of this many codes does not resolve the response.
        """
        if not samples > 0:
            raise ValueError(f"samples is a number of codes above 0, got {samples!r}")
        highest = self.highest(samples)
        if highest <= self.mean[0]:
            raise ValueError(
                f"{self.sensor}: its mean code rises from {self.mean[0]:.4g} in the dark to {self.mean[-1]:.4g} at "
                f"{self.photons[-1]:.4g} photons, which the mean of {samples:g} codes does not resolve; use a longer "
                "window, or the method naive"
            )
        return float(np.interp(highest, self.mean, self.photons))

    def invert(self, mean_code: Array, samples: float | Array) -> Array:
        """Return photons [...] whose mean code is this: 0 below the mean of a dark pixel, cap(samples) at saturation.

        `samples` may differ from pixel to pixel. `ValueError` as for `cap`, of the fewest of them.
        """
        samples = np.asarray(samples, np.float64)
        if samples.size:
            self.cap(float(samples.min()))
        return np.interp(np.minimum(mean_code, self.highest(samples)), self.mean, self.photons)


@dataclass(frozen=True)
class Estimate:
    """Light from codes; arrays [...] in photons.

    Two ends are special. A histogram that is likeliest in the dark has photons = lower = 0 and a one-sided `upper`.
    A histogram that gets ever likelier with light (all codes saturated) has `upper` infinite and a one-sided `lower`.
    Its `photons` is the light of half the final likelihood: for n saturated codes, P(saturated)^n = 1/2.
    """

    photons: Array
    lower: Array
    upper: Array


@dataclass(frozen=True)
class _Grid:
    photons: Array  # [G]
    log_pmf: Array  # [G, levels]
    saturates: bool  # at the end of the grid the code has its final distribution


@lru_cache(maxsize=32)
def _grid(sensor: Distribution, exposure: float) -> _Grid:
    end = sensor.white(exposure)
    brightest = sensor.brightest(exposure)
    if brightest <= 0:
        raise ValueError(_TOO_DARK.format(type(sensor).__name__))
    dark = sensor.cdf(np.array([0.0]), exposure)
    for _ in range(_DOUBLINGS):
        if 2 * end >= brightest:
            break
        here, there = sensor.cdf(np.array([end, 2 * end]), exposure)
        if np.ptp([here, there], axis=0).max() <= _FLAT < np.abs(here - dark).max():  # a high threshold starts flat
            break
        end *= 2
    else:
        end = sensor.white(exposure)  # no light changes its codes
    saturates = 2 * end < brightest
    end = end if saturates else brightest
    photons = np.append(0.0, np.geomspace(end * 10.0**-_DECADES, end, _DECADES * _PER_DECADE + 1))
    return _Grid(photons, np.maximum(sensor.log_pmf(photons, exposure), _NEVER), saturates)


def _end_of_rise(sensor: Distribution, exposure: float) -> float:
    """Return the photons at which the mean code stops rising: at the top code, or before (full well, dead time).

    `ValueError` for a sensor whose mean code does not rise from darkness.
    """
    top = sensor.levels - 1
    limit = sensor.brightest(exposure)

    def mean_at(photons: float) -> float:
        return float(sensor.mean(np.array([photons]), exposure)[0])

    dark = mean_at(0.0)
    photons = sensor.white(exposure) / 16
    here = mean_at(photons) if photons < limit else dark
    for _ in range(_DOUBLINGS):  # one by one: the brightest light takes the longest tables
        if 2 * photons >= limit:
            if mean_at(max(limit, 0.0)) > dark:
                return limit
            break
        there = mean_at(2 * photons)
        risen = here - dark > _ENDED * top  # a high threshold keeps codes dark for long
        if top - here < _ENDED * top or (risen and there - here < _ENDED * top):
            if here > dark:
                return photons
            break
        photons = 2 * photons
        here = there
    raise ValueError(f"{sensor}: its mean code is {dark:.4g} in the dark and does not rise with light")


def pieces(photons: Array, values: int) -> list[Array]:
    """Split photons [p] into pieces whose distributions, of this many values each, fit into memory together."""
    return np.array_split(photons, -(-len(photons) * values // _TOGETHER))


def response(sensor: Distribution, exposure: float, points: int = POINTS) -> Response:
    """Tabulate a sensor's response from darkness to the end of its rise, at `points` levels of light.

    Where the response falls again (a paralyzable counter) the table holds its rising branch only. `ValueError` for a
    sensor whose mean code does not rise.
    """
    # Shot noise grows with the root of the light: even steps of the root resolve each level alike.
    photons = np.linspace(0, np.sqrt(_end_of_rise(sensor, exposure)), points) ** 2
    mean, variance = sensor.moments(photons, exposure)
    rising = np.concatenate([[True], mean[1:] > np.maximum.accumulate(mean)[:-1]])
    return Response(photons[rising], mean[rising], variance[rising], sensor.levels - 1, str(sensor))


def maximum_likelihood(sensor: Distribution, histogram: Array, exposure: float, confidence: float = 0.95) -> Estimate:
    """See `Sensor.maximum_likelihood`."""
    counts = _checked(sensor, histogram)
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is a probability above 0 and below 1, got {confidence!r}")
    if sensor.many_codes:
        return _one_by_one(sensor, counts, exposure, confidence)
    _refuse_impossible(sensor, exposure, counts)
    distinct, where = np.unique(counts.reshape(-1, sensor.levels), axis=0, return_inverse=True)
    grid = _grid(sensor, exposure)
    parts = []
    for start in range(0, len(distinct), _CHUNK):
        likelihood = _Likelihood(sensor, exposure, distinct[start : start + _CHUNK])
        parts.append(_estimate(likelihood, grid, confidence))
    found = np.concatenate(parts, axis=1)[:, where.ravel()] if parts else np.zeros((3, 0))
    return Estimate(*found.reshape(3, *counts.shape[:-1]))


def _one_by_one(sensor: Distribution, counts: Array, exposure: float, confidence: float) -> Estimate:
    """Return the estimates of histograms of so many codes that only those that occur are looked at."""
    if sensor.brightest(exposure) <= 0:
        raise ValueError(_TOO_DARK.format(type(sensor).__name__))
    rows = counts.reshape(-1, sensor.levels)
    known: dict[bytes, tuple[float, float, float]] = {}
    found = np.empty((3, len(rows)))
    for i, row in enumerate(rows):
        name = row.tobytes()
        if name not in known:
            try:
                known[name] = code_likelihood.estimate(sensor, exposure, row, confidence)
            except code_likelihood.Impossible as error:
                at = [int(n) for n in np.unravel_index(i, counts.shape[:-1])]
                raise ValueError(_IMPOSSIBLE.format(at or "", error.code, sensor)) from None
        found[:, i] = known[name]
    return Estimate(*found.reshape(3, *counts.shape[:-1]))


def _checked(sensor: Distribution, histogram: Array) -> Array:
    counts = np.asarray(histogram, np.float64)
    if counts.ndim == 0 or counts.shape[-1] != sensor.levels:
        raise ValueError(f"histogram has the shape [..., {sensor.levels}], one bin per code; got {list(counts.shape)}")
    wrong = ~np.all(np.isfinite(counts) & (counts >= 0), axis=-1) | (counts.sum(axis=-1) <= 0)
    if wrong.any():
        where = [int(i) for i in np.argwhere(wrong)[0]]
        raise ValueError(
            f"histogram{where or ''} counts codes: finite, not negative, at least one; got {counts[wrong][0]}"
        )
    return counts


def _refuse_impossible(sensor: Distribution, exposure: float, counts: Array) -> None:
    impossible = (counts > 0) & (_grid(sensor, exposure).log_pmf <= _NEVER).all(axis=0)
    if impossible.any():
        *where, code = (int(i) for i in np.argwhere(impossible)[0])
        raise ValueError(_IMPOSSIBLE.format(where or "", code, sensor))


@dataclass(frozen=True)
class _Likelihood:
    """Histograms [h, levels] as functions of light.

    The methods take light levels [p] and the rows int [p] that they belong to, and return [p].
    """

    sensor: Distribution
    exposure: float
    counts: Array

    def value(self, photons: Array, rows: Array) -> Array:
        """Return the log-likelihood."""
        return (self.counts[rows] * self._log_pmf(photons, rows)).sum(axis=1)

    def score(self, photons: Array, rows: Array) -> Array:
        """Return the derivative of the log-likelihood by photons."""
        slope = np.diff(self.sensor.dcdf(photons, self.exposure), axis=-1, prepend=0.0)
        with np.errstate(over="ignore", invalid="ignore"):
            ratio = slope * np.exp(-self._log_pmf(photons, rows))
        # Codes that did not occur, or that light does not change, add nothing, though their logarithm is infinite.
        ratio[(slope == 0) | (self.counts[rows] == 0)] = 0.0
        return (self.counts[rows] * ratio).sum(axis=1)

    def _log_pmf(self, photons: Array, rows: Array) -> Array:
        return np.maximum(self.sensor.log_pmf(photons, self.exposure, self.counts[rows] > 0), _NEVER)


def _estimate(likelihood: _Likelihood, grid: _Grid, confidence: float) -> Array:
    """Return photons, lower and upper of every histogram: [3, h]."""
    table = likelihood.counts @ grid.log_pmf.T
    best = table.argmax(axis=1)
    end = len(grid.photons) - 1
    everything = np.arange(len(table))
    # Saturated codes level out: within 1e-6 of the end, more light is as likely. A rising
    # branch that ends earlier (dead time) is judged by the slope at its end.
    if grid.saturates:
        bright = table[:, end] >= table.max(axis=1) - 1e-6
    else:
        bright = best == end
        bright[bright] = likelihood.score(np.full(bright.sum(), grid.photons[end]), everything[bright]) >= 0
    dark = (best == 0) & ~bright
    dark[dark] = likelihood.score(np.zeros(dark.sum()), everything[dark]) <= 0
    inner = everything[~dark & ~bright]
    left, right = (grid.photons[np.clip(best[inner] + step, 0, end)] for step in (-1, 1))
    photons = np.where(bright, grid.photons[end], 0.0)
    photons[inner] = _root(likelihood.score, left, right, inner)
    peak = np.where(bright, table[:, end], likelihood.value(photons, everything))
    # Wilks' theorem for two sides; at an end, the chance of such codes itself.
    two_sided = -(NormalDist().inv_cdf((1 + confidence) / 2) ** 2) / 2
    level = peak + np.where(dark | bright, log(1 - confidence), two_sided)
    lower = _crossing(likelihood, grid, table, photons, level, -1)
    upper = _crossing(likelihood, grid, table, photons, level, +1)
    half = _crossing(likelihood, grid, table, photons, peak - log(2), -1)
    return np.stack([np.where(bright, half, photons), np.where(dark, 0.0, lower), np.where(bright, np.inf, upper)])


def _crossing(likelihood: _Likelihood, grid: _Grid, table: Array, start: Array, target: Array, direction: int) -> Array:
    """Return the light at which the log-likelihood first falls to `target` below (-1) or above (+1) `start`: [h].

    It is 0 or infinity if the likelihood does not fall that far.
    """
    photons = grid.photons
    size = len(grid.photons)
    # The grid brackets the crossing: its nearest point that is low enough, and the next one towards the maximum.
    low_enough = table < target[:, None]
    if direction < 0:
        there = low_enough & (photons <= start[:, None])
        outer = size - 1 - there[:, ::-1].argmax(axis=1)
        inner = np.minimum(photons[np.minimum(outer + 1, size - 1)], start)
    else:
        there = low_enough & (photons >= start[:, None])
        outer = there.argmax(axis=1)
        inner = np.maximum(photons[np.maximum(outer - 1, 0)], start)
    result = np.full(len(start), 0.0 if direction < 0 else np.inf)
    rows = np.flatnonzero(there.any(axis=1))
    ends = np.sort(np.stack([inner[rows], photons[outer[rows]]]), axis=0)
    result[rows] = _root(lambda x, r: direction * (likelihood.value(x, r) - target[r]), ends[0], ends[1], rows)
    return result


def _root(function: Callable[[Array, Array], Array], low: Array, high: Array, rows: Array) -> Array:
    """Return the zero of a function that falls from low to high, each row in its own bracket; else the nearer end."""
    from scipy.optimize.elementwise import find_root

    def bounded(x: Array, which: Array) -> Array:  # find_root stops at infinity and passes rows as floats
        found = function(x.ravel(), rows[which.ravel().astype(np.intp)]).reshape(x.shape)
        return np.nan_to_num(found, nan=-_HUGE, posinf=_HUGE, neginf=-_HUGE)

    which = np.arange(len(rows))
    f_low = bounded(low, which)
    f_high = bounded(high, which)
    # A function that keeps its sign has its zero outside: the bracket closes to its nearer end, and none is searched.
    first = np.where(f_high >= 0, high, low)
    last = np.where(f_low <= 0, low, high)
    open_ = first < last
    result = first.copy()
    if open_.any():
        tolerances = {"xrtol": 1e-13, "xatol": 0.0, "frtol": 0.0, "fatol": 0.0}
        bracket = (first[open_], last[open_])
        result[open_] = find_root(bounded, bracket, args=(which[open_],), tolerances=tolerances, maxiter=_STEPS).x
    return result

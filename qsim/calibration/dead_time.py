"""Measures the dead time of a counting SPAD from flat fields, or from any static scene.

    counts [T, H, W] of a static scene -> classes of pixels by their mean -> Fano factors -> dead time

In a static scene, classes of pixels with similar light replace flat fields. A class is chosen by the pixels' totals.
A total is independent of its spread over the frames (for Poisson counts, given the total, E[variance] = mean). The
choice therefore does not bias the Fano factor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.frame_statistics import FrameStatistics, alike, as_codes, measure
from qsim.calibration.quantiles import chi2_above
from qsim.calibration.results import Z95, Calibration, Value, normal_interval
from qsim.calibration.spad_response import Response

CLASSES = 8
LEAST_MEAN = 1.0  # counts; darker pixels hold no information about dead time
LEAST_PIXELS = 50  # in a class

_BLOCK = 1 << 22  # values that are checked at a time


@dataclass(frozen=True)
class Ratio:
    """Dead time in exposures, with a 95 % interval; `high` is infinite where the counts bound it on one side only."""

    value: float
    low: float
    high: float
    ceiling: float  # largest dead time with which light gives the flats' means

    @property
    def ends(self) -> tuple[float, float]:
        """The smallest and the largest dead time that may be."""
        return self.low, min(self.high, self.ceiling)


@dataclass(frozen=True)
class Pooled:
    """Moments of the good pixels of one flat."""

    mean: float  # codes
    variance: float  # codes^2, in time
    fixed_pattern: float  # codes^2, between the pixels' expected codes
    pixels: int
    frames: int
    exposure: float  # s

    @classmethod
    def of(cls, stack: FrameStatistics, good: Array | None = None) -> Pooled:
        """Return the moments of the pixels in `good`, bool [H, W]; None: of all."""
        kept = np.ones(stack.total.shape, bool) if good is None else good
        means = stack.total[kept] / stack.frames
        variance = float(stack.pixel_variance[kept].mean())
        pattern = float(means.var(ddof=1)) - variance / stack.frames if means.size > 1 else 0.0
        return cls(float(means.mean()), variance, pattern, means.size, stack.frames, stack.exposure)


def fitted_dead_time(flats: Sequence[Pooled], response: Response) -> Ratio | None:
    """Fit tau/T to the variance over time of every flat against its mean; None without a usable flat.

    The fit is a least squares on exact moments, with the afterpulses and crosstalk of `response`; its interval is that
    of the profile. `ValueError` if the flats have different exposures.
    """
    from scipy.optimize import brentq, minimize_scalar

    usable = [flat for flat in flats if flat.frames > 1 and flat.mean > 0]
    if not usable:
        return None
    if len({flat.exposure for flat in usable}) > 1:
        raise ValueError("calibrate: the flats have different exposures; give dead-time flats of one exposure")

    def residuals(ratio: float) -> Array:
        return fano_residuals(usable, replace(response, ratio=ratio))

    def misfit(ratio: float) -> float:
        return float((residuals(ratio) ** 2).sum())

    # A pixel counts at most about T/tau, or T/(e tau) if every arrival blocks it: the largest mean bounds the ratio.
    ceiling = min((0.45 if response.paralyzable else 0.9) / max(flat.mean for flat in usable), 2.0)
    # Near the bound no light gives the mean, and the misfit is flat: a local search starts from the best of a few.
    steps = ceiling * np.linspace(0, 1, 9) ** 2
    place = int(np.argmin([misfit(step) for step in steps]))
    bounds = (steps[max(place - 1, 0)], steps[min(place + 1, 8)])
    found = minimize_scalar(misfit, bounds=bounds, method="bounded", options={"xatol": 1e-9})
    ratio = float(found.x) if misfit(float(found.x)) < misfit(0.0) else 0.0
    if ratio > 0:
        ratio = _polished(ratio, residuals, bounds)
    limit = misfit(ratio) + Z95**2

    def edge(end: float) -> float | None:
        return float(brentq(lambda x: misfit(x) - limit, ratio, end, xtol=1e-10)) if misfit(end) > limit else None

    high = edge(ceiling)
    return Ratio(ratio, edge(0.0) or 0.0, inf if high is None else high, ceiling)


def _polished(ratio: float, residuals: Callable[[float], Array], bounds: tuple[float, float]) -> float:
    """Return where the slope of a least squares is 0, near its least value: by Gauss-Newton steps.

    The least value itself places the minimum only to the root of the rounding of the residuals. That is a thousandth
    of the standard error, and another one on each processor.
    """
    for _ in range(4):
        step = max(1e-3 * ratio, 1e-6)
        below = max(ratio - step, 0.0)  # a dead time is not negative
        slope = (residuals(ratio + step) - residuals(below)) / (ratio + step - below)
        change = float(slope @ residuals(ratio)) / max(float(slope @ slope), 1e-300)
        ratio = float(np.clip(ratio - change, *bounds))
    return ratio


def moved_ratio(flats: Sequence[Pooled], response: Response, moved: Response) -> float:
    """Return the dead time of the least squares for `moved`, near that of `response`, to first order."""
    step = max(1e-3 * response.ratio, 1e-5)
    base, by_ratio, by_move = (
        fano_residuals(flats, law) for law in (response, replace(response, ratio=response.ratio + step), moved)
    )
    slope = (by_ratio - base) / step
    change = -float(slope @ (by_move - base)) / max(float(slope @ slope), 1e-300)
    return float(np.clip(response.ratio + change, 0.0, 2 * response.ratio + step))


def fano_residuals(flats: Sequence[Pooled], response: Response) -> Array:
    """Return (observed variance - variance of dead-time pixels of the same mean) / sigma, [flat].

    The variance bends with the mean, so a spread of light between the pixels changes its average to second order.
    Sigma comes from the model's moments: those of the data would count the pattern of the pixels as noise.
    """
    mean, observed, pattern, pixels, frames = np.array(
        [(flat.mean, flat.variance, flat.fixed_pattern, flat.pixels, flat.frames) for flat in flats]
    ).T
    matched = matched_variance(mean, response)
    pmf = response.pmf(matched.arrivals)
    codes = np.arange(response.levels, dtype=float)
    centred = codes - (pmf @ codes)[:, None]
    third = (pmf * centred**3).sum(axis=1)
    fourth = (pmf * centred**4).sum(axis=1)
    v = np.maximum(matched.variance, 1e-12)
    # The variance of (s^2 - v(mean)): Var s^2 = (mu4 - v^2) / n, Var of the mean = v / n, and their covariance mu3 / n.
    noise = fourth - v**2 + matched.slope**2 * v - 2 * matched.slope * third
    # Jensen: E v(m) = v(E m) + v'' Var m / 2 over pixels of different means.
    expected = matched.variance + matched.bend / 2 * np.minimum(pattern, (mean / 2) ** 2)
    # Afterpulses vary the mean over the frames, which the variance about it leaves out.
    expected = expected * (1 - (response.excess(mean) - 1) / np.maximum(frames - 1, 1))
    return np.asarray((observed - expected) / np.sqrt(np.maximum(noise, 1e-12) / (pixels * (frames - 1))))


@dataclass(frozen=True, eq=False)
class Matched:
    """Arrivals and variance of counting pixels of given mean codes, and the variance's two derivatives by the mean."""

    arrivals: Array
    variance: Array
    slope: Array
    bend: Array


def matched_variance(mean: Array, response: Response) -> Matched:
    """Return the light and the variance of pixels of mean codes [p].

    Newton's method on the rising branch. If no light gives this mean, the variance is 0, which no data match.
    """
    # The inverse of the mean count without fluctuations: m / (1 - m tau / T).
    start = mean if response.paralyzable else mean / np.maximum(1 - mean * response.ratio, 0.2)
    arrivals = np.array(start, float)
    steep = np.ones(arrivals.shape, bool)
    for _ in range(40):
        h = 1e-4 * np.maximum(arrivals, 1e-4)
        below, at, above = response.mean(np.stack([arrivals - h, arrivals, arrivals + h]))
        slope = (above - below) / (2 * h)
        steep = slope >= 0.02  # else the mean is near its maximum or falls: no light gives it with this dead time
        step = np.clip((at - mean) / np.where(steep, slope, 1.0), -0.5 * arrivals - 0.1, 0.5 * arrivals)
        step = np.where(steep, step, 0.0)
        arrivals = arrivals - step
        if (np.abs(step) < 1e-9 * np.maximum(arrivals, 1e-6)).all():
            break
    h = 1e-3 * np.maximum(arrivals, 1e-4)
    near = np.concatenate([arrivals - h, arrivals, arrivals + h])
    variance, means = (values.reshape(3, -1) for values in (response.variance(near), response.mean(near)))
    rise = np.where(np.diff(means, axis=0) == 0, 1.0, np.diff(means, axis=0))
    before, after = np.diff(variance, axis=0) / rise
    whole = np.where(means[2] == means[0], 1.0, means[2] - means[0])
    found = (variance[1], (variance[2] - variance[0]) / whole, 2 * (after - before) / whole)
    return Matched(arrivals, *(np.where(steep, values, 0.0) for values in found))


def classes_of(
    counts: Array, *, bits: int, exposure: float, edges: Sequence[float] | None = None
) -> list[FrameStatistics]:
    """Group the pixels of counts [T, H, W] by their mean; return the statistics of each class.

    `edges` are the limits of the classes in counts (default: 8 steps of equal ratio). Small classes are left out.
    """
    mean = counts.mean(axis=0)
    if not edges:
        if not mean.max() > LEAST_MEAN:
            raise ValueError(f"calibrate: no pixel has a mean above {LEAST_MEAN:g} counts; more light is needed")
        edges = np.geomspace(LEAST_MEAN, float(mean.max()) * (1 + 1e-9), CLASSES + 1).tolist()
    chosen = [(mean >= low) & (mean < high) for low, high in pairwise(edges)]
    return [
        measure([counts[:, pixels][:, None, :]], bits=bits, exposure=exposure, photons=None)
        for pixels in chosen
        if pixels.sum() >= LEAST_PIXELS
    ]


def fano(stack: FrameStatistics) -> Value:
    """Return variance over mean in time with its 95 % interval.

    Its variance is 2 F^2 / n, exactly for Poisson counts; a dead time changes that by at most 0.25/mean above F = 0.25.
    """
    n = stack.pixels * (stack.frames - 1)
    value = stack.variance / stack.mean
    return normal_interval(value, 2 * value**2 / n, "variance / mean", f"{stack.pixels} pixels")


def calibrate_static(
    counts: Array,
    *,
    bits: int,
    exposure: float,
    edges: Sequence[float] | None = None,
    paralyzable: bool = False,
    name: str = "stack",
) -> Calibration:
    """Estimate the effective dead time [s] and the Fano factor of every class, from counts [T, H, W] of a static scene.

    `exposure` in seconds. `ValueError` for fewer than two frames, for frames that are all alike, if no class has enough
    pixels, and for values that are not codes (with `name`, frame and pixel). Light that changes gives a warning.
    """
    counts = np.asarray(counts)
    if counts.ndim != 3 or len(counts) < 2:
        raise ValueError(
            f"calibrate: a static scene is counts [T, H, W] of at least 2 frames, got {list(counts.shape)}"
        )
    step = max(1, _BLOCK // max(counts[0].size, 1))
    for start in range(0, len(counts), step):
        as_codes(counts[start : start + step], bits, name, start)
    stacks = classes_of(counts, bits=bits, exposure=exposure, edges=edges)
    if not stacks:
        raise ValueError(f"calibrate: no class of light has {LEAST_PIXELS} pixels; use a larger part of the scene")
    if all(alike(stack) for stack in stacks):
        raise ValueError(
            "calibrate: all frames are alike, which determines no dead time; are they copies of one, or saturated?"
        )
    pooled = [Pooled.of(stack) for stack in stacks]
    response = Response(bits, 0.0, paralyzable, exposure)
    found = fitted_dead_time(pooled, response)
    ratio = found.value if found else 0.0
    values = {f"fano_at_{stack.mean:.3g}": fano(stack) for stack in stacks}
    if found and found.high < inf:
        ends = (found.value * exposure, found.low * exposure, found.high * exposure)
        values["dead_time"] = Value(*ends, "s", "Fano factor against flux, static scene")
    residuals = fano_residuals(pooled, replace(response, ratio=ratio))
    p_value = _p_value(residuals, fitted=int(ratio > 0))
    warnings: tuple[str, ...] = ()
    if p_value < 1e-3:
        warnings = (f"the fitted dead time does not describe the counts (p = {p_value:.1g}): is the scene static?",)
    drawn = tuple(np.array([residual]) for residual in residuals)
    return Calibration("CountingSPAD", bits, values, p_value, warnings, drawn, paralyzable=paralyzable)


def _p_value(residuals: Array, fitted: int) -> float:
    """Return the chi-square p-value of the classes' variances against the curve; a dead time of 0 is not fitted."""
    freedom = len(residuals) - fitted
    return chi2_above(float((residuals**2).sum()), freedom) if freedom > 0 else float("nan")

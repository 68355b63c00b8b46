"""Measures the dead time of a counting SPAD from flat fields, or from any static scene.

    counts [T, H, W] of a static scene -> classes of pixels by their mean -> Fano factors -> dead time

In a static scene, classes of pixels with similar light replace flat fields. A class is chosen by the pixels' totals.
A total is independent of its spread over the frames (for Poisson counts, given the total, E[variance] = mean). The
choice therefore does not bias the Fano factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.frame_statistics import FrameStatistics, alike, as_codes, measure
from qsim.calibration.results import Calibration, Value, normal_interval
from qsim.sensor.counting import CountingSPAD

CLASSES = 8
LEAST_MEAN = 1.0  # counts; darker pixels hold no information about dead time
LEAST_PIXELS = 50  # in a class

_BLOCK = 1 << 22  # values that are checked at a time


@dataclass(frozen=True)
class Ratio:
    """Dead time in exposures, and its variance."""

    value: float
    variance: float


def fitted_dead_time(flats: Sequence[FrameStatistics], bits: int, paralyzable: bool) -> Ratio | None:
    """Fit tau/T to the variance over time of every flat against its mean; None without a usable flat.

    The fit is a weighted least squares on exact moments. `ValueError` if the flats have different exposures.
    """
    from scipy.optimize import minimize_scalar

    usable = [flat for flat in flats if flat.frames > 1 and flat.mean > 0]
    if not usable:
        return None
    if len({flat.exposure for flat in usable}) > 1:
        raise ValueError("calibrate: the flats have different exposures; give dead-time flats of one exposure")

    def misfit(ratio: float) -> float:
        return float(sum(r * r for r in _fano_residuals(usable, bits, ratio, paralyzable)))

    # A pixel counts at most about T/tau, or T/(e tau) if every arrival blocks it: the largest mean bounds the ratio.
    ceiling = min((0.45 if paralyzable else 0.9) / max(flat.mean for flat in usable), 2.0)
    found = minimize_scalar(misfit, bounds=(0.0, ceiling), method="bounded", options={"xatol": 1e-9})
    ratio = float(found.x) if misfit(float(found.x)) < misfit(0.0) else 0.0
    step = max(ratio * 1e-3, 1e-7)
    slope = [
        (a - b) / step
        for a, b in zip(
            _fano_residuals(usable, bits, ratio + step, paralyzable),
            _fano_residuals(usable, bits, ratio, paralyzable),
            strict=True,
        )
    ]
    return Ratio(ratio, 1 / max(float(np.dot(slope, slope)), 1e-300))


def _fano_residuals(flats: Sequence[FrameStatistics], bits: int, ratio: float, paralyzable: bool) -> list[float]:
    """Return (observed variance - variance of dead-time pixels of the same mean) / sigma, per flat.

    The variance bends with the mean, so a spread of light between the pixels changes its average to second order.
    Sigma comes from the model's moments: those of the data would count the pattern of the pixels as noise.
    """
    residuals = []
    codes = np.arange(1 << bits, dtype=float)
    sensor = CountingSPAD(1.0, 0.0, ratio, bits, paralyzable)
    for flat in flats:
        arrivals, expected, slope, bend = matched_variance(flat.mean, bits, ratio, paralyzable)
        pmf = np.exp(sensor.log_pmf(np.array(arrivals), 1.0))
        centred = codes - pmf @ codes
        third, fourth = float(pmf @ centred**3), float(pmf @ centred**4)
        v = max(expected, 1e-12)
        n = flat.pixels * (flat.frames - 1)
        noise = max(fourth - v**2 + slope**2 * v - 2 * slope * third, 1e-12) / n
        if flat.pixels > 1:
            expected += bend / 2 * min(flat.fixed_pattern, (flat.mean / 2) ** 2)
        residuals.append((flat.variance - expected) / sqrt(noise))
    return residuals


def matched_variance(mean: float, bits: int, ratio: float, paralyzable: bool) -> tuple[float, float, float, float]:
    """Return arrivals and variance of a counting pixel of this mean code, and the variance's two derivatives by it.

    tau/T = `ratio`. Newton's method on the rising branch. If no light gives this mean, the variance is 0, which no data
    match.
    """
    sensor = CountingSPAD(1.0, 0.0, ratio, bits, paralyzable)
    arrivals = mean
    for _ in range(40):
        at = np.array(arrivals)
        slope = -float(np.sum(sensor.dcdf(at, 1.0)[:-1]))
        excess = float(sensor.mean(at, 1.0)) - mean
        if slope < 0.02:  # the mean is near its maximum or falls: no light gives it with this dead time
            return arrivals, 0.0, 0.0, 0.0
        step = float(np.clip(excess / slope, -0.5 * arrivals - 0.1, 0.5 * arrivals))
        arrivals -= step
        if abs(step) < 1e-9 * max(arrivals, 1e-6):
            break
    h = 1e-3 * max(arrivals, 1e-4)
    at = np.array([arrivals - h, arrivals, arrivals + h])
    variance, means = sensor.variance(at, 1.0), sensor.mean(at, 1.0)
    below, above = np.diff(variance) / np.diff(means)
    bend = 2 * float(above - below) / float(means[2] - means[0])
    return arrivals, float(variance[1]), float((variance[2] - variance[0]) / (means[2] - means[0])), bend


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
    found = fitted_dead_time(stacks, bits, paralyzable)
    ratio = found.value if found else 0.0
    values = {f"fano_at_{stack.mean:.3g}": fano(stack) for stack in stacks}
    if found:
        method = "Fano factor against flux, static scene"
        values["dead_time"] = normal_interval(ratio * exposure, found.variance * exposure**2, "s", method, floor=0.0)
    residuals = _fano_residuals(stacks, bits, ratio, paralyzable)
    p_value = _p_value(residuals, fitted=int(ratio > 0))
    warnings: tuple[str, ...] = ()
    if p_value < 1e-3:
        warnings = (f"the fitted dead time does not describe the counts (p = {p_value:.1g}): is the scene static?",)
    drawn = tuple(np.array([residual]) for residual in residuals)
    return Calibration("CountingSPAD", bits, values, p_value, warnings, drawn, paralyzable=paralyzable)


def _p_value(residuals: Sequence[float], fitted: int) -> float:
    """Return the chi-square p-value of the classes' variances against the curve; a dead time of 0 is not fitted."""
    from scipy.stats import chi2

    freedom = len(residuals) - fitted
    return float(chi2.sf(sum(r * r for r in residuals), freedom)) if freedom > 0 else float("nan")

"""Dead time from any static scene: pixels of similar light take the place of flat fields.

    counts [T, H, W] of something that does not move -> classes of pixels by their mean -> Fano factors -> dead time

A class is chosen by the pixel's total, which says nothing about how that total is spread over the frames (for Poisson
counts, given the total, E[variance] = mean), so the choice does not bias the Fano factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.frame_statistics import Stack, measure
from qsim.calibration.qis import Calibration, Value, normal_interval
from qsim.calibration.spad import fitted_dead_time, matched_variance

CLASSES = 8
LEAST_MEAN = 1.0  # counts; darker pixels say nothing about dead time
LEAST_PIXELS = 50  # of a class


def classes_of(counts: Array, *, bits: int, exposure: float, edges: Sequence[float] | None = None) -> list[Stack]:
    """Stacks [T, 1, n] of pixels whose mean lies between neighbouring `edges` (default: 8 steps of equal ratio)."""
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


def fano(stack: Stack) -> Value:
    """Variance over mean in time with its 95 % interval; the size of the mean is known far better than the variance."""
    n = stack.pixels * (stack.frames - 1)
    poisson_fourth = stack.mean + 3 * stack.mean**2
    spread = (poisson_fourth - stack.mean**2) / n / stack.mean**2
    return normal_interval(stack.variance / stack.mean, spread, "variance / mean", f"{stack.pixels} pixels")


def calibrate_static(
    counts: Array, *, bits: int, exposure: float, edges: Sequence[float] | None = None, paralyzable: bool = False
) -> Calibration:
    """Effective dead time [s] and the Fano factor of every class of light, from counts [T, H, W] of a static scene.

    `ValueError` for fewer than two frames, or if no class has enough pixels.
    """
    counts = np.asarray(counts)
    if counts.ndim != 3 or len(counts) < 2:
        raise ValueError(
            f"calibrate: a static scene is counts [T, H, W] of at least 2 frames, got {list(counts.shape)}"
        )
    stacks = classes_of(counts, bits=bits, exposure=exposure, edges=edges)
    if not stacks:
        raise ValueError(f"calibrate: no class of light has {LEAST_PIXELS} pixels; use a larger part of the scene")
    found = fitted_dead_time(stacks, bits, paralyzable)
    ratio = found.value if found else 0.0
    values = {f"fano_at_{stack.mean:.3g}": fano(stack) for stack in stacks}
    if found:
        method = "Fano factor against flux, static scene"
        values["dead_time"] = normal_interval(ratio * exposure, found.variance * exposure**2, "s", method, floor=0.0)
    residuals = tuple(
        np.array([(stack.variance - matched_variance(stack.mean, bits, ratio, paralyzable)[1]) / _sigma(stack)])
        for stack in stacks
    )
    return Calibration("CountingSPAD", bits, values, _p_value(residuals), (), residuals, paralyzable=paralyzable)


def _sigma(stack: Stack) -> float:
    """Standard error of the mean variance, Poisson fourth moment."""
    return sqrt((stack.mean + 2 * stack.mean**2) / (stack.pixels * (stack.frames - 1)))


def _p_value(residuals: tuple[Array, ...]) -> float:
    """Chi-square of the classes' variances against the fitted curve, one parameter fitted."""
    from scipy.stats import chi2

    freedom = len(residuals) - 1
    return float(chi2.sf(sum(float(r[0] ** 2) for r in residuals), freedom)) if freedom > 0 else float("nan")

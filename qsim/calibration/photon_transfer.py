"""Measures gain, read noise, dark current and offset from means and variances (photon transfer, EMVA 1288)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.frame_statistics import FrameStatistics


@dataclass(frozen=True)
class Transfer:
    """Gain, read noise, dark current and offset from means and variances, with the variances of the estimates."""

    gain: float  # codes/e-
    offset: float  # codes
    dark_current: float  # e-/s
    read_variance: float  # e-^2; may be below 0 by noise
    gain_variance: float
    dark_current_variance: float
    read_variance_variance: float


def photon_transfer(darks: Sequence[FrameStatistics], flats: Sequence[FrameStatistics]) -> Transfer:
    """Fit a weighted straight line to variance over mean; its slope is the gain.

    Its height at the darkest stack is read noise plus ADC noise; the ADC adds 1/12 codes^2 (Janesick, Photon Transfer,
    SPIE 2007). Mean and variance of one stack are correlated through the third moment. The residual v - g m of a stack
    therefore has the variance (mu4 - v^2 + g^2 v - 2 g mu3) / n. Means are measured from that of the darkest stack. Its
    noise enters all others, while its own residual is that of v alone. The fit is a generalised least squares with
    these covariances.
    """
    base = min(darks, key=lambda stack: stack.exposure)
    stacks = [base, *[s for s in darks if s is not base], *flats]
    mean = np.array([s.mean - base.mean for s in stacks])
    variance = np.array([s.variance for s in stacks])
    n = np.array([s.pixels * max(s.frames - 1, 1) for s in stacks], float)
    third = np.array([s.central_moment(3) for s in stacks])
    fourth = np.array([s.central_moment(4) for s in stacks])
    design = np.stack([np.ones_like(mean), mean], axis=1)
    gain = max(float((variance[-1] - variance[0]) / (mean[-1] or 1.0)), 1e-6)
    for _ in range(4):
        spread = np.diag(np.maximum(fourth - variance**2 + gain**2 * variance - 2 * gain * third, 1e-12) / n)
        spread[1:, 1:] += gain**2 * variance[0] / n[0]
        spread[0, 0] = max(fourth[0] - variance[0] ** 2, 1e-12) / n[0]
        spread[0, 1:] = spread[1:, 0] = gain * third[0] / n[0]
        weighted = np.linalg.solve(spread, design)
        covariance = np.linalg.inv(design.T @ weighted)
        height, slope = covariance @ (weighted.T @ variance)
        gain = max(float(slope), 1e-9)
    # The dark mean grows with exposure: offset + gain D t. Its noise also enters the residuals that gave the gain.
    dark_slope, dark_offset, slope_variance, levers = _dark_line(stacks[: len(darks)])
    dark_current = dark_slope / gain
    shared = np.diag((third - gain * variance) / n)
    shared[1:, 0] = gain * variance[0] / n[0]
    shared[0, 0] = third[0] / n[0]
    slope_with_gain = float((covariance @ weighted.T)[1] @ shared[:, : len(darks)] @ levers)
    adc = 1 / 12
    dark_electrons = dark_current * base.exposure
    read_variance = (height - adc) / gain**2 - dark_electrons
    gradient = np.array([1 / gain**2, -2 * (height - adc) / gain**3])
    return Transfer(
        gain,
        dark_offset,
        dark_current,
        float(read_variance),
        float(covariance[1, 1]),
        (slope_variance + dark_current**2 * float(covariance[1, 1]) - 2 * dark_current * slope_with_gain) / gain**2,
        float(gradient @ covariance @ gradient) + base.exposure**2 * slope_variance / gain**2,
    )


def _dark_line(darks: Sequence[FrameStatistics]) -> tuple[float, float, float, Array]:
    """Fit the dark mean over exposure.

    Return the slope [codes/s], the offset [codes], the variance of the slope and the weights of the means in it.
    """
    time = np.array([s.exposure for s in darks])
    mean = np.array([s.mean for s in darks])
    spread = np.array([s.central_moment(2) / (s.pixels * s.frames) for s in darks]) + 1e-18
    if len(set(time)) < 2:
        return 0.0, float(np.average(mean, weights=1 / spread)), 0.0, np.zeros_like(time)
    weight = 1 / spread
    centre = np.average(time, weights=weight)
    lever = float(np.sum(weight * (time - centre) ** 2))
    levers = weight * (time - centre) / lever
    slope = float(levers @ mean)
    return slope, float(np.average(mean, weights=weight) - slope * centre), 1 / lever, levers


def spread_of_means(flats: Sequence[FrameStatistics], dark_mean: float) -> float:
    """Return the relative variance between the means of **all** pixels, with shading and hot pixels.

    This variance widens the histograms.
    """
    best = (0.0, inf)
    for flat in flats:
        signal = flat.mean - dark_mean
        if flat.frames < 2 or flat.pixels < 3 or signal <= 0:
            continue
        between = float((flat.total / flat.frames).var(ddof=1))
        if between / signal**2 < best[1]:
            best = ((between - flat.variance / flat.frames) / signal**2, between / signal**2)
    return best[0]

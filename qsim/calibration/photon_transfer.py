"""Measures gain, read noise and dark current from means and variances alone (photon transfer, EMVA 1288).

    variance = gain (mean - offset) + gain^2 read_noise^2 + 1/12      codes^2, of every stack

The ADC adds 1/12 codes^2 (Janesick, Photon Transfer, SPIE 2007) where the noise of a code in the dark is well above
half a code. Below `LEAST_NOISE` codes nothing is measured here. The errors are those between pixels, each of which has
a mean and a variance in time.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.cells import Cell
from qsim.calibration.moment_law import ADC, CLIPPED
from qsim.calibration.results import Value, normal_interval, root_interval

LEAST_NOISE = 0.7  # codes; 1/12 is then right to 6e-5 codes^2
METHOD = "mean-variance"


def photon_transfer(cells: Sequence[Cell], exposures: Sequence[float], darks: int, bits: int) -> dict[str, Value]:
    """Return gain, and with several dark exposures read noise and dark current; {} if codes are clipped."""
    stacks = [_joined([cell for cell in cells if cell.stack == i]) for i in range(len(exposures))]
    used = [i for i, stack in enumerate(stacks) if not _clipped(stack[0], bits)]
    dark = [i for i in used if i < darks]
    if not dark or len(used) == len(dark):
        return {}
    level = np.stack([stacks[i][1] for i in used])
    in_time = np.stack([stacks[i][2] for i in used])
    pixels = level.shape[1]
    mean = level.mean(axis=1)
    variance = in_time.mean(axis=1)
    gain = max(float((variance[-1] - variance[0]) / max(mean[-1] - mean[0], 1e-9)), 1e-9)
    for _ in range(4):
        residual = in_time - gain * level
        weight = pixels / np.maximum(residual.var(axis=1, ddof=1), 1e-12)
        centred = mean - weight @ mean / weight.sum()
        lever = weight * centred / float(weight @ centred**2)
        gain = float(lever @ variance)
    of_gain = lever @ (residual - residual.mean(axis=1, keepdims=True))  # [pixels], the error is its mean
    found = {"gain_transfer": normal_interval(gain, _error(of_gain), "codes/e-", METHOD, floor=0.0)}
    seconds = np.array([exposures[i] for i in dark])
    if gain <= 0 or len(set(seconds)) < 2:
        return found
    base = int(np.argmin(seconds))
    weight = pixels / np.maximum(variance[: len(dark)], 1e-12)
    time = seconds / seconds.max()
    centred = time - weight @ time / weight.sum()
    lever = weight * centred / float(weight @ centred**2)
    dark_level = level[: len(dark)] - mean[: len(dark), None]
    current = float(lever @ mean[: len(dark)]) / gain  # e- in the longest exposure
    of_current = (lever @ dark_level - current * of_gain) / gain
    square = (variance[base] - ADC) / gain**2 - current * time[base]
    of_square = (in_time[base] - variance[base]) / gain**2 - time[base] * of_current
    of_square -= 2 * (variance[base] - ADC) / gain**3 * of_gain
    if square > 3 * sqrt(_error(of_square)):
        found["read_noise_transfer"] = root_interval(square, _error(of_square), "e-", METHOD)
    if current > 2 * sqrt(_error(of_current)):
        found["dark_current_transfer"] = normal_interval(
            current / seconds.max(), _error(of_current) / seconds.max() ** 2, "e-/s", "dark mean over exposure"
        )
    return found


def _joined(cells: Sequence[Cell]) -> tuple[Array, Array, Array]:
    """Return the codes [t, n], pixel means [n] and pixel variances [n] of a stack, in the order of its pixels."""
    order = np.argsort(np.concatenate([cell.pixels for cell in cells]), kind="stable")
    codes = np.concatenate([cell.codes for cell in cells], axis=1)
    level = np.concatenate([cell.level for cell in cells])[order]
    in_time = np.concatenate([cell.in_time for cell in cells])[order]
    return codes, level, in_time


def _clipped(codes: Array, bits: int) -> bool:
    ends = np.count_nonzero((codes == 0) | (codes == (1 << bits) - 1))
    return bool(ends > CLIPPED * codes.size)


def _error(influence: Array) -> float:
    """Return the variance of an estimate whose error is the mean of the pixels' influence."""
    return float(influence.var(ddof=1)) / influence.size

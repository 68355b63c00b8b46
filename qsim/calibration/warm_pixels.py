"""Leaves out weak hot pixels, which no limit tells from good ones, in proportion to their probability.

The sum of a pixel's dark codes is that of a good pixel, or of one of 2 to 40 times the dark current. The share of the
latter is fitted to all sums. A pixel that is hot with a probability q is then left out with that probability. The
others are distributed like good pixels; a limit would cut off the tail of good pixels, or leave hot ones in.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.cells import MOST_SUMS
from qsim.calibration.code_law import code_law
from qsim.calibration.frame_statistics import FrameStatistics
from qsim.calibration.histogram_fit import DARK, GAIN, NOISE, OFFSET, Fit

FACTORS = np.geomspace(2, 40, 9)  # of the dark current
WEAK = 5.0  # times the dark current, of the weakest hot pixel that is looked for
SEEN = 6.0  # standard errors of a pixel's sum, above which it is seen
MOST = 0.1  # of all pixels; a larger share is no share of hot pixels, but a law that does not describe the sums
ROUNDS = 100  # of the fitted share
SEED = 20  # of what is left out


def without_warm(fit: Fit, darks: Sequence[FrameStatistics], good: Array) -> Array:
    """Return the pixels [H, W] that are used, `good` [H, W] less weak hot ones; from the longest dark exposure."""
    stack = max(darks, key=lambda dark: dark.exposure)
    at = fit.state.parameters
    if at[DARK] <= 0 or stack.sample is None or stack.stride > 1:
        return good
    levels = stack.histogram.size
    frames = min(len(stack.sample), max(MOST_SUMS // levels, 1))
    sums = stack.sample[:frames].astype(np.int64).sum(axis=0)[good]
    electrons = at[DARK] * np.concatenate([[1.0], FACTORS])
    law = code_law(
        np.arange(levels - 1.0),
        exp(at[GAIN]),
        float(at[OFFSET]),
        exp(at[NOISE]),
        electrons,
        np.zeros(len(electrons)),
        smooth=False,
    )
    size = 1 << (levels * frames - 1).bit_length()
    chances = np.array([_of_sum(shares, frames, size)[sums] for shares in law.shares])
    warm = chances[1:].mean(axis=0)
    # Expectation and maximisation of the share of warm pixels, in a mixture with those of the fitted law.
    share = 0.01
    for _ in range(ROUNDS):
        hot = share * warm / ((1 - share) * chances[0] + share * warm)
        share = float(hot.mean())
    if share > MOST:
        return good
    # A pixel is left out with its probability of being warm: a threshold would cut the tail of the others off.
    used = good.copy()
    used[good] = np.random.default_rng(SEED).random(sums.size) >= hot
    return used


def hidden(fit: Fit, darks: Sequence[FrameStatistics]) -> bool:
    """Return whether noise hides a weak hot pixel in the longest dark exposure."""
    stack = max(darks, key=lambda dark: dark.exposure)
    electrons = float(fit.state.parameters[DARK])
    noise = sqrt((electrons + fit.noise**2) / stack.frames)
    return (WEAK - 1) * electrons < SEEN * noise


def _of_sum(shares: Array, terms: int, size: int) -> Array:
    """Return the law [size] of the sum of independent codes of one law."""
    law = np.fft.irfft(np.fft.rfft(shares, size) ** terms, size)
    return np.maximum(law, 1e-14)  # below is rounding

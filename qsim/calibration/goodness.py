"""Tests fitted histograms by chi-square."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.frame_statistics import FrameStatistics
from qsim.calibration.prnu import normal_nodes
from qsim.calibration.quantiles import chi2_above

NODES, WEIGHTS = normal_nodes(5)  # of a PRNU


def goodness(
    stacks: Sequence[FrameStatistics], shares: Sequence[Array], fitted: int
) -> tuple[float, tuple[Array, ...]]:
    """Return the chi-square p-value of histograms against fitted shares, and residuals per level in sigmas.

    The common factor of a pixel acts on the codes like a change of light, which is fitted; the test therefore keeps its
    level.
    """
    expected = [share * stack.histogram.sum() for stack, share in zip(stacks, shares, strict=True)]
    pairs = [(stack.histogram, counts) for stack, counts in zip(stacks, expected, strict=True)]
    residuals = [(observed - counts) / np.sqrt(np.maximum(counts, 1.0)) for observed, counts in pairs]
    return chi_square(pairs, fitted), tuple(residuals)


def chi_square(histograms: Iterable[tuple[Array, Array]], fitted: int, total: float = 0.0, freedom: int = 0) -> float:
    """Return the p-value of (observed, expected) histograms with so many `fitted` parameters; NaN without freedom.

    Bins with an expectation below 5 are pooled. `total` is a chi-square of `freedom` other numbers, which is added.
    """
    freedom -= fitted
    for observed, expected in histograms:
        observed_bins, expected_bins = pooled(observed, expected)
        total += float(np.sum((observed_bins - expected_bins) ** 2 / expected_bins))
        freedom += len(expected_bins) - 1
    return chi2_above(total, freedom) if freedom > 0 else float("nan")


def pooled(observed: Array, expected: Array, least: float = 5.0) -> tuple[Array, Array]:
    """Join neighbouring bins until each expects at least `least`; return observed and expected counts."""
    enough = least - 1e-9 * float(expected.sum())  # rounding of the expected sum must not join two bins
    group = np.zeros(len(expected), dtype=int)
    number = 0
    inside = 0.0
    for i, count in enumerate(expected.tolist()):
        group[i] = number
        inside += count
        if inside >= enough:
            number += 1
            inside = 0.0
    group[group == number] = max(number - 1, 0)  # what is left at the end joins the last bin
    return np.bincount(group, observed), np.bincount(group, expected)

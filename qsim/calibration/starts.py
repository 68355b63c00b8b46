"""Chooses the points from which a fit of histograms starts.

Variance over mean of the cells gives a first gain. If single electrons show as peaks, the Fourier transform of the
codes at 1/gain gives gain, read noise and offset sharply; the offset is then known up to whole electrons.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from math import exp, log, pi, sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.cells import Cell
from qsim.calibration.moment_law import ADC

SHIFTS = 4  # steps of gain to either side of the first
STEP = 0.3  # e- of the brightest cell whose histogram is used, by a step of gain
NOISES = (0.1, 0.2, 0.3, 0.4, 0.6)  # e-
PARTS = (0.03, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.997)  # of the variance in the dark, by read noise
COMB = 1.05  # codes/e-; above, the transform may show electrons
FINE = 2.0  # codes/e-; above, it shows how wide they are
PADDING = 8  # of the Fourier transform
CLEAR = 6.0  # standard errors of a peak


@dataclass(frozen=True)
class Peaks:
    """Electron peaks: gain [codes/e-], read noise [e-], and the offset [codes] up to whole electrons."""

    gain: float
    noise: float
    offset: float


@dataclass(frozen=True, eq=False)
class Starts:
    """First parameters, the most likely kind first; `hidden`: the read noise hides the electrons."""

    points: list[Array]
    noise: float  # e-, for the width of the bins
    hidden: bool


def starts_of(cells: Sequence[Cell], share: Array, darks: int, brightest: float) -> Starts:
    """Return the starts of a fit. `share` [cells] is the exposure of dark cells relative to the longest.

    `brightest` is the light of the brightest cell whose histogram is used, in codes.
    """
    gain = first_gain(cells)
    peaks = electron_peaks([cell for cell in cells if cell.stack >= darks], gain)
    dark = [i for i, cell in enumerate(cells) if cell.stack < darks]
    shortest = min(dark, key=lambda i: share[i])
    longest = max(dark, key=lambda i: share[i])
    variance = max(cells[shortest].variance - ADC, 1e-4)  # codes^2
    several = share[shortest] < share[longest]
    points: list[Array] = []

    def add(gain: float, offset: float, noise: float, electrons: float) -> None:
        light = [max((cell.mean - offset) / gain, 1e-3) for cell in cells if cell.stack >= darks]
        points.append(np.array([log(gain), offset, log(noise), max(electrons, 1e-4), *light]))

    def by_exposures(at: float) -> float:
        """Dark electrons of the longest exposure, by the difference of two exposures."""
        return (cells[longest].mean - cells[shortest].mean) / at / (share[longest] - share[shortest])

    base = cells[shortest].mean
    for peak, shift in product(peaks, (1.0, 0.998, 1.002)):
        at = peak.gain * shift
        offset = peak.offset + at * np.floor((base - peak.offset) / at + 0.5)
        for back in range(int(2 + 2 * variance / at**2 + 3 * sqrt(variance) / at)):
            alone = max((base - offset) / at + back, 0.0) / share[shortest]
            add(at, offset - back * at, peak.noise, by_exposures(at) if several else alone)
    hidden = not peaks and sqrt(variance) / gain > 1.2
    for at in _gains(gain, brightest, known=bool(points)):
        total = variance / at**2
        tried = _noises(gain, hidden)
        if several:
            electrons = by_exposures(at)
            rest = sqrt(max(total - electrons * share[shortest], 0.01))
            for noise in {*tried, rest}:
                add(at, base - at * electrons * share[shortest], noise, electrons)
            continue
        # read noise and dark electrons share the variance of the one exposure
        for noise in {*tried, *(sqrt(part * total) for part in PARTS)}:
            electrons = max(total - noise**2, 0.003 * total)
            add(at, base - at * electrons, noise, electrons)
    visible = 0.35 if gain >= FINE else 0.15
    if peaks:
        visible = peaks[0].noise
    return Starts(points, sqrt(variance) / gain if hidden else visible, hidden)


def _gains(gain: float, brightest: float, *, known: bool) -> list[float]:
    """Return gains around a first one, near enough for the brightest cell; it alone if finer ones are `known`."""
    if known and gain >= FINE:
        return [gain]
    step = min(STEP * gain / max(brightest, 1e-9), 0.1)
    return [gain * (1 + number * step) for number in range(-SHIFTS, SHIFTS + 1)]


def _noises(gain: float, hidden: bool) -> tuple[float, ...]:
    """Return read noises [e-] to start from; none if read noise hides the electrons."""
    if hidden:
        return ()
    return NOISES if gain < 2 * FINE else (0.35, 0.6)


def first_gain(cells: Sequence[Cell]) -> float:
    """Return the slope of variance over mean of the cells, codes/e-."""
    mean = np.array([cell.mean for cell in cells])
    variance = np.array([cell.variance for cell in cells])
    weight = np.sqrt([cell.codes.size for cell in cells]) / np.maximum(variance, 0.05)
    design = np.stack([np.ones_like(mean), mean], axis=1)
    slope = float(np.linalg.lstsq(design * weight[:, None], variance * weight, rcond=None)[0][1])
    if slope > 0:
        return slope
    return max(float(variance.max() / max(np.ptp(mean), 1e-9)), 1e-6)


def electron_peaks(cells: Sequence[Cell], gain: float) -> list[Peaks]:
    """Return the electron peaks near a gain, if any show. The codes' transform at 1/gain is exp(-2 pi^2 noise^2).

    It is a local maximum over frequency, because the Poisson law is one at whole turns. Codes are whole numbers, so the
    transform at one turn per code less a frequency is as large, and both may be near the gain.
    """
    if gain < COMB:
        return []
    highest = max(int(cell.codes.max()) for cell in cells) + 1
    histogram = np.sum([np.bincount(cell.codes.ravel(), minlength=highest) for cell in cells], axis=0)
    share = histogram / histogram.sum()
    size = 1 << int(np.ceil(np.log2(max(PADDING * highest, 1024))))
    size_of = np.abs(np.fft.fft(share, size))
    first = int(size / (1.4 * gain))
    last = min(int(size / (0.7 * gain)) + 1, int(0.97 * size))
    inner = size_of[first:last]
    if len(inner) < 3:
        return []
    # A peak is a local maximum of the transform that stands out of the noise of a histogram of n codes, 1 / sqrt(n)
    local = np.flatnonzero((inner[1:-1] > inner[:-2]) & (inner[1:-1] > inner[2:])) + 1
    if len(local) == 0:
        return []
    best = int(local[np.argmax(inner[local])])
    height = float(inner[best])
    if height < CLEAR / sqrt(histogram.sum()):
        return []
    # The top of the parabola through the best bin and its neighbours
    left = inner[best - 1]
    right = inner[best + 1]
    turn = 0.5 * (left - right) / (left - 2 * height + right)
    frequency = (first + best + turn) / size
    codes = np.arange(highest)
    found = []
    # The size at the frequency states the read noise, beside what rounding to codes takes; the angle states the offset
    for turns in (frequency, 1 - frequency):
        if not first <= turns * size <= last:
            continue
        value = complex(share @ np.exp(2j * pi * turns * codes))
        left_by_rounding = float(np.sinc(turns))
        noise = sqrt(max(-log(max(abs(value) / left_by_rounding, 1e-12)) / (2 * pi**2), 0.06**2))
        found.append(Peaks(1 / turns, noise, float(np.angle(value) / (2 * pi * turns)) % (1 / turns)))
    return found


def distinct(points: Sequence[Array], values: Sequence[float], count: int) -> list[Array]:
    """Return the `count` likeliest points that differ in offset or in read noise."""
    kept: list[Array] = []
    for i in np.argsort(values)[::-1]:
        point = points[i]
        near = any(abs(point[1] - p[1]) < 0.25 * exp(p[0]) and abs(point[2] - p[2]) < 0.3 for p in kept)
        if not near:
            kept.append(point)
        if len(kept) == count:
            break
    return kept

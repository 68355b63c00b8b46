"""Calibrates a QIS or a camera: dark and flat frames -> its parameters, each with a 95 % interval.

    stacks --cells.py: good pixels in groups of similar light--> cells --histogram_fit.py: maximum likelihood--> Fit
    Fit    --intervals.py: profile of the likelihood, scaled to the scatter between pixels--> values
    cells  --photon_transfer.py: mean and variance, where rounding adds 1/12 codes^2--> a second estimate

The reported PRNU comes from prnu.py, without hot pixels and without a gradient of the light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import exp, isinf, log, pi, sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.cells import Cell, cells_of, good_pixels
from qsim.calibration.flat_fields import qis_flats
from qsim.calibration.frame_statistics import FrameStatistics, check_noise, check_stacks
from qsim.calibration.goodness import chi_square
from qsim.calibration.histogram_fit import DARK, GAIN, LEAST_NOISE, NOISE, OFFSET, Fit, fit_cells, refined
from qsim.calibration.intervals import HigherMaximum, profile
from qsim.calibration.photon_transfer import LEAST_NOISE as LEAST_TRANSFER_NOISE
from qsim.calibration.photon_transfer import photon_transfer
from qsim.calibration.prnu import measure_pattern
from qsim.calibration.quantiles import student_quantile
from qsim.calibration.results import Z95, Calibration, Value, odd_efficiency
from qsim.calibration.warm_pixels import hidden, without_warm
from qsim.host import own_numbers
from qsim.sensor.qis import QIS

METHOD = "likelihood of the codes"
MOST_OPEN = 2.0  # most high end over low end of the gain, for which electrons per photon are printed
REPEATS = 15  # of a fit whose profile met a larger likelihood


@own_numbers
def calibrate_qis(darks: Sequence[FrameStatistics], flats: Sequence[FrameStatistics], *, bits: int) -> Calibration:
    """Estimate gain, offset, read noise, dark current, PRNU and, if the flats' photons are known, QE of a QIS.

    Values named `..._transfer` come from means and variances, the others from the codes' histograms. Hot pixels are
    left out of all of them. `ValueError` if there is no dark or no flat stack, or if a stack is constant or its frames
    are all alike.
    """
    _check(darks, flats, bits)
    stacks = [*darks, *flats]
    exposures = [stack.exposure for stack in stacks]
    good = good_pixels(darks, flats)
    cells = cells_of(darks, flats, good)
    fit = fit_cells(cells, exposures, len(darks), bits)
    # Warm pixels show only against the fitted law; without them the law is fitted once more.
    used = without_warm(fit, darks, good)
    if not np.array_equal(used, good):
        cells = cells_of(darks, flats, used)
        fit = fit_cells(cells, exposures, len(darks), bits)
    fit, values = _with_intervals(fit, flats, exposures, len(darks))
    alone = len({stack.exposure for stack in darks}) < 2
    if alone and hidden(fit, darks):
        values |= _without_dark_current(fit, values)
    if fit.gain * fit.noise >= LEAST_TRANSFER_NOISE:
        values |= photon_transfer(cells, exposures, len(darks), bits)
    sensor = _MeanCode(1.0, 0.0, fit.noise, bits, gain=fit.gain, offset=float(fit.state.parameters[OFFSET]))
    levels, _ = qis_flats([_without_drift(flat, cells, i) for i, flat in enumerate(flats, len(darks))], darks, sensor)
    pattern = measure_pattern(levels, ~good)
    if pattern is not None:
        values |= _of_pattern(pattern.values())
    p_value, residuals = _goodness(fit, len(stacks), bits)
    warnings = _advice(darks, flats, values, fit, good)
    if p_value < 1e-3:
        warnings.append(f"the fitted histograms do not describe the data (p = {p_value:.1g}): the model is wrong here")
    if "quantum_efficiency" in values and values["gain"].high > MOST_OPEN * values["gain"].low:
        del values["quantum_efficiency"]
        warnings.append(
            f"the gain is not known within a factor of {MOST_OPEN:g}, so no efficiency is printed; use brighter "
            "flats or more frames"
        )
    if "quantum_efficiency" in values:
        warnings += odd_efficiency(values["quantum_efficiency"])
    return Calibration("QIS", bits, values, p_value, tuple(warnings), residuals)


class _MeanCode(QIS):
    """A QIS whose mean code above 8 bits is that of a normal law, cut at both ends: many levels round without bias."""

    def mean(self, photons: Array, exposure: float) -> Array:
        if self.bits <= 8:
            return super().mean(photons, exposure)
        from scipy.special import ndtr

        centre = self.gain * photons + self.offset
        spread = self.gain * np.sqrt(photons + self.read_noise**2) + 1e-9

        def above(level: float) -> Array:  # expected excess over a level
            z = (centre - level) / spread
            return np.asarray(spread * (z * ndtr(z) + np.exp(-0.5 * z * z) / sqrt(2 * pi)))

        return np.asarray(above(0.0) - above(self.levels - 1.0))


def _check(darks: Sequence[FrameStatistics], flats: Sequence[FrameStatistics], bits: int) -> None:
    """`ValueError` for frames that cannot be calibrated."""
    check_stacks(darks, flats, bits)
    if bits < 2:
        raise ValueError(
            "calibrate: 1 bit per code cannot tell gain, offset and read noise apart; calibrate binary planes with "
            "model=spad (calibrate_spad)"
        )
    if not darks or not flats:
        missing = "dark" if not darks else "flat"
        raise ValueError(f"calibrate: no {missing} frames; at least one dark and one flat stack are needed")
    for i, stack in enumerate((*darks, *flats)):
        if np.count_nonzero(stack.histogram) < 2:
            where = f"dark {i}" if i < len(darks) else f"flat {i - len(darks)}"
            code = int(np.argmax(stack.histogram))
            raise ValueError(
                f"calibrate: every code of {where} is {code}; calibration needs codes that vary: change the light or "
                "the exposure"
            )
    check_noise(darks, flats)
    if any(stack.frames < 2 for stack in (*darks, *flats)):
        raise ValueError(
            "calibrate: a stack of one frame cannot tell noise from the fixed pattern; take at least 2 frames"
        )
    dark = min(stack.mean for stack in darks)
    if all(flat.mean <= dark for flat in flats):
        raise ValueError("calibrate: no flat is brighter than the dark frames; are dark and flat frames swapped?")


def _with_intervals(
    fit: Fit, flats: Sequence[FrameStatistics], exposures: Sequence[float], darks: int
) -> tuple[Fit, dict[str, Value]]:
    """Return the fit and the values of its parameters; a larger likelihood that a profile meets starts it again."""
    for _ in range(REPEATS):
        try:
            return fit, _parameters(fit, max(exposures[:darks])) | _efficiency(fit, flats, exposures, darks)
        except HigherMaximum as met:
            fit = refined(fit.likelihood, met.state, [fit.state, *fit.modes])
    raise ValueError(
        "calibrate: the likelihood has no clear maximum; take more frames, more pixels or a flat of another light"
    )


def _parameters(fit: Fit, longest: float) -> dict[str, Value]:
    """Return gain, offset, read noise and dark current; `longest` is the longest dark exposure in seconds."""
    at = fit.state.parameters
    unit = np.eye(fit.likelihood.size)
    levels = 1 << fit.likelihood.bits
    least = log(LEAST_NOISE) - at[GAIN]
    gain = profile(fit, unit[GAIN], 0.3, 5.0)
    offset = profile(fit, unit[OFFSET], 0.3 * fit.gain, 4.0 * levels)
    noise = profile(fit, unit[NOISE], 0.5, 8.0, bound=least)
    dark = profile(fit, unit[DARK], 0.1 + 0.5 * at[DARK], 1e3 * (1 + at[DARK]), bound=0.0)
    noise_low = 0.0 if noise.low <= least else exp(noise.low)
    return {
        "gain": Value(exp(gain.value), exp(gain.low), exp(gain.high), "codes/e-", METHOD),
        "offset": Value(offset.value, offset.low, offset.high, "codes", METHOD),
        "read_noise": Value(exp(noise.value), noise_low, exp(noise.high), "e-", METHOD),
        "dark_current": Value(dark.value / longest, dark.low / longest, dark.high / longest, "e-/s", METHOD),
    }


def _without_dark_current(fit: Fit, values: dict[str, Value]) -> dict[str, Value]:
    """Return offset, read noise and dark current with intervals that hold those of a camera without dark current.

    One dark exposure tells dark current by the skewness of its histogram. Hot pixels that noise hides are skew, too.
    """
    start = fit.state.parameters.copy()
    # Without dark current the same histograms need a higher offset and
    # more read noise: its mean and its variance, in electrons.
    start[OFFSET] += fit.gain * start[DARK] * float(fit.likelihood.share.max())
    start[NOISE] = 0.5 * log(fit.noise**2 + start[DARK])
    start[DARK] = 0.0
    none = fit.likelihood.maximise(start, hold=np.eye(fit.likelihood.size)[DARK])
    offset = values["offset"]
    noise = values["read_noise"]
    dark = values["dark_current"]
    shift = float(none.parameters[OFFSET]) - offset.value
    factor = exp(none.parameters[NOISE]) / noise.value
    return {
        "offset": replace(offset, high=offset.high + max(shift, 0.0)),
        "read_noise": replace(noise, high=noise.high * max(factor, 1.0)),
        "dark_current": replace(dark, low=0.0),
    }


def _efficiency(fit: Fit, flats: Sequence[FrameStatistics], exposures: Sequence[float], darks: int) -> dict[str, Value]:
    """Return the electrons per photon, if a light standard gave the photons of the flats.

    The light of several flats differs from what is stated, by drift. Their scatter is measured and enters the interval
    by Student's t (Hartung and Knapp, Statistics in Medicine 20, 2001).
    """
    known = [i for i, flat in enumerate(flats) if flat.photons]
    if not known:
        return {}
    likelihood = fit.likelihood
    covariance = fit.covariance
    directions = np.zeros((len(known), likelihood.size))
    own = np.zeros(len(known))  # variance that the flats do not share
    for row, i in enumerate(known):
        photons = float(flats[i].photons or 0.0)
        members = [(c, cell) for c, cell in enumerate(likelihood.cells) if cell.stack == darks + i]
        pixels = sum(cell.pixels.size for _, cell in members)
        for c, cell in members:
            k = likelihood.own[c]
            share = cell.pixels.size / pixels / photons
            directions[row, k] = share
            # How far pixels scatter beyond the model: the sandwich over the inverse information.
            excess = covariance[k, k] / max(fit.inverse[k, k], 1e-300)
            own[row] += share**2 * excess / max(fit.state.information[k, k], 1e-300)
        directions[row, DARK] = -exposures[darks + i] / max(exposures[:darks]) / photons
    telling = own > 0  # a flat that is saturated throughout has no noise, and tells no light
    if not telling.any():
        return {}
    directions = directions[telling]
    own = own[telling]
    found = directions @ fit.state.parameters
    between = _between(found, own)
    weights = 1 / (own + between)
    weights /= weights.sum()
    direction = weights @ directions
    value = float(weights @ found)
    interval = profile(fit, direction, max(0.3 * abs(value), 1e-9), 1e3 * max(abs(value), 1e-9))
    low = interval.low
    high = interval.high
    method = "light standard, whose light is taken as exact"
    if len(own) > 1:
        freedom = len(own) - 1
        inner = float(weights**2 @ own)
        scatter = float(weights @ (found - value) ** 2) / freedom
        # The interval of the profile holds the flats' own noise by a normal
        # law; what their scatter adds to it is by Student's t.
        reach = student_quantile(0.975, freedom) ** 2 * scatter - Z95**2 * inner
        low = value - sqrt(max((value - low) ** 2 + reach, 0.0))
        high = value + sqrt(max((high - value) ** 2 + reach, 0.0))
        method = f"light standard, with the scatter of {len(own)} flats"
    return {"quantum_efficiency": Value(value, max(low, 0.0), high, "e-/photon", method)}


def _between(found: Array, own: Array) -> float:
    """Return the variance between flats beyond their own (DerSimonian and Laird, Control. Clin. Trials 7, 1986)."""
    weights = 1 / own
    mean = float(weights @ found / weights.sum())
    excess = float(weights @ (found - mean) ** 2) - (len(found) - 1)
    spread = float(weights.sum() - (weights**2).sum() / weights.sum())
    return max(excess / spread, 0.0) if spread > 0 else 0.0


def _without_drift(flat: FrameStatistics, cells: Sequence[Cell], stack: int) -> FrameStatistics:
    """Return a flat whose variance in time is that without drift of the light, which all pixels share."""
    members = [cell for cell in cells if cell.stack == stack]
    base = min(cell.mean for cell in cells)
    drift = 0.0
    light = 0.0
    for cell in members:
        drift += cell.pixels.size * (float(cell.codes.var(axis=0, ddof=1).mean()) - cell.variance)
        light += cell.pixels.size * (cell.mean - base) ** 2
    # Drift of the lamp moves all pixels together: the variance of a
    # cell's mean over time, in units of its light squared.
    relative = max(drift / light, 0.0) if light > 0 else 0.0
    level = flat.total / flat.frames - base
    return replace(flat, square=flat.square - (flat.frames - 1) * relative * level**2)


def _of_pattern(values: dict[str, Value]) -> dict[str, Value]:
    """Return the values of a pattern; those that describe the recording have no interval."""
    return {
        name: value if name == "prnu" else Value.exact(value.value, value.unit, value.method)
        for name, value in values.items()
    }


def _goodness(fit: Fit, stacks: int, bits: int) -> tuple[float, tuple[Array, ...]]:
    """Return the chi-square p-value of all cells, and the residuals of every stack by code [levels] in sigmas."""
    histograms = []
    observed = np.zeros((stacks, 1 << bits))
    expected = np.zeros((stacks, 1 << bits))
    for panel, law in zip(fit.likelihood.panels, fit.state.laws, strict=True):
        codes = np.clip(np.rint(panel.middle), 0, (1 << bits) - 1).astype(int)
        for r, i in enumerate(panel.cells):
            fitted = law.shares[r] * panel.counts[r].sum()
            histograms.append((panel.counts[r], fitted))
            np.add.at(observed[fit.likelihood.cells[i].stack], codes, panel.counts[r])
            np.add.at(expected[fit.likelihood.cells[i].stack], codes, fitted)
    # Pearson's residuals: counts are Poisson, with the root of the expected count as deviation.
    residuals = (observed - expected) / np.sqrt(np.maximum(expected, 1.0))
    simple = fit.likelihood.simple
    own = int(np.count_nonzero(~fit.likelihood.dark[simple]))  # parameters that the mean of a cell determines
    misfit = 0.0
    freedom = 0
    if simple.size:
        misfit = fit.likelihood.moments.misfit(fit.likelihood.moments_at(fit.state.parameters)[1])
        freedom = simple.size
    return chi_square(histograms, fit.likelihood.size - own, misfit, freedom), tuple(residuals)


def _advice(
    darks: Sequence[FrameStatistics],
    flats: Sequence[FrameStatistics],
    values: dict[str, Value],
    fit: Fit,
    good: Array,
) -> list[str]:
    """Return warnings about parameters that these data determine badly."""
    words = []
    if len({stack.exposure for stack in darks}) < 2:
        words.append("all darks have one exposure: dark current and offset are told apart by the histogram only")
    for i, flat in enumerate(flats):
        saturated = float(np.mean(flat.total[good] >= flat.frames * (flat.histogram.size - 1 - 1e-9)))
        if saturated > 0.01:
            words.append(f"flat {i}: {saturated:.1%} of the good pixels are saturated in every frame; use less light")
    for name in ("gain", "read_noise", "dark_current"):
        words += _undetermined(name, values[name])
    if fit.gain * fit.noise < LEAST_TRANSFER_NOISE:
        words.append(
            f"gain x read noise is {fit.gain * fit.noise:.2g} codes: below {LEAST_TRANSFER_NOISE} the variance of "
            "rounding is not 1/12, so nothing is measured from means and variances alone"
        )
    return words


def _undetermined(name: str, value: Value) -> list[str]:
    """Return a sentence if an interval is infinite, reaches 0 or is wider than the value."""
    words = name.replace("_", " ")
    if isinf(value.high):
        return [f"{words}: these data do not bound it from above"]
    if value.low <= 0:
        return [f"{words}: these data do not tell it from 0; it is below {value.high:.3g} {value.unit}"]
    if value.high - value.low > value.value:
        return [f"{words}: these data determine it badly, between {value.low:.3g} and {value.high:.3g} {value.unit}"]
    return []

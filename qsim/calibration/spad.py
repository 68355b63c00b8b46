"""Calibrates a SPAD array: dark and flat counts -> dark-count map, efficiency, PRNU, dead time, afterpulsing.

    1-bit planes:  arrivals of a pixel = -ln(1 - ones/frames)          counts: arrivals = counts, dead time corrected

Every number describes this array: DCR and PDE are means over its pixels, so their intervals hold shot noise alone.
Detection efficiency times fill factor is measured relative to the light standard that gave the photons of the flats.
Dead time comes from the Fano factor against flux: the variance of counts is below Poisson where an avalanche blocks the
next. Afterpulsing comes from the correlation of neighbouring frames. Left out: a spread of dead time between pixels,
crosstalk, afterpulses within one frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf, isfinite, log, nan, sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.dead_time import fitted_dead_time, matched_variance
from qsim.calibration.flat_fields import Response, dark_rates, spad_flats
from qsim.calibration.frame_statistics import FrameStatistics, check_noise, check_stacks
from qsim.calibration.histogram_fit import NODES, WEIGHTS, goodness
from qsim.calibration.prnu import BY_FLAT, HOT, measure_pattern
from qsim.calibration.results import Z95, Calibration, Value, normal_interval, odd_efficiency, poisson_interval
from qsim.sensor.counting import CountingSPAD

NO_EVENT_BOUND = -log(0.025)  # expected events at which none occurs in 2.5 % of the cases: end of a two-sided 95 %
FEW_COUNTS = 100  # from here on a normal interval differs from the exact one by about a tenth of its half-width
PERCENTILES = (1, 10, 25, 75, 90, 99, 99.9)  # of the DCR map, in addition to the median


def calibrate_spad(
    darks: Sequence[FrameStatistics],
    flats: Sequence[FrameStatistics],
    *,
    bits: int,
    dead_time: bool = True,
    paralyzable: bool = False,
) -> Calibration:
    """Estimate DCR (and its map), PDE x fill, PRNU, afterpulsing and, for counts of more than one bit, dead time.

    `dead_time=False` assumes Poisson counts; the p-value shows whether that holds. Without `darks` the DCR is assumed
    to be 0, with a warning. `flats` may be missing; `ValueError` if both are, and for stacks that determine nothing.
    """
    check_stacks(darks, flats, bits)
    check_noise(darks, flats)
    warnings = _dispersed([*darks, *flats])
    values: dict[str, Value] = {}
    maps: dict[str, Array] = {}
    usable = [flat for flat in flats if flat.frames > 1 and flat.mean > 0]  # of one exposure, if dead time is fitted
    fano = fitted_dead_time(usable, bits, paralyzable) if bits > 1 and usable and dead_time else None
    if bits > 1 and dead_time and fano is None:
        warnings.append("dead time is not measured (flats of two frames or more are needed): taken as 0")
    ratio = 0.0 if fano is None else fano.value
    exposure = usable[0].exposure if usable else 1.0  # without dead time it does not matter
    response = Response(bits, ratio, paralyzable, exposure)
    if darks:
        dcr_map, of_map = dark_rates(darks, response)
        maps["dark_count_rate"] = dcr_map
        values["dark_count_rate"] = _array_rate(darks, dcr_map, of_map)
        values |= _distribution(dcr_map)
        if not any(stack.total.any() for stack in darks):
            warnings.append("no dark count at all: the dark-count rate has an upper bound only")
    else:
        warnings.append("no dark frames: dark counts are taken as 0 and end up in the efficiency and in PRNU")
    if flats:
        warnings += _saturation(flats)
        values |= _efficiency(flats, darks, response, 0.0 if fano is None else fano.variance)
        if "pde_fill" in values:
            warnings += odd_efficiency(values["pde_fill"])
        levels, hot = spad_flats(flats, darks, response)
        pattern = measure_pattern(levels, hot)
        if pattern is not None:
            values |= pattern.values()
            if not darks and pattern.left_out.any():
                warnings.append(f"{pattern.left_out.sum()} pixels left out of PRNU as hot {BY_FLAT}")
        else:
            warnings.append("PRNU is not measured: the flats have one frame, or no light above the dark counts")
    if fano is not None:
        method = "Fano factor against flux" + (", paralyzable" if paralyzable else "")
        values["dead_time"] = normal_interval(ratio * exposure, fano.variance * exposure**2, "s", method, floor=0.0)
    values |= _afterpulsing([*darks, *flats], bits)
    spread = _spread(flats, darks, response)
    p_value, residuals = _goodness(flats, response, spread, len(flats) + (fano is not None))
    if p_value < 1e-3:
        warnings.append(
            f"the fitted histograms do not describe the counts (p = {p_value:.1g}): the model is wrong here"
        )
    model = "BinarySPAD" if bits == 1 else "CountingSPAD"
    return Calibration(model, bits, values, p_value, tuple(warnings), residuals, maps, paralyzable)


# The dark-count map and the efficiency


def _array_rate(darks: Sequence[FrameStatistics], rates: Array, variances: Array) -> Value:
    """Return the mean of a DCR map [H, W] with the variance of each pixel; of few counts, with the exact interval."""
    rate, count = float(rates.mean()), sum(float(stack.total.sum()) for stack in darks)
    if count == 0:
        time = sum(stack.frames * stack.exposure * stack.pixels for stack in darks)
        return Value(0.0, 0.0, NO_EVENT_BOUND / time, "1/s", "no dark count: upper bound")
    if count < FEW_COUNTS:
        return poisson_interval(rate, count, "1/s", "array mean")
    return normal_interval(rate, float(variances.sum()) / rates.size**2, "1/s", "array mean", floor=0.0)


def _distribution(rates: Array) -> dict[str, Value]:
    """Return median and percentiles of a DCR map [H, W] (order statistics), and the share of hot pixels (Wilson)."""
    from scipy.stats import binomtest

    ordered = np.sort(rates.ravel())
    n = ordered.size
    reach = Z95 * sqrt(n) / 2
    low, high = (int(np.clip(round(n / 2 + sign * reach), 0, n - 1)) for sign in (-1, 1))
    median = float(np.median(ordered))
    found = {
        "dark_count_rate_median": Value(median, float(ordered[low]), float(ordered[high]), "1/s", "order statistics")
    }
    for percent in PERCENTILES:
        share = percent / 100
        reach = Z95 * sqrt(n * share * (1 - share))
        low, high = (int(np.clip(round(n * share + sign * reach), 0, n - 1)) for sign in (-1, 1))
        value = float(np.percentile(ordered, percent))
        name = f"dark_count_rate_p{percent:g}"
        found[name] = Value(
            value, min(float(ordered[low]), value), max(float(ordered[high]), value), "1/s", "order statistics"
        )
    if median > 0:
        hot = int(np.count_nonzero(ordered > HOT * median))
        share = binomtest(hot, n).proportion_ci(method="wilson")
        found["hot_pixels"] = Value(hot / n, float(share.low), float(share.high), f"above {HOT:g} medians", "counting")
    return found


def _efficiency(
    flats: Sequence[FrameStatistics], darks: Sequence[FrameStatistics], response: Response, ratio_variance: float
) -> dict[str, Value]:
    """Return PDE x fill: avalanches per photon of the light standard, weighted mean of the flats.

    The uncertainty of the dead time is common to all flats.
    """
    known = [(flat, flat.photons) for flat in flats if flat.photons]
    if not known:
        return {}

    def slopes(used: Response) -> tuple[Array, Array]:
        rate, of_rate = dark_rates(darks, used) if darks else (np.zeros(1), np.zeros(1))
        rate_variance = float(of_rate.sum()) / rate.size**2
        values, variances = [], []
        for flat, photons in known:
            arrivals, of_map, _ = used.of_stack(flat)
            values.append(float(arrivals.mean() - rate.mean() * flat.exposure) / photons)
            variances.append((float(of_map.sum()) / flat.pixels**2 + rate_variance * flat.exposure**2) / photons**2)
        return np.array(values), np.maximum(variances, 1e-300)

    values, variances = slopes(response)
    moved = np.zeros_like(values)
    if ratio_variance > 0:
        step = max(1e-4 * response.ratio, 1e-7)
        moved = (slopes(replace(response, ratio=response.ratio + step))[0] - values) / step
    covariance = np.diag(variances) + ratio_variance * np.outer(moved, moved)
    weights = np.linalg.solve(covariance, np.ones(len(known)))
    weights /= weights.sum()
    variance = float(weights @ covariance @ weights)
    return {
        "pde_fill": normal_interval(float(weights @ values), variance, "counts/photon", "light standard", floor=0.0)
    }


def _spread(flats: Sequence[FrameStatistics], darks: Sequence[FrameStatistics], response: Response) -> float:
    """Return the relative spread of light over **all** pixels, with shading and hot pixels; it widens histograms."""
    rate = dark_rates(darks, response)[0] if darks else np.zeros(1)
    dark_spread = sum(max(s.fixed_pattern, 0.0) / s.exposure**2 for s in darks if s.frames > 1) / max(len(darks), 1)
    best = (0.0, inf)
    for flat in flats:
        if flat.frames < 2 or flat.pixels < 3:
            continue
        arrivals, _, slope = response.of_stack(flat)
        signal = slope * float(arrivals.mean() - rate.mean() * flat.exposure)
        if signal <= 0:
            continue
        variance = float((flat.total / flat.frames).var(ddof=1)) / signal**2
        if variance < best[1]:
            best = ((flat.fixed_pattern - dark_spread * (slope * flat.exposure) ** 2) / signal**2, variance)
    return sqrt(max(best[0], 0.0))


def _dispersed(stacks: Sequence[FrameStatistics]) -> list[str]:
    """Return warnings about sums of planes whose variance in time is not binomial."""
    words = []
    for i, stack in enumerate(stacks):
        error = sqrt(2 / (stack.pixels * max(stack.sums - 1, 1)))
        if isfinite(stack.dispersion) and abs(stack.dispersion - 1) > max(5 * error, 0.02):
            words.append(
                f"stack {i}: its sums scatter {stack.dispersion:.2f} times as much in time as this number of planes "
                "would: another number of planes, light that is not steady, or afterpulses"
            )
    if stacks and all(stack.sums or (stack.frames and not isfinite(stack.lag_covariance)) for stack in stacks):
        words.append("sums of planes do not keep their order: afterpulsing is not measured")
    return words


def _saturation(flats: Sequence[FrameStatistics]) -> list[str]:
    """Return warnings about flats in which some pixels hold the top code in every frame."""
    words = []
    for i, flat in enumerate(flats):
        full = float((flat.total >= flat.frames * (flat.histogram.size - 1)).mean())
        if full > 0:
            words.append(f"flat {i}: {full:.1%} of the pixels are saturated in every frame; use less light")
    return words


# Afterpulsing, and the test of the model


def _afterpulsing(stacks: Sequence[FrameStatistics], bits: int) -> dict[str, Value]:
    """Return the probability that a count causes another one in the next frame, from neighbouring frames of all stacks.

    Counts: Cov(x_t, x_t+1) = a Var(x). Planes: P(1 | 1 before) - P(1 | 0 before) = a (1 - P(1 | 0 before)).
    Fitting the mean of T frames leaves the share `kept` of a small correlation, and as much of the variance 1/(T - 1)
    of one pixel. Only a count can have a follower: n neighbours of p counts per frame give the variance (1 + a/p) / n.
    At a = 0.03 the standard error is right for counts and up to 5 % too large for planes, never too small.
    """
    measured = []
    for stack in stacks:
        if not (stack.variance > 0 and isfinite(stack.lag_covariance)):
            continue
        t, variance = stack.frames, stack.variance
        kept = (t - 2) ** 2 * (t + 1) / (t**2 * (t - 1))
        correlation = stack.lag_covariance / variance / kept
        room = max(1 - stack.mean * (1 - correlation), 1e-6) if bits == 1 else 1.0
        # Pixels of large variance count most: the mean of its square over the square of its mean, without its noise.
        square = (float((stack.pixel_variance**2).mean()) - variance / t) * (t - 1) / (t + 1)
        spread = max(square / variance**2, 1.0)
        measured.append((correlation / room, stack.mean, spread, stack.pixels * (t - 1) * kept * room**2))
    if not measured:
        return {}
    estimates, mean, spread, n = np.array(measured).T
    value, variances = 0.0, np.ones(len(measured))
    for _ in range(10):  # the variances depend on the value
        # One follower more than expected: a stack of few counts cannot show that there are none.
        followers = max(value, 0.0) + 1 / (n * mean)
        variances = (spread + followers / mean) / n
        value = float(np.average(estimates, weights=1 / variances))
    found = normal_interval(
        value, 1 / float((1 / variances).sum()), "per count, next frame", "lag-1 correlation", floor=0.0
    )
    return {"afterpulsing": found}


def _goodness(
    flats: Sequence[FrameStatistics], response: Response, s: float, fitted: int
) -> tuple[float, tuple[Array, ...]]:
    """Compare the flats' histograms with the model at each flat's own mean and PRNU `s`; NaN for 1-bit planes."""
    bits, paralyzable = response.bits, response.paralyzable
    if bits == 1 or not flats:
        return nan, ()
    shares = []
    for flat in flats:
        ratio = response.at(flat.exposure).ratio
        sensor = CountingSPAD(1.0, 0.0, ratio, bits, paralyzable)
        arrivals, *_ = matched_variance(flat.mean, bits, ratio, paralyzable)
        pmf = np.exp(sensor.log_pmf(np.maximum(arrivals * (1 + s * NODES), 0.0), 1.0))
        shares.append(WEIGHTS @ pmf)
    return goodness(flats, shares, fitted)

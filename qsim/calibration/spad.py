"""Calibrates a SPAD array: dark and flat counts -> dark rates, hot pixels, efficiency, PRNU, dead time, correlations.

    1-bit planes:  arrivals of a pixel = -ln(1 - ones/frames)          counts: arrivals = counts, dead time corrected

Means describe this array, and their intervals hold shot noise alone; median and percentiles of the dark rate describe
the population of its pixels. Detection efficiency times fill factor is relative to the light standard that gave the
photons of the flats. Dead time comes from the Fano factor against flux: the variance of counts is below Poisson where
an avalanche blocks the next. Afterpulsing and crosstalk come from neighbouring frames and pixels, and all other values
are corrected for both. Hot pixels are left out of all but the dark rates. Left out: a spread of dead time between
pixels, afterpulses within one frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite, log, nan, sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.correlations import LARGEST, Correlations, measure_correlations
from qsim.calibration.dark_distribution import Counts, Distribution, distribution
from qsim.calibration.dead_time import Pooled, Ratio, fitted_dead_time, matched_variance, moved_ratio
from qsim.calibration.flat_fields import DarkRates, dark_rates, light_of, most_counts, spad_flats, too_bright
from qsim.calibration.frame_statistics import FrameStatistics, check_noise, check_stacks
from qsim.calibration.goodness import NODES, WEIGHTS, goodness
from qsim.calibration.prnu import BY_DARK, BY_FLAT, Flat, hot_by_rate, measure_pattern, outliers, smooth_part, surface
from qsim.calibration.quantiles import chi2_quantile
from qsim.calibration.results import Z95, Calibration, Value, odd_efficiency, poisson_interval
from qsim.calibration.spad_response import NEIGHBOURS, Response, over_neighbours
from qsim.host import own_numbers

NO_EVENT_BOUND = -log(0.025)  # expected events at which none occurs in 2.5 % of the cases: end of a two-sided 95 %
FEW_COUNTS = 100  # from here on a normal interval differs from the exact one by about a tenth of its half-width
_LIT = 0.05  # of a typical pixel's counts, due to hot neighbours, above which its rate is not known
NEARLY_SATURATED = 50.0  # counts missing to saturation, below which a pixel's rate has an exact interval of its own


@own_numbers
def calibrate_spad(
    darks: Sequence[FrameStatistics],
    flats: Sequence[FrameStatistics],
    *,
    bits: int,
    dead_time: bool = True,
    paralyzable: bool = False,
) -> Calibration:
    """Estimate dark rates, hot pixels, PDE x fill, PRNU, afterpulsing, crosstalk and, of counts, dead time.

    `dead_time=False` assumes Poisson counts; the p-value shows whether that holds. Without `darks` the DCR is assumed
    to be 0, with a warning. `flats` may be missing; `ValueError` if both are, and for stacks that determine nothing.
    """
    check_stacks(darks, flats, bits)
    check_noise(darks, flats)
    array = _Array.measured(darks, flats, bits, dead_time, paralyzable)
    warnings = _dispersed([*darks, *flats]) + array.remarks()
    values: dict[str, Value] = {}
    maps: dict[str, Array] = {}
    if array.dark is not None:
        maps["dark_count_rate"] = np.maximum(array.dark.rate, 0.0)
        maps["hot_pixels"] = array.hot
        values |= _dark_values(array)
        warnings += _dark_remarks(array)
    else:
        warnings.append("no dark frames: dark counts are taken as 0 and end up in the efficiency and in PRNU")
    if flats:
        efficiency, remarks = _efficiency(array)
        values |= efficiency
        warnings += remarks
        pattern = measure_pattern(array.levels(), array.hot, BY_FLAT if array.dark is None else BY_DARK)
        if pattern is not None:
            values |= pattern.values()
            if not darks and pattern.left_out.any():
                warnings.append(f"{pattern.left_out.sum()} pixels left out as hot {BY_FLAT}")
        else:
            warnings.append("PRNU is not measured: the flats have one frame, or no light above the dark counts")
    if array.ratio is not None and array.ratio.high < inf:
        values["dead_time"] = array.dead_time_value(array.ratio)
    values |= array.correlations.values()
    p_value, residuals = _goodness(array)
    if p_value < 1e-3:
        warnings.append(
            f"the fitted histograms do not describe the counts (p = {p_value:.1g}): the model is wrong here"
        )
    model = "BinarySPAD" if bits == 1 else "CountingSPAD"
    return Calibration(model, bits, values, p_value, tuple(warnings), residuals, maps, paralyzable)


# The response of the array, and how far it may be wrong


@dataclass(frozen=True, eq=False)
class _Array:
    """The stacks of an array, the response of its pixels, and the pixels that are left out."""

    darks: Sequence[FrameStatistics]
    flats: Sequence[FrameStatistics]
    correlations: Correlations
    response: Response
    ratio: Ratio | None  # dead time; None: not measured
    dead_time: bool  # whether it was wanted
    dark: DarkRates | None
    found: Distribution | None  # of the dark rates
    hot: Array  # bool [H, W]: left out of all but the dark rates

    @classmethod
    def measured(
        cls,
        darks: Sequence[FrameStatistics],
        flats: Sequence[FrameStatistics],
        bits: int,
        dead_time: bool,
        paralyzable: bool,
    ) -> _Array:
        """Measure correlations, then hot pixels, then the dead time of the others."""
        correlations = measure_correlations([*darks, *flats], bits)
        usable = [flat for flat in flats if flat.frames > 1 and flat.mean > 0]
        exposure = usable[0].exposure if usable else 1.0  # without dead time it does not matter
        plain = Response(
            bits, 0.0, paralyzable, exposure, correlations.afterpulsing.value, correlations.crosstalk.value
        )
        wanted = dead_time and bits > 1
        array = cls(darks, flats, correlations, plain, None, wanted, None, None, np.zeros(_shape(darks, flats), bool))
        if wanted and usable:
            array = array._without_hot()
            ratio = fitted_dead_time(array._pooled(), plain)
            response = plain if ratio is None else replace(plain, ratio=ratio.value)
            array = replace(array, ratio=ratio, response=response)
        return array._with_hot()

    def _without_hot(self) -> _Array:
        """Return the array with its hot pixels by the median of the noisy dark rates: enough for the dead time."""
        if not self.darks:
            return self._with_hot()
        dark = dark_rates(self.darks, self.response)
        return replace(self, hot=hot_by_rate(dark.counts, float(np.median(dark.counts))) | dark.saturated)

    def _with_hot(self) -> _Array:
        """Return the array with its dark rates and hot pixels by the present response."""
        if not self.darks:
            hot = np.zeros_like(self.hot)
            for level in spad_flats(self.flats, None, hot, self.response):
                hot |= outliers(level)
            return replace(self, hot=hot)
        dark = dark_rates(self.darks, self.response)
        everywhere = np.ones_like(self.hot)
        found = _distribution(dark, everywhere)
        hot = hot_by_rate(dark.counts, found.median * dark.time) | dark.saturated
        # Hot pixels disturb the law of rates, and the law decides which
        # pixels are hot: once more without what they light.
        lit = self._lit_by_hot(dark, hot, found.median * dark.time)
        if lit.any() and not lit.all():
            found = _distribution(dark, ~lit)
            hot = hot_by_rate(dark.counts, found.median * dark.time) | dark.saturated
        return replace(self, dark=dark, found=found, hot=hot)

    def _lit_by_hot(self, dark: DarkRates, hot: Array, median: float) -> Array:
        """Return the pixels [H, W] that crosstalk of hot neighbours gives a good part of `median` counts.

        A hot pixel may fire more often than its code can tell, so what its neighbours owe to it is not known. They are
        left out of the law of rates, whatever their own rate is.
        """
        owed = over_neighbours(np.where(hot, dark.counts, 0.0)) * self.response.crosstalk
        return np.asarray(owed > _LIT * max(median, 0.0))

    @property
    def good(self) -> Array:
        """Pixels that are not left out, bool [H, W]; all, if none would remain."""
        return np.ones_like(self.hot) if self.hot.all() else ~self.hot

    def _pooled(self) -> list[Pooled]:
        return [Pooled.of(flat, self.good) for flat in self.flats if flat.frames > 1 and flat.mean > 0]

    def levels(self) -> list[Flat]:
        return spad_flats(self.flats, self.dark, self.hot, self.response)

    def reach(self, quantity: Callable[[Response], Array], base: Array) -> tuple[Array, Array]:
        """Return how far dead time, afterpulsing and crosstalk may move a quantity down and up, both squared.

        Each is moved to the ends of its 95 % interval. Afterpulsing and crosstalk move the dead time too.
        """
        down = np.zeros_like(base)
        up = np.zeros_like(base)
        moves = []
        if self.ratio is not None:
            moves += [quantity(replace(self.response, ratio=end)) - base for end in self.ratio.ends]
        for moved in self._moved():
            change = quantity(moved) - base
            moves += [change, -change]
        for move in moves:
            # Independent causes add in squares, on each side for itself: intervals need not be symmetric.
            down += np.minimum(move, 0) ** 2
            up += np.maximum(move, 0) ** 2
        return down, up

    def _moved(self) -> list[Response]:
        """Return the responses with afterpulsing and crosstalk at the ends of their intervals, if measured."""
        after = self.correlations.afterpulsing
        cross = self.correlations.crosstalk
        found = []
        if after.variance is not None:
            found.append(replace(self.response, afterpulsing=min(after.value + Z95 * after.sigma, LARGEST)))
        if cross.variance is not None:
            found.append(replace(self.response, crosstalk=min(cross.value + Z95 * cross.sigma, LARGEST)))
        if self.ratio is None:
            return found
        pooled = self._pooled()
        return [replace(moved, ratio=moved_ratio(pooled, self.response, moved)) for moved in found]

    def dead_time_value(self, ratio: Ratio) -> Value:
        """Return the dead time in seconds; afterpulsing and crosstalk widen its interval."""
        square = sum((moved.ratio - ratio.value) ** 2 for moved in self._moved())
        low = max(ratio.value - sqrt((ratio.value - ratio.low) ** 2 + square), 0.0)
        high = ratio.value + sqrt((ratio.high - ratio.value) ** 2 + square)
        method = "Fano factor against flux" + (", paralyzable" if self.response.paralyzable else "")
        exposure = self.response.exposure
        return Value(ratio.value * exposure, low * exposure, high * exposure, "s", method)

    def common(self, mean: float) -> float:
        """Return the variance of a mean over pixels over that of independent pixels: crosstalk is common to two."""
        c = max(self.correlations.crosstalk.value, 0.0)
        return 1 + 2 * NEIGHBOURS * c * (1 - min(mean, 1.0) if self.response.bits == 1 else 1.0)

    def remarks(self) -> list[str]:
        """Return what is not measured and what that means for the other values."""
        words = []
        if self.dead_time and self.ratio is None:
            words.append("dead time is not measured (flats of two frames or more are needed): taken as 0")
        if self.ratio is not None and self.ratio.high == inf:
            words.append(
                "dead time is not determined by these flats and is not printed: give brighter flats, or more frames"
            )
        if self.correlations.afterpulsing.variance is None:
            words.append(
                "afterpulsing and crosstalk are not measured (single frames of at least 3 are needed): both count as "
                "light and as dark counts in pde_fill, prnu and dark_count_rate"
            )
        return words


def _shape(darks: Sequence[FrameStatistics], flats: Sequence[FrameStatistics]) -> tuple[int, ...]:
    return next(iter([*darks, *flats])).total.shape


# Dark rates


def _distribution(dark: DarkRates, kept: Array) -> Distribution:
    """Return the distribution of the dark rates over the pixels in `kept`, bool [H, W]."""
    limit = 10 * max(float(np.median(dark.counts[kept])), 1.0) + 10
    bulk = (dark.counts <= limit) & kept
    counts = float(dark.counts[bulk].sum())
    # 1 for Poisson counts; correlated avalanches make it larger, saturation smaller.
    spread = float((dark.variance[bulk] * dark.time**2).sum()) / counts if counts > 0 else 1.0
    return distribution(Counts(dark.counts[kept], dark.time, max(spread, 0.05), dark.saturated[kept]))


def _dark_values(array: _Array) -> dict[str, Value]:
    """Return mean, median and percentiles of the dark rate, and the number of hot pixels."""
    dark = array.dark
    hot = array.hot
    assert dark is not None
    assert array.found is not None
    everywhere = np.ones_like(hot)
    values = {"dark_count_rate": _mean_rate(array, dark, everywhere)}
    if hot.any() and not hot.all():
        values["dark_count_rate_good"] = _mean_rate(array, dark, ~hot)
    values |= array.found.values
    rule = "above 10 medians and 5 standard errors"
    values["hot_pixels"] = Value.exact(float(hot.sum()), f"of {hot.size} pixels", rule)
    return values


def _mean_rate(array: _Array, dark: DarkRates, chosen: Array) -> Value:
    """Return the mean rate of some pixels.

    Few counts have the exact interval of a Poisson number. So have the counts that nearly saturated pixels miss.
    """
    what = "array mean" if chosen.all() else "mean of the pixels that are not hot"
    rate = float(dark.rate[chosen].mean())
    count = float(dark.counts[chosen].sum())
    pixel_time = dark.time * chosen.sum()
    if not any(stack.total[chosen].any() for stack in array.darks):
        return Value(0.0, 0.0, NO_EVENT_BOUND / pixel_time, "1/s", "no dark count: upper bound")
    exact = poisson_interval(max(rate, 0.0), count, "1/s", what) if 0 < count < FEW_COUNTS else None
    if exact is not None and not array.hot.any():
        return exact
    near = chosen & (dark.missing < NEARLY_SATURATED) & array.hot
    far = chosen & ~near
    mean = max(stack.mean for stack in array.darks)
    square = array.common(mean) * float(dark.variance[far].sum())
    # Squares of the errors of the sum: pixels far from saturation scatter alike on both sides, those near it do not
    below, above = _near_saturation(dark, near, array.response)
    n = float(chosen.sum())

    def quantity(response: Response) -> Array:
        return np.array([float(dark_rates(array.darks, response).rate[chosen].mean())])

    down, up = array.reach(quantity, np.array([rate]))
    below += Z95**2 * square
    above += Z95**2 * square
    if exact is not None:  # crosstalk of hot pixels is subtracted, which widens it
        below = max(below, ((exact.value - exact.low) * n) ** 2)
        above = max(above, ((exact.high - exact.value) * n) ** 2)
    low = rate - sqrt(below / n**2 + float(down[0]))
    high = rate + sqrt(above / n**2 + float(up[0]))
    if (dark.saturated & chosen).any():
        what = f"{what}; {(dark.saturated & chosen).sum()} pixels are saturated: a lower limit"
    return Value(max(rate, 0.0), max(low, 0.0), max(high, 0.0), "1/s", what)


def _near_saturation(dark: DarkRates, near: Array, response: Response) -> tuple[float, float]:
    """Return the summed squares of the distances to the ends of each nearly saturated pixel's interval, (1/s)^2."""
    below = 0.0
    above = 0.0
    for missing, frames, exposure, rate in zip(
        dark.missing[near], dark.frames[near], dark.exposure[near], dark.rate[near], strict=True
    ):
        here = response.at(exposure)
        most = most_counts(here)
        # The counts that a nearly saturated pixel misses are rare: their
        # exact interval is Garwood's (1936), by chi-square.
        fewest = chi2_quantile(0.025, 2 * missing) / 2 if missing > 0 else 0.0
        largest = chi2_quantile(0.975, 2 * max(missing, 0) + 2) / 2
        arrivals, codes = here.table(most)
        low = float(np.interp(most - largest / frames, codes, arrivals)) / exposure
        below += max(rate - low, 0.0) ** 2
        if fewest == 0:
            above = inf
        elif here.bits == 1:
            above += max(-log(fewest / frames) / exposure - rate, 0.0) ** 2
        else:
            above += max(float(np.interp(most - fewest / frames, codes, arrivals)) / exposure - rate, 0.0) ** 2
    return below, above


def _dark_remarks(array: _Array) -> list[str]:
    """Return remarks about dark frames without counts, saturated pixels and percentiles that are left out."""
    dark = array.dark
    found = array.found
    assert dark is not None
    assert found is not None
    words = []
    if not any(stack.total.any() for stack in array.darks):
        words.append("no dark count at all: the dark-count rate has an upper bound only")
    if dark.saturated.any():
        words.append(
            f"{dark.saturated.sum()} hot pixels are saturated in every dark frame and left out of efficiency, PRNU and "
            "dead time; the array's mean dark rate is a lower limit, which dark frames of a shorter exposure would mend"
        )
    if found.unresolved:
        words.append(
            f"the dark rate's {', '.join(found.unresolved)} over pixels are not printed: single pixels have too few "
            "counts, or too few pixels lie beyond; more or longer dark frames resolve them"
        )
    return words


# Efficiency


def _efficiency(array: _Array) -> tuple[dict[str, Value], list[str]]:
    """Return PDE x fill, avalanches per photon of the light standard: the weighted mean of the flats; and remarks."""
    good = array.good
    words = _saturation(array)
    known = [flat for flat in array.flats if flat.photons]
    used = [flat for flat in known if not too_bright(flat, good, array.response)]
    if not known:
        return {}, words
    if not used:
        return {}, [*words, "the efficiency is not printed: too many pixels are saturated in every flat of known light"]
    photons = np.array([flat.photons for flat in used], float)

    def slopes(response: Response) -> Array:
        dark = dark_rates(array.darks, response) if array.darks else None
        return np.array([_mean_light(flat, dark, good, response)[0] for flat in used]) / photons

    base = slopes(array.response)
    # Errors of the flats: each has its own counts, and all share the dark rates and the dead time
    covariance = np.diag([_mean_light(flat, array.dark, good, array.response)[1] for flat in used])
    covariance *= array.common(max(flat.mean for flat in used))
    if array.dark is not None:
        of_rate = array.common(0.0) * float(array.dark.variance[good].sum()) / good.sum() ** 2
        exposures = np.array([flat.exposure for flat in used])
        covariance = covariance + of_rate * np.outer(exposures, exposures)
    covariance = covariance / np.outer(photons, photons) + 1e-300 * np.eye(len(used))
    moved = np.zeros_like(base)
    if array.ratio is not None:
        ends = [slopes(replace(array.response, ratio=ratio)) for ratio in array.ratio.ends]
        moved = (ends[1] - ends[0]) / (2 * Z95)
    errors = covariance + np.outer(moved, moved)
    # The mean of the least variance of numbers with joint errors (Gauss and Markov)
    weights = np.linalg.solve(errors, np.ones(len(used)))
    weights /= weights.sum()
    value = float(weights @ base)
    if len(used) > 1:  # flats that scatter by more than their noise: the lamp was not steady
        # Birge's ratio: errors are scaled up where the numbers scatter more than they should, never down.
        scatter = float((base - value) @ np.linalg.solve(errors, base - value)) / (len(used) - 1)
        covariance = covariance * max(scatter, 1.0)
    down, up = array.reach(lambda response: np.array([weights @ slopes(response)]), np.array([value]))
    square = Z95**2 * float(weights @ covariance @ weights)
    low = value - sqrt(square + float(down[0]))
    high = value + sqrt(square + float(up[0]))
    found = Value(max(value, 0.0), max(low, 0.0), max(high, 0.0), "counts/photon", "light standard")
    return {"pde_fill": found}, words + odd_efficiency(found)


def _mean_light(flat: FrameStatistics, dark: DarkRates | None, good: Array, response: Response) -> tuple[float, float]:
    """Return the mean light over all pixels [avalanches], and its variance without that of the dark rates.

    The light of pixels left out is that of a smooth surface through the others, with their spread.
    """
    light, variance = light_of(flat, dark, response)
    mean = float(light[good].mean())
    noise = float(variance[good].sum()) / good.sum() ** 2
    # Pixels that are left out are lit all the same; without them a shaded corner would move the mean.
    missing = int((~good).sum())
    if missing == 0:
        return mean, noise
    basis = surface(good.shape, int(good.sum()))
    fitted = smooth_part(basis, light.ravel(), good.ravel())
    spread = float(np.var(light[good] - fitted[good.ravel()]))
    mean += float(fitted.mean() - fitted[good.ravel()].mean())
    return mean, noise + spread * missing / (good.size * good.sum())


def _saturation(array: _Array) -> list[str]:
    """Return warnings about flats in which good pixels hold the top code in every frame."""
    words = []
    for i, flat in enumerate(array.flats):
        full = float((flat.total >= flat.frames * (flat.histogram.size - 1))[array.good].mean())
        if full > 0:
            words.append(f"flat {i}: {full:.1%} of the pixels are saturated in every frame; use less light")
    return words


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


# The test of the model


def _goodness(array: _Array) -> tuple[float, tuple[Array, ...]]:
    """Compare the flats' histograms with the model; NaN for 1-bit planes.

    Good pixels have the mean of each flat and their spread of light; each hot pixel has its own mean.
    """
    if array.response.bits == 1 or not array.flats:
        return nan, ()
    good = array.good
    spread = _spread(array)
    shares = []
    for flat in array.flats:
        here = array.response.at(flat.exposure)
        mean = float(flat.total[good].mean()) / flat.frames
        arrivals = float(matched_variance(np.array([mean]), here).arrivals[0])
        # Gauss-Hermite quadrature over the spread of light from pixel to pixel.
        share = WEIGHTS @ here.pmf(np.maximum(arrivals * (1 + spread * NODES), 0.0))
        hot = here.of_stack(flat).value[~good]
        if hot.size:
            share = (good.sum() * share + here.pmf(np.maximum(hot, 0.0)).sum(axis=0)) / good.size
        shares.append(np.maximum(share, 0.0))
    return goodness(array.flats, shares, len(array.flats) + (array.ratio is not None))


def _spread(array: _Array) -> float:
    """Return the relative spread of light over the good pixels, with shading; it widens histograms."""
    good = array.good
    best = (0.0, inf)
    for flat in array.flats:
        if flat.frames < 2 or good.sum() < 3:
            continue
        here = array.response.of_stack(flat)
        light, _ = light_of(flat, array.dark, array.response)
        signal = here.slope * float(light[good].mean())
        if signal <= 0:
            continue
        means = flat.total[good] / flat.frames
        variance = float(means.var(ddof=1)) / signal**2
        if variance < best[1]:
            noise = float(flat.pixel_variance[good].mean()) / flat.frames
            best = (variance - noise / signal**2, variance)
    return sqrt(max(best[0], 0.0))

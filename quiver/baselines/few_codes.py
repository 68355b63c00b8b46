"""Estimates light from few codes without the bias that a curved response gives to their mean.

The light whose expected sum is the sum that was read is too bright where responses bend: by 7 % for eleven binary
planes at half a detection each. Two corrections are made here, both from the sensor's exact law of independent codes:

    few outcomes    steps between the estimates g of neighbouring outcomes are changed as little as unbiasedness allows:
                    the least BIAS * sum over levels of light theta of (E[g | theta] / theta - 1)^2
                             + sum over outcomes of (change of the step / step)^2
    many outcomes   the estimate minus its bias of second order, -m'' V / (2 m'^3) of a sum of mean m and variance V

Light up to `END` is fitted. Beyond, where more than 0.3 of all windows hold top codes only, estimates are too
low: that of such a window is finite, about the light of half a count below saturation. Below the sum of a dark window
estimates are negative, so that means over dim pixels are right; pictures clip them. Spikes are not independent (a pixel
keeps its charge), and their sums are left as they are; so are those of a sensor whose first code needs several
electrons. Sources: textbook.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from math import log

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.estimation import pieces
from qsim.sensor.sensor import Sensor

MOST = 512  # outcomes that are solved for; of more, the second order leaves less than 0.1 %
END = 0.3  # chance that all codes are the top one, up to which light the estimates are unbiased
CLEAR = 1.1  # standard deviations that the mean of a window then stays below its largest
BIAS = 3e4  # weight of the squared relative bias, over LIGHTS levels
LIGHTS = 160  # levels of light of a fit, over three decades
GRID = 1024  # levels of light from DARKEST on
COARSE = 8  # of these levels one is taken for the second order
FIRST = 0.05  # of the range of the mean, where its power of the light is taken
# That power, up to which estimates are made unbiased. Over QIS of 1 to 3 bits, gains of 0.22 to 1 and read noise of
# 0.05 to 0.4 e-, in windows of 3 and 11 codes, unbiased estimates then err at most 1.2 times as much (rms) as the
# plain ones; at powers of 1.2 to 1.5 it is up to 5 times, above up to 10, and the bias of three codes stays.
STEEPEST = 1.19
DARKEST = 1e-5  # of the brightest light: the first level above darkness
FEW = 1e-3  # Poisson events of a full exposure: the first level has no more, however bright the last one is

Times = tuple[tuple[float, int], ...]  # shares of a full exposure, and how many codes of a window have each


def times_of(shares: Iterable[float]) -> Times:
    """Return the distinct shares of the codes of a window in rising order, each with the number of its codes."""
    distinct, counts = np.unique(np.asarray(list(shares), float), return_counts=True)
    return tuple((float(share), int(count)) for share, count in zip(distinct, counts, strict=True))


def counts_suffice(sensor: Sensor) -> bool:
    """Return whether the sum of codes of one exposure tells all that they tell: sums of binary samples, and one bit."""
    return sensor.sums_planes or sensor.levels == 2


@lru_cache(maxsize=64)
def of_sums(sensor: Sensor, exposure: float, times: Times) -> Array:
    """Return the photons of a full exposure [s] for each sum of the codes of a window, float64 [sums], read-only."""
    top = sensor.levels - 1
    sums = np.arange(top * sum(count for _, count in times) + 1)
    light, mean, variance = _response(sensor, exposure, times)
    start = _plug_in(sums, light, mean)
    if sensor.keeps_charge or not _proportional(light, mean):
        found = start
    elif len(sums) <= MOST:
        light = _fitted_light(sensor, exposure, times)
        found = _solved(start, light, _sum_chances(sensor, exposure, times, light))
    else:
        found = start - np.interp(start, light, _second_order(light, mean, variance))
    found.setflags(write=False)
    return found


def outcome_shape(sensor: Sensor, times: Times) -> tuple[int, ...] | None:
    """Return the numbers of sums of the codes of each exposure; None where `of_outcomes` does not apply.

    It needs codes whose sums tell all that they tell, and at most MOST outcomes.
    """
    shape = tuple((sensor.levels - 1) * count + 1 for _, count in times)
    known = counts_suffice(sensor) and not sensor.keeps_charge
    return shape if known and np.prod(shape) <= MOST else None


@lru_cache(maxsize=64)
def of_outcomes(sensor: Sensor, exposure: float, times: Times) -> Array:
    """Return the photons for the sums of the codes of each exposure, float64 [`outcome_shape`], read-only.

    Outcomes are in the order of their likeliest light.
    """
    shape = outcome_shape(sensor, times)
    assert shape is not None
    light = levels(tuple(share for share, _ in times), sensor, exposure)
    chances = _binomial_chances(sensor, exposure, times, light)
    likeliest = peak(np.log(np.maximum(chances, 1e-300)).T, light)
    from_sums = of_sums(sensor, exposure, times)[np.indices(shape).sum(axis=0).ravel()]
    start = np.where(likeliest > 0, likeliest, from_sums)
    order = np.argsort(start, kind="stable")
    found = np.empty_like(start)
    fitted = _fitted_light(sensor, exposure, times)
    found[order] = _solved(start[order], fitted, _binomial_chances(sensor, exposure, times, fitted)[:, order])
    found = found.reshape(shape)
    found.setflags(write=False)
    return found


@lru_cache(maxsize=8)
def levels(shares: tuple[float, ...], sensor: Sensor, exposure: float) -> Array:
    """Return the levels of light [G] of full exposures on which estimates are looked for, evenly spaced in log.

    They end where the response of the shortest exposure ends, or that of the longest where responses fall again.
    """
    ends = [sensor.response(exposure * share).photons[-1] / share for share in shares]
    end = min(ends) if np.isfinite(sensor.brightest(exposure)) else max(ends)
    low = min(DARKEST * end, FEW / sensor.efficiency)
    return np.geomspace(low, end, 1 + round(log(low / end) / log(DARKEST) * (GRID - 1)))


@lru_cache(maxsize=16)
def second_order(sensor: Sensor, exposure: float, times: Times) -> tuple[Array, Array]:
    """Return levels of light [G] from 0 on, and the bias of second order of the likeliest photons there, [G].

    It is -sum of p' p'' / p over all codes / (2 I^2) for their Fisher information I (Cox and Snell, "A general
    definition of residuals", 1968), cut off at one standard deviation, and at the light itself: where the first code
    needs several electrons, dark codes tell next to nothing, and their deviation is that of bright light.
    """
    light = np.append(0.0, levels(tuple(share for share, _ in times), sensor, exposure)[::COARSE])
    above = np.zeros_like(light)
    information = np.zeros_like(light)
    for share, count in times:
        slope, bend, chance = _slopes(sensor, exposure * share, light * share)
        weight = np.divide(slope, chance, out=np.zeros_like(slope), where=chance > 1e-12)
        # Light of a share s of an exposure: each derivative over full photons brings a factor s.
        above += count * share**3 * (weight * bend).sum(axis=-1)
        information += count * share**2 * (weight * slope).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        bias = -above / (2 * information**2)
        most = np.minimum(1 / np.sqrt(information), light)
    bias[0] = 0.0  # in the dark a step of scoring is unbiased
    return light, np.where(information > 0, np.clip(bias, -most, most), 0.0)


def less_bias(likeliest: Array, sums: Array, sensor: Sensor, exposure: float, times: Times) -> Array:
    """Return the likeliest photons [N] without their bias of second order, from those and the sums [N] of the codes.

    A window that is likeliest in the dark has the photons of its sum; none has more than a window of top codes only.
    """
    table = of_sums(sensor, exposure, times)
    if sensor.keeps_charge:
        return np.minimum(likeliest, table[-1])
    light, bias = second_order(sensor, exposure, times)
    found = np.where(likeliest > 0, likeliest - np.interp(likeliest, light, bias), table[sums])
    return np.where(sums == len(table) - 1, table[-1], np.minimum(found, table[-1]))


def _slopes(sensor: Sensor, exposure: float, light: Array) -> tuple[Array, Array, Array]:
    """Return first and second derivative over photons of the chance of each code, and the chance, [G, levels] each."""
    step = 1e-3 * light + 1e-4 / sensor.efficiency
    low = np.maximum(light - step, 0)

    def slope_at(photons: Array) -> Array:
        parts = [sensor.dcdf(part, exposure) for part in pieces(photons, sensor.levels)]
        return np.diff(np.concatenate(parts), axis=-1, prepend=0.0)

    # The second derivative of a chance, as a difference of exact first ones; one-sided in the dark.
    bend = (slope_at(light + step) - slope_at(low)) / (light + step - low)[:, None]
    chance = np.concatenate([sensor.pmf(part, exposure) for part in pieces(light, sensor.levels)])
    return slope_at(light), bend, chance


def _response(sensor: Sensor, exposure: float, times: Times) -> tuple[Array, Array, Array]:
    """Return levels of light from 0 on, and mean and variance of the sum of a window's codes, where the mean rises."""
    light = np.append(0.0, levels(tuple(share for share, _ in times), sensor, exposure))
    mean = np.zeros_like(light)
    variance = np.zeros_like(light)
    for share, count in times:
        parts = pieces(light * share, sensor.levels)
        mean += count * np.concatenate([sensor.mean(part, exposure * share) for part in parts])
        variance += count * np.concatenate([sensor.variance(part, exposure * share) for part in parts])
    rising = np.concatenate([[True], mean[1:] > np.maximum.accumulate(mean)[:-1]])
    return light[rising], mean[rising], variance[rising]


def _proportional(light: Array, mean: Array) -> bool:
    """Return whether the response rises in proportion to light from the dark, so that dim light can be told at all.

    Where the first code needs many electrons it rises with a high power of the light, and dark codes say nothing.
    """
    rise = mean - mean[0]
    first = max(int(np.searchsorted(rise, FIRST * rise[-1])), 1)
    power = np.log(rise[first + 1] / rise[first]) / np.log(light[first + 1] / light[first])
    return bool(power <= STEEPEST)


def _plug_in(sums: Array, light: Array, mean: Array) -> Array:
    """Return the light at which each sum is expected: at most half a count below saturation, on a line below dark."""
    found = np.interp(np.minimum(sums, mean[-1] - 0.5), mean, light)
    first = np.searchsorted(mean, mean[0] + 0.01 * (mean[-1] - mean[0]))  # the slope of the first hundredth
    slope = light[first] / (mean[first] - mean[0])
    return found + slope * np.minimum(sums - mean[0], 0.0)


def _second_order(light: Array, mean: Array, variance: Array) -> Array:
    """Return the bias of `_plug_in` to second order, at most one standard deviation."""
    slope = np.gradient(mean, light)
    bend = np.gradient(slope, light)
    most = np.sqrt(variance) / slope
    return np.clip(-bend * variance / (2 * slope**3), -most, most)


def _solved(start: Array, light: Array, chance: Array) -> Array:
    """Return the estimates [outcomes] that the head of this file defines, from those before, in rising order.

    `chance` [G, outcomes] is that of each outcome at each of the levels `light` [G].
    """
    # Least squares: rows of bias, relative to the light, under rows that keep each change of a step small.
    weight = np.sqrt(BIAS) / (light + 0.01 * light[-1])
    steps = np.diff(start, prepend=start[0] - (start[1] - start[0]))
    # A change of one step moves all outcomes above it alike, which keeps the estimates in order.
    rises = np.tril(np.ones((len(start), len(start)))) * steps  # of relative changes of the steps
    rows = np.concatenate([weight[:, None] * (chance @ rises), np.eye(len(start))])
    goal = np.concatenate([weight * (light - chance @ start), np.zeros(len(start))])
    found: Array = start + rises @ np.linalg.lstsq(rows, goal, rcond=None)[0]
    return found


def _fitted_light(sensor: Sensor, exposure: float, times: Times) -> Array:
    """Return the levels of light [LIGHTS] over which estimates are unbiased: darkness, and three decades up to END."""
    light, mean, variance = _response(sensor, exposure, times)
    full = np.ones_like(light)
    for share, count in times:
        full *= sensor.pmf(light * share, exposure * share)[:, -1] ** count
    # Two conditions: top codes alone are rare, and the mean is still some deviations below its largest.
    clear = (full <= END) & (mean[-1] - mean >= CLEAR * np.sqrt(variance))
    last = max(int(np.argmin(clear)) - 1, 1) if not clear.all() else len(light) - 1
    return np.append(0.0, np.geomspace(1e-3 * light[last], light[last], LIGHTS - 1))


def _sum_chances(sensor: Sensor, exposure: float, times: Times, light: Array) -> Array:
    """Return the chance of each sum of a window's codes at levels of light, [G, sums]."""
    size = (sensor.levels - 1) * sum(count for _, count in times) + 1
    spectrum = np.ones(1, np.complex128)
    for share, count in times:
        # The law of a sum is the product of transforms; twice the length, so that the convolution does not wrap around.
        spectrum = spectrum * np.fft.rfft(sensor.pmf(light * share, exposure * share), 2 * size, axis=1) ** count
    return np.maximum(np.fft.irfft(spectrum, 2 * size, axis=1)[:, :size], 0.0)


def _binomial_chances(sensor: Sensor, exposure: float, times: Times, light: Array) -> Array:
    """Return the chance of each outcome of `of_outcomes`, sums of binary samples, at levels of light: [G, outcomes]."""
    from scipy import stats

    top = sensor.levels - 1
    joint = np.ones((len(light), 1))
    for share, count in times:
        one = np.clip(sensor.mean(light * share, exposure * share) / top, 0.0, 1.0)[:, None]
        each = stats.binom.pmf(np.arange(top * count + 1), top * count, one)
        joint = (joint[:, :, None] * each[:, None, :]).reshape(len(light), -1)
    return joint


def peak(table: Array, light: Array) -> Array:
    """Return the light of the largest value of each row of a table [N, G], by a parabola in log light.

    It is 0 where the first value is the largest.
    """
    best = table.argmax(axis=1)
    inner = np.clip(best, 1, len(light) - 2)
    rows = np.arange(len(table))
    before, middle, after = (table[rows, inner + step] for step in (-1, 0, 1))
    bend = before - 2 * middle + after
    # The vertex of the parabola through three points, in steps of the grid.
    shift = np.where(bend < 0, (before - after) / (2 * np.where(bend < 0, bend, -1.0)), 0.0)
    shift = np.where(best == inner, np.clip(shift, -1, 1), 0.0)
    spacing = np.log(light[1] / light[0])
    return np.where(best == 0, 0.0, np.exp(np.log(light[best]) + shift * spacing))

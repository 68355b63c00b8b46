"""Computes mean and variance of a QIS code from the codes near the mean, or by series, at any number of bits.

    X = gain (min(N, full_well) + read_noise z) + offset,    code = clip(rint X, 0, top)

Levels of light fall into four groups (`moments`):

* **settled**: every code is 0, the top one, or that of the full well;
* **by series**: nothing is clipped. The error of rounding, saw(x) = x - rint x, is a Fourier series, and so are its
  moments by the characteristic function of X, which is a closed form. Read noise above FINE codes ends the series;
* **by thresholds**: nothing is clipped, and read noise is so small that codes are steps of the number of electrons,
  many electrons each. Each step is where a smooth Poisson law would have it, shifted by less than an electron;
* **summed**: sums over the electrons near the mean of the moments that n electrons have. Where read noise blurs
  many electrons, every second, fourth ... term suffices: the sum over a part of the integers is exact to the transform
  of its terms at the new period.

Error: below 1e-10 of the mean and of the variance; absolutely, probabilities below 1e-17 are left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil, inf, pi
from typing import Protocol

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.poisson import poisson_log_pmf

SIGMAS = 8.6  # beyond them, 1e-17 of a normal law is left out
LONGER = 45.0  # electrons by which the upper tail of a dim Poisson law is longer
FINE = 3e-3  # codes of read noise; less makes the series longer than the sums
COARSE = 0.3  # codes per electron; below, thresholds are fewer than electrons
BRIGHT = 1e4  # electrons from which a Poisson law is as smooth as the expansion around a threshold needs
BLURRED = 1.6  # variance of X [codes^2] at which rounding is uniform: exp(-2 pi^2 1.6) = 2e-14
SPREAD = 1e-2  # variance of X [codes^2] of the series; less is too small a part of its terms
NEGLIGIBLE = 30.0  # exponents: exp(-30) = 1e-13
NARROW = 1e-3  # variance over the squared distance from the middle of a table
WIDE = 8.0  # codes of read noise from which sums over codes are integrals with five corrections
TABLED = 4e6  # electrons up to which log n! rounds to 4e-9, which the mean over thousands of terms reduces


class Converter(Protocol):
    """The parameters of a QIS behind the photodiode."""

    @property
    def gain(self) -> float: ...
    @property
    def offset(self) -> float: ...
    @property
    def read_noise(self) -> float: ...
    @property
    def full_well(self) -> float | None: ...
    @property
    def levels(self) -> int: ...


@dataclass(frozen=True)
class Chain:
    """The numbers of a QIS behind the photodiode."""

    gain: float  # codes/e-
    offset: float  # codes
    noise: float  # e- rms
    well: float  # e-, or infinity
    top: int

    @classmethod
    def of(cls, sensor: Converter) -> Chain:
        well = inf if sensor.full_well is None else sensor.full_well
        return cls(sensor.gain, sensor.offset, sensor.read_noise, well, sensor.levels - 1)

    @property
    def blur(self) -> float:
        """The read noise in codes."""
        return self.gain * self.noise

    def level(self, electrons: Array) -> Array:
        """Return the codes before noise, rounding and clipping: electrons [...] -> [...]."""
        return self.gain * np.minimum(electrons, self.well) + self.offset


def moments(sensor: Converter, mean: Array) -> tuple[Array, Array]:
    """Return mean and variance of the code: expected electrons [p] -> [p] each."""
    chain = Chain.of(sensor)
    least, most = window(mean)
    low = chain.level(least) - SIGMAS * chain.blur
    high = chain.level(most) + SIGMAS * chain.blur
    first = np.zeros(len(mean))
    second = np.zeros(len(mean))
    # Codes that no light of the window leaves, 0 and the top, need no sum.
    first[low > chain.top - 0.5] = chain.top
    full = least >= chain.well
    if full.any():
        (first[full],), (second[full],) = given(chain, np.array([chain.well]))
    left = ~full & (low <= chain.top - 0.5) & (high >= 0.5)
    free = left & (low > -0.5) & (high < chain.top + 0.5) & (most < chain.well)
    spread = chain.gain**2 * mean + chain.blur**2
    # The cheapest law that is exact to 1e-13 at this light: series, smooth thresholds, or the sum over electrons.
    by_series = free & (chain.blur >= FINE) & (spread >= SPREAD)
    smooth = (mean >= BRIGHT) & (chain.gain**2 * mean >= BLURRED)
    by_thresholds = free & ~by_series & smooth & (chain.gain < COARSE)
    for chosen, method in (
        (by_series, _by_series),
        (by_thresholds, _by_thresholds),
        (left & ~by_series & ~by_thresholds, _summed),
    ):
        if chosen.any():
            first[chosen], second[chosen] = method(chain, mean[chosen])
    return first, np.maximum(second, 0.0)


def window(mean: Array) -> tuple[Array, Array]:
    """Return the least and the most electrons of expected electrons [p] that count."""
    reach = SIGMAS * np.sqrt(mean)
    return np.maximum(np.floor(mean - reach), 0.0), np.ceil(mean + reach + LONGER)


# ---- Without clipping


def _by_series(chain: Chain, mean: Array) -> tuple[Array, Array]:
    """Return the moments of rint X, from E exp(i t X) = exp(i t offset - t^2 blur^2 / 2 + mean (exp(i t gain) - 1)).

    saw(x) = sum over j of (-1)^(j + 1) sin(2 pi j x) / (pi j),
    saw(x)^2 = 1/12 + sum over j of (-1)^j cos(2 pi j x) / (pi j)^2.
    """
    terms = np.full(len(mean), np.sqrt(NEGLIGIBLE / 2) / (pi * chain.blur))
    if chain.noise >= 2.5:  # e-: no term that read noise leaves is near a period of the electrons
        terms = np.sqrt(NEGLIGIBLE / (2 * (pi * chain.blur) ** 2 + 8 * chain.gain**2 * mean))
    saw, product, square = (np.zeros(len(mean)) for _ in range(3))
    for j in range(1, ceil(terms.max()) + 1):
        some = np.flatnonzero(terms >= j - 1)
        t = 2 * pi * j
        light = mean[some]
        # Phases are taken modulo one turn before they are multiplied: j gain may be many turns.
        angle, turn = (2 * pi * (value - np.rint(value)) for value in (j * chain.gain, j * chain.offset))
        # cos x - 1 as -2 sin^2(x / 2), which keeps its digits for small gains.
        change = complex(-2 * np.sin(angle / 2) ** 2, np.sin(angle))  # exp(i t gain) - 1
        size = np.exp(light * change.real - (t * chain.blur) ** 2 / 2)
        wave = size * np.exp(1j * (turn + light * change.imag))
        sign = (-1) ** (j + 1) / (pi * j)
        # rint X = X - saw(X). Mean and variance need E saw, E (X saw) and E saw^2;
        # the second is the derivative of the characteristic function.
        saw[some] += sign * wave.imag
        product[some] += sign * (wave * (1j * t * chain.blur**2 + light * chain.gain * change)).imag
        square[some] -= sign / (pi * j) * wave.real
    variance = chain.gain**2 * mean + chain.blur**2 + 1 / 12
    return chain.gain * mean + chain.offset - saw, variance - 2 * product + square - saw**2


def _by_thresholds(chain: Chain, mean: Array) -> tuple[Array, Array]:
    """Return the moments of rint X as those of a smooth law of electrons, whose thresholds are shifted by d.

    A smooth density q with the Poisson probabilities between n - 1/2 and n + 1/2 is p - p''/24 + ...; its variance is
    mean - 1/12. P(code > k) = E G(t_k + d) with G' = -q, expanded to the third moment of d.
    """
    codes = np.arange(chain.top)
    places = (codes + 0.5 - chain.offset) / chain.gain
    shifts = _shifts(chain, codes, places)
    base = chain.gain * mean + chain.offset
    starts, stops = (np.searchsorted(places, mean + side * SIGMAS * np.sqrt(mean)) for side in (-1, 1))
    first = np.empty(len(mean))
    second = np.empty(len(mean))
    for i, light in enumerate(mean):
        some = slice(starts[i], stops[i])
        x = places[some]
        ratio = np.log1p((x - light) / light)
        # The Poisson density at a real number of electrons, by Stirling's series.
        p = np.exp(x - light - x * ratio - 0.5 * (np.log(2 * pi * light) + ratio) - 1 / (12 * x))
        slope = -ratio - 0.5 / x  # of log p
        bend = slope**2 - 1 / x  # p'' / p
        d1, d2, d3 = shifts[:, some]
        # Taylor's series of E G(t + d), with the correction -p''/24 of the smooth density in its first term.
        change = -p * (d1 * (1 - bend / 24) + d2 / 2 * slope + d3 / 6 * bend)
        first[i] = change.sum()
        second[i] = change @ (2 * (codes[some] - base[i]) + 1)
    return base + first, chain.gain**2 * (mean - 1 / 12) + 1 / 12 + second - first**2


def _shifts(chain: Chain, codes: Array, places: Array) -> Array:
    """Return the first three moments of the shifts of thresholds [K], in electrons: [3, K].

    A threshold at t is passed by n > t: by n - 1/2 of the smooth law. Read noise moves it by a normal number.
    """
    from scipy.special import ndtr

    if chain.noise == 0:
        around = np.floor(places)[:, None] + np.arange(-1, 3)
        kept = np.rint(chain.gain * around + chain.offset) <= codes[:, None]  # ties as the ADC rounds them
        shift = around[:, 0] + np.count_nonzero(kept, axis=1) - 0.5 - places
        return np.stack([shift, shift**2, shift**3])
    if chain.noise > 1.25:  # e-: single electrons are blurred
        return np.stack([0 * places, np.full(len(places), chain.noise**2 + 1 / 12), 0 * places])
    width = ceil(SIGMAS * chain.noise) + 1
    result = np.zeros((3, len(places)))
    for step in range(-width, width + 1):
        n = np.floor(places) + step
        chance = ndtr((n - places) / chain.noise) - ndtr((n - 1 - places) / chain.noise)
        for r in range(3):
            result[r] += chance * (n - 0.5 - places) ** (r + 1)
    return result


# ---- Sums over electrons


def _summed(chain: Chain, mean: Array) -> tuple[Array, Array]:
    """Return the moments of the code from those of n electrons, weighted by their probabilities."""
    from scipy.special import gammaln

    first = np.empty(len(mean))
    second = np.empty(len(mean))
    for levels, n in shared_tables(chain, mean):
        codes, spread = given(chain, n)
        middle = codes[len(codes) // 2]
        away = codes - middle
        table = np.stack([np.ones(len(n)), away, spread + away**2])
        log_factorial = gammaln(n + 1) if n[-1] < TABLED else None
        least, most = window(mean[levels])
        starts = np.searchsorted(n, least)
        stops = np.searchsorted(n, most, "right")
        for i, start, stop in zip(levels, starts, stops, strict=True):
            some = slice(start, stop)
            if log_factorial is None or mean[i] == 0:
                weight = np.exp(poisson_log_pmf(mean[i], n[some]))
            else:
                # log Pois up to a constant: the weights are divided by their sum in the end.
                weight = n[some] * np.log(mean[i])
                weight -= log_factorial[some]
                weight -= weight.max()
                np.exp(weight, out=weight)
            whole, shift, square = table[:, some] @ weight
            first[i] = middle + shift / whole
            second[i] = square / whole - (shift / whole) ** 2
            if second[i] < NARROW * (shift / whole) ** 2:  # digits were lost
                own = codes[start + int(weight.argmax())]
                near = codes[some] - own
                first[i] = own + weight @ near / whole
                second[i] = weight @ (spread[some] + (codes[some] - first[i]) ** 2) / whole
    return first, second


def shared_tables(chain: Chain, mean: Array) -> Iterator[tuple[Array, Array]]:
    """Yield levels of light int [i] that share a table, and its electrons [n], evenly spaced."""
    order = np.argsort(mean)
    least, most = window(mean)
    root = np.sqrt(mean)
    with np.errstate(invalid="ignore"):
        # Sums of smooth terms are exact in steps of about half the narrower of their widths, of read noise
        # and of the Poisson law. Steps are powers of two, so that levels of light share tables.
        steps = np.where(chain.noise > 0, 0.5 * chain.noise * root / (chain.noise + root), 1.0)
    steps = np.where(most >= chain.well, 1.0, np.nan_to_num(steps))
    steps = 2.0 ** np.floor(np.log2(np.maximum(steps, 1.0)))
    start = 0
    while start < len(order):
        head = order[start]
        step = steps[head]
        longest = 4 * (most[head] - least[head])
        stop = start + 1
        while stop < len(order) and steps[order[stop]] == step and most[order[stop]] - least[head] <= longest:
            stop += 1
        levels = order[start:stop]
        yield levels, np.arange(least[head] // step, most[levels].max() // step + 2) * step
        start = stop


def given(chain: Chain, electrons: Array) -> tuple[Array, Array]:
    """Return mean and variance of the code of n electrons [n]: [n] each."""
    x = chain.level(electrons)
    blur = chain.blur
    top = chain.top
    if blur == 0:
        return np.clip(np.rint(x), 0, top), np.zeros(len(x))
    if blur < FINE:
        codes = np.clip(np.rint(x), 0, top)
        spread = np.zeros(len(x))
        near = np.abs(x - np.rint(x)) > 0.5 - SIGMAS * blur
        codes[near], spread[near] = _counted(x[near], blur, top)
        return codes, spread
    near = (x < SIGMAS * blur) | (x > top - SIGMAS * blur)
    codes = x.copy()
    spread = np.full(len(x), blur**2 + 1 / 12)
    if blur >= WIDE:
        codes[near], spread[near] = _wide(x[near], blur, top)
        return codes, spread
    # From 1.25 on the first term of the series is below 1e-13, and rounding adds 1/12 and nothing else.
    if blur < 1.25:
        # The series of a narrow blur has many terms; to count its few codes is cheaper.
        near |= blur < 0.3
        codes[~near], spread[~near] = _rounded(x[~near], blur)
    codes[near], spread[near] = _counted(x[near], blur, top)
    return codes, spread


def _rounded(x: Array, blur: float) -> tuple[Array, Array]:
    """Return the moments of rint(x + blur z) by the series of `_by_series`."""
    saw, product, square = (np.zeros(len(x)) for _ in range(3))
    for j in range(1, ceil(np.sqrt(NEGLIGIBLE / 2) / (pi * blur)) + 1):
        t = 2 * pi * j
        # Rounding takes off a sawtooth. Its Fourier series, averaged over a
        # normal z, is damped by exp(-(2 pi j blur)^2 / 2).
        size = (-1) ** (j + 1) / (pi * j) * np.exp(-((t * blur) ** 2) / 2)
        sine = size * np.sin(t * x)
        cosine = size * np.cos(t * x)
        saw += sine
        product += t * blur**2 * cosine
        square -= cosine / (pi * j)
    return x - saw, blur**2 + 1 / 12 - 2 * product + square - saw**2


def _counted(x: Array, blur: float, top: int) -> tuple[Array, Array]:
    """Return the moments of clip(rint(x + blur z), 0, top) by its codes one by one; blur is small."""
    from scipy.special import ndtr

    anchor = np.clip(np.rint(x), 0, top)  # small probabilities are summed on either side of it
    lowest = np.floor(x - SIGMAS * blur)
    first = np.zeros(len(x))
    second = np.zeros(len(x))
    for j in range(ceil(2 * SIGMAS * blur) + 2):
        k = lowest + j
        below = k < anchor
        # E clip(rint) = anchor + sum P(code > k) above it - sum P(code <= k) below it.
        passed = ndtr(np.where(below, k + 0.5 - x, x - k - 0.5) / blur)
        passed[(k < 0) | (k >= top)] = 0.0
        first += np.where(below, -passed, passed)
        second += np.where(below, 2 * (anchor - k) - 1, 2 * (k - anchor) + 1) * passed
    return anchor + first, second - first**2


def _wide(x: Array, blur: float, top: int) -> tuple[Array, Array]:
    """Return the moments of clip(rint(x + blur z), 0, top) from what lies beyond the two ends; blur >= WIDE.

    The nearer end is mirrored to 0. What lies beyond it is subtracted from the moments without clipping; of an x beyond
    it, what lies within is summed.
    """
    mirrored = x > top / 2
    x = np.where(mirrored, top - x, x)
    inside = x >= 0
    beyond, beyond2 = _tail(np.abs(x) / blur, blur)
    far, far2 = _tail((top - x) / blur, blur)
    first = np.where(inside, x + beyond - far, beyond - far)
    around = blur**2 + 1 / 12 - beyond2 - 2 * x * beyond - far2 - 2 * (top - x) * far
    second = np.where(inside, around - (first - x) ** 2, beyond2 - far2 - 2 * top * far - first**2)
    return np.where(mirrored, top - first, first), np.maximum(second, 0.0)


def _tail(z: Array, blur: float) -> tuple[Array, Array]:
    """Return sums of P(y) and of 2 y P(y) over y = 1/2, 3/2, ...; P(y) is normal, P(Z > z + y / blur).

    Midpoint sums are integrals with corrections by the odd derivatives at their beginning (Euler, Maclaurin).
    """
    from scipy.special import ndtr

    tail = ndtr(-z)
    density = np.exp(-z * z / 2) / np.sqrt(2 * pi)
    hermite: list[Array] = [
        np.ones(len(z)),
        z,
        z**2 - 1,
        z**3 - 3 * z,
        z**4 - 6 * z**2 + 3,
        z**5 - 10 * z**3 + 15 * z,
        z**6 - 15 * z**4 + 45 * z**2 - 15,
        z**7 - 21 * z**5 + 105 * z**3 - 105 * z,
        z**8 - 28 * z**6 + 210 * z**4 - 420 * z**2 + 105,
    ]
    # The derivatives of P along y: those of a normal tail are Hermite polynomials times its density.
    slopes = [tail, *((-1) ** (r + 1) * h * density / blur ** (r + 1) for r, h in enumerate(hermite))]
    first = blur * (density - z * tail)
    second = blur**2 * ((1 + z * z) * tail - z * density)
    for r, weight in ((1, 1 / 24), (3, -7 / 5760), (5, 31 / 967680), (7, -127 / 154828800), (9, 73 / 3503554560)):
        first = first + weight * slopes[r]
        second = second + weight * 2 * r * slopes[r - 1]
    return first, second

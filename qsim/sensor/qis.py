"""Models the quanta image sensor's pixel: Poisson electrons, Gaussian read noise, an ADC of few bits.

    code = clip(round(gain (min(N, full_well) + read_noise z) + offset), 0, 2^b - 1),   N ~ Poisson(QE photons + dark t)

Rounding is half to even: with read noise 0 ties happen, and gain n + offset is then its float64 value.
With t_k = (k + 1/2 - offset) / gain, the table of the mixture is P(code <= k | n) = Phi((t_k - min(n, full_well)) /
read_noise).

Single steps F_k = P(code <= k) need no table. Given n electrons, P(code <= k | n) is 1 for few of them, and 0 or a
constant (full well) for many. It lies in between only where read noise blurs the threshold:

    F_k = P(N < first_k) + sum over the blurred n of Pois(n) weight_k(n) + tail_k P(N >= last_k)

So a step costs the width of the blur, 17 read noises, however many electrons a code holds. The compiled engine's curves
(curves.py) are made of such steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from math import ceil, floor, inf
from typing import ClassVar

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key, normal, uniform_pair, words
from qsim.sensor import qis_codes, qis_moments
from qsim.sensor.code_search import decide
from qsim.sensor.compiled.curves import by_pairs, falling
from qsim.sensor.compiled.plan import MOST_BITS, Electrons, Plan
from qsim.sensor.distribution import MANY_BITS, MOST_EVENTS, require_bits, require_number, require_size
from qsim.sensor.poisson import Mixture, poisson_log_pmf, poisson_quantile
from qsim.sensor.sensor import Sensor

_REACH = 39.0  # sigmas: Phi(-39) = 1e-333 is 0 in float64
# most levels, and electrons between them, that share one table
_BLOCK = 256
_SPAN = 4096
_LONG = 1 << 13  # electrons of a table x (codes + 32); above it, few steps are computed one by one
_LONGEST_TABLE = 2048  # electrons in a table that short sums are made of
_BLUR = 8.3  # sigmas: 1 - Phi(8.3) = 5e-17 is negligible beside 1
_FARTHEST = 1e15  # electrons; no light reaches further
_WIDEST = 1 << 22  # numbers in all thresholds of a sensor
_SIZES = {  # of numbers that are not 0
    "quantum_efficiency": (1e-12, 1.0),
    "dark_current": (1e-30, MOST_EVENTS),
    "read_noise": (1e-6, 1e9),
    "gain": (1e-9, 1e9),
    "offset": (1e-12, 1e12),
    "full_well": (1e-6, MOST_EVENTS),
}
NOISY = 20.0  # e- of read noise, from which few cumulants state the law of the electrons read
_CHUNK = 1 << 13  # pairs of one block of work: its arrays stay in the cache
_PROCESS_BITS = 8  # above, codes are drawn step by step instead of through their cdf


@dataclass(frozen=True)
class QIS(Sensor):
    """A quanta image sensor: one read-out of a few electrons per exposure."""

    quantum_efficiency: float  # electrons per photon, 0 ... 1
    dark_current: float  # e-/s
    read_noise: float  # e- rms
    bits: int  # 1 ... 16
    gain: float = 1.0  # codes per electron
    offset: float = 0.0  # codes
    full_well: float | None = None  # e-

    code_model: ClassVar[str] = "multibit"
    takes_slices: ClassVar[bool] = True
    has_read_out: ClassVar[bool] = True
    tabulated: ClassVar[bool] = True
    law_follows_exposure: ClassVar[bool] = False

    def __post_init__(self) -> None:
        require_number(self, "quantum_efficiency", 0, 1, open_low=True)
        require_number(self, "dark_current", 0)
        require_number(self, "read_noise", 0)
        require_bits(self)
        require_number(self, "gain", 0, open_low=True)
        require_number(self, "offset", -inf)
        if self.full_well is not None:
            require_number(self, "full_well", 0, open_low=True)
        for name, (least, most) in _SIZES.items():
            require_size(self, name, least, most)

    @property
    def efficiency(self) -> float:
        return self.quantum_efficiency

    @property
    def dark_rate(self) -> float:
        return self.dark_current

    @property
    def blur(self) -> float:
        return self.read_noise

    def with_dark_rate(self, rate: float) -> QIS:
        return replace(self, dark_current=rate)

    def law(self, *, summed: bool = False, disturbed: bool = False, read_out: bool = False) -> str:
        return "process" if read_out or self.bits > _PROCESS_BITS else "table"

    def at_depth(self, bits: int) -> QIS | None:
        return replace(self, bits=bits) if (self.gain, self.offset) == (1.0, 0.0) else None

    def without_read_noise(self) -> QIS:
        return replace(self, read_noise=0.0)

    def full_well_code(self, sigmas: float) -> int | None:
        if self.full_well is None:
            return None
        electrons = max(self.full_well - sigmas * self.read_noise, self.full_well / 2)
        return int(self.codes_of(np.array(electrons)))

    def white(self, exposure: float) -> float:
        """Return the photons at which x = 1: top code / (gain QE); offset, dark current and full well do not enter."""
        return (self.levels - 1) / (self.gain * self.quantum_efficiency)

    def cdf_of(self, arrivals: Array, exposure: float) -> Array:
        return np.concatenate([t.evaluate_cdf(arrivals) for _, t in self._tables()], axis=1)

    def log_pmf_of(self, arrivals: Array, exposure: float, wanted: Array | None = None) -> Array:
        parts = []
        for codes, table in self._tables():
            parts.append(table.evaluate_log_pmf(arrivals, None if wanted is None else wanted[:, codes]))
        return np.concatenate(parts, axis=1)

    def slope_of(self, arrivals: Array, exposure: float) -> Array:
        return np.concatenate([t.evaluate_slope(arrivals) for _, t in self._tables()], axis=1)

    @property
    def many_codes(self) -> bool:
        return self.bits >= MANY_BITS or table_length(self) > _LONGEST_TABLE

    def moments_of(self, arrivals: Array, exposure: float) -> tuple[Array, Array]:
        if not self.many_codes:
            return self.dense_moments_of(arrivals, exposure)
        return qis_moments.moments(self, arrivals)

    def code_laws(self, codes: Array, arrivals: float, exposure: float) -> tuple[Array, Array]:
        chain = qis_moments.Chain.of(self)
        found = []
        for code in codes.tolist():

            def chance(electrons: Array, code: int = code) -> Array:
                electrons = electrons if self.full_well is None else np.minimum(electrons, self.full_well)
                z = _normal_thresholds(self, electrons, np.array([code - 1, code]))
                return log_normal_difference(z[:, 0], z[:, 1])

            found.append(qis_codes.code_law(chain, code, arrivals, chance))
        logs, slopes = np.array(found).reshape(-1, 2).T
        return logs, slopes

    def _tables(self) -> Iterator[tuple[slice, Mixture]]:
        """Yield some codes and their table, so few that a table stays below 20 MB.

        All codes share one table for 8 bits and a gain above 1/16.
        """
        step = min(_BLOCK, max(1, int(_SPAN * self.gain)))
        for start in range(0, self.levels, step):
            stop = min(start + step, self.levels)
            yield slice(start, stop), electron_table(self, start, stop)

    def codes_of(self, electrons: Array) -> Array:
        """Convert float electrons [...], read noise included, to codes [...]: the only place of gain and rounding."""
        return np.clip(np.rint(self.gain * electrons + self.offset), 0, self.levels - 1).astype(self.dtype)

    def decide(self, u: Array, photons: Array, exposure: float) -> tuple[Array, Array]:
        """As every sensor; where the table is long, from the steps around the code alone, to the same 1e-13."""
        from scipy.special import ndtri

        steps = thresholds(self) if table_length(self) * (self.levels + 32) > _LONG else None
        if steps is None:
            return super().decide(u, photons, exposure)
        mean = self.arrivals(photons, exposure).ravel()
        variance = mean + self.read_noise**2
        z = ndtri(u.ravel())
        # Cornish-Fisher: the quantile of electrons plus read noise from mean, variance
        # and third cumulant, which is the mean, as read noise has none.
        skew = np.divide(mean, variance, out=np.zeros_like(mean), where=variance > 0) * (z * z - 1) / 6
        electrons = mean + z * np.sqrt(variance) + skew
        if self.full_well is not None:
            electrons = np.minimum(electrons, self.full_well)
        guess = np.clip(np.rint(self.gain * electrons + self.offset), 0, self.levels - 1)
        codes, near = decide(steps.cdf, self.levels - 1, u.ravel(), mean, guess)
        return codes.reshape(u.shape), near.reshape(u.shape) <= 2.0**-32

    def kernel_plan(self, exposure: float) -> Plan | None:
        """Return a plan of short sums over electrons, or of curves where those are too long."""
        if self.bits > MOST_BITS:
            return None
        dark = self.dark_rate * exposure
        count = self.levels - 1
        if (sums := self.short_sums()) is not None:
            return Plan.summed(self.efficiency, dark, sums)
        steps: Thresholds | BlurredSteps | None = self._blurred_steps() or thresholds(self)
        if steps is None:
            return None
        return Plan.looked_up(
            self.efficiency, dark, falling(by_pairs(steps.cdf, count), by_pairs(steps.slope, count), count)
        )

    def _blurred_steps(self) -> BlurredSteps | None:
        """Return the steps of strong read noise; None for less, and where the full well is in reach."""
        places = (np.arange(self.levels - 1) + 0.5 - self.offset) / self.gain
        # The full well cuts the law off, and its cumulants no longer describe it.
        if self.read_noise < NOISY or (self.full_well or inf) < places[-1] + _BLUR * self.read_noise:
            return None
        return BlurredSteps(places, self.read_noise)

    def short_sums(self) -> Electrons | None:
        """Return the steps of at most 8 bits as sums over electrons; None if they are too long."""
        if table_length(self) > _LONGEST_TABLE:
            return None
        table = electron_table(self, 0, self.levels)
        cdf = np.concatenate([np.ones((table.first, self.levels - 1)), table.cdf[:, :-1]])
        return Electrons.of(cdf, table.tail_cdf[:-1])

    def _draw_frame(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int]) -> Array:
        if self.bits <= _PROCESS_BITS:
            return super()._draw_frame(photons, exposure, key, origin)
        return self.read_out(photons, exposure, key, origin)

    def read_out(
        self,
        photons: Array,
        exposure: float,
        key: Key,
        origin: tuple[int, int] = (0, 0),
        noise: Array | float = 1.0,
        offset: Array | float = 0.0,
    ) -> Array:
        """Return codes [H, W] of photons [H, W]: electrons, read noise and ADC, each inverted at a 64-bit number.

        `noise` is relative to `read_noise`, and `offset` [codes] is added to that of the sensor: a number, or [H, W].
        Error: that of the inverted functions, below 1e-13 in any probability (tested for means to 65 000).
        """
        w = [words(key, photons.shape, origin, redraw) for redraw in range(4)]
        electrons = poisson_quantile(self.arrivals(photons, exposure), *uniform_pair(w[0], w[1]))
        if self.full_well is not None:
            electrons = np.minimum(electrons, self.full_well)
        below, above = uniform_pair(w[2], w[3])
        # Inverting both laws, not rejecting, uses as many numbers for every pixel: so a key names them all.
        electrons = electrons + self.read_noise * noise * normal(below, above)
        return self.codes_of(electrons + offset / self.gain)

    def read_out_pmf(
        self, photons: Array, exposure: float, noise: Array | float = 1.0, offset: Array | float = 0.0
    ) -> Array:
        """Return P(code) of `read_out`: photons [..., H, W] -> [..., H, W, levels], with the same noise and offset.

        Sum over electrons n of Pois(n) P(code | n).
        """
        from scipy.special import ndtr, pdtr, pdtrik

        mean = self.arrivals(photons, exposure)
        spread = np.broadcast_to(self.read_noise * noise, mean.shape)
        shift = np.broadcast_to(offset / self.gain, mean.shape)
        steps = (np.arange(self.levels - 1) + 0.5 - self.offset) / self.gain
        # Electrons are summed to where 1e-12 of the brightest pixel's law
        # is left; that rest has the last number of them.
        last = int(np.ceil(pdtrik(1 - 1e-12, max(float(mean.max()), 1e-6)))) + 1
        below = np.zeros_like(mean)
        cdf = np.zeros((*mean.shape, self.levels))
        for n in range(last + 1):
            up_to = pdtr(n, mean) if n < last else np.ones_like(mean)
            electrons = n if self.full_well is None else min(n, self.full_well)
            with np.errstate(divide="ignore", invalid="ignore"):
                passed = ndtr((steps - (electrons + shift)[..., None]) / spread[..., None])
            # Without read noise the step is where the ADC rounds it, ties included.
            exact = self.codes_of(electrons + shift)[..., None] <= np.arange(self.levels - 1)
            passed = np.where(spread[..., None] > 0, passed, exact)
            cdf[..., :-1] += (up_to - below)[..., None] * passed
            below = up_to
        cdf[..., -1] = 1.0
        return np.diff(cdf, axis=-1, prepend=0.0)


def table_length(sensor: QIS) -> float:
    """Return the number of electrons in the table of all codes, as `electron_table` makes it."""
    high = (sensor.levels - 1.5 - sensor.offset) / sensor.gain + _REACH * sensor.read_noise + 1
    return max(min(high, inf if sensor.full_well is None else sensor.full_well), 0.0)


@dataclass(frozen=True, eq=False)
class Thresholds:
    """P(code <= k | n) of K codes below the top one: 1 for n < first, weights [K, W] from there on, then the tail."""

    first: Array  # int [K]
    weights: Array  # [K, W]
    tail: Array  # [K]

    def cdf(self, codes: Array, mean: Array) -> Array:
        """Return F of pairs: codes int [p], Poisson means [p] -> [p]."""
        from scipy.special import gammainc, gammaincc

        def block(k: Array, some: Array) -> Array:
            first = self.first[k]
            last = self.first[k] + self.weights.shape[1]
            result = np.where(first > 0, gammaincc(np.maximum(first, 1), some), 0.0) + self._sum(self.weights, k, some)
            if self.tail[k].any():
                result += self.tail[k] * np.where(last > 0, gammainc(np.maximum(last, 1), some), 1.0)
            return np.minimum(result, 1.0)

        return _in_blocks(block, codes, mean)

    def slope(self, codes: Array, mean: Array) -> Array:
        """Return dF/dmean of pairs: codes int [p], Poisson means [p] -> [p]."""
        ends = np.column_stack([np.ones(len(self.first)), self.weights, self.tail])
        # d/dmean of a Poisson sum is the sum over the steps of its weights (poisson.py).
        falls = np.diff(ends, axis=1)  # of P(code <= k | n) from n = first - 1 on

        def block(k: Array, some: Array) -> Array:
            before = self.first[k] - 1
            edge = np.where(before >= 0, np.exp(poisson_log_pmf(some, np.maximum(before, 0))) * falls[k, 0], 0.0)
            return edge + self._sum(falls[:, 1:], k, some)

        return _in_blocks(block, codes, mean)

    def _sum(self, table: Array, k: Array, mean: Array) -> Array:
        """Return the sum over n of Pois(n; mean) table[k, n - first]: [p].

        Electrons whose weight is below 1e-19 are left out.
        """
        width = table.shape[1]
        reach = 9 * np.sqrt(mean) + 25
        start = np.clip(np.floor(mean - reach) - self.first[k], 0, width).astype(np.intp)
        stop = np.clip(np.ceil(mean + reach) - self.first[k], 0, width).astype(np.intp)
        total = np.zeros(len(mean))
        n = (self.first[k] + start).astype(float)
        steps = int((stop - start).max(initial=0))
        if not steps:
            return total
        # A column of zeros at the end of each row, where pixels wait that are through before others.
        flat = np.column_stack([table, np.zeros(len(table))]).ravel()
        at = k * (width + 1) + start
        end = k * (width + 1) + width
        weight = np.exp(poisson_log_pmf(mean, n))
        for _ in range(steps):
            total += weight * flat[at]
            n += 1
            # P(n) = P(n - 1) mean / n: cheaper than the logarithm of a factorial.
            weight *= mean / n
            at = np.minimum(at + 1, end)
        return total


@dataclass(frozen=True, eq=False)
class BlurredSteps:
    """P(N + noise z <= t_k) of thresholds t_k [K] in electrons, for read noise of NOISY electrons or more.

    Edgeworth's series of the third order: all cumulants of N are its mean, and the error is below 1e-9.
    """

    places: Array  # [K], e-
    noise: float  # e- rms

    def cdf(self, codes: Array, mean: Array) -> Array:
        """Return F of pairs: codes int [p], Poisson means [p] -> [p]."""
        return self._below(self.places[np.asarray(codes, np.intp)], np.asarray(mean, float))

    def slope(self, codes: Array, mean: Array) -> Array:
        """Return dF/dmean of pairs: the change by one more electron."""
        places = self.places[np.asarray(codes, np.intp)]
        mean = np.asarray(mean, float)
        return self._below(places - 1, mean) - self._below(places, mean)

    def _below(self, places: Array, mean: Array) -> Array:
        from scipy.special import ndtr

        variance = mean + self.noise**2
        x = np.clip((places - mean) / np.sqrt(variance), -40, 40)
        # Edgeworth's series to third order (Abramowitz and Stegun, 26.2): all cumulants of the
        # electrons equal their mean, and read noise adds to the second alone.
        k3, k4, k5 = (mean / variance ** (order / 2) for order in (3, 4, 5))
        h2 = x**2 - 1
        h3 = x**3 - 3 * x
        h4 = x**4 - 6 * x**2 + 3
        h5 = x**5 - 10 * x**3 + 15 * x
        h6 = x**6 - 15 * x**4 + 45 * x**2 - 15
        h8 = x**8 - 28 * x**6 + 210 * x**4 - 420 * x**2 + 105
        series = k3 / 6 * h2 + k4 / 24 * h3 + k3**2 / 72 * h5
        series += k5 / 120 * h4 + k3 * k4 / 144 * h6 + k3**3 / 1296 * h8
        return np.clip(ndtr(x) - np.exp(-x * x / 2) / np.sqrt(2 * np.pi) * series, 0.0, 1.0)


@lru_cache(maxsize=32)
def thresholds(sensor: QIS) -> Thresholds | None:
    """Return the steps of a sensor of at most 8 bits, for evaluation one by one.

    None where read noise blurs more electrons than fit into memory.
    """
    from scipy.special import ndtr

    top = sensor.levels - 1
    noise = sensor.read_noise
    codes = np.arange(top)
    well = inf if sensor.full_well is None else sensor.full_well
    at = (codes + 0.5 - sensor.offset) / sensor.gain  # electrons
    width = ceil(2 * _BLUR * noise) + 1 if noise else 0
    if top * width > _WIDEST:
        return None
    if noise:
        first = np.clip(np.floor(at - _BLUR * noise), 0, _FARTHEST)
        electrons = np.minimum(first[:, None] + np.arange(width), well)
        tail = ndtr((at - well) / noise)
        return Thresholds(first.astype(np.int64), ndtr((at[:, None] - electrons) / noise), tail)
    # Where the ADC sees no noise, a threshold lies between two electrons:
    # these are tried by its own rounding, which decides ties.
    around = np.floor(at)[:, None] + np.arange(-1, 3)
    kept = sensor.codes_of(around) <= codes[:, None]  # ties as the ADC rounds them
    first = np.clip(
        np.minimum(around[:, 0] + np.count_nonzero(kept, axis=1), ceil(well) if well < inf else inf), 0, _FARTHEST
    )
    never = np.full(top, False) if well == inf else sensor.codes_of(np.array(well)) <= codes
    return Thresholds(first.astype(np.int64), np.empty((top, 0)), never.astype(float))


@lru_cache(maxsize=32)
def electron_table(sensor: QIS, start: int, stop: int) -> Mixture:
    """Return P(code | n electrons) for the codes start ... stop - 1."""
    from scipy.special import ndtr

    top = sensor.levels - 1
    low, high = ((k + 0.5 - sensor.offset) / sensor.gain for k in (start - 1, min(stop, top) - 1))
    reach = _REACH * sensor.read_noise + 1
    well = inf if sensor.full_well is None else sensor.full_well
    # Outside of the reach of read noise all electrons give codes below the block, or above it.
    first = max(floor(min(low - reach, well)), 0) if start else 0
    last = max(ceil(min(high + reach, well)), first)
    # The last row stands for all electrons from there on: those of a full
    # well, or so many that no code of the block is left.
    saturated = well if last >= well else inf  # electrons of all n >= last
    electrons = np.append(np.arange(first, last, dtype=float), saturated)
    z = _normal_thresholds(sensor, electrons, np.arange(start - 1, stop))
    cdf = ndtr(z[:, 1:])
    log_pmf = log_normal_difference(z[:, :-1], z[:, 1:])
    slope = -np.exp(log_normal_difference(z[1:, 1:], z[:-1, 1:]))
    return Mixture(first, cdf[:-1], log_pmf[:-1], slope, cdf[-1], log_pmf[-1])


def _normal_thresholds(sensor: QIS, electrons: Array, codes: Array) -> Array:
    """Return z of P(code <= k | electrons) = Phi(z): [n, k]; -inf for k = -1, +inf for the top code."""
    if sensor.read_noise == 0:
        return np.where(sensor.codes_of(electrons)[:, None] <= codes, inf, -inf)
    z = ((codes + 0.5 - sensor.offset) / sensor.gain - electrons[:, None]) / sensor.read_noise
    z[:, codes < 0] = -inf
    z[:, codes >= sensor.levels - 1] = inf
    return z


def log_normal_difference(low: Array, high: Array) -> Array:
    """Return log(Phi(high) - Phi(low)), broadcast, for low <= high, without cancellation on either side of 0."""
    from scipy.special import erf, log_ndtr

    # Above 0 both values of Phi are near 1 and cancel. Phi(b) - Phi(a) = Phi(-a) - Phi(-b) moves them below 0.
    flip = low > 0
    start = np.where(flip, -high, low)
    end = np.where(flip, -low, high)
    with np.errstate(divide="ignore", invalid="ignore"):
        a = log_ndtr(start)
        b = log_ndtr(end)
        one_side = b + np.log1p(-np.exp(a - b))
        astride = np.log((erf(end / np.sqrt(2)) + erf(-start / np.sqrt(2))) / 2)
    return np.where(start == end, -inf, np.where(end > 0, astride, one_side))


def _in_blocks(function: Callable[[Array, Array], Array], codes: Array, mean: Array) -> Array:
    codes = np.asarray(codes, np.intp)
    mean = np.asarray(mean, float)
    result = np.empty(len(mean))
    for start in range(0, len(mean), _CHUNK):
        some = slice(start, start + _CHUNK)
        result[some] = function(codes[some], mean[some])
    return result

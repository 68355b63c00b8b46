"""Single-photon avalanche diodes: clocked pixels (BinarySPAD) and free-running counters with dead time (CountingSPAD).

Avalanches that the pixel could see are a Poisson process; arrivals = PDE photons + dark_count_rate exposure of them are
expected in an exposure.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf
from typing import ClassVar

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key, uniform, uniform_pair, words
from qsim.sensor import paralyzable_steps
from qsim.sensor.paralyzable import Paralyzable, most_counts
from qsim.sensor.poisson import poisson_log_pmf
from qsim.sensor.qis_steps import decide, search
from qsim.sensor.sensor import Sensor, require_bits, require_number

_PLANES_BITS = 8  # of a sum of planes; above, the sum is drawn at once
_BATCH = 1 << 17  # words of a batch of planes
_ROWS = 1 << 14  # pixels of a block that is drawn step by step
_UNDERFLOW = 1e-290  # below, sums in floating point may have lost terms


@dataclass(frozen=True)
class SPAD(Sensor):
    """What both pixels are: avalanches per photon, and in the dark."""

    pde: float  # avalanches per photon, 0 ... 1
    dark_count_rate: float  # 1/s

    def __post_init__(self) -> None:
        require_number(self, "pde", 0, 1, open_low=True)
        require_number(self, "dark_count_rate", 0)
        require_bits(self)

    @property
    def efficiency(self) -> float:
        return self.pde

    @property
    def dark_rate(self) -> float:
        return self.dark_count_rate

    def white(self, exposure: float) -> float:
        """(2^bits - 1) / PDE: light that would fill the code if every plane could count, or nothing were dead."""
        return (self.levels - 1) / self.pde


@dataclass(frozen=True)
class BinarySPAD(SPAD):
    """A clocked pixel: one plane says whether anything arrived; a code is the sum of M = 2^bits - 1 planes.

    **Planes are drawn one by one**, up to 8 bits. Frame f of a b-bit stream is the sum of planes f M ... f M + M - 1,
    and plane p is what a 1-bit sensor draws for frame p of the same key. So two bit depths of one plane rate use the
    same photons: seven frames of the 1-bit stream add up to one frame of the 3-bit stream, at constant light and, with
    `sample_planes` at any number of bits, when every plane sees its own instant of the motion. Above 8 bits `sample`
    draws the binomial sum from one number per pixel: 65 535 planes would take 2.5 ms.
    """

    bits: int = 1  # 1 ... 16

    code_model: ClassVar[str] = "binary_sum"

    @property
    def planes(self) -> int:
        """Binary planes in one code, M = 2^bits - 1."""
        return self.levels - 1

    def _cdf(self, arrivals: Array, exposure: float) -> Array:
        cdf = np.minimum(np.cumsum(np.exp(self._log_pmf(arrivals, exposure)), axis=1), 1.0)
        cdf[:, -1] = 1.0
        return cdf

    def _log_pmf(self, arrivals: Array, exposure: float, wanted: Array | None = None) -> Array:
        """Binomial(M, p) with p = 1 - exp(-arrivals / M)."""
        from scipy.special import xlogy

        k, per_plane = np.arange(self.levels), arrivals[:, None] / self.planes
        return _log_binomials(self.planes) + xlogy(k, -np.expm1(-per_plane)) - (self.planes - k) * per_plane

    def _slope(self, arrivals: Array, exposure: float) -> Array:
        """dF_k/dp = -M C(M-1, k) p^k (1-p)^(M-1-k), dp/darrivals = (1-p) / M."""
        from scipy.special import xlogy

        k, per_plane = np.arange(self.planes), arrivals[:, None] / self.planes
        log_slope = _log_binomials(self.planes - 1) + xlogy(k, -np.expm1(-per_plane)) - (self.planes - k) * per_plane
        return np.pad(-np.exp(log_slope), ((0, 0), (0, 1)))

    def sample_planes(
        self,
        photons: Array,
        exposure: float,
        *,
        key: Key,
        origin: tuple[int, int] = (0, 0),
        engine: str = "auto",
    ) -> Array:
        """Codes [T, H, W] from a clip at the plane rate: photons and exposure of each plane, [T M, H, W]."""
        if photons.ndim != 3 or len(photons) % self.planes:
            raise ValueError(
                f"planes of a {self.bits}-bit code come in groups of {self.planes}: [T {self.planes}, H, W], "
                f"got {list(photons.shape)}"
            )
        single = replace(self, bits=1)
        codes = np.empty((len(photons) // self.planes, *photons.shape[1:]), self.dtype)
        for t in range(len(codes)):
            group = photons[t * self.planes : (t + 1) * self.planes]
            at = key.at((key.frame + t) * self.planes)
            codes[t] = single.sample(group, exposure, key=at, origin=origin, engine=engine).sum(axis=0)
        return codes

    def _draw(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int]) -> Array:
        if self.bits <= _PLANES_BITS:
            return self._draw_planes(photons, exposure, key, origin)
        return self._draw_sum(photons, exposure, key, origin)

    def _draw_sum(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int]) -> Array:
        """The smallest code k with u < P(Binomial(M, p) <= k); u has 64 bits.

        Error: that of the regularised beta function, below 1e-11 in any probability (tested at 9 and 16 bits).
        """
        from scipy.special import betainc, ndtri

        below, above = (u.ravel() for u in uniform_pair(*(words(key, photons.shape, origin, n) for n in (0, 1))))
        m, per_plane = self.planes, self.arrivals(photons, exposure).ravel() / self.planes
        dark, lit = np.exp(-per_plane), -np.expm1(-per_plane)

        def passed(k: Array, left: Array) -> Array:
            q, p, u, v = dark[left], lit[left], below[left], above[left]
            low = u < 0.5
            tail = betainc(np.where(low, m - k, k + 1.0), np.where(low, k + 1.0, m - k), np.where(low, q, p))
            return np.where(low, u >= tail, v <= tail)

        z = np.where(below < 0.5, ndtri(below), -ndtri(above))
        guess = m * lit + z * np.sqrt(m * lit * dark)
        return search(passed, m, np.rint(guess)).reshape(photons.shape).astype(self.dtype)

    def _draw_planes(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int]) -> Array:
        """Many planes of a few rows at a time: all planes of a code share their light.

        Error: the rounding of one exponential, 1e-16 in the probability of each plane, at any number of bits.
        """
        single, m = replace(self, bits=1), self.planes
        codes = np.zeros(photons.shape, self.dtype)
        rows = max(1, _BATCH // max(photons.shape[1], 1))
        for y in range(0, len(photons), rows):
            light = np.asarray(photons[y : y + rows], np.float64) / m
            dark = single.cdf(light, exposure / m)[..., 0]
            step = max(1, _BATCH // max(light.size, 1))
            for plane in range(0, m, step):
                at = key.at(key.frame * m + plane)
                batch, place = (min(step, m - plane), *light.shape), (origin[0] + y, origin[1])
                first = words(at, batch, place)
                u = uniform(first)
                fires = u >= dark
                tail = np.abs(u - dark) <= 2.0**-32
                if tail.any():
                    second = words(at, batch, place, redraw=1)[tail]
                    lit = np.broadcast_to(light, batch)[tail]
                    fires[tail] = single.codes_at(first[tail], second, lit, exposure / m)
                codes[y : y + rows] += fires.sum(axis=0, dtype=self.dtype)
        return codes


@dataclass(frozen=True)
class PlaneByPlane(BinarySPAD):
    """A clocked pixel as streams without `drawn_by` have it: planes one by one at any number of bits."""

    def _draw(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int]) -> Array:
        return self._draw_planes(photons, exposure, key, origin)


def _log_binomials(n: int) -> Array:
    """log C(n, k), k = 0 ... n."""
    from scipy.special import gammaln

    k = np.arange(n + 1)
    return gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)


@dataclass(frozen=True)
class CountingSPAD(SPAD):
    """A free-running counter, live at the start of the exposure; codes clip at 2^bits - 1.

    Non-paralyzable: after a count the pixel is dead for `dead_time`, and k counts fit if the k-th arrival of the live
    time comes soon enough: P(N >= k) = P(Gamma(k) <= arrivals (1 - (k - 1) dead_time / exposure)).
    Paralyzable: every arrival, counted or not, starts a new dead time; see `deadtime.py`.
    """

    dead_time: float  # s
    bits: int  # 1 ... 16
    paralyzable: bool = False

    code_model: ClassVar[str] = "counting"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_number(self, "dead_time", 0)
        if not isinstance(self.paralyzable, bool):
            raise ValueError(f"CountingSPAD.paralyzable is true or false, got {self.paralyzable!r}")

    def brightest(self, exposure: float) -> float:
        """Paralyzable: E[N] = 1 - exp(-n a) + n (1 - a) exp(-n a) of n arrivals, a = dead time / exposure < 1, peaks at
        n a (1 - a) = 1.
        """
        a = self.dead_time / exposure
        if not (self.paralyzable and 0 < a < 1):
            return inf
        return (1 / (a * (1 - a)) - self.dark_count_rate * exposure) / self.pde

    def dead_time_law(self, exposure: float) -> Paralyzable | None:
        """That of a paralyzable pixel; None for the other one, without dead time the two are one."""
        return Paralyzable(exposure / self.dead_time, self.levels) if self.paralyzable and self.dead_time else None

    def _live(self, arrivals: Array, exposure: float) -> Array:
        """Arrivals expected in the live time that is left after k counts: [p, levels]."""
        share = 1 - np.arange(self.levels) * (self.dead_time / exposure)
        return arrivals[:, None] * np.maximum(share, 0)

    def steps(self, exposure: float) -> tuple[Callable[[Array, Array], Array], Callable[[Array, Array], Array]]:
        """F_k and dF_k/darrivals of a non-paralyzable pixel for pairs: codes int [p], Poisson means [p] -> [p]."""
        from scipy.special import gammaincc

        share = np.maximum(1 - np.arange(self.levels) * (self.dead_time / exposure), 0)
        return (
            lambda k, mean: gammaincc(k + 1.0, mean * share[k]),
            lambda k, mean: -share[k] * np.exp(poisson_log_pmf(mean * share[k], k)),
        )

    def _cdf(self, arrivals: Array, exposure: float) -> Array:
        """F_k = P(N < k + 1) = Q(k + 1, live_k): the regularised incomplete gamma function."""
        from scipy.special import gammaincc

        if (paralyzable := self.dead_time_law(exposure)) is not None:
            return paralyzable.cdf(arrivals)
        cdf = gammaincc(np.arange(1.0, self.levels + 1), self._live(arrivals, exposure))
        cdf[:, -1] = 1.0
        return cdf

    def _log_pmf(self, arrivals: Array, exposure: float, wanted: Array | None = None) -> Array:
        """P(N = k) = Pois(k; live_(k-1)) + integral of Pois(k; x) from live_k to live_(k-1): two positive terms."""
        from scipy.special import gammainc, gammaincc

        if (paralyzable := self.dead_time_law(exposure)) is not None:
            return paralyzable.log_pmf(arrivals, wanted)
        live = self._live(arrivals, exposure)
        before, k = np.column_stack([arrivals, live[:, :-1]]), np.arange(self.levels)
        at_once = poisson_log_pmf(before, k)
        with np.errstate(divide="ignore"):
            lower = gammainc(k + 1.0, before) - gammainc(k + 1.0, live)
            upper = gammaincc(k + 1.0, live) - gammaincc(k + 1.0, before)
            pmf = np.exp(at_once) + np.where(before < k + 1, lower, upper)
            pmf[:, -1] = gammainc(k[-1], before[:, -1])
            result = np.where(
                pmf > _UNDERFLOW, np.log(np.maximum(pmf, _UNDERFLOW)), _log_tail(at_once, before, live, k)
            )
        result[:, 0] = -arrivals
        return result

    def _draw(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int]) -> Array:
        law = self.dead_time_law(exposure)
        if law is not None and law.by_steps:
            return self._draw_rows(photons, exposure, key, origin, _ROWS)
        if self.bits <= 8:
            return super()._draw(photons, exposure, key, origin)
        if law is not None:
            enough = min(self.bits, most_counts(exposure / self.dead_time).bit_length())
            draw = super()._draw if enough == self.bits else replace(self, bits=enough)._draw
            return draw(photons, exposure, key, origin).astype(self.dtype)
        return self._draw_by_bisection(photons, exposure, key, origin)

    def decide(self, u: Array, photons: Array, exposure: float) -> tuple[Array, Array]:
        """As every sensor; the steps around the code alone, but for few bits or few paralyzable dead times."""
        from scipy.special import ndtri

        law = self.dead_time_law(exposure)
        if law is not None and law.by_steps:
            codes, near = self._paralyzable_codes(law.ratio, u.ravel(), 1 - u.ravel(), photons, exposure)
            return codes.reshape(u.shape), near.reshape(u.shape) <= 2.0**-32
        if self.bits <= 3 or law is not None:
            return super().decide(u, photons, exposure)
        cdf, _ = self.steps(exposure)
        mean = self.arrivals(photons, exposure).ravel()
        guess = self._guess(mean, exposure, ndtri(u.ravel()))
        codes, near = decide(cdf, self.levels - 1, u.ravel(), mean, guess)
        return codes.reshape(u.shape), near.reshape(u.shape) <= 2.0**-32

    def codes_at(self, first: Array, second: Array, photons: Array, exposure: float) -> Array:
        """As every sensor; paralyzable pixels of many dead times to 1e-11 in any probability."""
        law = self.dead_time_law(exposure)
        if law is None or not law.by_steps:
            return super().codes_at(first, second, photons, exposure)
        return self._paralyzable_codes(law.ratio, *uniform_pair(first, second), photons, exposure)[0]

    def _paralyzable_codes(
        self, ratio: float, below: Array, above: Array, photons: Array, exposure: float
    ) -> tuple[Array, Array]:
        top = min(self.levels - 1, most_counts(ratio))
        return paralyzable_steps.decide(ratio, top, below, above, self.arrivals(photons, exposure).ravel())

    def _guess(self, arrivals: Array, exposure: float, z: Array) -> Array:
        """About the code at z standard deviations: of a renewal count, gaps a dead time and a wait."""
        dead = 1 + arrivals * (self.dead_time / exposure)
        return np.rint((arrivals + dead - 1) / dead + z * np.sqrt(arrivals / dead) / dead)

    def _draw_by_bisection(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int]) -> Array:
        """The smallest code k with u < F_k without looking at all 2^bits of them; u has 64 bits.

        Error: that of the regularised gamma function, below 1e-11 in any probability (tested to 65 534 counts).
        """
        from scipy.special import gammainc, gammaincc, ndtri

        below, above = (u.ravel() for u in uniform_pair(*(words(key, photons.shape, origin, n) for n in (0, 1))))
        arrivals, share = self.arrivals(photons, exposure).ravel(), self.dead_time / exposure

        def passed(k: Array, left: Array) -> Array:
            live, u, v = arrivals[left] * np.maximum(1 - k * share, 0), below[left], above[left]
            low = u < 0.5
            result = np.empty(len(left), bool)
            result[low] = u[low] >= gammaincc(k[low] + 1, live[low])
            result[~low] = v[~low] <= gammainc(k[~low] + 1, live[~low])
            return result

        guess = self._guess(arrivals, exposure, np.where(below < 0.5, ndtri(below), -ndtri(above)))
        return search(passed, self.levels - 1, guess).reshape(photons.shape).astype(self.dtype)

    def _slope(self, arrivals: Array, exposure: float) -> Array:
        """dF_k/dlive_k = -Pois(k; live_k)."""
        if (paralyzable := self.dead_time_law(exposure)) is not None:
            return paralyzable.slope(arrivals)
        k = np.arange(self.levels)
        share = np.maximum(1 - k * (self.dead_time / exposure), 0)
        slope = -share * np.exp(poisson_log_pmf(arrivals[:, None] * share, k))
        slope[:, -1] = 0.0
        return slope


def _log_tail(at_once: Array, before: Array, live: Array, k: Array) -> Array:
    """log P(N = k) below 1e-290, to a few per cent of P: the integral from its larger end and its slope there."""
    bright = live > k
    end = np.where(bright, live, before)
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = np.maximum(np.abs(1 - k / end), 1e-9)
        integral = poisson_log_pmf(end, k) + np.log(-np.expm1(-rate * (before - live)) / rate)
    return np.logaddexp(at_once, np.where(end > 0, integral, -np.inf))

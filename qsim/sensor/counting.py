"""Models free-running counters with dead time (CountingSPAD): the avalanches of an exposure, one by one.

Avalanches that the pixel could detect are a Poisson process. An exposure expects PDE photons + dark_count_rate exposure
of them, called arrivals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf
from typing import ClassVar

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key, normal, uniform_pair, words
from qsim.sensor import counting_moments, paralyzable
from qsim.sensor.code_search import decide, search
from qsim.sensor.compiled.curves import Curves, below, by_pairs, falling
from qsim.sensor.compiled.plan import MOST_BITS, Live, Plan
from qsim.sensor.distribution import LONGEST, SHORTEST, check_exposure, require_number, require_size
from qsim.sensor.paralyzable import Paralyzable, most_counts
from qsim.sensor.poisson import poisson_log_pmf
from qsim.sensor.spad import SPAD

_ROWS = 1 << 14  # pixels of a block whose steps are computed one by one
_SUMMED_BITS = 4  # of counters whose steps a kernel adds up
_PARALYSED = 45.0  # arrivals per dead time, at least one of which then comes in each: the code is 1 to 1e-16
_BRIGHT = 1000.0  # arrivals up to which those of many dead times have curves
_UNDERFLOW = 1e-290  # below it, float64 sums may have lost terms


@dataclass(frozen=True)
class CountingSPAD(SPAD):
    """A free-running counter, live at the start of the exposure; codes clip at 2^bits - 1.

    Non-paralyzable: after a count the pixel is dead for `dead_time`, and k counts fit if the k-th arrival of the live
    time comes soon enough: P(N >= k) = P(Gamma(k) <= arrivals (1 - (k - 1) dead_time / exposure)).
    Paralyzable: every arrival, counted or not, starts a new dead time; see paralyzable.py.
    """

    dead_time: float  # s
    bits: int  # 1 ... 16
    paralyzable: bool = False

    code_model: ClassVar[str] = "counting"
    takes_slices: ClassVar[bool] = True
    follows_photons: ClassVar[bool] = True
    tabulated: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        require_number(self, "dead_time", 0)
        require_size(self, "dead_time", SHORTEST, LONGEST)
        if not isinstance(self.paralyzable, bool):
            raise ValueError(f"CountingSPAD.paralyzable is true or false, got {self.paralyzable!r}")

    def at_depth(self, bits: int) -> CountingSPAD:
        return replace(self, bits=bits)

    def brightest(self, exposure: float) -> float:
        """Return the photons at which the mean count of a paralyzable pixel peaks; infinity for the other kind.

        E[N] = 1 - exp(-n a) + n (1 - a) exp(-n a) of n arrivals, a = dead time / exposure < 1, peaks at n a (1 - a) =
        1.
        """
        a = self.dead_time / exposure
        if not (self.paralyzable and 0 < a < 1):
            return inf
        return (1 / (a * (1 - a)) - self.dark_count_rate * exposure) / self.pde

    def dead_time_law(self, exposure: float) -> Paralyzable | None:
        """Return the law of a paralyzable pixel; None for the other kind. Without dead time both kinds are one."""
        return Paralyzable(exposure / self.dead_time, self.levels) if self.paralyzable and self.dead_time else None

    def _live(self, arrivals: Array, exposure: float) -> Array:
        """Return the arrivals expected in the live time that remains after k counts: [p] -> [p, levels]."""
        # After k counts the pixel was dead for k dead times; the rest of the
        # exposure is the time in which the next arrival can come.
        share = 1 - np.arange(self.levels) * (self.dead_time / exposure)
        return arrivals[:, None] * np.maximum(share, 0)

    def steps(self, exposure: float) -> tuple[Callable[[Array, Array], Array], Callable[[Array, Array], Array]]:
        """Return F_k and dF_k/darrivals of a non-paralyzable pixel as functions of pairs.

        A pair is a code and a Poisson mean: int [p], [p] -> [p].
        """
        from scipy.special import gammaincc

        share = np.maximum(1 - np.arange(self.levels) * (self.dead_time / exposure), 0)
        return (
            lambda k, mean: gammaincc(k + 1.0, mean * share[k]),
            lambda k, mean: -share[k] * np.exp(poisson_log_pmf(mean * share[k], k)),
        )

    def cdf_of(self, arrivals: Array, exposure: float) -> Array:
        """Return F_k = P(N < k + 1) = Q(k + 1, live_k): the regularised incomplete gamma function."""
        from scipy.special import gammaincc

        if (law := self.dead_time_law(exposure)) is not None:
            return law.cdf(arrivals)
        cdf = gammaincc(np.arange(1.0, self.levels + 1), self._live(arrivals, exposure))
        cdf[:, -1] = 1.0
        return cdf

    def log_pmf_of(self, arrivals: Array, exposure: float, wanted: Array | None = None) -> Array:
        """Return log P(N = k): [p] -> [p, levels].

        P(N = k) = Pois(k; live_(k-1)) + integral of Pois(k; x) from live_k to live_(k-1): two positive terms.
        """
        from scipy.special import gammainc, gammaincc

        if (law := self.dead_time_law(exposure)) is not None:
            return law.log_pmf(arrivals, wanted)
        live = self._live(arrivals, exposure)
        before = np.column_stack([arrivals, live[:, :-1]])
        k = np.arange(self.levels)
        at_once = poisson_log_pmf(before, k)
        with np.errstate(divide="ignore"):
            # The integral is a difference of the gamma function's two halves: of
            # the half that is small, so that it does not cancel.
            lower = gammainc(k + 1.0, before) - gammainc(k + 1.0, live)
            upper = gammaincc(k + 1.0, live) - gammaincc(k + 1.0, before)
            pmf = np.exp(at_once) + np.where(before < k + 1, lower, upper)
            pmf[:, -1] = gammainc(k[-1], before[:, -1])
            result = np.where(
                pmf > _UNDERFLOW, np.log(np.maximum(pmf, _UNDERFLOW)), _log_tail(at_once, before, live, k)
            )
        result[:, 0] = -arrivals
        return result

    def code_laws(self, codes: Array, arrivals: float, exposure: float) -> tuple[Array, Array]:
        from scipy.special import gammainc, gammaincc

        if self.dead_time_law(exposure) is not None:
            return super().code_laws(codes, arrivals, exposure)
        shares = [np.maximum(1 - (codes - step) * (self.dead_time / exposure), 0) for step in (1, 0)]
        before, live = (arrivals * share for share in (np.where(codes > 0, shares[0], 1.0), shares[1]))
        at_once = poisson_log_pmf(before, codes)
        with np.errstate(divide="ignore"):
            # As in `log_pmf_of`, for the codes that occur.
            lower = gammainc(codes + 1.0, before) - gammainc(codes + 1.0, live)
            upper = gammaincc(codes + 1.0, live) - gammaincc(codes + 1.0, before)
            pmf = np.exp(at_once) + np.where(before < codes + 1, lower, upper)
            top = codes == self.levels - 1
            pmf[top] = gammainc(codes[top], before[top])
            tail = _log_tail(at_once, before, live, codes)
            logs = np.where(pmf > _UNDERFLOW, np.log(np.maximum(pmf, _UNDERFLOW)), tail)
            logs[codes == 0] = -arrivals
            # dP(N = k) = dF_k - dF_(k-1), each a Poisson probability of the
            # live time after k or k - 1 counts (`slope_of`).
            less = np.log(shares[1]) + poisson_log_pmf(live, codes)
            more = np.log(shares[0]) + poisson_log_pmf(before, np.maximum(codes - 1, 0))
        with np.errstate(over="ignore", invalid="ignore"):
            gained = np.where(codes > 0, np.exp(more - logs), 0.0)
            return logs, gained - np.where(top, 0.0, np.exp(less - logs))

    def moments_of(self, arrivals: Array, exposure: float) -> tuple[Array, Array]:
        from scipy.special import gammainc, gammaincc

        law = self.dead_time_law(exposure)
        if law is not None:
            return law.moments(arrivals)
        if not self.many_codes:
            return self.dense_moments_of(arrivals, exposure)
        share = self.dead_time / exposure

        def tail(k: Array, mean: Array, below: Array) -> Array:
            live = mean * np.maximum(1 - k * share, 0)
            result = np.empty(len(k))
            result[below] = gammaincc(k[below] + 1.0, live[below])
            result[~below] = gammainc(k[~below] + 1.0, live[~below])
            return result

        return counting_moments.moments(arrivals, share, self.levels - 1, tail)

    def kernel_plan(self, exposure: float) -> Plan | None:
        """Return a plan of sums of k + 1 Poisson terms for few bits; of curves for more bits, and if paralyzable."""
        check_exposure(exposure)
        if self.bits > MOST_BITS:
            return None
        dark = self.dark_rate * exposure
        count = self.levels - 1
        law = self.dead_time_law(exposure)
        if law is not None:
            curves = _paralyzable_curves(law, count)
        elif self.bits <= _SUMMED_BITS:
            shares = 1 - np.arange(count) * (self.dead_time / exposure)
            live = Live(self.levels, tuple(float(share) for share in shares[shares > 0]))
            return Plan.summed(self.efficiency, dark, live)
        else:
            cdf, slope = self.steps(exposure)
            curves = falling(by_pairs(cdf, count), by_pairs(slope, count), count)
        return Plan.looked_up(self.efficiency, dark, curves)

    def _draw_frame(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int]) -> Array:
        law = self.dead_time_law(exposure)
        if law is not None and law.by_steps:
            return self._draw_rows(photons, exposure, key, origin, _ROWS)
        if self.bits <= 8:
            return super()._draw_frame(photons, exposure, key, origin)
        if law is not None:
            # No more counts fit into the exposure than this: a table of all codes would hold zeros beyond.
            enough = min(self.bits, most_counts(exposure / self.dead_time).bit_length())
            draw = super()._draw_frame if enough == self.bits else replace(self, bits=enough)._draw_frame
            return draw(photons, exposure, key, origin).astype(self.dtype)
        return self._draw_by_bisection(photons, exposure, key, origin)

    def decide(self, u: Array, photons: Array, exposure: float) -> tuple[Array, Array]:
        """As every sensor; from the steps around the code alone, but for few bits or few paralyzable dead times."""
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
        return paralyzable.decide(ratio, top, below, above, self.arrivals(photons, exposure).ravel())

    def _guess(self, arrivals: Array, exposure: float, z: Array) -> Array:
        """Return about the code at z standard deviations of a renewal count, whose gaps are a dead time and a wait."""
        # Renewal theory (Cox, 1962): N counts have the mean T / (tau + 1 /
        # lambda), and variance lambda T / (1 + lambda tau)^3.
        dead = 1 + arrivals * (self.dead_time / exposure)
        return np.rint((arrivals + dead - 1) / dead + z * np.sqrt(arrivals / dead) / dead)

    def _draw_by_bisection(self, photons: Array, exposure: float, key: Key, origin: tuple[int, int]) -> Array:
        """Return the smallest code k with u < F_k for each pixel [H, W], from few of the 2^bits steps; u has 64 bits.

        Error: that of the regularised gamma function, below 1e-11 in any probability (tested to 65 534 counts).
        """
        from scipy.special import gammainc, gammaincc

        below, above = (u.ravel() for u in uniform_pair(*(words(key, photons.shape, origin, n) for n in (0, 1))))
        arrivals = self.arrivals(photons, exposure).ravel()
        share = self.dead_time / exposure

        def passed(k: Array, left: Array) -> Array:
            # k or fewer counts: at most k arrivals in the time that k dead times
            # leave, Q(k + 1, live). Near 1 its complement keeps the digits.
            live = arrivals[left] * np.maximum(1 - k * share, 0)
            u = below[left]
            v = above[left]
            low = u < 0.5
            result = np.empty(len(left), bool)
            result[low] = u[low] >= gammaincc(k[low] + 1, live[low])
            result[~low] = v[~low] <= gammainc(k[~low] + 1, live[~low])
            return result

        guess = self._guess(arrivals, exposure, normal(below, above))
        return search(passed, self.levels - 1, guess).reshape(photons.shape).astype(self.dtype)

    def slope_of(self, arrivals: Array, exposure: float) -> Array:
        """Return dF_k/darrivals = -share_k Pois(k; live_k), share_k being the live share after k counts."""
        if (law := self.dead_time_law(exposure)) is not None:
            return law.slope(arrivals)
        k = np.arange(self.levels)
        share = np.maximum(1 - k * (self.dead_time / exposure), 0)
        slope = -share * np.exp(poisson_log_pmf(arrivals[:, None] * share, k))
        slope[:, -1] = 0.0
        return slope


def _paralyzable_curves(law: Paralyzable, count: int) -> Curves | None:
    """Return curves of the steps F_0 ... F_(count - 1) of a paralyzable pixel; None if no grid is fine enough."""
    if law.by_steps:
        return below(
            lambda mean: paralyzable.steps(law.ratio, count, mean[0])[0],
            lambda mean: paralyzable.steps(law.ratio, count, mean[0])[1],
            count,
            _BRIGHT,
        )
    return below(
        lambda mean: law.cdf(mean[0])[:, :-1].T,
        lambda mean: law.slope(mean[0])[:, :-1].T,
        count,
        _PARALYSED * max(law.ratio, 1.0),
        settled=True,
    )


def _log_tail(at_once: Array, before: Array, live: Array, k: Array) -> Array:
    """Return log P(N = k) below 1e-290, to a few per cent of P.

    The integral is approximated from its larger end and its slope there.
    """
    bright = live > k
    end = np.where(bright, live, before)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Laplace's method: the integrand falls from its larger end like exp(-rate
        # distance), with the slope of log Pois(k; x) there, k / x - 1.
        rate = np.maximum(np.abs(1 - k / end), 1e-9)
        integral = poisson_log_pmf(end, k) + np.log(-np.expm1(-rate * (before - live)) / rate)
    return np.logaddexp(at_once, np.where(end > 0, integral, -np.inf))

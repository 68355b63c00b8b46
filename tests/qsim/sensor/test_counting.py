"""Counting pixels against arbitrary-precision oracles, and the laws of dead time."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import mpmath as mp
import numpy as np
import pytest
from law_errors import EXPOSURE, LIMITS, errors
from oracles import paralyzable_oracle
from stats import assert_histogram

from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD

FRACTIONS = tuple(float(Fraction(1, d)) for d in (16, 10, 4, 2, 1))
ARRIVALS = (0.01, 0.1, 1.0, 5.0, 20.0, 60.0, 100.0, 400.0)


def renewal_oracle(arrivals: float, share: float, most: int) -> tuple[list, list]:
    """Non-paralyzable, live at the start: P(N >= k) = P(Gamma(k) <= arrivals (1 - (k - 1) share)), k <= `most`."""
    live = [mp.mpf(arrivals) * max(mp.mpf(0), 1 - k * mp.mpf(share)) for k in range(most + 1)]
    fewer = [mp.mpf(0)]  # P(N < k) and P(N >= k), each from its own integral
    more = [mp.mpf(1)]
    for k in range(1, most + 2):
        fewer.append(mp.gammainc(k, live[k - 1], mp.inf, regularized=True))
        more.append(mp.gammainc(k, 0, live[k - 1], regularized=True))
    pmf = [more[k] - more[k + 1] if more[k] < 0.5 else fewer[k + 1] - fewer[k] for k in range(most + 1)]
    slope = [-(live[k] / arrivals) * mp.e ** -live[k] * live[k] ** k / mp.factorial(k) for k in range(most + 1)]
    return [*pmf, more[most + 1]], slope


def renewal_errors(shares, all_arrivals, bits) -> np.ndarray:
    worst = np.zeros(3)
    with mp.workdps(80):
        for share, arrivals in product(shares, all_arrivals):
            sensor = CountingSPAD(1.0, 0.0, share, bits)
            pmf, slope = renewal_oracle(arrivals, share, min(sensor.levels, int(1 / share) + 1))
            worst = np.maximum(worst, errors(sensor, arrivals, pmf, slope))
    return worst


def test_dead_time_agrees_with_the_oracle():
    worst = renewal_errors((1e-6, 6e-5, 0.03, *FRACTIONS, 2.0), ARRIVALS, 4)
    assert np.all(worst < LIMITS), worst


@pytest.mark.slow
@pytest.mark.parametrize("share", [1e-6, 6e-5, 1e-3, 0.013, 1 / 32, 0.3, *FRACTIONS, 1.3, 2.0])
def test_dead_time_agrees_with_the_oracle_for_8_bits(share):
    worst = renewal_errors([share], ARRIVALS, 8)
    assert np.all(worst < LIMITS), worst


def paralyzable_errors(shares, all_arrivals, bits: int, digits: int = 400) -> np.ndarray:
    worst = np.zeros(3)
    with mp.workdps(digits):
        for share, arrivals in product(shares, all_arrivals):
            sensor = CountingSPAD(1.0, 0.0, share, bits, True)
            step = mp.mpf(arrivals) * mp.mpf(10) ** (-digits // 8)
            pmf = paralyzable_oracle(arrivals, share)
            beside = [paralyzable_oracle(mp.mpf(arrivals) + s, share) for s in (step, -step)]
            change = [(x - y) / (2 * step) for x, y in zip(*beside, strict=True)]
            slope = [mp.fsum(change[: k + 1]) for k in range(len(pmf))]
            worst = np.maximum(worst, errors(sensor, arrivals, pmf, slope))
    return worst


def test_paralyzable_dead_time_agrees_with_the_oracle():
    worst = paralyzable_errors((*FRACTIONS, 0.3, 2.0), ARRIVALS, 4)
    assert np.all(worst < LIMITS), worst


@pytest.mark.slow
@pytest.mark.parametrize("share", [1 / 32, 1 / 20, 0.3, *FRACTIONS, 1.3, 2.0])
def test_paralyzable_dead_time_agrees_with_the_oracle_for_8_bits(share):
    worst = paralyzable_errors([share], ARRIVALS, 8)
    assert np.all(worst < LIMITS), worst


@pytest.mark.parametrize(("share", "arrivals"), [(1e-3, 1.6e4), (1 / 32, 2e4), (0.3, 1e6), (2.0, 1e12)])
def test_paralysed_pixels_agree_with_the_oracle(share, arrivals):
    """Light beyond the table of arrivals: 0.0018 counts after the first are expected, or none at all."""
    sensor = CountingSPAD(1.0, 0.0, share, 3, True)
    with mp.workdps(400):
        step = mp.mpf(arrivals) * mp.mpf(10) ** -50
        levels = (mp.mpf(arrivals) + s for s in (0, step, -step))
        pmf, *beside = ([mp.e**-n, *paralyzable_oracle(n, share, 16)[1:]] for n in levels)
        slope = [mp.fsum(x - y for x, y in list(zip(*beside, strict=True))[: k + 1]) / (2 * step) for k in range(7)]
        worst = errors(sensor, arrivals, pmf, slope)
    assert np.all(worst < LIMITS), worst


def test_short_dead_times_agree_with_the_oracle():
    """30 ns in 0.5 ms, and one in a thousand: the top code is a sum over all the counts that fit."""
    for share, arrivals in ((6e-5, 3.0), (1e-3, 12.0)):
        with mp.workdps(200):
            pmf = paralyzable_oracle(arrivals, share, 80)
            worst = errors(CountingSPAD(1.0, 0.0, share, 3, True), arrivals, pmf, [])
        assert np.all(worst < LIMITS), worst


def test_light_without_closed_form_is_refused():
    sensor = CountingSPAD(1.0, 0.0, 1e-4, 3, True)
    with pytest.raises(
        ValueError, match=r"3e\+04 arrivals in an exposure of 10000 paralyzable dead times have no closed form"
    ):
        sensor.cdf(3e4, EXPOSURE)


def counted(arrivals: float, share: float, paralyzable: bool, exposures: int) -> np.ndarray:
    """Counts of many exposures, arrival by arrival: the definition of both kinds of dead time."""
    rng = np.random.default_rng(11)
    counts = np.zeros(exposures, int)
    for i, n in enumerate(rng.poisson(arrivals, exposures)):
        live_again = 0.0
        for time in np.sort(rng.uniform(0, 1, n)):
            counts[i] += time >= live_again
            if paralyzable or time >= live_again:
                live_again = time + share
    return counts


@pytest.mark.parametrize("paralyzable", [False, True])
@pytest.mark.parametrize(("arrivals", "share"), [(3.0, 0.25), (25.0, 0.1), (12.0, 0.06)])
def test_dead_time_counts_as_the_definition_says(arrivals, share, paralyzable):
    sensor = CountingSPAD(1.0, 0.0, share, 5, paralyzable)
    counts = counted(arrivals, share, paralyzable, 20_000)
    assert_histogram(counts, sensor.pmf(arrivals, EXPOSURE), checks=6)
    other = CountingSPAD(1.0, 0.0, share, 5, not paralyzable)
    with pytest.raises(AssertionError, match="chi-square"):
        assert_histogram(counts, other.pmf(arrivals, EXPOSURE))


@pytest.mark.parametrize("paralyzable", [False, True])
def test_samples_have_the_distribution(paralyzable):
    sensor = CountingSPAD(0.5, 200.0, 4e-5, 4, paralyzable)
    codes = sensor.sample(np.full((201, 300), 24.0), 5e-4, key=Key(2, 9), engine="reference")
    assert_histogram(codes, sensor.pmf(24.0, 5e-4), checks=2)


def test_no_dead_time_is_a_clipped_poisson():
    poisson = np.exp(-2.5) * np.cumprod([1.0, *(2.5 / np.arange(1, 7))])
    for paralyzable in (False, True):
        pmf = CountingSPAD(0.5, 0.0, 0.0, 3, paralyzable).pmf(5.0, EXPOSURE)
        np.testing.assert_allclose(pmf, [*poisson, 1 - poisson.sum()], rtol=1e-12)


@pytest.mark.parametrize("share", [1.0, 1.3, 2.0])
def test_dead_for_the_whole_exposure_counts_once(share):
    for paralyzable in (False, True):
        pmf = CountingSPAD(1.0, 0.0, share, 2, paralyzable).pmf(3.0, EXPOSURE)
        np.testing.assert_allclose(pmf, [np.exp(-3), -np.expm1(-3), 0, 0], rtol=1e-13)


@pytest.mark.parametrize("paralyzable", [False, True])
def test_sixteen_bits_count_like_eight(paralyzable):
    """Wide counters are drawn without their 65536 probabilities: the same codes wherever 8 bits can write them."""
    light = np.random.default_rng(4).uniform(0, 200, (31, 33))
    dead_time = 5e-4 if paralyzable else 1e-4
    wide, narrow = (
        CountingSPAD(0.7, 10.0, dead_time, bits, paralyzable).sample(light, 0.05, key=Key(6, 7), engine="reference")
        for bits in (16, 8)
    )
    assert wide.dtype == np.uint16
    np.testing.assert_array_equal(wide, narrow)


def test_the_mean_of_a_paralyzable_pixel_peaks_where_it_says():
    sensor = CountingSPAD(0.5, 100.0, 5e-5, 6, True)
    peak = sensor.brightest(5e-4)
    mean = sensor.mean(peak * np.array([0.99, 1.0, 1.01]), 5e-4)
    assert mean[1] > max(mean[0], mean[2])
    assert CountingSPAD(0.5, 100.0, 5e-5, 6).brightest(5e-4) == np.inf


def test_settings_that_make_no_sense_are_named():
    with pytest.raises(ValueError, match=r"^CountingSPAD.dead_time is a number, at least 0; got -1e-08$"):
        CountingSPAD(0.5, 0.0, -1e-8, 3)
    with pytest.raises(ValueError, match=r"^CountingSPAD.paralyzable is true or false, got 1$"):
        CountingSPAD(0.5, 0.0, 1e-8, 3, 1)


@pytest.mark.parametrize(
    ("k", "live"), [(255, 240.0), (1023, 1050.0), (4095, 4000.0), (65_000, 65_200.0), (65_534, 64_800.0)]
)
def test_the_error_of_deep_counters_is_below_1e_11(k, live):
    """P(N <= k) summed downwards from n = k with 40 digits: the bisection above 8 bits compares these."""
    from scipy.special import gammainc, gammaincc

    with mp.workdps(40):
        mean = mp.mpf(live)
        term = mp.exp(k * mp.log(mean) - mean - mp.loggamma(k + 1))
        total = mp.mpf(0)
        n = k
        while n >= 0 and term > 1e-25:
            total = total + term
            term = term * n / mean
            n = n - 1
        below = float(total)
        above = float(1 - total)
    assert abs(gammaincc(k + 1, live) - below) < 1e-11
    assert abs(gammainc(k + 1, live) - above) < 1e-11

"""Clocked and counting pixels against arbitrary-precision oracles, and the laws of planes and dead time."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from itertools import product

import mpmath as mp
import numpy as np
import pytest
from oracles import paralyzable_oracle
from stats import assert_histogram

from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.spad import BinarySPAD, PlaneByPlane

EXPOSURE = 1.0  # s; dead times below are shares of it
FRACTIONS = tuple(float(Fraction(1, d)) for d in (16, 10, 4, 2, 1))
ARRIVALS = (0.01, 0.1, 1.0, 5.0, 20.0, 60.0, 100.0, 400.0)


def errors(sensor, photons: float, pmf: list, slope: list) -> np.ndarray:
    """Error of the cdf, of log P where P > 1e-280, relative error of the slope above 1e-280; codes clip at the top."""
    top = sensor.levels - 1
    pmf = [*pmf, *[mp.mpf(0)] * sensor.levels]
    pmf = [*pmf[:top], mp.fsum(pmf[top:])]
    cdf, log_pmf, dcdf = (f(photons, EXPOSURE) for f in (sensor.cdf, sensor.log_pmf, sensor.dcdf))
    worst, total = np.zeros(3), mp.mpf(0)
    for k in range(sensor.levels):
        total += pmf[k]
        worst[0] = max(worst[0], abs(float(cdf[k] - total)))
        if pmf[k] > 1e-280:
            worst[1] = max(worst[1], abs(float(log_pmf[k] - mp.log(pmf[k]))))
        if k < min(top, len(slope)) and abs(slope[k]) > 1e-280:
            worst[2] = max(worst[2], abs(float(dcdf[k] / slope[k] - 1)))
    return worst


LIMITS = np.array([1e-10, 1e-8, 1e-8])

# ---- Clocked planes


def binomial_oracle(planes: int, photons: float, pde: float, dark: float) -> tuple[list, list]:
    """Binomial(M, p) and dF_k/dphotons = dp/dphotons dF_k/dp, the latter summed from the pmf's own derivatives."""
    rate = (mp.mpf(pde) * mp.mpf(photons) + mp.mpf(dark)) / planes
    q, p = mp.e**-rate, -mp.expm1(-rate)
    pmf = [mp.binomial(planes, k) * p**k * q ** (planes - k) for k in range(planes + 1)]
    slope, total = [], mp.mpf(0)
    for k in range(planes):  # d pmf / dp = C(M, k) [k p^(k-1) q^(M-k) - (M-k) p^k q^(M-k-1)], dp/dphotons = pde q / M
        rises = k * p ** (k - 1) * q ** (planes - k) if k else 0
        total += mp.binomial(planes, k) * (rises - (planes - k) * p**k * q ** (planes - k - 1))
        slope.append(total * mp.mpf(pde) / planes * q)
    return pmf, slope


def binary_errors(bits: int) -> np.ndarray:
    sensor, worst = BinarySPAD(0.4, 0.01, bits), np.zeros(3)
    with mp.workdps(400):  # the oracle's slope is a sum that cancels
        for photons in (0.0, *10.0 ** np.arange(-12, 13, 3), 0.3, 3.25, 26.0, 200.0, 1500.0, 2e4):
            worst = np.maximum(worst, errors(sensor, photons, *binomial_oracle(sensor.planes, photons, 0.4, 0.01)))
    return worst


@pytest.mark.parametrize("bits", [1, 3, 5])
def test_sums_of_planes_agree_with_the_oracle(bits):
    worst = binary_errors(bits)
    assert np.all(worst < LIMITS), worst


@pytest.mark.slow
def test_sums_of_127_planes_agree_with_the_oracle():
    worst = binary_errors(7)
    assert np.all(worst < LIMITS), worst


def test_two_bit_depths_of_one_plane_rate_use_the_same_photons():
    """Frame f of 3 bits is the sum of the 1-bit frames 7 f ... 7 f + 6 of the same key."""
    light = np.random.default_rng(0).uniform(0, 20, (9, 13))
    key = Key(1, 2, frame=5)
    deep = BinarySPAD(0.4, 100.0, 3).sample(light, 7e-4, key=key, engine="reference")
    planes = np.broadcast_to(light / 7, (7, 9, 13))
    flat = BinarySPAD(0.4, 100.0).sample(planes, 1e-4, key=key.at(35), engine="reference")
    np.testing.assert_array_equal(deep, flat.sum(axis=0))
    assert 0 < deep.mean() < 7


def test_planes_that_see_their_own_instant_are_summed_in_groups():
    """A light that is on in the first group only: the second code holds dark counts, of which there are none."""
    sensor = BinarySPAD(0.5, 0.0, 2)
    light = np.zeros((6, 5, 7))
    light[:3] = 4.0
    codes = sensor.sample_planes(light, 1e-4, key=Key(3, 4), engine="reference")
    assert codes.shape == (2, 5, 7)
    assert codes[1].max() == 0
    assert codes[0].mean() > 1.5
    steady = sensor.sample(np.full((5, 7), 12.0), 3e-4, key=Key(3, 4), engine="reference")
    np.testing.assert_array_equal(codes[0], steady)


def test_planes_at_constant_light_are_the_codes_of_a_stack():
    """A clip at the plane rate whose light holds still for each code: the same codes as at the code rate."""
    sensor, light = BinarySPAD(0.4, 50.0, 2), np.random.default_rng(1).uniform(0, 9, (3, 6, 9))
    key = Key(2, 3, frame=4)
    planes = sensor.sample_planes(np.repeat(light / 3, 3, axis=0), 1e-4, key=key, engine="reference")
    np.testing.assert_array_equal(planes, sensor.sample(light, 3e-4, key=key, engine="reference"))


def test_planes_in_the_wrong_number_are_refused():
    with pytest.raises(ValueError, match=r"planes of a 3-bit code come in groups of 7: \[T 7, H, W\], got \[8, 2, 2\]"):
        BinarySPAD(0.5, 0.0, 3).sample_planes(np.ones((8, 2, 2)), 1e-4, key=Key(0, 0))


@pytest.mark.parametrize(("bits", "photons"), [(1, 0.7), (3, 4.9), (5, 60.0)])
def test_codes_of_planes_are_binomial(bits, photons):
    sensor = BinarySPAD(0.4, 300.0, bits)
    codes = sensor.sample(np.full((200, 203), photons), 1e-3, key=Key(8, bits), engine="reference")
    assert_histogram(codes, sensor.pmf(photons, 1e-3), checks=3)


@pytest.mark.parametrize("bits", [9, 12, 16])
@pytest.mark.parametrize("light", [0.0005, 0.4, 5.0])
def test_sums_of_many_planes_are_binomial_drawn_at_once(bits, light):
    """By one number per pixel, and plane by plane as earlier streams have them: the same law, other codes."""
    sensor = BinarySPAD(0.4, 300.0, bits)
    photons = light * sensor.planes
    codes = sensor.sample(np.full((200, 203), photons), 1e-3, key=Key(8, bits), engine="reference")
    assert_histogram(codes, sensor.pmf(photons, 1e-3), checks=9)
    single = PlaneByPlane(**vars(sensor)).sample(np.full((2, 3), photons), 1e-3, key=Key(8, bits), engine="reference")
    plane = replace(sensor, bits=1).sample(
        np.full((sensor.planes, 2, 3), light), 1e-3 / sensor.planes, key=Key(8, bits)
    )
    np.testing.assert_array_equal(single, plane.sum(axis=0))


def test_sixteen_bits_are_65535_planes():
    """Mean M p within 6 sigma of 12 pixels, each Binomial(65535, p)."""
    sensor = BinarySPAD(0.5, 0.0, 16)
    codes = sensor.sample(np.full((3, 4), 65535.0), 1.0, key=Key(1, 1), engine="reference")
    p = -np.expm1(-0.5)
    assert codes.dtype == np.uint16
    assert abs(codes.mean() - 65535 * p) < 6 * np.sqrt(65535 * p * (1 - p) / 12)


# ---- Dead time


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
            sensor, step = CountingSPAD(1.0, 0.0, share, bits, True), mp.mpf(arrivals) * mp.mpf(10) ** (-digits // 8)
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
    with pytest.raises(ValueError, match=r"^BinarySPAD.pde is a number, above 0 and at most 1; got 45$"):
        BinarySPAD(45, 0.0)


@pytest.mark.parametrize(
    ("k", "live"), [(255, 240.0), (1023, 1050.0), (4095, 4000.0), (65_000, 65_200.0), (65_534, 64_800.0)]
)
def test_the_error_of_deep_counters_is_below_1e_11(k, live):
    """P(N <= k) summed downwards from n = k with 40 digits: what the bisection of codes above 8 bits looks at."""
    from scipy.special import gammainc, gammaincc

    with mp.workdps(40):
        mean = mp.mpf(live)
        term = mp.exp(k * mp.log(mean) - mean - mp.loggamma(k + 1))
        total, n = mp.mpf(0), k
        while n >= 0 and term > 1e-25:
            total, term, n = total + term, term * n / mean, n - 1
        below, above = float(total), float(1 - total)
    assert abs(gammaincc(k + 1, live) - below) < 1e-11
    assert abs(gammainc(k + 1, live) - above) < 1e-11

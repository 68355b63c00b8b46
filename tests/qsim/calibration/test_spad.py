"""Calibration of a SPAD array: dark counts, hot pixels, sums of planes, real detectors."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import poisson
from stats import assert_mean, assert_share
from synthetic import COUNTER, PLANE, draw_planes, statistics_of

from qsim.calibration.frame_statistics import FrameStatistics, measure, measure_sums
from qsim.calibration.spad import calibrate_spad
from qsim.sensor.counting import CountingSPAD

DATA = Path(__file__).parents[2] / "data"


H, W = PLANE


def test_no_dark_count_gives_a_one_sided_bound():
    """No event in time t: the rate is below -ln(0.025)/t with 97.5 %."""
    found = calibrate_spad([statistics_of(np.zeros((100, 6, 7), int), 1)], [], bits=1)
    rate = found.values["dark_count_rate"]
    assert (rate.value, rate.low) == (0.0, 0.0)
    assert rate.high == pytest.approx(-np.log(0.025) / (100 * 1e-3 * 42))


def test_few_dark_counts_have_an_exact_interval():
    """The interval of one count ended at 2.96 counts, below that of none (3.69); 3.5 were held in 89 %."""
    rates = []
    for count in range(25):
        planes = np.zeros((100, 42), int)
        planes[np.arange(count), np.arange(count)] = 1
        found = calibrate_spad([statistics_of(planes.reshape(100, 6, 7), 1)], [], bits=1)
        rates.append(found.values["dark_count_rate"])
    time = 100 * 1e-3 * 42
    assert rates[1].low * time == pytest.approx(0.0253, rel=0.1)  # corrected for afterpulses, +- 4 %
    assert rates[1].high * time == pytest.approx(5.572, rel=0.1)
    assert all(rate.high < more.high for rate, more in pairwise(rates))
    chance = poisson.pmf(np.arange(25), 3.5)
    assert sum(p for rate, p in zip(rates, chance, strict=True) if rate.low <= 3.5 / time <= rate.high) >= 0.95


def test_afterpulsing_of_few_frames_is_not_too_small():
    """The means of 6 frames take 38 % of the correlation with them: 0.03 became 0.019."""
    rng = np.random.default_rng(8)
    found = []
    for _ in range(20):
        planes = rng.random((7, 150, 150)) < 0.3
        for before, plane in pairwise(planes):
            plane[:] |= before & (rng.random(before.shape) < 0.03)
        found.append(calibrate_spad([], [statistics_of(planes[1:], 1, None)], bits=1).values["afterpulsing"])
    sigma = (found[0].high - found[0].low) / (2 * 1.96)
    assert_mean(np.array([value.value for value in found]), 0.03, sigma**2)


def test_hot_pixels_do_not_pass_for_afterpulses():
    """2 % of the pixels have nearly all of the variance: the interval was 4 times too narrow."""
    rng = np.random.default_rng(9)
    hits = 0
    rate = np.where(np.arange(576) < 12, 0.1, 1e-3).reshape(24, 24)
    for _ in range(60):
        dark = statistics_of(rng.random((400, 24, 24)) < rate, 1)
        hits += calibrate_spad([dark], [], bits=1).values["afterpulsing"].low == 0
    assert_share(hits, 60, 0.975)


def test_one_hot_pixel_a_hundred_thousand_times_the_median():
    """It appears in the map and in the share of hot pixels, and does not change the median."""
    rng = np.random.default_rng(0)
    rate = np.full((20, 20), 1e-2)
    rate[3, 4] = 1e3  # per frame: always on
    planes = rng.random((400, 20, 20)) < -np.expm1(-rate)
    found = calibrate_spad([statistics_of(planes, 1)], [], bits=1)
    assert np.unravel_index(np.argmax(found.maps["dark_count_rate"]), (20, 20)) == (3, 4)
    assert found.values["dark_count_rate_median"].value < 3e-2 / 1e-3
    assert found.values["hot_pixels"].value == 1
    assert np.array_equal(np.argwhere(found.maps["hot_pixels"]), [(3, 4)])
    assert found.values["dark_count_rate"].high == np.inf


def test_ignored_dead_time_is_flagged_and_the_right_model_is_not():
    rng = np.random.default_rng(3)
    right, _ = COUNTER.calibrate(rng)
    wrong, _ = COUNTER.calibrate(rng, ignore_dead_time=True)
    assert right.p_value > 1e-4
    assert wrong.p_value < 1e-6
    assert any("the model is wrong" in words for words in wrong.warnings)


def test_real_dark_counts():
    """50 x 50 SPADs, 7650 planes of 10.3 us: 1.0 % of the pixels above ten medians.

    Pixels below three medians have 9.68 counts in the mean, 123 /s; the median of all counts is 10, or 127 /s, because
    counts are whole numbers.
    """
    path = Path(__file__).parents[4] / "shared" / "data" / "spad512_darkcounts_YX.npy"
    if not path.exists():
        pytest.skip(f"{path.name} is not part of this repository")
    ones = np.rint(-np.expm1(-np.load(path)) * 7650)
    found = calibrate_spad([measure_sums([ones], planes=7650, exposure=10.3e-6, photons=0.0)], [], bits=1)
    median = found.values["dark_count_rate_median"]
    assert 115 < median.low < median.value < median.high < 127
    assert 20 < found.values["hot_pixels"].value < 30
    named = {words for warning in found.warnings for words in warning.split(", ")}
    assert "p10" in named  # of 9 counts


@pytest.mark.parametrize("seed", range(4))
def test_sums_are_calibrated_exactly_as_their_planes(seed):
    """Random numbers of planes, sums, light and dark: every value, interval and map is equal to the last bit.

    Sums do not keep the order of the planes, so the planes' order is taken from them.
    """
    rng = np.random.default_rng(seed)
    planes = int(rng.integers(1, 40))
    stacks = []
    for rate, photons in ((0.01, 0.0), (float(rng.uniform(0.05, 3)), 0.8), (float(rng.uniform(0.05, 3)), 1.6)):
        frames = int(rng.integers(2, 9))
        bits = draw_planes(rng, frames * planes, rate, 0.1)
        exposure = 1e-5
        sums = bits.reshape(frames, planes, H, W).sum(axis=1)
        kind = rng.choice([np.uint16, np.float64, np.int64])
        one = measure([bits], bits=1, exposure=exposure, photons=photons)
        stacks.append(
            (
                one,
                measure_sums(
                    [sums[:1].astype(kind), sums[1:].astype(kind)], planes=planes, exposure=exposure, photons=photons
                ),
            )
        )
    for one, many in stacks:
        assert np.array_equal(one.total, many.total)
        assert np.array_equal(one.square, many.square)
        assert np.array_equal(one.histogram, many.histogram)
        assert one.frames == many.frames
    unknown = np.full(PLANE, np.nan)
    unordered = [
        (replace(one, lagged=unknown, first=unknown, last=unknown, adjacent=None), many) for one, many in stacks
    ]
    found = [
        calibrate_spad([pair[i] for pair in unordered[:1]], [pair[i] for pair in unordered[1:]], bits=1) for i in (0, 1)
    ]
    assert str(found[0].values) == str(found[1].values)  # NaN is not equal to itself
    for name, image in found[0].maps.items():
        assert np.array_equal(image, found[1].maps[name])
    assert any("afterpulsing is not measured" in words for words in found[1].warnings)


def test_another_number_of_planes_is_noticed():
    """4096 planes at 30 %, taken as 8192: the variance is 0.70 / 0.85 of that of a binomial."""
    sums = np.random.default_rng(1).binomial(4096, 0.3, (30, H, W))
    right, wrong = (measure_sums([sums], planes=n, exposure=1e-5, photons=None) for n in (4096, 8192))
    sigma = np.sqrt(2 / (29 * H * W))
    assert abs(right.dispersion - 1) < 5 * sigma
    assert abs(wrong.dispersion - 0.7 / 0.85) < 5 * sigma
    assert not any("scatter" in words for words in calibrate_spad([], [right], bits=1).warnings)
    assert any("scatter 0.8" in words for words in calibrate_spad([], [wrong], bits=1).warnings)


def counted(rng: np.random.Generator, arrivals: float, exposure: float, frames: int) -> FrameStatistics:
    """Return the statistics of counts with a dead time of 50 us."""
    cdf = CountingSPAD(1.0, 0.0, 5e-5, 6).cdf(np.array(arrivals), exposure)
    codes = np.searchsorted(cdf[:-1], rng.random((frames, 24, 24)), side="right")
    return measure([codes], bits=6, exposure=exposure, photons=None)


def test_dead_time_is_a_smaller_share_of_long_dark_frames():
    """It is 5 % of the flats' exposure and 1 % of the long darks'; all were corrected for 5 %, to 430 counts/s."""
    rng = np.random.default_rng(5)
    darks = [counted(rng, 400 * exposure, exposure, 160) for exposure in (1e-3, 5e-3)]
    flats = [counted(rng, arrivals, 1e-3, 40) for arrivals in (2.0, 6.0, 14.0)]
    rate = calibrate_spad(darks, flats, bits=6).values["dark_count_rate"]
    assert rate.low <= 400 <= rate.high


def test_the_dead_time_is_that_of_the_flats_of_several_frames():
    """A first flat of one frame and another exposure doubled it."""
    rng = np.random.default_rng(6)
    flats = [counted(rng, 4.0, 2e-3, 1), *(counted(rng, arrivals, 1e-3, 40) for arrivals in (2.0, 6.0, 14.0))]
    found = calibrate_spad([], flats, bits=6)
    assert found.values["dead_time"].low <= 5e-5 <= found.values["dead_time"].high
    assert found.p_value > 1e-4

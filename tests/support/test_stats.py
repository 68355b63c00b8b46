"""The tests of the tests: false alarms as rare as promised, faults caught, nothing passes without noise."""

import numpy as np
import pytest
from stats import (
    assert_histogram,
    assert_mean,
    assert_same_rms,
    assert_share,
    assert_variance,
    critical_z,
    histogram_p_value,
    mixture_p_value,
    per_check,
)

LIGHT = 3.25  # expected photons
POISSON_FOURTH = LIGHT + 3 * LIGHT**2  # fourth central moment
PMF = np.array([0.5, 0.25, 0.15, 0.07, 0.03])


def trips(check, *arguments, **settings) -> bool:
    try:
        check(*arguments, **settings)
    except AssertionError:
        return True
    return False


def share_of_alarms(check, draw, *arguments, runs: int = 2000, **settings) -> float:
    rng = np.random.default_rng(0)
    return float(np.mean([trips(check, draw(rng), *arguments, **settings) for _ in range(runs)]))


# ---- False alarms: 2000 correct programs at 5 %; the share has sigma = sqrt(.05 * .95 / 2000) = 0.49 %, 4 sigma = 2 %


def test_the_mean_alarms_as_rarely_as_promised():
    share = share_of_alarms(assert_mean, lambda r: r.poisson(LIGHT, 400), LIGHT, LIGHT, false_alarm=0.05)
    assert 0.03 < share < 0.07


def test_the_variance_alarms_as_rarely_as_promised():
    """s^2 of 2000 draws is still a little skewed: allow 3 % to 8 %."""
    share = share_of_alarms(assert_variance, lambda r: r.poisson(LIGHT, 2000), LIGHT, POISSON_FOURTH, false_alarm=0.05)
    assert 0.03 < share < 0.08


def test_the_mixture_s_chi_square_alarms_as_rarely_as_promised():
    """400 draws of which each has its own probabilities; p-values of the plain chi-square would be too large."""
    rng = np.random.default_rng(0)
    pmf = rng.dirichlet([0.4] * 5, 400)
    steps = pmf.cumsum(axis=1)[:, :-1]
    drawn = (rng.random((2000, 400, 1)) > steps).sum(axis=2)
    alarms = [mixture_p_value(codes, pmf) < 0.05 for codes in drawn]
    assert 0.03 < np.mean(alarms) < 0.07
    assert mixture_p_value(drawn[0] // 2, pmf) < 1e-6


def test_one_rms_alarms_as_rarely_as_promised():
    def both(rng: np.random.Generator) -> np.ndarray:
        return rng.normal(size=(2, 400))

    share = share_of_alarms(lambda pair, **rest: assert_same_rms(*pair, **rest), both, false_alarm=0.05)
    assert 0.03 < share < 0.07


def test_histograms_alarm_as_rarely_as_promised():
    share = share_of_alarms(assert_histogram, lambda r: r.choice(5, 1000, p=PMF), PMF, false_alarm=0.05)
    assert 0.03 < share < 0.07


def test_shares_alarm_no_more_often_than_promised():
    """An exact test of a discrete number is on the safe side: at most 5 %, and not asleep."""
    share = share_of_alarms(assert_share, lambda r: int(r.binomial(400, 0.3)), 400, 0.3, false_alarm=0.05, runs=500)
    assert 0.01 < share < 0.08


def test_many_checks_together_alarm_as_rarely_as_one():
    """100 programs of 20 checks each would nearly all alarm at 5 % a check; the correction brings the 5 % back."""
    rng = np.random.default_rng(0)
    runs = [
        any(trips(assert_mean, rng.poisson(LIGHT, 400), LIGHT, LIGHT, false_alarm=0.05, checks=20) for _ in range(20))
        for _ in range(300)
    ]
    assert np.mean(runs) < 0.05 + 4 * np.sqrt(0.05 * 0.95 / 300)
    assert critical_z(0.05) == pytest.approx(1.959964, abs=1e-6)
    assert critical_z(0.05, 1000) > 4
    assert 1 - (1 - per_check(0.05, 20)) ** 20 == pytest.approx(0.05)


def test_p_values_are_uniform_under_the_null():
    """Kolmogorov's distance of 1000 p-values; 0.0617 has the false alarm rate 0.001."""
    rng = np.random.default_rng(2)
    p = np.sort([histogram_p_value(rng.choice(5, 1000, p=PMF), PMF) for _ in range(1000)])
    assert np.abs(p - (np.arange(1000) + 0.5) / 1000).max() < 0.0617


# ---- Faults


def test_a_bias_of_one_percent_is_caught():
    """Power 99 % at 5 % needs n = ((1.96 + 2.33) sqrt(3.25) / 0.0325)^2 = 56 600 draws; here are 100 000."""
    share = share_of_alarms(
        assert_mean, lambda r: r.poisson(1.01 * LIGHT, 100_000), LIGHT, LIGHT, false_alarm=0.05, runs=50
    )
    assert share > 0.9


def test_a_bias_of_one_percent_is_caught_at_the_default_false_alarm_of_one_in_a_million():
    """Power 99.9 % at 1e-6 needs n = ((4.89 + 3.09) sqrt(3.25) / 0.0325)^2 = 196 000 draws."""
    rng = np.random.default_rng(3)
    assert trips(assert_mean, rng.poisson(1.01 * LIGHT, 400_000), LIGHT, LIGHT)
    assert not trips(assert_mean, rng.poisson(LIGHT, 400_000), LIGHT, LIGHT)


def test_five_percent_more_variance_is_caught():
    rng = np.random.default_rng(4)
    wide = LIGHT + (rng.poisson(LIGHT, 100_000) - LIGHT) * np.sqrt(1.05)
    assert trips(assert_variance, wide, LIGHT, POISSON_FOURTH)


def test_a_fifth_more_error_is_caught():
    """sigma of the ratio of two rms of 4000 is 1.6 %: 18 % are eleven of them."""
    rng = np.random.default_rng(3)
    errors = rng.normal(size=(2, 4000))
    assert not trips(assert_same_rms, *errors)
    assert trips(assert_same_rms, errors[0], 1.2 * errors[1])
    assert trips(assert_same_rms, errors[0], 0 * errors[1])


def test_an_image_without_noise_fails_everywhere():
    flat = np.full(10_000, 3)
    assert trips(assert_mean, flat, LIGHT, LIGHT)
    assert trips(assert_mean, np.full(10_000, LIGHT * 1.05), LIGHT, LIGHT)
    assert trips(assert_variance, flat, LIGHT, POISSON_FOURTH)
    assert trips(assert_histogram, np.full(10_000, 1), PMF)


def test_two_codes_exchanged_are_caught_though_the_mean_stays():
    """+ 2 % for codes 0 and 4, - 2 % for 1 and 3, so that the mean moves by 0.0 and the histogram by 4 %."""
    rng = np.random.default_rng(5)
    wrong = PMF + np.array([0.02, -0.02, 0.0, -0.02, 0.02])
    codes = rng.choice(5, 20_000, p=wrong)
    assert wrong @ np.arange(5) == pytest.approx(PMF @ np.arange(5))
    assert trips(assert_histogram, codes, PMF)


def test_a_code_that_cannot_occur_is_caught():
    pmf = np.array([0.5, 0.5, 0.0])
    rng = np.random.default_rng(6)
    codes = rng.integers(0, 2, 1000)
    assert not trips(assert_histogram, codes, pmf)
    codes[:60] = 2
    assert trips(assert_histogram, codes, pmf)


def test_a_share_off_by_a_tenth_is_caught():
    assert trips(assert_share, 1100, 10_000, 0.1, false_alarm=0.01)
    assert not trips(assert_share, 1010, 10_000, 0.1, false_alarm=0.01)


# ---- Edges


def test_a_constant_is_right_or_wrong_without_a_tolerance():
    assert not trips(assert_mean, np.zeros(10), 0.0, 0.0)
    assert trips(assert_mean, np.full(10, 1e-9), 0.0, 0.0)


def test_rare_codes_are_pooled_and_too_few_codes_are_an_error():
    pmf = np.array([0.9, 0.09, 0.009, 0.001])
    rng = np.random.default_rng(7)
    assert 0.001 < histogram_p_value(rng.choice(4, 200, p=pmf), pmf) < 1
    with pytest.raises(ValueError, match="too few"):
        histogram_p_value(np.zeros(3, int), pmf)

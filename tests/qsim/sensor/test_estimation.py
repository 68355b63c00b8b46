"""Light from codes: maximum likelihood with its bounds, and the response of a sensor."""

from __future__ import annotations

import numpy as np
import pytest
from sensor_cases import EXPOSURE, SENSORS, each
from stats import critical_z

from qsim.keys import Key
from qsim.sensor import code_likelihood
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD


@pytest.mark.parametrize("sensor", [SENSORS[0], SENSORS[4], SENSORS[6], SENSORS[7]])
def test_estimates_scatter_as_fisher_information_says(sensor: Sensor):
    """From 2000 codes each: z-scores have mean 0 (bias of the order 1/sqrt(n)) and variance 1; intervals hold 95 %."""
    n = 2000
    repeats = 2000
    light = 4.0
    histograms = np.random.default_rng(5).multinomial(n, sensor.pmf(light, EXPOSURE), size=repeats)
    found = sensor.maximum_likelihood(histograms, EXPOSURE)
    z = (found.photons - light) * np.sqrt(n * sensor.fisher_information(light, EXPOSURE))
    limit = critical_z(checks=12)
    assert abs(z.mean()) < limit / np.sqrt(repeats) + 3 / np.sqrt(n)
    assert abs(z.var() - 1) < limit * np.sqrt(2 / repeats) + 10 / n
    inside = int(((found.lower < light) & (light < found.upper)).sum())
    assert abs(inside / repeats - 0.95) < limit * np.sqrt(0.95 * 0.05 / repeats) + 10 / n


def test_one_plane_has_its_closed_form():
    """Binary pixels: photons = -log(share of zeros) / PDE - dark; 0 where dark counts explain more than was seen."""
    sensor = BinarySPAD(0.4, 100.0)
    ones = np.array([1, 5, 40, 90, 99])
    found = sensor.maximum_likelihood(np.stack([100 - ones, ones], axis=-1), EXPOSURE)
    expected = np.maximum((-np.log1p(-ones / 100) - 100 * EXPOSURE) / 0.4, 0)
    np.testing.assert_allclose(found.photons, expected, rtol=1e-9, atol=1e-15)
    assert found.photons[0] == 0
    assert np.all((found.lower <= found.photons) & (found.photons < found.upper))


@pytest.mark.parametrize("n", [1, 11, 10**9])
def test_all_dark_has_a_one_sided_bound(n):
    """No count in n planes: 0, and an upper bound where that has a probability of 5 %: 2.996 / (n PDE)."""
    found = BinarySPAD(0.4, 0.0, 3).maximum_likelihood(np.array([n, 0, 0, 0, 0, 0, 0, 0]), EXPOSURE)
    assert (found.photons, found.lower) == (0.0, 0.0)
    assert found.upper == pytest.approx(-np.log(0.05) / (0.4 * n), rel=1e-6)


@pytest.mark.parametrize("n", [1, 11, 10**6])
@each
def test_all_saturated_is_finite_with_a_one_sided_bound(sensor: Sensor, n):
    """The highest possible code n times: P^n is 1/2 at the estimate, 5 % at the lower bound, if it can be certain."""
    histogram = np.zeros(sensor.levels)
    highest = np.flatnonzero(sensor.log_pmf(5.0, EXPOSURE) > -np.inf)[-1]
    histogram[highest] = n
    found = sensor.maximum_likelihood(histogram, EXPOSURE)
    assert np.isfinite(found.photons)
    assert 0 < found.lower < found.photons
    # On the rising branch of a paralyzable pixel a single code can be likeliest before the end
    assert found.upper == np.inf or getattr(sensor, "paralyzable", False)
    if sensor.pmf(1e6, EXPOSURE)[highest] == 1:
        saturated = np.exp(n * sensor.log_pmf(np.stack([found.photons, found.lower]), EXPOSURE)[:, highest])
        np.testing.assert_allclose(saturated, [0.5, 0.05], rtol=1e-4)


def test_the_likelihood_is_highest_at_the_estimate():
    rng = np.random.default_rng(2)
    for sensor in SENSORS:
        histograms = rng.multinomial(30, sensor.pmf(rng.uniform(0.5, 12, 50), EXPOSURE))
        found = sensor.maximum_likelihood(histograms, EXPOSURE)
        best, *others = (
            (histograms * np.maximum(sensor.log_pmf(found.photons * factor, EXPOSURE), -1e9)).sum(axis=1)
            for factor in (1.0, 0.99, 1.01)
        )
        for beside in others:
            dark_or_bright = (found.photons == 0) | np.isinf(found.upper)
            assert np.all((beside <= best + 1e-9) | dark_or_bright)


def test_histograms_without_answer_are_named():
    sensor = QIS(0.8, 0.0, 0.0, 3, gain=2.0)
    with pytest.raises(ValueError, match=r"^histogram has the shape \[..., 8\], one bin per code; got \[2, 4\]$"):
        sensor.maximum_likelihood(np.ones((2, 4)), EXPOSURE)
    counts = np.ones((3, 2, 8))
    counts[1, 0] = 0
    with pytest.raises(ValueError, match=r"^histogram\[1, 0\] counts codes: finite, not negative, at least one"):
        sensor.maximum_likelihood(counts, EXPOSURE)
    counts[1, 0, 0] = 1
    message = r"^histogram\[0, 0\] contains code 1, which has probability 0 at every light level for QIS\("
    with pytest.raises(ValueError, match=message):
        sensor.maximum_likelihood(counts, EXPOSURE)  # gain 2 without read noise: codes are even


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(s, marks=pytest.mark.slow) for s in range(2, 30))])
def test_the_codes_that_occur_give_the_estimates_of_all_codes(seed):
    """Estimates of many codes look only at those that occur; for few codes both ways can be compared."""
    rng = np.random.default_rng(seed)
    for _ in range(6):
        bits = int(rng.integers(2, 8))
        gain = 10 ** rng.uniform(-1, 1)
        noise = float(rng.choice([0.0, 0.2, 3.0]))
        offset = float(rng.choice([0.0, 3.3]))
        well = None if rng.random() < 0.6 else float(rng.uniform(0.3, 1.5) * 2**bits / gain)
        dead = float(rng.choice([0.0, 1e-6, 3e-5]))
        sensors = (
            QIS(0.8, 100.0, noise, bits, gain=gain, offset=offset, full_well=well),
            BinarySPAD(0.4, 100.0, bits),
            CountingSPAD(0.5, 100.0, dead, bits),
        )
        for sensor in sensors:
            light = 10 ** rng.uniform(-2, np.log10(1.3 * sensor.white(EXPOSURE)))
            histogram = rng.multinomial(int(rng.integers(1, 30)), sensor.pmf(light, EXPOSURE)).astype(float)
            expected = sensor.maximum_likelihood(histogram, EXPOSURE)
            found = code_likelihood.estimate(sensor, EXPOSURE, histogram, 0.95)
            np.testing.assert_allclose(found, [expected.photons, expected.lower, expected.upper], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("bits", [9, 12, 16])
def test_estimates_of_many_codes(bits):
    """The mean of codes that are not clipped is nearly sufficient; saturated and impossible codes are named."""
    sensor = QIS(0.8, 0.0, 3.0, bits, gain=0.5, offset=20.0)
    light = 0.5 * sensor.white(EXPOSURE)
    codes = sensor.sample(np.full((1, 50), light), EXPOSURE, key=Key(1, 2), engine="reference").ravel()
    found = sensor.maximum_likelihood(np.bincount(codes, minlength=sensor.levels), EXPOSURE)
    moment = sensor.response(EXPOSURE).invert(codes.mean(), 50)
    assert found.photons == pytest.approx(moment, abs=0.2 * np.sqrt(light / 50))
    assert found.lower < found.photons < found.upper
    only = np.zeros(sensor.levels)
    only[-1] = 1
    top = sensor.maximum_likelihood(only, EXPOSURE)
    assert 0 < top.lower < top.photons < np.inf == top.upper
    with pytest.raises(ValueError, match=r"^histogram contains code 1, which has probability 0 at every light level"):
        QIS(0.8, 0.0, 0.0, bits, gain=2.0).maximum_likelihood(np.roll(only, 2), EXPOSURE)


# ---- Response


@each
def test_response_is_the_exact_mean_and_variance(sensor: Sensor):
    table = sensor.response(EXPOSURE)
    some = slice(None, None, 97)
    np.testing.assert_allclose(table.mean[some], sensor.mean(table.photons[some], EXPOSURE), rtol=1e-9)
    np.testing.assert_allclose(table.variance[some], sensor.variance(table.photons[some], EXPOSURE), atol=1e-12)


@each
def test_response_gives_the_light_of_a_mean_code_back(sensor: Sensor):
    """Interpolated between 4096 levels of light: to 1e-4 of what a hundred codes resolve, and never beyond its cap."""
    table = sensor.response(EXPOSURE)
    light = np.linspace(0.2, 1.0, 5) * table.cap(100)
    np.testing.assert_allclose(table.invert(sensor.mean(light, EXPOSURE), 10**6), light, rtol=1e-4)
    assert table.invert(sensor.levels, 11) == table.cap(11) < table.photons[-1]
    counts = np.array([[50.0, 100.0], [1000.0, 11.5]])  # of codes, pixel by pixel
    np.testing.assert_array_equal(
        table.invert(np.full((2, 2), sensor.levels, np.float32), counts), np.vectorize(table.cap)(counts)
    )
    for count in (0, -1, np.nan):
        with pytest.raises(ValueError, match="samples is a number of codes above 0"):
            table.cap(count)


@pytest.mark.parametrize(
    ("sensor", "code"),
    [
        (QIS(0.37, 0.0, 30.0, 11, gain=45.0, full_well=20.7), 267),
        (QIS(0.53, 0.0, 30.0, 9, gain=18.4), 41),
        pytest.param(QIS(0.91, 0.0, 30.0, 14, gain=15.7), 128, marks=pytest.mark.slow),
        (QIS(0.085, 0.0, 30.0, 13, gain=210.2, offset=-95.9), 533),
    ],
)
def test_many_codes_of_a_sensor_without_dark_current_have_an_estimate(sensor, code):
    """The search went down to no arrivals at all, where the slope is 0 over 0, and ended in an OverflowError."""
    histogram = np.zeros(sensor.levels)
    histogram[code] = 5
    found = sensor.maximum_likelihood(histogram, 5e-4)
    assert 0 <= found.lower <= found.photons <= found.upper
    codes = np.full(5, code)
    best, low = (sensor.log_likelihood(codes, float(light), 5e-4).sum() for light in (found.photons, found.lower))
    assert best >= low - 1e-9


def test_an_impossible_code_of_a_sensor_without_noise_is_refused():
    sensor = QIS(0.54, 0.0, 0.0, 10, gain=0.0134, offset=114.7)
    histogram = np.zeros(sensor.levels)
    histogram[3] = 5
    with pytest.raises(ValueError, match="probability 0 at every light level"):
        sensor.maximum_likelihood(histogram, 5e-4)

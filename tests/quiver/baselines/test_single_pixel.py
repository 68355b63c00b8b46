"""Restorers of single pixels: naive mean, moment inverse, and what they share with maximum likelihood.

Numbers "worked by hand" are computed from the sensor's definition in double precision: 3 bits, gain 3.5 / 3.25.
"""

import numpy as np
import pytest
from stats import critical_z

from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.devices import quiver_physical
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from quiver.baselines import METHODS, moment, naive_mean

EXPOSURE = 5e-4
SENSORS = {
    "qis-3": quiver_physical(3.25),
    "qis-1": quiver_physical(3.25, bits=1),
    "qis-3-noisy": QIS(0.7, 3200.0, 0.6, 3, gain=0.7, offset=0.3),
    "spad-sum": BinarySPAD(0.4, 25.0, bits=3),
    "spad-1": BinarySPAD(0.4, 25.0, bits=1),
    "spad-count": CountingSPAD(0.5, 100.0, dead_time=2e-5, bits=4),
}
LEVELS = (0.1, 0.3, 1.0, 3.25, 6.5, 9.75, 19.5, 26.0)


def flat(sensor, photons, frames, shape=(40, 50)):
    return sensor.sample(np.full((frames, *shape), photons), EXPOSURE, key=Key(5, 8), engine="reference")


def estimator_moments(sensor, photons, window, restore):
    """Exact mean and variance of an estimate that depends on the sum of a window only."""
    top = sensor.levels - 1
    sums = np.arange(window * top + 1)
    frames = np.clip(sums[None] - top * np.arange(window)[:, None], 0, top)  # any codes with this sum
    estimate = restore(frames[:, None].astype(sensor.dtype), sensor, EXPOSURE, window=window)[window // 2, 0]
    pmf = np.ones(1)
    for _ in range(window):
        pmf = np.convolve(pmf, np.exp(sensor.log_pmf(np.array([photons]), EXPOSURE))[0])
    average = float(pmf @ estimate)
    return average, float(pmf @ (estimate - average) ** 2), estimate, pmf


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("photons", LEVELS)
def test_flat_fields_have_the_mean_the_exact_distribution_predicts(name, photons):
    """2000 windows of a flat field, disjoint in time and space; variance of their mean from the exact distribution."""
    sensor = SENSORS[name]
    window = 5
    restored = moment.restore(flat(sensor, photons, window), sensor, EXPOSURE, window=window)[window // 2]
    expected, variance, _, _ = estimator_moments(sensor, photons, window, moment.restore)
    sigma = np.sqrt(variance / restored.size) + 1e-6 * expected
    assert abs(restored.mean(dtype=float) - expected) < critical_z(1e-6, len(SENSORS) * len(LEVELS)) * sigma


@pytest.mark.parametrize("method", ["moment", "likelihood"])
@pytest.mark.parametrize("photons", LEVELS)
def test_a_flat_field_is_recovered_within_four_standard_errors(method, photons):
    """100 frames of 8 pixels; variance is the Cramer-Rao bound 1/(n I), bias of order 1/n far below.

    A window of 199 frames around frame 0 holds frame 0 once and all others twice, which averages like 99.75 frames.
    At 19.5 and 26 photons (6 and 8 times the level the gain is made for) nearly all codes are the top one: light is
    known only as a bound, and the estimate must reach it, up to the cap half a count below saturation.
    """
    sensor = quiver_physical(3.25)
    frames = 100
    shape = (2, 4)
    codes = flat(sensor, photons, frames, shape)
    middle = METHODS[method].restore(codes, sensor, EXPOSURE, window=2 * frames - 1)[0]
    information = float(sensor.fisher_information(np.array([photons]), EXPOSURE)[0])
    standard_error = 1 / np.sqrt(frames * middle.size * information)
    cap = sensor.response(EXPOSURE).cap(2 * frames - 1)
    if photons < 0.6 * cap:
        assert abs(middle.mean() - photons) < 4 * standard_error
    else:
        assert middle.min() > 0.6 * cap
        assert middle.max() <= cap * (1 + 1e-6)


@pytest.mark.parametrize("ppp", [3.25, 9.75, 19.5, 26.0])
def test_the_light_a_gain_is_made_for_is_recovered(ppp):
    """With the gain rule 3.5/PPP no level saturates: mean of 11-frame windows within 4 standard errors of the light.

    The moment inverse is biased by its curvature, -mu''/(2 mu'^3) V/n, which the exact distribution gives; 0.5 % of the
    light bounds it for all four levels.
    """
    sensor = quiver_physical(ppp)
    restored = moment.restore(flat(sensor, ppp, 11), sensor, EXPOSURE, window=11)[5]
    expected, variance, _, _ = estimator_moments(sensor, ppp, 11, moment.restore)
    assert abs(restored.mean(dtype=float) - expected) < 4 * np.sqrt(variance / restored.size)
    assert abs(expected - ppp) < 0.005 * ppp


def test_caps_and_dark_level_worked_by_hand():
    table = QIS(0.8, 1.6, 0.2, 3, gain=3.5 / 3.25).response(EXPOSURE)
    np.testing.assert_allclose([table.cap(n) for n in (1, 3, 5, 11)], [10.326, 12.873, 13.969, 15.584], atol=6e-4)
    np.testing.assert_allclose(table.mean[0], 0.010941, atol=1e-6)
    np.testing.assert_allclose(table.invert(2.696241, 100), 3.25, rtol=1e-5)


@pytest.mark.parametrize(("factor", "bias"), [(0.5, -0.041), (1, -0.037), (2, -0.096), (4, -0.389)])
def test_the_naive_mean_is_as_biased_as_clipping_makes_it(factor, bias):
    """Expectation over one code, worked by hand for 3.25 photons per pixel."""
    sensor = QIS(0.8, 1.6, 0.2, 3, gain=3.5 / 3.25)
    photons = 3.25 * factor
    estimate = naive_mean.restore(np.arange(8, dtype=np.uint8).reshape(1, 1, 8), sensor, EXPOSURE, window=1)[0, 0]
    unclamped = np.where(estimate > 0, estimate, -naive_mean.dark_codes(sensor, EXPOSURE) * sensor.white(EXPOSURE) / 7)
    pmf = np.exp(sensor.log_pmf(np.array([photons]), EXPOSURE))[0]
    assert abs(pmf @ unclamped / photons - 1 - bias) < 6e-4


@pytest.mark.parametrize("name", ["naive", "moment", "likelihood"])
def test_the_order_of_the_frames_in_a_window_does_not_matter(name):
    sensor = quiver_physical(3.25)
    rng = np.random.default_rng(0)
    codes = rng.integers(0, 8, (5, 8, 10), dtype=np.uint8)
    once = METHODS[name].restore(codes, sensor, EXPOSURE, window=5)[2]
    again = METHODS[name].restore(codes[[3, 1, 4, 0, 2]], sensor, EXPOSURE, window=5)[2]
    np.testing.assert_array_equal(once, again)


@pytest.mark.parametrize("method", METHODS)
def test_the_unit_of_the_result(method):
    codes = flat(SENSORS["qis-3"], 3.25, 3, (17, 19))
    run = METHODS[method].restore
    photons = run(codes, SENSORS["qis-3"], EXPOSURE, window=3)
    lux = run(codes, SENSORS["qis-3"], EXPOSURE, window=3, photons_per_unit=2.47)
    assert lux.dtype == np.float32
    assert np.allclose(lux, photons / 2.47, rtol=1e-6)
    with pytest.raises(ValueError, match="photons_per_unit must be a finite number above 0, got 0"):
        run(codes, SENSORS["qis-3"], EXPOSURE, window=3, photons_per_unit=0)

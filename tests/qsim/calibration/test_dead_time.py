"""Dead time: the matched variance, static scenes, real photons."""

from pathlib import Path

import numpy as np
import pytest
from stats import assert_share

from qsim.calibration.dead_time import Pooled, calibrate_static, fitted_dead_time, matched_variance
from qsim.calibration.results import Calibration
from qsim.calibration.spad_response import Response
from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD

DATA = Path(__file__).parents[2] / "data"


@pytest.mark.parametrize("paralyzable", [False, True])
def test_matched_variance_inverts_the_exact_mean(paralyzable):
    sensor = CountingSPAD(1.0, 0.0, 0.05, 6, paralyzable)
    arrivals = 4.2
    mean = float(sensor.mean(np.array(arrivals), 1.0))
    response = Response(6, 0.05, paralyzable, 1.0)
    h = 1e-3
    found = matched_variance(np.array([mean, mean + h, mean - h]), response)
    assert found.arrivals[0] == pytest.approx(arrivals, rel=1e-7)
    assert found.variance[0] == pytest.approx(float(sensor.variance(np.array(arrivals), 1.0)), rel=1e-6)
    assert found.slope[0] == pytest.approx((found.variance[1] - found.variance[2]) / (2 * h), rel=1e-3)
    assert found.bend[0] == pytest.approx((found.slope[1] - found.slope[2]) / (2 * h), rel=1e-3)


def test_real_photons_fano_one_at_low_flux_and_a_dead_time_near_four_nanoseconds():
    """Five scans of a hazelnut, 6.33 us per pixel. Known: effective dead time 4.0 +- 0.3 ns."""
    counts = np.load(DATA / "hazelnut_gates6.npz")["gates"].astype(np.int64).sum(axis=1)
    edges = (1, 5, 10, 20, 30, 40, 60, 100, 130)
    found = calibrate_static(counts, bits=8, exposure=6.33e-6, edges=edges)
    dead = found.values["dead_time"]
    assert dead.low < 4.0e-9 < dead.high
    assert dead.high - dead.low < 2e-9
    dim = found.values["fano_at_2.19"]
    assert dim.low < 1.0 < dim.high
    bright = found.values["fano_at_111"]
    assert bright.high < 0.9
    assert found.p_value > 1e-3


def test_static_scene_without_dead_time_finds_none():
    rng = np.random.default_rng(0)
    light = np.geomspace(1, 120, 60)[:, None] * np.ones((1, 60))
    found = calibrate_static(rng.poisson(light, (6, 60, 60)), bits=8, exposure=1e-5)
    dead = found.values["dead_time"]
    assert dead.low == 0.0 or dead.low < 3e-9
    with pytest.raises(ValueError, match="at least 2 frames"):
        calibrate_static(rng.poisson(light, (1, 60, 60)), bits=8, exposure=1e-5)


@pytest.fixture(scope="module")
def bright() -> list[Calibration]:
    """Calibrations of light from 1 to 100 arrivals per exposure; at a dead time of 1/200 F falls to 0.44."""
    sensor = CountingSPAD(1.0, 0.0, 5e-3, 7)
    light = np.broadcast_to(np.geomspace(1, 100, 64 * 64).reshape(64, 64), (150, 64, 64))
    return [calibrate_static(sensor.sample(light, 1.0, key=Key(seed, 3)), bits=7, exposure=1.0) for seed in range(20)]


def test_the_spread_of_light_in_a_class_does_not_lengthen_the_dead_time(bright):
    """The variance of counts bends with light: dead times were 2 % too long, with errors of 0.5 %."""
    found = [one.values["dead_time"] for one in bright]
    assert_share(sum(dead.low <= 5e-3 <= dead.high for dead in found), len(found), 0.95)


def test_p_values_of_a_right_model_are_uniform(bright):
    """With the errors of Poisson counts, chi-square was several times too small where dead time blocks half."""
    p = np.array([one.p_value for one in bright])
    for share in (0.1, 0.5, 0.9):
        assert_share(int((p < share).sum()), p.size, share, checks=3)
    assert not any(one.warnings for one in bright if one.p_value > 1e-3)


def test_light_that_changes_between_frames_is_noticed():
    """It gave a dead time of exactly 0 without a word."""
    rng = np.random.default_rng(4)
    light = np.broadcast_to(np.geomspace(1, 60, 64 * 64).reshape(64, 64), (20, 64, 64))
    flicker = np.where(np.arange(20) % 2, 0.9, 1.1)[:, None, None]
    steady, moving = (calibrate_static(rng.poisson(x), bits=8, exposure=1e-5) for x in (light, light * flicker))
    assert steady.warnings == ()
    assert "is the scene static?" in moving.warnings[0]


@pytest.mark.parametrize(("value", "words"), [(300, "300"), (-1, "-1"), (0.5, "0.5")])
def test_a_value_that_is_not_a_code_names_its_place(value, words):
    """Values of dark pixels were not checked, others named their place in a class of light."""
    counts = np.random.default_rng(5).poisson(np.geomspace(0.1, 60, 32 * 32).reshape(32, 32), (6, 32, 32)).astype(float)
    counts[3, 2, 30] = value
    with pytest.raises(ValueError, match=rf"a.npy: {words}.* at \(t, y, x\) = \(3, 2, 30\) is not a code of 8 bits"):
        calibrate_static(counts, bits=8, exposure=1e-5, name="a.npy")


@pytest.mark.parametrize("excess", [1e-9, 1e-7, 1e-6, 1e-4])
def test_a_dead_time_near_none_is_placed_without_leaving_its_range(excess):
    """Flats whose variance is hardly below that of Poisson counts."""
    response = Response(5, 0.0, False, 1e-6)
    flats = [Pooled(mean, mean * (1 - 2 * excess * mean), 0.0, 400, 200, 1e-6) for mean in (2.0, 6.0)]
    found = fitted_dead_time(flats, response)
    assert found is not None
    assert 0.0 <= found.value <= 20 * excess + 1e-5
    assert found.low == 0.0
    assert found.high > found.value

"""Dead time: the matched variance, static scenes, real photons."""

from pathlib import Path

import numpy as np
import pytest

from qsim.calibration.dead_time import calibrate_static, matched_variance
from qsim.sensor.counting import CountingSPAD

DATA = Path(__file__).parents[2] / "data"


@pytest.mark.parametrize("paralyzable", [False, True])
def test_matched_variance_inverts_the_exact_mean(paralyzable):
    sensor = CountingSPAD(1.0, 0.0, 0.05, 6, paralyzable)
    arrivals = 4.2
    mean = float(sensor.mean(np.array(arrivals), 1.0))
    found, variance, slope = matched_variance(mean, 6, 0.05, paralyzable)
    assert found == pytest.approx(arrivals, rel=1e-7)
    assert variance == pytest.approx(float(sensor.variance(np.array(arrivals), 1.0)), rel=1e-6)
    h = 1e-3
    steps = [matched_variance(mean + sign * h, 6, 0.05, paralyzable)[1] for sign in (1, -1)]
    assert slope == pytest.approx((steps[0] - steps[1]) / (2 * h), rel=1e-3)


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

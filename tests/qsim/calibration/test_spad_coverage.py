"""Coverage of SPAD intervals, over frames of a simulator that knows nothing of qsim."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from stats import assert_share

from qsim.calibration.frame_statistics import measure
from qsim.calibration.spad import calibrate_spad

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
from calibration_simulator import SPADArray
from coverage_spad import CASES, SPADCase, hits_of


def assert_covered(case: SPADCase, arrays: int) -> None:
    hits: dict[str, list[bool]] = {}
    for number in range(arrays):
        for name, held in hits_of(case, [3, number]).items():
            hits.setdefault(name, []).append(held)
    means = {name: held for name, held in hits.items() if "_p" not in name and "median" not in name}
    for held in means.values():
        assert_share(sum(held), len(held), 0.95, checks=len(means))


def test_quick_coverage():
    """24 small arrays with afterpulses, crosstalk and saturated hot pixels: 95 % differs from 60 %."""
    case = SPADCase(planes=100, side=14, hot=0.02, hottest=30.0, afterpulsing=0.1, crosstalk=0.003)
    assert_covered(case, 24)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_intervals_of_random_arrays_cover_as_promised(name):
    """200 arrays of each kind."""
    assert_covered(replace(CASES[name], most_values=4e5), 200)


def test_pixels_of_equal_dark_rates_have_their_median_and_no_percentiles():
    """All pixels at 20 /s in 300 planes of 0.1 ms: the median was 0 [0, 0], p90 66.778 [66.778, 66.778]."""
    held = 0
    for number in range(20):
        rng = np.random.default_rng([6, number])
        planes = rng.random((300, 20, 20)) < -np.expm1(-20 * 1e-4)
        found = calibrate_spad([measure([planes], bits=1, exposure=1e-4, photons=0.0)], [], bits=1)
        median = found.values["dark_count_rate_median"]
        assert median.low < median.value < median.high
        held += median.low <= 20 <= median.high
        assert not [name for name in found.values if name.startswith("dark_count_rate_p")]
        assert any("p90, p99, p99.9 over pixels are not printed" in words for words in found.warnings)
    assert_share(held, 20, 0.95)


def test_the_unit_of_time_scales_rates_and_changes_nothing_else():
    """The same frames stated at 1e-7 s and at 1e4 s."""
    rng = np.random.default_rng(3)
    array = SPADArray(np.full((12, 12), 0.4), np.full((12, 12), 0.01), 1)
    dark, flat = (array.frames(rng, np.full((12, 12), light), 1.0, 100) for light in (0.0, 1.0))
    found = []
    for exposure in (1e-7, 1e4):
        darks = [measure([dark], bits=1, exposure=exposure, photons=0.0)]
        flats = [measure([flat], bits=1, exposure=exposure, photons=1.0)]
        values = calibrate_spad(darks, flats, bits=1).values
        found.append(
            {
                name: np.array([v.value, v.low, v.high]) * (exposure if v.unit == "1/s" else 1.0)
                for name, v in values.items()
            }
        )
    assert found[0].keys() == found[1].keys()
    for name, values in found[0].items():
        np.testing.assert_allclose(values, found[1][name], rtol=1e-9)


def test_saturated_hot_pixels_leave_the_efficiency_right_and_the_mean_dark_rate_open():
    """2 % of the pixels at 8 counts a plane: the efficiency was 7 % low, and the mean dark rate too with an end."""
    rng = np.random.default_rng(7)
    rate = np.full((20, 20), 0.02)
    rate.ravel()[:8] = 20.0
    array = SPADArray(np.full(rate.shape, 0.4), rate, 1)
    darks = [measure([array.frames(rng, np.zeros(rate.shape), 1.0, 200)], bits=1, exposure=1.0, photons=0.0)]
    flats = [measure([array.frames(rng, np.full(rate.shape, 1.5), 1.0, 60)], bits=1, exposure=1.0, photons=1.5)]
    found = calibrate_spad(darks, flats, bits=1)
    assert abs(found.values["pde_fill"].value / 0.4 - 1) < 0.05  # four standard errors
    assert found.values["dark_count_rate"].high == np.inf
    assert found.values["dark_count_rate_good"].high < 0.03
    assert np.array_equal(found.maps["hot_pixels"], rate > 1)
    assert any("8 hot pixels are saturated in every dark frame" in words for words in found.warnings)
    assert not any("use less light" in words for words in found.warnings)

"""PRNU: hot pixels, dark patterns and clean arrays."""

import numpy as np
import pytest
from synthetic import RandomArray

from qsim.calibration.frame_statistics import measure, measure_sums
from qsim.calibration.spad import calibrate_spad


@pytest.mark.parametrize("readout", ["qis", "planes", "counts"])
def test_hot_pixels_stay_out_of_prnu(readout):
    """15 % hot pixels hardly change PRNU and more than double the spread of all pixels; both are reported."""
    array = RandomArray(readout, 0.04, 0.3, (0.1, 0.0), 0.15, 30, 600 if readout == "planes" else 60, 1.0)
    found = array.calibrate(np.random.default_rng(0)).values
    prnu, everything, count = (found[name] for name in ("prnu", "prnu_with_hot_pixels", "prnu_left_out"))
    assert prnu.low <= 0.04 <= prnu.high
    assert everything.value > 0.08
    hot = 0.15 * 900
    assert abs(count.value - hot) < 5 * np.sqrt(hot)
    assert count.unit == "of 900 pixels"
    assert 0.02 < found["shading"].value < 0.15


def test_clean_arrays_lose_no_pixel():
    array = RandomArray("planes", 0.1, 0.5, (0.0, 0.0), 0.0, 24, 300, 0.6)
    found = array.calibrate(np.random.default_rng(1)).values
    assert found["prnu_left_out"].value == 0
    assert "prnu_with_hot_pixels" not in found


def test_without_darks_the_flat_tells_hot_pixels():
    """Only bright pixels, and a warning names the rule."""
    array = RandomArray("counts", 0.03, 0.3, (0.0, 0.0), 0.0, 24, 40, 2.0)
    rng = np.random.default_rng(2)
    clean = array.calibrate(rng, darks=False)
    assert clean.values["prnu_left_out"].value == 0
    flat = rng.poisson(2.0 * (1 + 0.03 * rng.standard_normal((24, 24))), (40, 24, 24))
    flat[:, 3, 4] += 40
    flat[:, 7, 9] += 15
    found = calibrate_spad([], [measure([flat], bits=7, exposure=1e-3, photons=None)], bits=7, dead_time=False)
    assert found.values["prnu_left_out"].value == 2
    assert found.values["prnu"].low <= 0.03 <= found.values["prnu"].high
    assert any("left out as hot by the flat: 6 robust sigmas" in words for words in found.warnings)


@pytest.mark.parametrize("correlation", [-1.0, 0.0, 1.0])
def test_dark_pattern_that_follows_the_light_does_not_bias_prnu(correlation):
    """Dark counts that rise or fall with a pixel's efficiency: each pixel's own level must be subtracted.

    Subtracting variances gave sqrt(4^2 +- 2 x 4 x 1.2) = 5.1 % and 2.5 % for 4 % PRNU and 1.2 % dark spread.
    """
    rng = np.random.default_rng(4)
    pattern, other = rng.standard_normal((2, 60, 60))
    light = 0.1 * (1 + 0.04 * pattern)
    dark = 0.004 + 0.0012 * (pattern if correlation else other) * (correlation or 1)
    ones = [
        rng.binomial(60000, -np.expm1(-arrivals)) for arrivals in (np.maximum(dark, 0), light + np.maximum(dark, 0))
    ]
    stacks = [measure_sums([count], planes=60000, exposure=1e-5, photons=None) for count in ones]
    value = calibrate_spad(stacks[:1], stacks[1:], bits=1).values["prnu"]
    assert value.low <= 0.04 <= value.high
    assert value.high - value.low < 0.003

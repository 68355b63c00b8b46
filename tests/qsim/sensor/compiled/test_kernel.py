"""Kernels decide like the reference: at every light, margin and length of sums."""

from dataclasses import replace

import numpy as np
import pytest
from compiled_cases import EXPOSURE, SENSORS, fast, light, needs_engine, reference
from stats import assert_histogram

import qsim.sensor.sensor as sensor_module
from qsim.sensor.compiled import kernel
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import plan_of


@needs_engine
@pytest.mark.parametrize("name", SENSORS)
def test_float32_alone_stays_well_within_its_margin(name, monkeypatch):
    """With a quarter of the margin nothing changes; with none a few pixels in a million differ."""
    sensor = SENSORS[name]
    photons = light(sensor, (2, 300, 500), seed=3)
    expected = fast(sensor, photons)
    plan = plan_of(sensor, EXPOSURE)
    monkeypatch.setattr(sensor_module, "plan_of", lambda *_: replace(plan, margin=plan.margin / 4))
    np.testing.assert_array_equal(fast(sensor, photons), expected)
    monkeypatch.setattr(sensor_module, "plan_of", lambda *_: replace(plan, margin=0.0))
    assert (fast(sensor, photons) != expected).mean() <= 2e-5


@needs_engine
@pytest.mark.parametrize("name", SENSORS)
def test_extreme_light_has_the_reference_codes(name):
    sensor = SENSORS[name]
    levels = [0.0, 1e-300, 1e-12, 1e-6, 1e-3, 87.0, 88.8, 130.0, 1e3, 1e6, 1e12, 1e30, 1e39, 1e200]
    photons = np.repeat(np.array(levels)[:, None], 64, axis=1)
    np.testing.assert_array_equal(fast(sensor, photons), reference(sensor, photons))


@needs_engine
@pytest.mark.parametrize("terms", [48, 58, 59, 62, 65, 68, 71, 75, 76, 104])
def test_dark_pixels_of_long_sums_are_drawn_right(terms):
    """At a few electrons the last terms are tiny and still decide; 59 to 75 terms once lost them and drew the top."""
    sensor = QIS(0.8, 1.6, 0.2, 1, gain=0.5 / terms)
    photons = np.repeat([0.1, 0.5, 2.4, 6.0, 15.0], 8192).reshape(5, 64, 128)
    np.testing.assert_array_equal(fast(sensor, photons), reference(sensor, photons))


@needs_engine
def test_sensors_share_kernels_after_the_first_few(monkeypatch):
    """Numbers as arguments of a common kernel instead of constants: the same codes."""
    monkeypatch.setattr(kernel, "CONSTANT_PLANS", 0)
    kernel.arguments.cache_clear()
    for name in ("published gain", "full well", "dead time", "seven planes"):
        sensor = SENSORS[name]
        photons = light(sensor, (2, 20, 30))
        np.testing.assert_array_equal(fast(sensor, photons), reference(sensor, photons))
    kernel.arguments.cache_clear()


@needs_engine
def test_the_drawn_codes_follow_the_closed_form():
    sensor = SENSORS["published gain"]
    codes = fast(sensor, np.full((1, 300, 400), 3.25, np.float32))
    assert_histogram(codes, np.exp(sensor.log_pmf(np.array(3.25), EXPOSURE)))

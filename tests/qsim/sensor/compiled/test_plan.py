"""Plans state the sensor's cdf: short sums to rounding, curves to half of their margin."""

import numpy as np
import pytest
from compiled_cases import EXPOSURE, OTHERS, SENSORS, SHORT

from qsim.sensor.compiled.curves import Curves
from qsim.sensor.compiled.plan import Electrons
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import plan_of


@pytest.mark.parametrize("name", [name for name in SHORT if isinstance(SENSORS[name], QIS)])
def test_the_sums_are_the_cdf(name):
    """Evaluated in float64 they differ by the coefficients left out (1e-12) and by rounding."""
    sensor = SENSORS[name]
    steps = sensor.short_sums()
    assert isinstance(steps, Electrons)
    mean = np.minimum(np.linspace(0, 1.2 * steps.highest, 200), steps.highest)[:, None]
    terms = (mean / steps.scale) ** np.arange(len(steps.full))
    for k, (prefix, band, floor) in enumerate(zip(steps.prefix, steps.band, steps.floor, strict=True)):
        total = terms[:, :prefix] @ steps.full[:prefix] + terms[:, prefix : prefix + len(band)] @ band
        step = floor + total * np.exp(-mean[:, 0])
        np.testing.assert_allclose(step, sensor.cdf_of(mean[:, 0], EXPOSURE)[:, k], atol=1e-10)


@pytest.mark.parametrize("name", [name for name in SENSORS if name not in SHORT])
def test_curves_are_the_cdf(name):
    """At random light, dark to beyond the last step, to half of their margin: their error and float32's rounding."""
    sensor = SENSORS[name]
    plan = plan_of(sensor, EXPOSURE)
    assert isinstance(plan.steps, Curves)
    brightest = min(1.5 * sensor.white(EXPOSURE), 0.98 * plan.steps.brightest**2 / sensor.efficiency)
    photons = np.random.default_rng(1).uniform(0, brightest, 500).astype(np.float32)
    at = (np.sqrt(sensor.arrivals(photons, EXPOSURE))[:, None] - plan.steps.start) * plan.steps.rate
    cells = plan.steps.cubics.shape[1]
    at = np.clip(at, 0, cells)
    cell = np.minimum(at.astype(int), cells - 1)
    cubic = plan.steps.cubics[np.arange(len(plan.steps.rate)), cell].astype(float)
    found = (cubic * (at - cell)[..., None] ** np.arange(4)).sum(axis=-1)
    np.testing.assert_allclose(found, sensor.cdf(photons, EXPOSURE)[:, :-1], rtol=0, atol=plan.margin / 2)


@pytest.mark.parametrize("name", OTHERS)
def test_more_than_eight_bits_have_no_plan(name):
    assert plan_of(OTHERS[name], EXPOSURE) is None

"""The laws of a sensor file: median dark rates, dark counts over temperature, efficiency over wavelength."""

import numpy as np
import pytest

from qsim.sensor import devices
from qsim.sensor.defects.fixed_pattern import DarkSpread, FixedPattern, draw_maps
from qsim.sensor.file_laws import Conditions

PLAIN = '[sensor]\nmodel = "BinarySPAD"\nbits = 3\npde = 0.5\n'
WARM = PLAIN + "dark_count_rate = 20.0\ndark_doubling = 8.0\ndark_reference = 25.0\n"
CURVE = '[sensor]\nmodel = "QIS"\nbits = 3\nread_noise = 0.2\ndark_current = 1.6\n'
CURVE += "qe_curve = [[450e-9, 0.3], [550e-9, 0.5], [650e-9, 0.4]]\n"


def load(folder, text, **conditions):
    (folder / "s.toml").write_text(text)
    return devices.load(folder / "s.toml", conditions=Conditions(**conditions))


def test_a_dark_rate_doubles_per_so_many_kelvin(tmp_path):
    assert load(tmp_path, WARM) == load(tmp_path, PLAIN + "dark_count_rate = 20.0\n")
    rng = np.random.default_rng(1)
    for celsius in rng.uniform(-40, 80, 20):
        found = load(tmp_path, WARM, temperature=celsius).dark_rate
        assert found == pytest.approx(20 * np.exp(np.log(2) * (celsius - 25) / 8), rel=1e-12)
    assert load(tmp_path, WARM + "temperature = 41.0\n").dark_rate == pytest.approx(80)
    assert load(tmp_path, WARM + "temperature = 41.0\n", temperature=25.0).dark_rate == 20


def test_a_median_is_that_of_the_pixels(tmp_path):
    """The median pixel of a map of a million has the stated rate, within 5 of its standard errors."""
    text = PLAIN + "median = 0.4\n"
    assert load(tmp_path, text) == load(tmp_path, PLAIN + "dark_count_rate = 0.4\n")
    sensor = load(tmp_path, text + "[defects]\ndark.spread = 0.4\n")
    spread = DarkSpread(spread=0.4)
    rates = sensor.dark_rate * draw_maps(FixedPattern(dark=spread), (1000, 1000)).dark
    hot = spread.hot_share / 2  # hot pixels lie above the median, which moves by so much of the body's distribution
    assert np.median(rates) == pytest.approx(0.4 * np.exp(0.4 * 2.5066 * hot), rel=0.005)
    preset = devices.load("megax-a", conditions=Conditions(dark=spread))
    assert preset.dark_rate == pytest.approx(0.4 * spread.mean)
    assert devices.load("spad512s", conditions=Conditions(dark=spread)) == devices.load("spad512s")


def test_efficiency_follows_the_wavelength(tmp_path):
    for nanometres, expected in ((450, 0.3), (500, 0.4), (550, 0.5), (600, 0.45), (650, 0.4)):
        assert load(tmp_path, CURVE, wavelength=nanometres * 1e-9).efficiency == pytest.approx(expected)
    assert load(tmp_path, CURVE).efficiency == pytest.approx(0.5)  # cameras' default, 550 nm


@pytest.mark.parametrize(
    ("text", "given", "message"),
    [
        (PLAIN + "dark_count_rate = 1.0\nmedian = 1.0\n", {}, "twice; leave one out"),
        (PLAIN + "dark_count_rate = 1.0\ntemperature = 20.0\n", {}, "temperature needs dark_doubling"),
        (PLAIN + "dark_count_rate = 1.0\n", {"temperature": 20.0}, "no law of temperature; give it dark_doubling"),
        (WARM.replace("dark_reference = 25.0\n", ""), {}, "needs dark_reference"),
        (WARM, {"temperature": 400.0}, "in degrees C, -273.15 to 300"),
        (CURVE + "quantum_efficiency = 0.5\n", {}, "efficiency twice; leave one out"),
        (CURVE, {"wavelength": 700e-9}, "covers 450 to 650 nm, and the light has 700 nm"),
        (CURVE.replace("450e-9", "450"), {}, r"qe_curve\[0\]\[0\]: expected a number from 1e-07 to 2e-05, got 450"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, text, given, message):
    with pytest.raises(ValueError, match=message):
        load(tmp_path, text, **given)


def test_a_named_sensor_has_no_temperature():
    with pytest.raises(ValueError, match="spad512s: has no law of temperature; use a sensor file"):
        devices.load("spad512s", conditions=Conditions(temperature=20.0))

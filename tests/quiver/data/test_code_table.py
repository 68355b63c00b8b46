"""Codes drawn through the table equal those of the reference draw; sensors that fit no table draw without it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from stats import assert_histogram

from qsim.keys import Key
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD
from quiver.data.code_table import CodeTable, draw_codes

EXPOSURE = 5e-4

SENSORS = (
    QIS(0.8, 1.6, 0.2, 3, gain=3.5 / 3.25),
    QIS(0.8, 3200.0, 0.0, 2),
    QIS(0.8, 1.6, 2.0, 5, gain=0.3, full_well=20.0),
    QIS(0.8, 1.6, 0.2, 6, gain=0.3),
    QIS(0.8, 1.6, 0.2, 7, gain=0.635),
    BinarySPAD(0.4, 100.0, bits=1),
    CountingSPAD(0.5, 25.0, 5e-5, 3),
)


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda s: f"{type(s).__name__}-{s.bits}")
def test_table_draws_are_the_reference_draws(sensor: Sensor):
    """Every code, from darkness to far beyond saturation, equals the sensor's slow draw."""
    photons = np.random.default_rng(0).choice([0, 1e-6, 0.3, 1, 3.25, 7, 20, 300, 1e6], (3, 40, 50))
    photons = photons * np.random.default_rng(1).uniform(0.5, 1.5, photons.shape)
    key = Key(seed=3, clip=5, frame=2)
    expected = sensor.sample(photons, EXPOSURE, key=key, engine="reference")
    np.testing.assert_array_equal(draw_codes(sensor, photons, EXPOSURE, key), expected)


def test_sums_of_planes_have_the_exact_distribution():
    """A clocked SPAD draws plane by plane; its table draws the sum: the same binomial law."""
    for sensor, level in itertools.product((BinarySPAD(1.0, 0.0, bits=bits) for bits in (3, 7)), (0.5, 4.9, 20.0)):
        codes = draw_codes(sensor, np.full((5, 80, 100), level), EXPOSURE, Key(1, int(level)))
        assert_histogram(codes, np.exp(sensor.log_pmf(np.array([level]), EXPOSURE)[0]), checks=6)


def test_the_table_decides_most_pixels_itself():
    """The table is used: 3 bits leave 1 to 2 % of the cells undecided."""
    table = CodeTable(SENSORS[0], EXPOSURE)
    assert 0.003 < np.mean(table.table == CodeTable.UNDECIDED) < 0.03
    assert set(np.unique(table.table)) == {0, 1, 2, 3, 4, 5, 6, 7, 255}


def test_a_table_asks_for_second_words_where_one_does_not_decide():
    sensor = SENSORS[0]
    photons = np.full((1, 1), 3.25)
    edge = np.array([[int(sensor.cdf(photons, EXPOSURE)[0, 0, 2] * 2**32)]], dtype=np.uint32)
    table = CodeTable(sensor, EXPOSURE)
    with pytest.raises(LookupError, match="second words"):
        table.draw(photons, edge)
    least, most = (table.draw(photons, edge, np.full((1, 1), w, np.uint32)) for w in (0, 2**32 - 1))
    assert (least, most) == (2, 3)


def test_sensors_that_fit_no_table_are_drawn_by_themselves():
    """A paralyzable counter's codes fall again at high light; ten bits have too many thresholds."""
    photons = np.full((2, 5, 7), 30.0)
    for sensor in (CountingSPAD(0.5, 25.0, 5e-5, 3, paralyzable=True), QIS(0.8, 1.6, 5.1, 10, offset=32.0)):
        expected = sensor.sample(photons, EXPOSURE, key=Key(1, 2), engine="reference")
        np.testing.assert_array_equal(draw_codes(sensor, photons, EXPOSURE, Key(1, 2)), expected)
    with pytest.raises(ValueError, match="do not grow with light"):
        CodeTable(CountingSPAD(0.5, 25.0, 5e-5, 3, paralyzable=True), EXPOSURE)


def test_a_paralyzable_counter_is_dark_far_above_its_brightest_light():
    """Its table ended where nearly every code was the top one, and held that code for all light above."""
    sensor = CountingSPAD(0.5, 25.0, 5e-6, 3, paralyzable=True)
    photons = np.full((2, 5, 7), 2000.0)
    codes = draw_codes(sensor, photons, EXPOSURE, Key(1, 2))
    np.testing.assert_array_equal(codes, sensor.sample(photons, EXPOSURE, key=Key(1, 2), engine="reference"))
    assert codes.max() < 5


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf])
def test_bad_photons_are_named(bad: float):
    photons = np.ones((2, 5, 7))
    photons[1, 4, 2] = bad
    with pytest.raises(ValueError, match="photons"):
        draw_codes(SENSORS[0], photons, EXPOSURE, Key(1, 2))

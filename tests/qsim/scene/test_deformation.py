"""Cloth: fixed at its pole, periodic, with ripples that move away from it."""

from __future__ import annotations

import numpy as np
import pytest

from qsim.scene import Ballistic, Flag, Ripple
from qsim.scene.shapes import sheet

FLYING = Ballistic((0.1, 0.2, 0.3), (1.0, 2.0, -0.5), axis=(1, 1, 0), rate=-25.0, phase=1.0)
REST = sheet(0.4, 0.2, 7, 5).vertices + np.array([0.2, 0, 0])
FLAG = Flag(REST, (Ripple(0.05, 0.3, 4.0, 3.0, 0.5), Ripple(0.02, 0.11, -7.0)), FLYING)
STEP = 1e-6  # s: central differences err by step^2 * third derivative, below 1e-6 here


def test_the_flag_is_fixed_at_its_pole_and_periodic():
    t = 0.123
    np.testing.assert_array_equal(FLAG.deform(t)[REST[:, 0] == 0], REST[REST[:, 0] == 0])
    np.testing.assert_array_equal(FLAG.deform(t)[:, :2], REST[:, :2])
    slope = (FLAG.deform(t + STEP) - FLAG.deform(t - STEP)) / (2 * STEP)
    assert np.abs(slope).max() > 0.1  # m/s: it moves
    edge = FLAG.rest[:, 0] == FLAG.width
    assert np.abs(FLAG.deform(t)[edge, 2]).max() <= 0.05 + 0.02
    period = Flag(REST, FLAG.ripples[:1])
    np.testing.assert_allclose(period.deform(0.1), period.deform(0.1 + 1 / 4.0), atol=1e-12)


def test_ripples_travel_away_from_the_pole():
    ripple = Ripple(1.0, 0.3, 4.0)
    place = np.array([[0.1, 0.0, 0.0]])
    later = 0.05
    assert ripple.angle(place + np.array([0.3 * 4.0 * later, 0, 0]), later) == pytest.approx(ripple.angle(place, 0.0))

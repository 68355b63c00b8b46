"""Props: gears, rotors and letters have their sizes, teeth, blades and volumes."""

from __future__ import annotations

import numpy as np
import pytest
from mesh_measures import area, area_vectors, polygon_share, shoelace, volume

from qsim.scene.props import gear, glyph_outlines, letters, rotor


def test_gears_have_their_teeth_bore_and_size():
    plain = gear(12, 0.1, 0.02)
    spoked = gear(12, 0.1, 0.02, spokes=4)
    reach = np.hypot(*plain.vertices[:, :2].T)
    assert reach.max() == pytest.approx(0.1)
    assert 0.014 * np.cos(np.pi / 24) <= reach.min() * (1 + 1e-12) <= 0.014 * (1 + 2e-12)  # the bore has 24 corners
    angle = np.arctan2(plain.vertices[:, 1], plain.vertices[:, 0])[reach > 0.0999]
    assert len(np.unique(np.round(angle * 12 / (2 * np.pi)) % 12)) == 12
    root = 0.1 * 0.82
    tip = 0.1
    rim = 12 * (tip**2 * np.sin(0.32 * 2 * np.pi / 12) + root**2 * np.sin(0.40 * 2 * np.pi / 12)) / 2
    flanks = 12 * root * tip * np.sin(0.14 * 2 * np.pi / 12)
    bore = np.pi * 0.014**2 * polygon_share(24)
    assert volume(plain) == pytest.approx((rim + flanks - bore) * 0.02)
    assert 0.3 * volume(plain) < volume(spoked) < 0.8 * volume(plain)
    with pytest.raises(ValueError, match="at least 3 teeth"):
        gear(2, 0.1, 0.02)


def test_rotors_have_equal_blades_within_their_radius():
    one = rotor(1, 0.3)
    five = rotor(5, 0.3)
    assert len(five.faces) == 5 * len(one.faces)
    assert area(five) == pytest.approx(5 * area(one))
    assert 0.28 < np.hypot(*five.vertices[:, :2].T).max() < 0.34
    np.testing.assert_allclose(area_vectors(five).sum(0)[:2], 0, atol=1e-12)  # five-fold symmetry


def test_letters_have_the_volume_of_their_glyphs_and_the_height_of_capitals():
    word = letters("HO", 0.05, 0.01)
    assert np.ptp(word.vertices[:, 1]) == pytest.approx(0.05, rel=0.06)  # round letters reach over the line
    assert np.ptp(letters("H", 0.05, 0.01).vertices[:, 1]) == pytest.approx(0.05, rel=0.01)
    assert np.ptp(word.vertices[:, 2]) == pytest.approx(0.01)
    (h,), (outer, inner) = ([loop * 0.05 / 0.73 for loop in loops] for loops in glyph_outlines("HO"))
    assert volume(word) == pytest.approx((shoelace(h) + abs(shoelace(outer) - shoelace(inner))) * 0.01)
    narrow, wide = (np.ptp(letters(t, 0.05, 0.01).vertices[:, 0]) for t in ("H", "H H"))
    assert wide > 2 * narrow  # a space takes room
    with pytest.raises(ValueError, match="nothing to draw in ' '"):
        letters(" ", 0.05, 0.01)
    with pytest.raises(ValueError, match=r"font 'Comic' is not among matplotlib's: .*DejaVuSans"):
        letters("A", 0.05, 0.01, font="Comic")

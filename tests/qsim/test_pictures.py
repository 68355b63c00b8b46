"""Pictures: the declared tone curve, colours that mean a direction, and no surprise at NaN or empty input."""

import numpy as np
import pytest

from qsim.pictures import code_levels, depth_levels, flow_colours, flow_legend, tone


def test_tone_is_the_declared_curve_rounded_and_clipped():
    levels = tone(np.array([-1.0, 0.0, 0.25, 1.0, 2.0, 9.0, np.nan]), peak=2.0)
    expected = [0, 0, round(255 * 0.125 ** (1 / 2.2)), round(255 * 0.5 ** (1 / 2.2)), 255, 255, 0]
    assert levels.tolist() == expected


def test_tone_refuses_a_dark_peak():
    with pytest.raises(ValueError, match="peak must be positive"):
        tone(np.zeros((2, 2)), peak=0.0)


def test_codes_span_the_whole_range():
    assert code_levels(np.array([0, 7]), 3).tolist() == [0, 255]
    assert code_levels(np.array([0, 1]), 1).tolist() == [0, 255]


def test_flow_colour_shows_direction_speed_and_the_unknown():
    flow = np.zeros((2, 1, 4))
    flow[0, 0] = [0.0, 3.0, 1.5, np.nan]
    colours = flow_colours(flow, largest=3.0)[0]
    assert colours[0].tolist() == [255, 255, 255]  # still
    assert colours[1].tolist() == [255, 0, 0]  # right, at full speed
    assert colours[2].tolist() == [255, 128, 128]  # right, half the speed
    assert colours[3].tolist() == [128, 128, 128]  # unknown


def test_opposite_directions_have_opposite_hues():
    flow = np.array([[[1.0, -1.0]], [[0.0, 0.0]]])
    right, left = flow_colours(flow, 1.0)[0].astype(int)
    assert (right + left == 255).all()


def test_legend_is_white_in_the_middle_and_outside():
    wheel = flow_legend(33)
    assert wheel[0, 0].tolist() == [255] * 3
    assert wheel[16, 16].tolist() == [255] * 3
    assert wheel[16, 32].tolist() == [255, 0, 0]


def test_depth_near_is_brighter_and_nothing_is_black():
    grey = depth_levels(np.array([[1.0, 2.0, np.inf, 0.0]]))
    assert grey[0, 0] > grey[0, 1] > 0
    assert grey[0, 2] == grey[0, 3] == 0
    assert depth_levels(np.full((3, 5), np.inf)).max() == 0

"""Tests transfer curves, luminance, PSNR, the tone curve and false colours, also for NaN and empty input."""

import math

import numpy as np
import pytest

from qsim.colour import (
    code_levels,
    depth_colours,
    depth_legend,
    depth_range,
    error_colours,
    flow_colours,
    flow_legend,
    from_linear,
    luminance,
    peak,
    psnr,
    to_linear,
    tone,
)


def test_tone_is_the_declared_curve_rounded_and_clipped():
    levels = tone(np.array([-1.0, 0.0, 0.25, 1.0, 2.0, 9.0, np.nan]), peak=2.0)
    expected = [0, 0, round(255 * 0.125 ** (1 / 2.2)), round(255 * 0.5 ** (1 / 2.2)), 255, 255, 0]
    assert levels.tolist() == expected


def test_tone_refuses_a_dark_peak():
    with pytest.raises(ValueError, match="peak must be positive"):
        tone(np.zeros((2, 2)), peak=0.0)


def test_codes_span_the_whole_range():
    assert code_levels(np.array([0, 7]), 7).tolist() == [0, 255]
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


def test_depth_goes_from_light_near_to_dark_far_and_nothing_is_black():
    """Lightness falls with depth, so that the order survives a grey printer."""
    metres = np.array([[1.0, 1.2, 1.5, 2.0, 3.0, 4.0, np.inf, 0.0, np.nan]])
    colours = depth_colours(metres, 1.0, 4.0).astype(float)
    lightness = colours[0] @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness[:6]) < 0).all()
    assert colours[0, 6:].max() == 0
    assert colours[0, 5].max() > 0, "far is not nothing"


def test_depth_is_even_in_its_inverse():
    """Half way between 1/far and 1/near is the middle of the bar."""
    middle = 1 / ((1 / 1.0 + 1 / 4.0) / 2)
    bar = depth_legend(1, 97)[0].astype(int)
    colour = depth_colours(np.array([[middle]]), 1.0, 4.0)[0, 0].astype(int)
    assert np.abs(bar[48] - colour).max() <= 1


def test_range_of_depth_ignores_what_was_not_hit():
    near, far = depth_range(np.array([np.inf, 0.0, np.nan, *np.linspace(2.0, 3.0, 1001)]))
    assert (near, far) == (pytest.approx(2.01), pytest.approx(2.99))
    assert depth_range(np.full((3, 5), np.inf)) == (1.0, 1.0)
    assert depth_colours(np.full((3, 5), np.inf), 1.0, 1.0).max() == 0


@pytest.mark.parametrize(("near", "far"), [(0.0, 1.0), (2.0, 1.0), (1.0, np.inf)])
def test_a_senseless_range_is_refused(near, far):
    with pytest.raises(ValueError, match="0 < near <= far"):
        depth_colours(np.ones((2, 2)), near, far)


def test_peak_ignores_the_unknown_and_is_one_for_black():
    assert peak(np.array([0.0, np.nan, 2.0, np.inf])) == pytest.approx(2.0, rel=1e-2)
    assert peak(np.zeros(3)) == peak(np.full(3, np.nan)) == 1.0


def test_luminance_is_rec_709_in_the_precision_of_its_input():
    rgb = np.array([[1, 1, 1], [1, 0, 0], [0, 0, 1]])
    for dtype in (np.float32, np.float64):
        found = luminance(rgb.astype(dtype))
        assert found.dtype == dtype
        np.testing.assert_allclose(found, [1, 0.2126, 0.0722], rtol=1e-6)
    assert luminance(rgb.astype(np.uint8)).dtype == np.float64


def test_psnr_has_one_convention_for_nothing():
    assert psnr(1.0, 0.1) == pytest.approx(20)
    assert psnr(2.0, 0.2) == pytest.approx(20)
    assert psnr(1.0, 0.0) == math.inf
    assert psnr(0.0, 0.1) == -math.inf
    assert math.isnan(psnr(1.0, math.nan))


@pytest.mark.parametrize("transfer", ["linear", "srgb", "gamma 2.2"])
@pytest.mark.parametrize("top", [255, 65535])
def test_transfer_curves_are_inverted_exactly(transfer: str, top: int):
    coded = np.arange(top + 1)
    linear = to_linear(coded, transfer, top)
    assert (np.diff(linear) >= 0).all()
    assert (linear[0], linear[-1]) == (0, pytest.approx(1))
    back = from_linear(linear, transfer, top).astype(int)
    assert np.abs(back - coded).max() <= (0 if top == 255 else 1)


def test_error_colour_shows_sign_and_size():
    """White is no error, red above, blue below; clipped at the full colour; grey where it is unknown."""
    error = np.array([[0.0, 1.0, 2.0, 9.0, -1.0, -2.0, np.nan]])
    colours = error_colours(error, 2.0)[0].astype(int)
    assert list(colours[0]) == [255, 255, 255]
    assert colours[1][0] == 255 > colours[1][2] > colours[2][2]
    assert list(colours[2]) == list(colours[3])
    assert colours[4][2] == 255 > colours[4][0] > colours[5][0]
    assert list(colours[6]) == [128, 128, 128]
    with pytest.raises(ValueError, match="must be positive"):
        error_colours(error, 0.0)

"""Tests the laws of bit depth against motion, with the paper's table."""

import numpy as np
import pytest

from qsim.studies.bit_depth.laws import Structure, depths

PAPER = {  # QUIVER paper, Table 1: bits -> fps, "read noise per second", "data rate" (which is megabytes per second)
    1: (10_000, 2000, 96),
    3: (1428, 285.6, 41.13),
    5: (323, 64.6, 15.5),
    7: (78, 15.6, 5.24),
    9: (20, 4, 1.73),
}


def paper_rows(**changes):
    arguments = {"height": 240, "width": 320, "base_fps": 10_000, "read_noise": 0.2, "speed": 2500.0, "bits": [*PAPER]}
    return depths(**{**arguments, **changes})


def test_the_papers_table_to_the_rounding_of_its_frame_rates():
    """Every column is proportional to fps, and the paper rounds fps: at most 0.5 of 19.57, or 1 part in 40."""
    for row in paper_rows():
        fps, noise, rate = PAPER[row.bits]
        assert abs(row.fps - fps) < 1.0
        rounding = fps / row.fps
        assert row.read_noise_per_second * rounding == pytest.approx(noise, rel=1e-9)
        assert row.data_rate_megabytes_per_second * rounding == pytest.approx(rate, abs=0.0051)


def test_exposure_is_shared():
    for row in paper_rows():
        assert row.fps * row.planes == pytest.approx(10_000)
        assert row.motion_px_per_frame * row.fps == pytest.approx(2500.0)
        assert row.read_noise_quadrature**2 == pytest.approx(0.2**2 * row.fps)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"height": 0}, "height must be positive, got 0"),
        ({"base_fps": float("nan")}, "base_fps must be positive, got nan"),
        ({"read_noise": -1.0}, "read_noise must not be negative, got -1.0"),
        ({"bits": [0]}, "bits must be 1 ... 16, got 0"),
    ],
)
def test_impossible_numbers_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        paper_rows(**change)


def test_structure_function_scales_with_speed():
    """A ramp (D = k^2) has no blur; a sine loses amplitude by the mean of the cosine over the frame."""
    ramp = Structure(np.arange(9.0) ** 2)
    assert ramp.blur(9) == pytest.approx(0, abs=1e-12)
    wave = Structure(1 - np.cos(2 * np.pi * np.arange(41) / 40))  # of sin, variance 1/2
    mean = np.cos(2 * np.pi * np.arange(-3, 4) / 40).mean()
    assert wave.blur(7) == pytest.approx((1 - mean) ** 2 / 2, rel=1e-9)
    mean = np.cos(4 * np.pi * np.arange(-3, 4) / 40).mean()
    assert wave.blur(7, 2.0) == pytest.approx((1 - mean) ** 2 / 2, rel=1e-9)

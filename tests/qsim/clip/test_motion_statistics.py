"""Tests which pixels count as moving, in one frame and in several."""

import numpy as np
import pytest

from qsim.clip.motion_statistics import moving_mean


def test_pixels_count_as_moving_per_frame():
    """0.02 px per plane is nothing in one plane and 0.14 px in seven."""
    length = np.array([0.0, 0.02, 0.01, np.nan])
    assert moving_mean(length) is None
    assert moving_mean(length, 7) == pytest.approx(0.14)
    assert moving_mean(length, 11) == pytest.approx((0.22 + 0.11) / 2)

"""Sums over sliding windows are sums over reflected or existing frames; wrong codes and windows are named."""

import numpy as np
import pytest

from qsim.sensor.devices import quiver_physical
from quiver.baselines import moment, naive_mean
from quiver.baselines.sliding_window import (
    existing_frames,
    existing_sums,
    frame_times,
    look_ahead,
    moved_window,
    reflect,
    window_frames,
    window_sums,
)

EXPOSURE = 5e-4


@pytest.mark.parametrize("window", [1, 2, 3, 4, 11])
@pytest.mark.parametrize("length", [1, 2, 7])
def test_running_sums_are_sums_over_reflected_windows(window, length):
    codes = np.random.default_rng(1).integers(0, 256, (length, 8, 10), dtype=np.uint8)
    index = np.pad(np.arange(length), 40, mode="reflect" if length > 1 else "edge")
    for t, total in enumerate(window_sums(codes, window, 255)):
        frames = index[40 + t - window // 2 : 40 + t + look_ahead(window) + 1]
        np.testing.assert_array_equal(frames, window_frames(t, window, length))
        np.testing.assert_array_equal(total, codes[frames].astype(int).sum(axis=0))


@pytest.mark.parametrize("window", [1, 2, 3, 4, 11])
def test_sums_of_existing_frames_are_those_of_the_cut_window(window):
    codes = np.random.default_rng(1).integers(0, 256, (7, 8, 10), dtype=np.uint8)
    for frames in (range(7), range(2, 6)):
        for t, (count, total) in zip(frames, existing_sums(codes, window, frames, 255), strict=True):
            there = [n for n in range(t - window // 2, t + look_ahead(window) + 1) if 0 <= n < 7]
            assert count == len(there)
            np.testing.assert_array_equal(total, codes[there].astype(int).sum(axis=0))


@pytest.mark.parametrize("window", [1, 2, 3, 4, 11])
@pytest.mark.parametrize("length", [1, 2, 7, 30])
def test_moved_windows_have_as_many_frames_as_there_are_and_the_own_one(window, length):
    for t in range(length):
        taken = moved_window(t, window, length)
        cut = existing_frames(t, window, length)
        assert 0 <= taken.start <= t < taken.stop <= length
        assert taken.stop - taken.start == min(window, length)
        assert taken.start <= cut.start
        assert cut.stop <= taken.stop


def test_reflection_goes_on_and_on():
    np.testing.assert_array_equal(reflect(np.arange(-5, 8), 3), [1, 0, 1, 2, 1, 0, 1, 2, 1, 0, 1, 2, 1])


def test_frames_near_the_ends_count_several_times():
    for window in (1, 3, 4, 11):
        assert frame_times(20, window, 50) == (1,) * window
    assert frame_times(0, 11, 50) == frame_times(49, 11, 50) == (2, 2, 2, 2, 2, 1)
    assert frame_times(0, 4, 50) == (2, 1, 1)  # one frame more of the past
    assert frame_times(0, 11, 1) == (11,)
    assert frame_times(1, 11, 2) == (6, 5)


def test_wrong_codes_and_windows_are_named():
    sensor = quiver_physical(3.25)
    codes = np.zeros((4, 8, 10), np.uint8)
    codes[2, 3, 5] = 9
    with pytest.raises(ValueError, match=r"0\.\.7 for a 3-bit sensor, found 9 at \(t, y, x\) = \(2, 3, 5\)"):
        moment.restore(codes, sensor, EXPOSURE)
    with pytest.raises(ValueError, match="expected integers"):
        naive_mean.restore(codes.astype(float), sensor, EXPOSURE)
    with pytest.raises(ValueError, match="window is a number of frames, got 0"):
        moment.restore(codes[:1], sensor, EXPOSURE, window=0)

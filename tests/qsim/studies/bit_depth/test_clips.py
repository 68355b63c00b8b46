"""Tests the clips of a study: one clip at several speeds, grouped frames, and another clip in the way."""

import numpy as np
import pytest
from waves import SIZE, wave_clip

from qsim.studies.bit_depth.clips import ClipShape, clips_for, group, render


def test_a_clip_at_several_speeds_is_one_clip_read_in_steps(clip):
    found = list(clips_for(str(clip.path), [1.0, 4.0], ClipShape(64), None))
    assert [(one.speed, one.step) for one in found] == [(1.0, 1), (4.0, 4)]
    assert {one.clip.path for one in found} == {clip.path}
    with pytest.raises(ValueError, match="whole factors only"):
        list(clips_for(str(clip.path), [0.5], ClipShape(64), None))


def test_a_grouped_frame_is_the_mean_and_its_sharp_frame_the_middle_one(clip, tmp_path):
    grouped = group(clip, tmp_path / "wave_7", 7)
    assert grouped.shape == (64 // 7, *SIZE)
    assert grouped.exposure == pytest.approx(7 * clip.exposure)
    assert grouped.frame_rate == pytest.approx(clip.frame_rate / 7)
    mean = np.mean([clip.radiance(t) for t in range(7, 14)], axis=0, dtype=np.float64)
    np.testing.assert_allclose(grouped.radiance(1), mean, rtol=1e-3)  # stored as halves
    assert np.array_equal(grouped.sharp(1), clip.radiance(10))


def test_another_clip_in_the_place_of_a_rendered_one_is_refused(tmp_path):
    wave_clip(tmp_path / "plain_x1", 4, 1)
    with pytest.raises(FileExistsError, match="exists and is another clip; name another folder with -o"):
        render("plain", tmp_path / "plain_x1", ClipShape(8, 24, 32))

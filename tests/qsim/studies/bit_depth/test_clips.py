"""Tests the clips of a study: one clip at several speeds, grouped frames, and another clip in the way."""

import numpy as np
import pytest
from clips import write_clip
from waves import SIZE, wave_clip

from qsim.clip.clip import Clip
from qsim.clip.photons import clip_photons, light_level
from qsim.dataset.redraw import redraw
from qsim.studies.bit_depth.clips import ClipShape, clips_for, group, render, write_streams
from qsim.studies.bit_depth.readout import StudySettings
from qsim.studies.readouts import compare


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


@pytest.mark.parametrize("relative", [True, False])
def test_codes_of_summed_planes_belong_to_the_frames_of_their_own_clip(clip, tmp_path, relative):
    """A code of either stream is one frame of the grouped clip: the same truth, and a like score."""
    if not relative:
        light = np.stack([clip.radiance(t) for t in range(len(clip))])
        clip = write_clip(tmp_path / "lit", radiance=light, frame_rate=clip.frame_rate, exposure=clip.exposure)
    factor = light_level(clip, ppp=0.65).factor
    (path,) = write_streams(clip, tmp_path, StudySettings(bits=(3,), ppp=0.65))
    grouped = Clip.open(path)
    planes, multibit = grouped.stream("planes"), grouped.stream("multibit")
    assert planes.meta["ppp_target"] == pytest.approx(7 * 0.65)
    for t in (0, len(grouped) - 1):
        middle = clip_photons(clip, 7 * t + 3, 7 * factor, sharp=True)
        np.testing.assert_allclose(planes.truth(t, t + 1)[0], middle, rtol=1e-6)
        np.testing.assert_allclose(planes.truth(t, t + 1), multibit.truth(t, t + 1), rtol=0.02)
    found = compare(grouped)
    assert len(found.instants) == len(grouped)
    scores = {row.stream: row.psnr_db for row in found.rows}
    assert scores["planes"] == pytest.approx(scores["multibit"], abs=2.0)
    (again, other) = sorted(redraw(path), key=lambda one: one.path.name, reverse=True)
    assert "was not drawn from a clip" in again.why
    assert (other.why, other.differ) == (None, 0)
    assert "sensor_name" not in planes.meta  # no device is called so; the record has all


def test_another_clip_in_the_place_of_a_rendered_one_is_refused(tmp_path):
    wave_clip(tmp_path / "plain_x1", 4, 1)
    with pytest.raises(FileExistsError, match="exists and is another clip; name another folder with -o"):
        render("plain", tmp_path / "plain_x1", ClipShape(8, 24, 32))

"""Tests the bit-depth study of one clip: simulated errors against their expectations."""

from dataclasses import replace

import numpy as np
import pytest
from clips import sliding_pattern, write_clip
from stats import critical_z
from waves import wave_clip

from qsim.cli.program import main
from qsim.clip.clip_info import RELATIVE
from qsim.clip.writer import ClipWriter
from qsim.optics.radiometry import RGB
from qsim.report import clip_section
from qsim.streams.clip import Clip
from qsim.streams.photons import clip_photons, light_level
from qsim.studies.bit_depth import answer, clip_study
from qsim.studies.bit_depth.clip_study import study
from qsim.studies.bit_depth.readout import MODELS, StudySettings, plane_sensor


@pytest.fixture(scope="module")
def found(clip):
    return study(clip, StudySettings(bits=(1, 3, 4), ppp=0.65, instants=4))


def rows_of(found, model):
    return [row for row in found.rows if row.model == model]


@pytest.mark.parametrize("ppp", [0.1, 0.65, 8.0])
@pytest.mark.parametrize("plane", [None, "quiver-paper"])
def test_simulation_agrees_with_its_expectation(clip, ppp, plane):
    """No row differs by more than its stated error allows (false alarm 1e-6 for all rows together)."""
    rows = study(clip, StudySettings(bits=(1, 3, 4), ppp=ppp, plane=plane, instants=4)).rows
    limit = critical_z(1e-6 / len(rows))
    # 3e-3: second order in the differences of light between the planes of a frame
    for row in rows:
        relative = row.psnr_error_db * np.log(10) / 10
        assert abs(row.sigmas) * relative < limit * relative + 3e-3, row


def test_a_colour_clip_is_studied_behind_its_filters(tmp_path):
    """Simulated errors keep their expectations, and a mask of one colour finds what a clip of that band alone has."""
    light = sliding_pattern(15, 40, 48, 0)[:, None] * np.array([0.5, 1.0, 1.5])[:, None, None]
    fast = {"frame_rate": 20_000.0, "exposure": 5e-5}
    clip = write_clip(tmp_path / "c", radiance=light, bands=list(RGB), **fast)
    settings = StudySettings(bits=(1, 3), ppp=2.0, instants=2)
    rows = study(clip, replace(settings, colour="rggb")).rows
    for row in rows:
        relative = row.psnr_error_db * np.log(10) / 10
        assert abs(row.sigmas) * relative < critical_z(1e-6 / len(rows)) * relative + 3e-3, row
    grey = write_clip(tmp_path / "g" / "c", radiance=light[:, 1], **fast)
    photons = [clip_photons(each, 7, light_level(each, ppp=2.0).factor).mean(axis=(-2, -1)) for each in (clip, grey)]
    alike = study(grey, replace(settings, ppp=2.0 * float(photons[0][1] / photons[1])))
    seen = study(clip, replace(settings, colour="green"))
    for one, other in zip(seen.rows, alike.rows, strict=True):
        assert (one.blur_error, one.shot_error) == pytest.approx((other.blur_error, other.shot_error), rel=1e-5)
    with pytest.raises(ValueError, match="holds three bands; say what its pixels see, as in colour=rggb"):
        study(clip, settings)
    with pytest.raises(ValueError, match="has one band; leave colour=rggb out"):
        study(grey, replace(settings, colour="rggb"))


def test_blur_follows_from_the_structure_function(found):
    for row in found.rows:
        assert row.blur_predicted == pytest.approx(row.blur_error, rel=2e-3, abs=1e-6)


def test_motion_and_rate_follow_the_planes(found):
    for row in found.rows:
        assert row.motion_px_per_frame == pytest.approx(2**row.bits - 1)
        assert row.fps * (2**row.bits - 1) == pytest.approx(10_000)
        assert row.data_rate_megabytes_per_second == pytest.approx(48 * 64 * row.bits * row.fps / 8e6)


def test_noise_falls_and_blur_grows_with_depth(found):
    for model in MODELS:
        rows = rows_of(found, model)
        assert [row.shot_error for row in rows] == sorted((row.shot_error for row in rows), reverse=True)
        assert [row.blur_error for row in rows] == sorted(row.blur_error for row in rows)
        assert rows[0].blur_error == 0


def test_shot_noise_of_a_sum_is_that_of_its_light(found):
    """Mean light 0.65, efficiency 0.8: variance per plane 0.65/0.8 over M, plus 1.6 dark electrons per second."""
    for row in found.rows:
        m = 2**row.bits - 1
        assert row.shot_error**2 == pytest.approx((0.8 * 0.65 + 1.6e-4) / 0.64 / m, rel=1e-3)


def test_deeper_frames_hold_the_planes_of_shallower_ones(clip):
    settings = StudySettings(bits=(1, 2, 3), ppp=0.65)
    plane = plane_sensor(settings, 0.65, clip.exposure)
    frames = list(clip_study.expose(clip, 20, settings, 0.65, plane, np.zeros(7), np.ones(clip.shape[1:], bool)))
    assert [frame.planes for frame in frames] == [1, 3, 7]
    assert (frames[0].fired <= frames[1].fired).all()
    assert (frames[1].fired <= frames[2].fired).all()
    assert (frames[2].fired - frames[1].fired).max() <= 4


def test_faster_is_every_other_frame(clip, tmp_path):
    """A clip read at speed 2 equals a clip that moves twice as fast."""
    twice = wave_clip(tmp_path / "wave2", 32, 2)
    stepped = study(clip, StudySettings(bits=(1, 3), ppp=0.65, speed=2, instants=1))
    fast = study(twice, StudySettings(bits=(1, 3), ppp=0.65, instants=1))
    for a, b in zip(stepped.rows, fast.rows, strict=True):
        assert a.blur_error == pytest.approx(b.blur_error, rel=1e-6)
        assert a.motion_px_per_frame == pytest.approx(b.motion_px_per_frame)


def test_clips_that_are_too_slow_or_short_are_refused(clip, tmp_path, capsys):
    slow = wave_clip(tmp_path / "slow", 3, 1, frame_rate=2000.0)
    with pytest.raises(ValueError, match="at least 10000 fps"):
        study(slow, StudySettings(ppp=1.0))
    with pytest.raises(ValueError, match="7 bits at speed 1 need 127"):
        study(clip, StudySettings(bits=(7,), ppp=1.0))
    assert main(["tradeoff", str(clip.path)]) == 2
    assert "--ppp" in capsys.readouterr().err


def test_one_definition_of_motion(tmp_path):
    """Half of the field is still: studies and the clip page state the motion of the other half."""
    clip = wave_clip(tmp_path / "half", 32, 2, still=24)
    rows = study(clip, StudySettings(bits=(1, 3), ppp=0.65, instants=2)).rows
    assert [row.motion_px_per_frame for row in rows] == pytest.approx([2, 14, 2, 14])
    assert [answer.code_motion(row) for row in rows] == pytest.approx([14] * 4)
    assert 7 * clip_study.clip_motion(clip, 3) == pytest.approx(14)
    line = clip_section.motion_line(clip, range(4))
    assert "move 2 px/frame on average (14 px per 3-bit frame of 7 planes)" in line


def test_still_pixels_do_not_count_among_moving_ones(tmp_path, monkeypatch):
    """A third of the field rests: blur is that of the others, and light and peak stay those of the clip."""
    clip = wave_clip(tmp_path / "third", 32, 2, still=16)
    settings = StudySettings(bits=(1, 3), ppp=0.65, instants=2)
    every = study(clip, settings)
    moving = study(clip, replace(settings, moving=True))
    assert (every.share, moving.share) == (1.0, pytest.approx(2 / 3))
    assert (every.ppp, every.peak) == (moving.ppp, moving.peak)
    for one, other in zip(every.rows, moving.rows, strict=True):
        assert one.blur_error**2 == pytest.approx(2 / 3 * other.blur_error**2)
        assert one.motion_px_per_frame == other.motion_px_per_frame
        assert other.blur_predicted == pytest.approx(other.blur_error, rel=2e-3, abs=1e-6)
    monkeypatch.setattr(clip_study, "moving_pixels", lambda length, planes: np.zeros(length.shape, bool))
    with pytest.raises(ValueError, match=r"no pixel moves at its frames \d+, \d+, which would be scored; give more"):
        study(clip, replace(settings, moving=True))


def test_the_motion_of_a_clip_does_not_depend_on_the_depths(tmp_path):
    """Deep frames are scored at few instants; the motion is the mean over the clip all the same."""
    meta = {"shape": [32, 8, 8], "frame_rate": 10_000.0, "exposure": 1e-4, "radiance_unit": RELATIVE}
    with ClipWriter(tmp_path / "faster", meta) as writer:
        for t in range(32):
            flow = np.full((2, 8, 8), [[[0.1 * t]], [[0.0]]], np.float32)
            truth = {"flow": flow, "flow_back": -flow, "valid": np.ones((8, 8), bool)}
            writer.add(t, np.ones((8, 8), np.float32), truth=truth)
    clip = Clip.open(tmp_path / "faster")
    shallow, deep = (study(clip, StudySettings(bits=bits, ppp=1.0)) for bits in ((1,), (5,)))
    assert answer.code_motion(shallow.rows[0]) == pytest.approx(answer.code_motion(deep.rows[0]))
    assert answer.code_motion(deep.rows[0]) == pytest.approx(7 * 0.1 * np.mean([0, 10, 21, 31]))

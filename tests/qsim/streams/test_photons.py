"""Tests the photons of a clip: crops, light levels, relative radiance."""

from pathlib import Path

import numpy as np
import pytest
from tiny_clip import FRAMES, write

from qsim.clip.clip_info import RELATIVE
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from qsim.streams.photons import clip_photons, light_level, light_line
from qsim.streams.sensing import Sensing
from qsim.streams.storing import replay, sense


def test_photons_of_a_crop_are_the_crop_of_the_photons(tmp_path: Path):
    clip = write(tmp_path / "a")
    whole = clip_photons(clip, 1, 2.0)
    np.testing.assert_array_equal(clip_photons(clip, 1, 2.0, (3, 2, 4, 5)), whole[3:7, 2:7])
    level = light_level(clip, ppp=3.25)
    mean = np.mean([clip_photons(clip, t, level.factor).mean() for t in range(FRAMES)])
    assert mean == pytest.approx(3.25, rel=1e-12)


def test_light_levels(tmp_path: Path):
    clip = write(tmp_path / "a")
    as_is = light_level(clip)
    assert as_is.factor == 1
    assert as_is.ppp == clip.mean_photons
    same = light_level(clip, lux=as_is.lux)
    assert same.factor == pytest.approx(1, rel=1e-12)
    with pytest.raises(ValueError, match="not both"):
        light_level(clip, ppp=1.0, lux=1.0)
    assert "to 3.25 photons/pixel (2.6 e-" in light_line(light_level(clip, ppp=3.25), 0.8)


def test_light_beyond_the_sensor_models_is_refused(tmp_path: Path):
    """A QIS showed no more light above 1e15 electrons, without a word."""
    clip = write(tmp_path / "a")
    video = write(tmp_path / "r", radiance_unit=RELATIVE, camera=None)
    for levels in ({"ppp": 1e17}, {"lux": 1e17}):
        with pytest.raises(ValueError, match=r"a: .* photons per pixel and frame are too many; give at most 1e\+12"):
            light_level(clip, **levels)
    with pytest.raises(ValueError, match=r"r: 1e\+17 photons per pixel"):
        light_level(video, ppp=1e17)
    assert light_level(clip, ppp=1e12).ppp == 1e12


def test_relative_radiance_needs_a_target(tmp_path: Path):
    clip = write(tmp_path / "r", radiance_unit=RELATIVE, camera=None)
    with pytest.raises(ValueError, match=r"r: its radiance is relative .* ppp=3.25"):
        light_level(clip)
    level = light_level(clip, ppp=3.25)
    mean = np.mean([clip_photons(clip, t, level.factor).mean() for t in range(FRAMES)])
    assert mean == pytest.approx(3.25, rel=1e-12)


def test_lux_of_a_clip_without_a_camera_need_a_pixel_pitch(tmp_path: Path):
    """1 lx at 555 nm on 1.1 um for 4.167 ms: (1/683) W/m2 * 1.21e-12 m2 * 4.167e-3 s / 3.5792e-19 J = 20.6 photons."""
    clip = write(tmp_path / "r", radiance_unit=RELATIVE, camera=None, exposure=1 / 240, frame_rate=240.0)
    with pytest.raises(ValueError, match=r"as in pixel_pitch=1.1e-06, where 1 lx at 555 nm is 20\.6 PPP in 4\.167 ms"):
        light_level(clip, lux=3.0)
    level = light_level(clip, lux=3.0, pixel_pitch=1.1e-6)
    assert level.ppp == pytest.approx(3 * 20.62, rel=1e-3)
    assert level.lux == pytest.approx(3.0)
    assert light_level(clip, ppp=level.ppp, pixel_pitch=2.2e-6).lux == pytest.approx(0.75)
    with pytest.raises(ValueError, match="no absolute light"):
        light_level(clip, pixel_pitch=1.1e-6)


def test_lux_of_a_video_are_those_of_a_camera_with_its_pixels(tmp_path: Path):
    """One pitch and exposure, photosensitive all over: the same photons with and without a lens, also in sums."""
    camera = write(tmp_path / "a")
    assert camera.camera.fill_factor == 1
    pitch = camera.camera.pixel_pitch
    video = write(tmp_path / "r", radiance_unit=RELATIVE, camera=None)
    wanted = light_level(camera, lux=2.0).ppp
    assert light_level(video, lux=2.0, pixel_pitch=pitch).ppp == pytest.approx(wanted)
    stream, line = sense(video, Sensing(BinarySPAD(0.5, 0.0, 2), lux=2.0, pixel_pitch=pitch, group=True))
    assert stream.info.sensing.pixel_pitch == pitch
    assert stream.info.light.ppp == pytest.approx(3 * wanted)
    assert "equivalent to 2 lx at 555 nm" in line
    np.testing.assert_array_equal(*replay(video, stream, 0))
    with pytest.raises(FileExistsError, match="other settings"):
        sense(video, Sensing(BinarySPAD(0.5, 0.0, 2), lux=2.0, pixel_pitch=2 * pitch, group=True))


@pytest.mark.parametrize(
    "sensing",
    [
        Sensing(BinarySPAD(0.5, 0.0, 2), ppp=6.0, group=True),
        Sensing(QIS(0.5, 0.0, 0.2, 3), ppp=6.0, slices=3),
    ],
)
def test_the_line_counts_photons_and_electrons_of_one_code(tmp_path: Path, sensing: Sensing):
    """With three clip frames per code it was 2 photons/pixel (3 e-)."""
    assert "to 6 photons/pixel (3 e-" in sense(write(tmp_path / "a"), sensing)[1]

"""Tests clips of three bands: files, crops, photons per band, light levels, and what refuses them."""

import json
from dataclasses import replace

import numpy as np
import OpenEXR
import pytest
from clips import colour_clip, write_clip
from PIL import Image

from qsim.cli import main
from qsim.clip.clip_info import ClipInfo
from qsim.clip.writer import ClipWriter
from qsim.colour import from_linear
from qsim.optics.diffraction import diffract
from qsim.optics.radiometry import LIGHT_SPEED, PLANCK, RGB, expected_photons
from qsim.report.explore import explore_page
from qsim.report.views import open_source
from qsim.streams.photons import clip_photons, light_level


def test_bands_are_stored_as_halves_in_one_file(tmp_path):
    stack = np.random.default_rng(0).random((2, 3, 7, 9)).astype(np.float16).astype(np.float32)
    clip = write_clip(tmp_path / "c", radiance=stack, bands=list(RGB), sharp=True)
    for t in range(2):
        np.testing.assert_array_equal(clip.radiance(t), stack[t])
        np.testing.assert_array_equal(clip.radiance(t, (2, 1, 5, 4)), stack[t][:, 2:7, 1:5])
        np.testing.assert_array_equal(clip.sharp(t, (6, 8, 1, 1)), clip.sharp(t)[:, 6:, 8:])
        with OpenEXR.File(str(clip.path / f"radiance/{t:06d}.exr"), separate_channels=True) as file:
            for band, name in zip(stack[t], "RGB", strict=True):
                np.testing.assert_array_equal(file.channels()[name].pixels, band)
    np.testing.assert_array_equal(clip[:], stack)
    assert clip.shape == (2, 7, 9)
    assert clip.mean_radiance == pytest.approx(stack.mean(dtype=np.float64), rel=1e-6)
    assert clip.verify() == []


def test_photons_of_a_band_have_its_wavelength(tmp_path):
    clip = colour_clip(tmp_path / "c", origin=[2, 3])
    clip = replace(clip, info=replace(clip.info, camera=replace(clip.camera, height=20, width=30)))
    camera = clip.camera
    found = clip_photons(clip, 1, 2.0)
    area = camera.fill_factor * camera.pixel_pitch**2
    for band, wavelength in enumerate(RGB):
        one = replace(camera, wavelength=wavelength)
        expected = 2 * expected_photons(clip.radiance(1)[band], one, clip.exposure, origin=(2, 3))
        np.testing.assert_array_equal(found[band], expected)
        cosine = 1 / np.hypot(1, np.hypot(10 - 2.5, 15 - 3.5) * camera.pixel_pitch / camera.focal_length)
        flux = np.pi * clip.radiance(1)[band, 0, 0] * camera.transmission / (4 * camera.f_number**2) * cosine**4
        by_hand = 2 * flux * area * clip.exposure * wavelength / (PLANCK * LIGHT_SPEED)
        assert found[band, 0, 0] == pytest.approx(by_hand, rel=1e-6)
        np.testing.assert_array_equal(clip_photons(clip, 1, 2.0, (1, 2, 3, 5))[band], found[band, 1:4, 2:7])
        blurred = 2 * expected_photons(diffract(clip.radiance(1)[band], one), one, clip.exposure, origin=(2, 3))
        np.testing.assert_allclose(clip_photons(clip, 1, 2.0, diffraction=True)[band], blurred, rtol=1e-12)


def test_a_light_level_is_the_mean_of_the_bands(tmp_path):
    clip = colour_clip(tmp_path / "c")
    level = light_level(clip, ppp=3.25)
    photons = np.stack([clip_photons(clip, t, level.factor) for t in range(len(clip))])
    assert photons.mean() == pytest.approx(3.25, rel=1e-6)


def test_views_films_and_pages_are_in_colour(tmp_path):
    clip = colour_clip(tmp_path / "c")
    picture = open_source(clip.path).views["sharp"].picture(1)
    white = np.percentile(clip[:], 99.9)
    assert picture.shape == (7, 9, 3)
    expected = 255 * np.clip(clip[1].astype(float) / white, 0, 1) ** (1 / 2.2)
    assert np.abs(np.moveaxis(picture, -1, 0) - expected).max() <= 0.5 + 1e-6
    assert clip.show().pictures.shape == (3, 7, 9, 3)
    assert "<img" in clip._repr_html_()
    assert "in each of 3 bands" in repr(clip)


def test_exports_are_in_colour(tmp_path):
    clip = colour_clip(tmp_path / "c", frames=2, height=8, width=10)
    assert main(["convert", str(clip.path), str(tmp_path / "exr"), "--to", "exr"]) == 0
    with OpenEXR.File(str(tmp_path / "exr" / "000001.exr"), separate_channels=True) as file:
        for band, name in zip(clip.radiance(1), "RGB", strict=True):
            np.testing.assert_array_equal(file.channels()[name].pixels, band)
    assert main(["convert", str(clip.path), str(tmp_path / "png"), "--to", "png"]) == 0
    white = json.loads((tmp_path / "png" / "meta.json").read_text())["white"]
    with Image.open(tmp_path / "png" / "000001.png") as opened:
        expected = from_linear(np.moveaxis(clip.radiance(1), 0, -1) / white, "gamma 2.2", 255)
        np.testing.assert_array_equal(opened, expected)
    assert main(["convert", str(clip.path), str(tmp_path / "z.zarr"), "--to", "zarr"]) == 2


def test_what_takes_one_band_says_so(tmp_path):
    clip = colour_clip(tmp_path / "c")
    with pytest.raises(ValueError, match="holds three bands, and the page of sliders takes one"):
        explore_page(clip)
    with (
        pytest.raises(ValueError, match=r"radiance of frame 0 is \(7, 9\), expected \(3, 7, 9\)"),
        ClipWriter(
            tmp_path / "d",
            ClipInfo(shape=clip.shape, frame_rate=clip.frame_rate, exposure=clip.exposure, bands=RGB),
        ) as writer,
    ):
        writer.add(0, np.ones((7, 9), np.float32))
    with pytest.raises(ValueError, match="bands: expected a list of 3"):
        write_clip(tmp_path / "e", bands=[1.0, 2.0])

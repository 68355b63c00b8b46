"""Textures: within 0..1, equal for equal generators, seamless if documented; photographs of the installed wheel."""

from __future__ import annotations

from importlib.metadata import files

import numpy as np
import pytest
from PIL import Image

from qsim.scene import Texture, textures

MADE = {
    "noise": lambda rng: textures.noise(rng, (64, 96)),
    "rings": lambda rng: textures.rings(rng, size=96),
    "bricks": lambda rng: textures.bricks(rng, size=144),
    "cells": lambda rng: textures.cells(rng, 30, 96),
    "speckles": lambda rng: textures.speckles(rng, 100, 96),
}
DRAWN = {
    "checker": textures.checker(6, 4),
    "stripes": textures.stripes(9),
    "dots": textures.dots(7),
    "text": textures.lines_of_text(["", "PHOTON", "3 bits of light"], 256, 128),
}


@pytest.mark.parametrize("name", MADE)
def test_random_textures_lie_in_0_to_1_and_repeat_with_their_seed(name):
    first, again, other = (MADE[name](np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert first.dtype == np.float32
    assert first.min() >= 0
    assert first.max() <= 1
    assert first.std() > 0.02
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).mean() > 0.02


@pytest.mark.parametrize("name", DRAWN)
def test_drawn_textures_reach_both_their_levels(name):
    picture = DRAWN[name]
    assert picture.dtype == np.float32
    dark, bright = (0.05, 0.8) if name == "text" else (0.1, 0.8)
    assert picture.min() == pytest.approx(dark, abs=1e-6)
    assert picture.max() == pytest.approx(bright, abs=1e-6)


@pytest.mark.parametrize("name", ["noise", "bricks", "cells", "speckles"])
def test_tiling_textures_have_no_seam(name):
    picture = MADE[name](np.random.default_rng(6)).astype(float)
    for axis in (0, 1):
        steps = np.abs(np.diff(picture, axis=axis)).mean()
        seam = np.abs(np.take(picture, 0, axis) - np.take(picture, -1, axis)).mean()
        assert seam < 4 * steps, "the seam stands out from the steps inside"


def test_drawn_patterns_have_their_periods():
    np.testing.assert_allclose(textures.stripes(8), np.roll(textures.stripes(8), 512 // 8, axis=1))
    np.testing.assert_allclose(textures.dots(8), np.roll(textures.dots(8), (64, 128), (0, 1)), atol=1e-6)
    board = textures.checker(6, 4, cell=8)
    assert board.shape == (32, 48)
    np.testing.assert_allclose(board + np.roll(board, 8, axis=0), 0.9)
    assert textures.stripes(8, 0, 1, duty=0.25).mean() == pytest.approx(0.25, abs=0.01)
    assert textures.dots(8, 0, 1, radius=0.3).mean() == pytest.approx(np.pi * 0.09, rel=0.01)


@pytest.mark.parametrize("slope", [0.5, 1.0, 1.5])
def test_noise_has_the_requested_slope(slope):
    raw = textures.noise(np.random.default_rng(7), (256, 256), slope).astype(float)
    power = np.abs(np.fft.fft2(raw - raw.mean())) ** 2
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(256) * 256, np.fft.fftfreq(256) * 256))
    bands = [(4, 8), (8, 16), (16, 32), (32, 64)]
    level = [np.log(power[(f >= low) & (f < high)].mean()) for low, high in bands]
    fitted = -np.polyfit(np.log([np.sqrt(low * high) for low, high in bands]), level, 1)[0] / 2
    assert fitted == pytest.approx(slope, abs=0.15)


def test_levels_stretch_and_refuse():
    ramp = np.linspace(-3, 9, 10001)
    stretched = textures.levels(ramp, 0.2, 0.6)
    assert stretched.min() == pytest.approx(0.2)
    assert stretched.max() == pytest.approx(0.6)
    assert (np.diff(stretched) >= 0).all()
    assert textures.levels(ramp, 0, 1, contrast=3.0).std() > textures.levels(ramp, 0, 1).std()
    assert np.ptp(textures.levels(np.full((4, 4), 0.3), 0.1, 0.8)) == 0
    for low, high in ((-0.1, 0.5), (0.5, 1.1), (0.6, 0.4)):
        with pytest.raises(ValueError, match=r"levels: expected 0 <= low <= high <= 1"):
            textures.levels(ramp, low, high)


@pytest.mark.parametrize("name", sorted(textures.PHOTOGRAPHS))
def test_photographs_are_files_of_the_installed_wheel(name):
    shipped = {path.name for path in files("scikit-image") or [] if "data" in path.parts}
    assert textures.PHOTOGRAPHS[name] in shipped


def test_photographs_are_linear_pictures_within_their_levels():
    picture = textures.photograph("coins", 0.1, 0.7).pixels()
    assert picture.ndim == 2
    assert picture.min() == pytest.approx(0.1)
    assert picture.max() == pytest.approx(0.7)
    with pytest.raises(ValueError, match="photograph 'lena' is not one of astronaut, brick"):
        textures.photograph("lena")


def test_long_lines_of_text_are_smaller():
    page = textures.lines_of_text(["AB", "ABABABABAB"], 400, 400, ink=0.0, paper=1.0)
    inked = np.flatnonzero((page < 0.5).any(axis=1))
    lines = np.split(inked, np.flatnonzero(np.diff(inked) > 1) + 1)
    assert len(lines) == 2
    assert len(lines[0]) > 3 * len(lines[1])


def test_pictures_of_a_folder(tmp_path):
    for name in ("b.png", "a.JPG"):
        Image.new("L", (4, 3), 100).save(tmp_path / name)
    (tmp_path / "notes.txt").write_text("no picture")
    assert [p.name for p in textures.pictures_in(tmp_path)] == ["a.JPG", "b.png"]
    with pytest.raises(FileNotFoundError, match="no image files"):
        textures.pictures_in(tmp_path / "nowhere")


@pytest.mark.parametrize("name", sorted(textures.PHOTOGRAPHS))
def test_a_photograph_states_its_source_in_any_range(name: str):
    for low, high in ((0.0, 1.0), (0.15, 0.45)):
        assert textures.photograph(name, low, high).source == name
    assert Texture(textures.checker(8, 8)).source is None

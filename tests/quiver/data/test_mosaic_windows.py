"""Tests training windows of mosaics: the mask of every window, its light, its codes, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from clips import colour_clip, write_clip

from qsim.sensor.colour_filter import MASKS, ColourFilter
from qsim.sensor.qis import QIS
from qsim.streams.sensing import Sensing
from quiver.data.defects import Filler
from quiver.data.illumination import Illumination
from quiver.data.mosaic_windows import filled_windows, place_in_tile, places_of_turns, turned_frame
from quiver.data.window_noise import window_codes
from quiver.data.windows import Windows, WindowSettings

SENSOR = QIS(0.8, 5.0, 0.2, 3)
SETTINGS = WindowSettings(frames=5, crop=8, drift=3, seed=3)


def light(**settings) -> Illumination:
    return Illumination(Sensing(SENSOR, ppp=6.0, **settings))


def clip_at(tmp_path, origin=(0, 0), frames=12, height=21, width=25):
    return colour_clip(tmp_path / "c", frames=frames, height=height, width=width, origin=list(origin))


def letters(mask, height, width, origin=(0, 0)):
    """The letter over every pixel [height, width] of frames that begin at a row and column of the tile."""
    tile = np.array([list(row) for row in mask])
    y = (np.arange(height) + origin[0]) % tile.shape[0]
    x = (np.arange(width) + origin[1]) % tile.shape[1]
    return tile[y[:, None], x]


@pytest.mark.parametrize("seed", range(20))
def test_a_window_at_its_place_has_the_mask_after_its_turn(seed):
    """Random tiles; a Bayer mask keeps all eight turns, a tile without symmetry one."""
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(1, 5, 2)
    mask = tuple("".join(rng.choice(list("RGBW"), columns)) for _ in range(rows))
    side = 2 * math.lcm(rows, columns)
    origin = rng.integers(0, 9, 2)
    at_first = ColourFilter(mask).shifted(*origin).mask
    found = places_of_turns(mask, at_first, side)
    assert 0 in found
    for turn, (y, x) in found.items():
        window = letters(mask, side, side, (origin[0] + y, origin[1] + x))
        np.testing.assert_array_equal(turned_frame(window, turn), letters(mask, side, side))


def test_known_masks():
    assert set(places_of_turns(MASKS["rggb"], MASKS["rggb"], 8)) == set(range(8))
    assert set(places_of_turns(MASKS["quad"], MASKS["quad"], 8)) == set(range(8))
    assert set(places_of_turns(("RGB",), ("RGB",), 6)) == {0, 6}, "rows of three colours may be turned upside down"
    assert [place_in_tile(start, 1, 4) for start in range(8)] == [1, 1, 1, 1, 1, 5, 5, 5]


@pytest.mark.parametrize("mask", ["rggb", "quad", "rgbw"])
@pytest.mark.parametrize("origin", [(0, 0), (3, 5)])
def test_the_light_of_every_window_is_that_behind_the_mask(tmp_path, mask, origin):
    """At any place, turn, drift and direction, of a camera whose frame begins elsewhere, too."""
    clip = clip_at(tmp_path, origin)
    filters = ColourFilter(MASKS[mask])
    windows = Windows([clip], replace(SETTINGS, lights=(light(colour=mask),)), repeats=40)
    seen = set()
    for n in range(40):
        place = windows.place(n)
        exposed, sharp = windows.photons_of(place)
        assert sharp.shape == (5, 3, 8, 8)
        np.testing.assert_allclose(exposed, filters.mosaic(sharp, 0.8), rtol=1e-12)
        seen.add((place.turn, place.drift != (0, 0), place.backwards))
    assert len({turn for turn, _, _ in seen}) == (4 if mask == "rgbw" else 8), "white and green lie apart"
    assert {moved for _, moved, _ in seen} == ({False, True} if mask != "quad" else {False})


def test_windows_are_the_codes_of_the_stream_there(tmp_path):
    """With the window's random key, `qsim sense` draws the same codes at the place of an unturned window."""
    clip = clip_at(tmp_path, (1, 1))
    settings = replace(SETTINGS, lights=(light(colour="rggb", row_delay=1e-5),), drift=0, flips=False, reverse=False)
    windows = Windows([clip], settings, repeats=8)
    for n in range(8):
        place = windows.place(n)
        if place.turn:
            continue
        noise = windows.noise.noises[0]
        draw = replace(noise.draw(clip), key=place.key)
        drawn = window_codes(noise, draw, clip, place, 5, 8)
        whole = draw.frames(clip, place.start, place.start + 5)
        np.testing.assert_array_equal(drawn, whole[:, place.y : place.y + 8, place.x : place.x + 8])
        item = windows[n]
        np.testing.assert_array_equal(np.rint(item["codes"].numpy()[:, 0] * 7), drawn)
        assert item["target"].shape == (5, 3, 8, 8)


def test_the_windows_of_validation_begin_with_the_mask(tmp_path):
    clip = clip_at(tmp_path, (1, 0))
    windows = Windows([clip], replace(SETTINGS, lights=(light(colour="rggb"),)), fixed=True)
    exposed, sharp = windows.photons_of(windows.place(0))
    np.testing.assert_allclose(exposed, ColourFilter(MASKS["rggb"]).mosaic(sharp, 0.8), rtol=1e-12)


def test_defective_pixels_are_filled_by_their_colour():
    rng = np.random.default_rng(0)
    codes = rng.integers(0, 8, (3, 8, 8)).astype(np.uint8)
    bad = rng.random((8, 8)) < 0.1
    filled = filled_windows(codes, bad, SENSOR, (2, 2))
    np.testing.assert_array_equal(filled[:, ~bad], codes[:, ~bad])
    for i, j in np.ndindex(2, 2):
        own = bad[i::2, j::2]
        if own.any():
            expected = Filler(own).fill(codes[:, i::2, j::2], 0)
            np.testing.assert_array_equal(filled[:, i::2, j::2], expected)


def test_what_has_no_windows_is_refused(tmp_path):
    clip = clip_at(tmp_path)

    def refused(words, clips=(clip,), **settings):
        with pytest.raises(ValueError, match=words):
            Windows(clips, replace(SETTINGS, **settings))

    bayer = light(colour="rggb")
    refused("has three bands, and the noise of its windows no colour filters; sense a stream with colour=rggb")
    refused("one mask of colour filters, these noises RG GB; RRGG", lights=(bayer, light(colour="quad")))
    refused("crop=9: windows of a mosaic need a multiple of the mask's 2 px", lights=(bayer,), crop=9)
    refused("mask R does not determine three bands", lights=(light(colour="red"),))
    refused("windows of mosaics have no copies at rest", lights=(bayer,), still=True)
    grey = write_clip(tmp_path / "grey", frames=12, height=21, width=25)
    refused("has one band, and the sensor has colour filters", clips=(grey,), lights=(bayer,))
    odd = colour_clip(tmp_path / "odd", frames=6, height=6, width=6, origin=[0, 1])
    filters = light(colour=ColourFilter(("RGB",)))
    refused("has no place for a window that begins with the mask", clips=(odd,), lights=(filters,), crop=6)

"""Colours of cubes become codes: sums that end with the last plane, of any size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from qsim.formats.challenge import read_cube
from quiver.data.challenge import band_codes, light_of_band


def cube_of(folder: Path, drawn: np.ndarray):
    folder.mkdir()
    np.save(folder / "000000.npy", np.packbits(drawn, axis=2))
    (folder / "meta.json").write_text(f'{{"width": {drawn.shape[2]}}}')
    return read_cube(folder / "000000.npy")


@pytest.mark.parametrize("planes", [1, 3, 7, 15, 255, 511])
def test_sums_end_with_the_last_plane(tmp_path, planes):
    frames = planes * 2 + min(planes - 1, 4)
    drawn = np.random.default_rng(planes).integers(0, 2, (frames, 3, 11, 3), dtype=np.uint8)
    cube = cube_of(tmp_path / "fan", drawn)
    for colour in range(3):
        codes = band_codes(cube, colour, planes)
        assert codes.shape == (2, 3, 11)
        ends = drawn[frames - 2 * planes :, ..., colour].reshape(2, planes, 3, 11).astype(int).sum(axis=1)
        np.testing.assert_array_equal(codes.read(0, 2), ends)
        np.testing.assert_array_equal(codes.read(1, 2), ends[1:])
        assert codes.sensor.levels == planes + 1


def test_light_is_counted_in_white():
    """A code of n planes that expects 0.5 n detections is white."""
    photons = [np.full((2, 3), 0.5 * 7 * level) for level in (1.0, 0.5, 0.0)]
    np.testing.assert_allclose(light_of_band(photons, 7)[0, 0], [1.0, 0.5, 0.0])


def test_sums_that_a_cube_cannot_fill_are_refused(tmp_path):
    cube = cube_of(tmp_path / "fan", np.zeros((6, 3, 4, 3), np.uint8))
    with pytest.raises(ValueError, match="has 6, fewer than the 7 of one code; give fewer"):
        band_codes(cube, 0, 7)
    assert band_codes(cube, 0, 5).sensor.levels == 6

"""Packed binary planes become codes: exact sums, and refusals of what no sensor makes."""

from __future__ import annotations

import numpy as np
import pytest
from clips import packed
from numpy import ndarray as Array

from qsim.plane_sums import PlaneSums
from quiver.data.illumination import Illumination
from quiver.data.photon_cubes import cube_codes

DEPTHS = [2**b - 1 for b in range(1, 17)]
OTHERS = [2, 5, 10, 100, 256, 1000]

SPAD = Illumination.of("spad-320x240", None, None)


@pytest.mark.parametrize("planes", [*DEPTHS, *OTHERS])
def test_sums_of_planes_are_plain_sums(tmp_path, planes):
    """Every depth from 1 to 16 bits, others, a width that fills no byte, planes left over; full and random planes."""
    rng = np.random.default_rng(planes)
    height, width, frames = (2, 5, 3) if planes < 5000 else (1, 3, 1)
    drawn = rng.integers(0, 2, (planes * frames + min(planes - 1, 2), height, width), dtype=np.uint8)
    drawn[:planes] = 1  # the first code is the top one: where a narrow type wraps
    codes = cube_codes(packed(drawn, tmp_path / "c.npy"), SPAD, 1000.0, sums=PlaneSums(planes=planes), width=width)
    expected = drawn[: planes * frames].reshape(frames, planes, height, width).astype(np.int64).sum(axis=1)
    assert codes.shape == expected.shape
    assert codes.sensor.bits == planes.bit_length()
    assert codes.sensor.levels == planes + 1
    np.testing.assert_array_equal(codes.read(0, frames).astype(np.int64), expected)
    assert codes.read(0, 1).max() == planes
    for t in range(frames):
        np.testing.assert_array_equal(codes.read(t, t + 1)[0], expected[t])


def test_planes_unpacked_in_pieces_are_the_same(tmp_path, monkeypatch):
    drawn = np.random.default_rng(1).integers(0, 2, (511 * 2, 3, 11), dtype=np.uint8)
    path = packed(drawn, tmp_path / "c.npy")
    whole = cube_codes(path, SPAD, 1000.0, sums=PlaneSums(planes=511), width=11).read(0, 2)
    monkeypatch.setattr("qsim.plane_sums.PLANE_PIXELS", 3 * 11 * 7)
    np.testing.assert_array_equal(
        cube_codes(path, SPAD, 1000.0, sums=PlaneSums(planes=511), width=11).read(0, 2), whole
    )


def test_binary_planes_are_codes_of_one_bit(tmp_path):
    path = packed(np.random.default_rng(0).integers(0, 2, (4, 3, 9), dtype=np.uint8), tmp_path / "c.npy")
    assert cube_codes(path, SPAD, 1000.0, width=9).sensor.bits == 1


@pytest.mark.parametrize(
    ("light", "planes", "message"),
    [
        (
            Illumination.of("spad-320x240", None, 3),
            15,
            "bits: 3: a plane has 1 bit and a sum of 15 has 4; leave it out",
        ),
        (
            Illumination.of("quiver-paper", None, None),
            7,
            "quiver-paper: only a clocked SPAD sums planes, this is a QIS",
        ),
    ],
)
def test_a_sensor_that_cannot_have_made_the_sums_is_refused(tmp_path, light, planes, message):
    path = packed(np.ones((30, 3, 9), np.uint8), tmp_path / "c.npy")
    with pytest.raises(ValueError, match=message):
        cube_codes(path, light, 1000.0, sums=PlaneSums(planes=planes), width=9)


def test_an_archive_under_the_name_of_an_array_is_named(tmp_path):
    with open(tmp_path / "z.npy", "wb") as file:
        np.savez(file, a=np.zeros((2, 3, 4), np.uint8))
    with pytest.raises(ValueError, match=r"z\.npy: is an archive"):
        cube_codes(tmp_path / "z.npy", Illumination(), 1000.0)


def test_photon_cubes(tmp_path, rng_planes: Array):
    """Packed planes, seven to a code; a width that is no multiple of eight; leftover planes are dropped."""
    np.save(tmp_path / "cube.npy", np.packbits(rng_planes, axis=2))
    light = Illumination.of("spad-320x240", None, 3)
    codes = cube_codes(tmp_path / "cube.npy", light, 1428.0, sums=PlaneSums(planes=7), width=13)
    assert codes.shape == (2, 5, 13)
    np.testing.assert_array_equal(codes.read(0, 2), rng_planes[:14].reshape(2, 7, 5, 13).sum(axis=1))
    assert codes.white == pytest.approx(7.0)
    with pytest.raises(ValueError, match=r"is not a cube of packed planes 30 px wide"):
        cube_codes(tmp_path / "cube.npy", light, 1428.0, sums=PlaneSums(planes=7), width=30)
    with pytest.raises(ValueError, match="fewer than the 31 of one code"):
        cube_codes(
            tmp_path / "cube.npy", Illumination.of("spad-320x240", None, 5), 300.0, sums=PlaneSums(planes=31), width=13
        )


@pytest.fixture
def rng_planes() -> Array:
    return np.random.default_rng(0).integers(0, 2, (16, 5, 13), dtype=np.uint8)

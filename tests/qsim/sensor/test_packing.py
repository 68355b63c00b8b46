"""Packing: there and back for every width and depth, the field's golden bytes, and messages with the place."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qsim.sensor.packing import MAX_BITS, check, code_dtype, pack, packed_width, unpack


def bit_string(codes: np.ndarray, bits: int) -> str:
    """Return one row written the slow way: binary digits side by side, with zeros up to a full byte."""
    digits = "".join(format(int(code), f"0{bits}b") for code in codes)
    return digits + "0" * (-len(digits) % 8)


def draw(shape: tuple[int, ...], bits: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2**bits, shape).astype(code_dtype(bits))


@given(st.integers(1, MAX_BITS), st.integers(1, 70), st.integers(0, 2**32 - 1))
@settings(max_examples=300, deadline=None)
def test_unpacking_undoes_packing_at_every_width_and_depth(bits, width, seed):
    codes = draw((3, 2, width), bits, seed)
    packed = pack(codes, bits)
    assert packed.shape == (3, 2, packed_width(width, bits))
    np.testing.assert_array_equal(unpack(packed, bits, width), codes, strict=True)


@pytest.mark.parametrize("bits", range(1, MAX_BITS + 1))
def test_bytes_are_the_binary_digits_written_side_by_side(bits):
    for width in (1, 2, 7, 8, 9, 15, 16, 17, 70):
        row = draw((width,), bits, seed=width)
        digits = bit_string(row, bits)
        expected = [int(digits[i : i + 8], 2) for i in range(0, len(digits), 8)]
        assert pack(row, bits).tolist() == expected


def test_each_row_is_packed_alone():
    """Widths that end inside a byte: a row's bytes do not depend on its neighbours."""
    codes = draw((4, 5, 11), 3)
    packed = pack(codes, 3)
    for t in range(4):
        for y in range(5):
            np.testing.assert_array_equal(packed[t, y], pack(codes[t, y], 3))


def test_golden_bytes_of_the_photon_cube():
    """A (1, 2, 10) cube with ones at (0, 0, 0) and (0, 1, 9): width 10 takes two bytes, not one."""
    cube = np.zeros((1, 2, 10), np.uint8)
    cube[0, 0, 0] = cube[0, 1, 9] = 1
    np.testing.assert_array_equal(pack(cube, 1), np.array([[[128, 0], [0, 64]]], np.uint8), strict=True)


@pytest.mark.parametrize("width", range(1, 71))
def test_one_bit_is_numpy_packbits(width):
    codes = draw((2, width), 1, seed=width)
    np.testing.assert_array_equal(pack(codes, 1), np.packbits(codes, axis=-1))


def test_packing_does_not_change_its_input_or_alias_it():
    for bits in (1, 3, 8, 16):
        codes = draw((2, 9), bits)
        before = codes.copy()
        packed = pack(codes, bits)
        packed[...] = 255
        np.testing.assert_array_equal(codes, before)


@pytest.mark.parametrize("bits", [1, 5, 8, 12, 16])
def test_non_contiguous_codes_pack_like_their_copies(bits):
    codes = draw((4, 6, 23), bits)
    for view in (codes[::2, ::-1, 1::3], codes.transpose(2, 0, 1), codes[:, :, ::-1]):
        np.testing.assert_array_equal(pack(view, bits), pack(view.copy(), bits))
    packed = pack(codes, bits)
    np.testing.assert_array_equal(unpack(packed[::-1], bits, 23), codes[::-1])


def test_empty_stacks_stay_empty():
    assert pack(np.zeros((0, 4, 10), np.uint8), 3).shape == (0, 4, 4)
    assert unpack(np.zeros((0, 4, 4), np.uint8), 3, 10).shape == (0, 4, 10)


def test_a_code_too_large_is_named_with_its_place():
    codes = np.zeros((6, 12, 5), np.uint8)
    codes[4, 10, 3] = codes[5, 11, 4] = 9
    text = 'codes: expected uint8 "t h w" with values 0..7 for a 3-bit sensor, found 9 at (t, y, x) = (4, 10, 3)'
    with pytest.raises(ValueError, match=re.escape(text)):
        pack(codes, 3)
    check(codes, 4)  # nine fits into four bits


@pytest.mark.parametrize(
    ("codes", "bits", "text"),
    [
        (np.zeros((2, 3), np.float32), 3, 'expected uint8 "h w" with values 0..7 for a 3-bit sensor, found float32'),
        (np.zeros((2, 3), np.uint8), 9, "expected uint16"),
        (np.zeros((2, 3), np.int64), 9, "found int64"),
        (np.uint8(3) * np.ones((), np.uint8), 3, "found a single number"),
        (np.zeros(3, np.uint8), 0, "expected 1 to 16 bits per code, got 0"),
        (np.zeros(3, np.uint8), 17, "got 17"),
        (np.array([0, 2], np.uint8), 1, "found 2 at x = 1"),
    ],
)
def test_wrong_codes_are_refused_in_one_sentence(codes, bits, text):
    with pytest.raises(ValueError, match=re.escape(text)):
        pack(codes, bits)


def test_a_wrong_width_is_refused():
    packed = pack(draw((2, 10), 3), 3)
    with pytest.raises(ValueError, match="11 codes of 3 bits need 5 bytes per row, found 4"):
        unpack(packed, 3, 11)
    with pytest.raises(ValueError, match="expected an array of uint8"):
        unpack(packed.astype(np.int32), 3, 10)

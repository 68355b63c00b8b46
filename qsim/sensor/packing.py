"""Packs codes: b bits per pixel, each row alone, most significant bit first.

    codes [..., W] (uint8, or uint16 above 8 bits)  <->  packed [..., ceil(W * b / 8)] (uint8)

A row starts on a byte and is padded with zero bits, so rows can be read alone. The width cannot be recovered from the
packed array and is stored beside it. With one bit this is the photon cube of the field: `numpy.packbits` along W.
"""

from __future__ import annotations

import numpy as np
from numpy import ndarray as Array

from qsim.arrays import plain
from qsim.host import own_numbers

MAX_BITS = 16


def code_dtype(bits: int) -> np.dtype:
    """Return uint8 up to 8 bits, uint16 up to 16."""
    _check_bits(bits)
    return np.dtype(np.uint8 if bits <= 8 else np.uint16)


def packed_width(width: int, bits: int) -> int:
    """Return the bytes of one packed row of `width` codes."""
    return -(-width * bits // 8)


def check(codes: Array, bits: int) -> None:
    """Raise `ValueError` with the first of the codes [...] that is not an unsigned integer within 0 ... 2^bits - 1."""
    _check_bits(bits)
    top = 2**bits - 1
    expected = f'codes: expected {code_dtype(bits)} "{_axes(codes.ndim)}" with values 0..{top} for a {bits}-bit sensor'
    if codes.dtype != code_dtype(bits):
        raise ValueError(f"{expected}, found {codes.dtype}")
    if codes.ndim == 0:
        raise ValueError(f"{expected}, found a single number")
    if codes.size and codes.max() > top:
        first = tuple(int(i) for i in np.unravel_index(int(np.argmax(codes > top)), codes.shape))
        raise ValueError(f"{expected}, found {int(codes[first])} at {index_text(first)}")


def index_text(index: tuple[int, ...]) -> str:
    """Return an array index as text: "(t, y, x) = (4, 10, 3)"."""
    names = ("t", "y", "x")[-len(index) :] if len(index) <= 3 else tuple(f"axis {i}" for i in range(len(index)))
    if len(index) == 1:
        return f"{names[0]} = {index[0]}"
    return f"({', '.join(names)}) = ({', '.join(map(str, index))})"


@own_numbers
def pack(codes: Array, bits: int) -> Array:
    """Return packed bytes [..., ceil(W * bits / 8)] of codes [..., W]; `ValueError` if a code does not fit."""
    codes = plain(codes)
    check(codes, bits)
    if bits == 1:
        return np.packbits(codes, axis=-1)
    if bits == 8:
        return codes.copy()
    if bits == 16:
        return np.ascontiguousarray(codes, dtype=">u2").view(np.uint8)
    # Eight codes fill exactly `bits` bytes, and each byte takes bits of at most eight codes.
    groups = _grouped(codes)
    packed = np.empty((*groups.shape[:-1], bits), np.uint8)
    for byte in range(bits):
        value = np.zeros(groups.shape[:-1], np.uint8)
        for i in range(8):
            # The code's bits are [i * bits, (i + 1) * bits), the byte's are [8 * byte, 8 * byte + 8), left to right.
            shift = (i + 1) * bits - 8 * (byte + 1)
            if -8 < shift < bits:
                code = groups[..., i]
                value |= (code >> shift if shift >= 0 else code << -shift).astype(np.uint8)
        packed[..., byte] = value
    rows = packed.reshape(*codes.shape[:-1], groups.shape[-2] * bits)
    return np.ascontiguousarray(rows[..., : packed_width(codes.shape[-1], bits)])


@own_numbers
def unpack(packed: Array, bits: int, width: int) -> Array:
    """Return codes [..., width] of packed bytes [..., ceil(width * bits / 8)]: uint8, or uint16 above 8 bits.

    `ValueError` if the last axis does not have the bytes of `width` codes. By hand, because `numpy.unpackbits` followed
    by `packbits` takes eleven times as long (measured: 41 ms against 3.6 for 8 x 512 x 1024 codes of 3 bits).
    """
    _check_bits(bits)
    packed = plain(packed)
    if packed.dtype != np.uint8 or packed.ndim == 0:
        raise ValueError(f"packed codes: expected an array of uint8, found {packed.ndim} axes of {packed.dtype}")
    needed = packed_width(width, bits)
    if width < 0 or packed.shape[-1] != needed:
        raise ValueError(
            f"packed codes: {width} codes of {bits} bits need {needed} bytes per row, found {packed.shape[-1]}; "
            "check the width and the bits in the stream's json"
        )
    if bits == 1:
        return np.unpackbits(packed, axis=-1, count=width)
    if bits == 8:
        return packed.copy()
    if bits == 16:
        return packed.view(">u2").astype(np.uint16)
    groups = -(-width // 8)
    padded = np.zeros((*packed.shape[:-1], groups * bits), np.uint8)
    padded[..., :needed] = packed
    columns = padded.reshape(*packed.shape[:-1], groups, bits)
    dtype = code_dtype(bits)
    codes = np.empty((*columns.shape[:-1], 8), dtype)
    mask = dtype.type(2**bits - 1)
    for i in range(8):
        value = np.zeros(columns.shape[:-1], dtype)
        # A code of up to 16 bits lies in at most three bytes; each gives its part, shifted to its place.
        for byte in range(i * bits // 8, ((i + 1) * bits - 1) // 8 + 1):
            shift = (i + 1) * bits - 8 * (byte + 1)
            column = columns[..., byte].astype(dtype)
            value |= column << shift if shift >= 0 else column >> -shift
        codes[..., i] = value & mask
    return np.ascontiguousarray(codes.reshape(*packed.shape[:-1], groups * 8)[..., :width])


def _grouped(codes: Array) -> Array:
    """Return codes [..., W] as [..., ceil(W/8), 8], padded with zeros."""
    width = codes.shape[-1]
    groups = -(-width // 8)
    padded = np.zeros((*codes.shape[:-1], groups * 8), codes.dtype)
    padded[..., :width] = codes
    return padded.reshape(*codes.shape[:-1], groups, 8)


def _check_bits(bits: int) -> None:
    if not 1 <= bits <= MAX_BITS:
        raise ValueError(f"bits: expected 1 to {MAX_BITS} bits per code, got {bits}")


def _axes(ndim: int) -> str:
    """Return the names of the axes: "t h w" for three."""
    return {1: "w", 2: "h w", 3: "t h w"}.get(ndim, "... t h w")

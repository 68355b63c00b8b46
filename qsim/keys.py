"""Draws random words as a function of (seed, clip, stage, frame, row, column), never of call order.

The generator is Philox4x32 with 7 rounds (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011), the
variant of Dr.Jit: NumPy (this module, the reference) and compiled kernels draw the same 32-bit words.

* The 64-bit Philox key is a hash of (seed, clip, stage).
* A pixel's word is number ``x & 3`` of the block whose counters are ``(x >> 2, y, frame, redraw)``: four neighbours in
  a row share one block, and x, y are coordinates of the **full** frame, so a crop has the words of the full frame.
* ``redraw`` counts further words of the same pixel: 0 decides nearly every pixel, 1 refines it to 64 bits in the tails.
  Pixels that need several numbers use further ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from hashlib import blake2b
from math import prod
from operator import index

import numpy as np
from numpy import ndarray as Array

ROUNDS = 7  # of Philox4x32; Dr.Jit's default
MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
KEY_STEPS = (0x9E3779B9, 0xBB67AE85)
COUNTED = 1 << 32  # frames (or planes), rows and columns that have a counter of 32 bits
_BATCH = 1 << 13  # blocks that stay in the cache
_LOW = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)


@dataclass(frozen=True)
class Key:
    """The name of a random stream; ``at`` selects a frame of the clip."""

    seed: int  # of the study; a training sample puts its epoch in here
    clip: int  # hash_name of the clip's name, or any integer
    frame: int = 0  # 0 ... 2^32 - 1
    stage: int = 0  # which random step of the chain: 0 is the sensor's read-out

    def __post_init__(self) -> None:
        for name in ("seed", "clip", "frame", "stage"):
            try:
                object.__setattr__(self, name, index(getattr(self, name)))
            except TypeError:
                raise ValueError(f"Key.{name} is an integer, got {getattr(self, name)!r}") from None
        if not 0 <= self.frame < COUNTED:
            raise ValueError(f"Key.frame counts frames from 0 to 2^32 - 1, got {self.frame}")

    def at(self, frame: int) -> Key:
        """Return the key of the same stream at another frame."""
        return replace(self, frame=frame)

    @property
    def philox_key(self) -> int:
        """The 64-bit key of the generator: a hash of (seed, clip, stage)."""
        text = f"{self.seed},{self.clip},{self.stage}".encode()
        return int.from_bytes(blake2b(text, digest_size=8, person=b"qsim key").digest(), "little")


def hash_name(name: str) -> int:
    """Return a clip's name as an integer below 2^63, the same on every machine."""
    return int.from_bytes(blake2b(name.encode(), digest_size=8, person=b"qsim name").digest(), "little") >> 1


def philox4x32(counters: Array, key: int) -> Array:
    """Return four random words per counter: integers [4, ...] below 2^32 -> uint32 [4, ...] under a 64-bit key."""
    state = np.array(counters, np.uint64)
    c0, c1, c2, c3 = (state[i, ...] for i in range(4))
    even = np.empty_like(c0)
    odd = np.empty_like(c2)
    k0 = key >> 32 & 0xFFFFFFFF
    k1 = key & 0xFFFFFFFF
    for _ in range(ROUNDS):  # in place: this is the inner loop of the reference engine
        np.multiply(np.uint64(MULTIPLIERS[0]), c0, out=even)
        np.multiply(np.uint64(MULTIPLIERS[1]), c2, out=odd)
        for c, old, product, k in ((c0, c1, odd, k0), (c2, c3, even, k1)):
            np.right_shift(product, _SHIFT, out=c)
            np.bitwise_xor(c, old, out=c)
            np.bitwise_xor(c, np.uint64(k), out=c)
        np.bitwise_and(odd, _LOW, out=c1)
        np.bitwise_and(even, _LOW, out=c3)
        k0 = (k0 + KEY_STEPS[0]) & 0xFFFFFFFF
        k1 = (k1 + KEY_STEPS[1]) & 0xFFFFFFFF
    return state.astype(np.uint32)


def require_counters(key: Key, shape: tuple[int, ...], origin: tuple[int, int] = (0, 0), planes: int = 1) -> None:
    """Raise `ValueError` unless all frames, rows and columns of a draw [H, W] or [T, H, W] have a counter.

    `origin` (y, x) places the crop in the full frame. A sum of `planes` takes as many counters per frame.
    """
    *frames, height, width = shape
    try:
        y, x = (index(place) for place in origin)
    except (TypeError, ValueError):
        raise ValueError(f"origin is a row and a column of the full frame, got {origin!r}") from None
    first = key.frame * planes
    count = planes * (frames[0] if frames else 1)
    _require_counted("frames" if planes == 1 else f"planes ({planes} per frame)", first, count)
    _require_counted("rows", y, height)
    _require_counted("columns", x, width)


def _require_counted(name: str, first: int, count: int) -> None:
    if first < 0 or first + count > COUNTED:
        raise ValueError(
            f"{name} {first} to {first + count - 1}: random numbers have counters from 0 to 2^32 - 1; "
            "begin at another frame, or place the crop in the full frame"
        )


def words(key: Key, shape: tuple[int, ...], origin: tuple[int, int] = (0, 0), redraw: int = 0) -> Array:
    """Return a word per pixel of the crop at `origin` = (y, x): uint32 [H, W], or [T, H, W] of frames key.frame + t."""
    require_counters(key, shape, origin)
    *frames, height, width = shape
    y, x = origin
    # Four neighbouring columns of the full frame share a block of words: a crop draws what the full frame would.
    first = x >> 2
    last = (x + width + 3) >> 2
    blocks = (frames[0] if frames else 1, height, last - first)
    result = np.empty((prod(blocks), 4), np.uint32)
    for start in range(0, len(result), _BATCH):
        some = np.arange(start, min(start + _BATCH, len(result)))
        frame, row, column = np.unravel_index(some, blocks)
        counters = np.stack([column + first, row + y, frame + key.frame, np.full_like(some, redraw)])
        result[start : start + _BATCH] = philox4x32(counters, key.philox_key).T
    crop = result.reshape(*blocks[:2], -1)[..., x - 4 * first : x - 4 * first + width]
    return crop if frames else crop[0]


def words_at(key: Key, at: Array, redraw: int = 0) -> Array:
    """The words of single pixels, int [3, p] = (frame, row, column) of the full frame: uint32 [p]."""
    frame, y, x = at
    for name, places in (("frames", frame), ("rows", y), ("columns", x)):
        if places.size:
            first = int(places.min())
            _require_counted(name, first, int(places.max()) - first + 1)
    blocks = philox4x32(np.stack([x >> 2, y, frame, np.full_like(x, redraw)]), key.philox_key)
    return blocks[x & 3, np.arange(x.size)]


def uniform(first: Array, second: Array | None = None) -> Array:
    """Return numbers in (0, 1) of the shape of the words: the centre of the cell of one word, or of two (2^-64 wide).

    Two words just below 1 round to 1 in float64; `uniform_pair` keeps the precision of both tails.
    """
    # Centres of cells: neither 0 nor 1 occurs, at which inverse laws are infinite.
    low = 0.5 if second is None else (second.astype(np.float64) + 0.5) * 2.0**-32
    return (first.astype(np.float64) + low) * 2.0**-32


def uniform_pair(first: Array, second: Array) -> tuple[Array, Array]:
    """Return (u, 1 - u) of two words, both with full relative precision."""
    return uniform(first, second), uniform(~first, ~second)


def normal(below: Array, above: Array) -> Array:
    """Return the standard normal numbers of (u, 1 - u), arrays of one shape: exact to rounding in both tails."""
    from scipy.special import ndtri

    return np.where(below < 0.5, ndtri(below), -ndtri(above))

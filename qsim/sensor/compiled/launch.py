"""Draws clips by the compiled engine: the codes of the NumPy reference, many times faster.

    photons of one frame -> one thread per pair of pixels -> two codes, one byte each or packed

Every pixel compares the same Philox word with the same cdf as `Sensor.sample(engine="reference")`, but in float32, by
short sums (plan.py) or along curves over light (curves.py). The kernel flags a pixel whose word is too near to a step
F_k for float32 to decide (about 40 in a million). The reference draws such pixels in float64, so the codes are the
reference's on every kind of machine. Tails, where a second word is drawn, are right for the same reason.

Peak memory: the output, one frame, and the buffers of launches. A launch has at most four million pixels, where the
cost of starting it no longer matters. Per pixel the buffers hold 4 bytes of converted light, 2 of indices for each of
two shapes, and 2.5 that each of two launches writes: at most 55 MB.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.device_lock import one_thread_at_a_time
from qsim.keys import Key
from qsim.sensor.compiled.jit import whole_packets
from qsim.sensor.compiled.kernel import fixed_scalars, start
from qsim.sensor.compiled.plan import Plan
from qsim.sensor.packing import pack, packed_width

LARGEST = 1 << 22  # pixels of a launch: small frames share one, large frames take several

Exact = Callable[[Array], Array]  # pixels int [3, p] = (t, y, x) of photons [T, H, W] -> codes [p] of the reference


@one_thread_at_a_time
def sample(plan: Plan, photons: Array, key: Key, origin: tuple[int, int], exact: Exact) -> Array:
    """Return codes uint8 [T, H, W] of expected photons [T, H, W], frame t under `key.at(key.frame + t)`.

    `origin` (y, x) places a crop in the full frame; `exact` draws the pixels that the kernel leaves uncertain.
    """
    left = origin[1] & 3
    width = photons.shape[2]
    codes = np.empty(photons.shape, np.uint8)
    uncertain = []
    for frames, rows, pairs, at in _parts(plan, photons, key, origin, blocks=1):
        if 2 * pairs.shape[2] == width:
            codes[frames, rows].view(np.uint16)[...] = pairs
        else:
            codes[frames, rows] = pairs.astype(np.uint16).view(np.uint8)[..., left : left + width]
        at = np.repeat(at, 2, axis=1)
        at[2] = 2 * at[2] - left + np.tile([0, 1], at.shape[1] // 2)
        uncertain.append(at[:, (at[2] >= 0) & (at[2] < width)])
    at = np.concatenate(uncertain, axis=1)
    if at.size:
        codes[tuple(at)] = exact(at)
    return codes


@one_thread_at_a_time
def sample_packed(plan: Plan, photons: Array, bits: int, key: Key, origin: tuple[int, int], exact: Exact) -> Array:
    """Return packed codes uint8 [T, H, ceil(W bits / 8)] (packing.py), without writing a byte per code.

    Equal to `packing.pack(sample(...), bits)`; the column of `origin` is a multiple of 4.
    """
    width = photons.shape[2]
    row = packed_width(width, bits)
    packed = np.empty((*photons.shape[:2], row), np.uint8)
    uncertain = []
    for frames, rows, pairs, at in _parts(plan, photons, key, origin, blocks=2, bits=bits):
        packed[frames, rows] = _octets(pairs, bits)[..., :row]
        at[2] //= 4
        uncertain.append(np.unique(at, axis=1))
    if width * bits % 8:
        packed[..., -1] &= 0xFF << (8 * row - width * bits) & 0xFF
    at = np.concatenate(uncertain, axis=1)
    if at.size:
        _write_octets(at, width, bits, exact, packed)
    return packed


def _octets(pairs: Array, bits: int) -> Array:
    """Return rows of bytes [..., n bits] of rows of pairs of codes, [..., 4 n] numbers of 2 `bits` each."""
    if bits == 1:
        # Four bytes of two bits: the product puts them side by side into the highest byte
        return (pairs.view(np.uint32) * np.uint32(0x40100401)) >> np.uint32(24)
    eights = _join(_join(pairs, 2 * bits), 4 * bits)
    size = eights.dtype.itemsize
    octets = eights.byteswap().view(np.uint8).reshape(*eights.shape, size)[..., size - bits :]
    return octets.reshape(*eights.shape[:-1], -1)


def _join(numbers: Array, bits: int) -> Array:
    """Return neighbours side by side: [..., 2 n] numbers of `bits` bits -> [..., n] of twice as many, first highest."""
    width = 8 * numbers.itemsize
    wide = np.dtype(f"u{2 * numbers.itemsize}") if numbers.itemsize < 8 else None
    if wide is None:
        return numbers[..., ::2] << np.uint64(bits) | numbers[..., 1::2]
    both = numbers.view(wide)  # little-endian: the first one is in the low half
    low = wide.type(2 ** (2 * bits) - 1)
    return (both << wide.type(bits) | both >> wide.type(width)) & low


def _write_octets(at: Array, width: int, bits: int, exact: Exact, packed: Array) -> None:
    """Write the reference's bytes of the octets of pixels `at` int [3, n] = (t, y, x // 8) into `packed`."""
    pixels = np.repeat(at, 8, axis=1)
    pixels[2] = 8 * pixels[2] + np.tile(np.arange(8), at.shape[1])
    inside = pixels[2] < width
    codes = np.zeros(pixels.shape[1], np.uint8)
    codes[inside] = exact(pixels[:, inside])
    columns = bits * at[2][:, None] + np.arange(bits)
    octet, byte = np.nonzero(columns < packed.shape[2])
    packed[at[0][octet], at[1][octet], columns[octet, byte]] = pack(codes.reshape(-1, 8), bits)[octet, byte]


def _parts(
    plan: Plan, photons: Array, key: Key, origin: tuple[int, int], blocks: int, bits: int | None = None
) -> Iterator[tuple[slice, slice, Array, Array]]:
    """Yield parts of a clip: frames, rows, pairs of codes [frames, rows, threads], and uncertain threads.

    Uncertain threads are int [3, n] = (t, y, thread). Rows are padded to complete groups of `blocks` Philox blocks of
    the full frame. Small frames share a launch, large ones take several.
    """
    frames, height, width = photons.shape
    left = origin[1] & 3
    threads = -(-(left + width) // (4 * blocks)) * 2 * blocks  # of a row
    rows = min(height, max(1, LARGEST // (2 * threads)))  # of a launch
    together = min(frames, max(1, LARGEST // (2 * height * threads))) if rows == height else 1
    direct = 2 * threads == width and photons.dtype == np.float32 and photons.flags.c_contiguous
    light = np.zeros((0 if direct else together, rows, 2 * threads), np.float32)
    fixed = fixed_scalars(key, origin)

    def started(part: tuple[slice, slice]) -> list[Any]:
        some = photons[part]
        shape = (*some.shape[:2], threads)
        if not direct:
            with np.errstate(over="ignore"):  # beyond float32 the reference decides
                light[: shape[0], : shape[1], left : left + width] = some
            some = light[: shape[0], : shape[1]]
        pairs = whole_packets(np.ascontiguousarray(some).reshape(-1).view(np.uint64))
        first = (key.frame + part[0].start, origin[0] + part[1].start)
        return start(plan, pairs, shape, first, fixed, bits)

    # The kernel of the next frames runs while the host finishes these, unless both need the buffer
    running: tuple[tuple[slice, slice], list[Any]] | None = None
    times = [slice(t, min(t + together, frames)) for t in range(0, frames, together)]
    parts = [(t, slice(y, min(y + rows, height))) for t in times for y in range(0, height, rows)]
    for part in (*parts, None):
        done = [out.numpy() for out in running[1]] if running and not direct else []
        now = started(part) if part else None
        if running:
            (t, y), arrays = running
            written, flags = done or [out.numpy() for out in arrays]
            shape = (t.stop - t.start, y.stop - y.start, threads)
            at = np.stack(np.unravel_index(np.flatnonzero(flags.view(bool)), shape))
            at += np.array([[t.start], [y.start], [0]])
            yield t, y, written.reshape(shape), at
        running = (part, now) if part and now else None

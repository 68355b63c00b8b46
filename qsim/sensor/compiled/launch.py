"""The compiled engine: the codes of the NumPy reference, many times faster.

    photons of one frame -> a lane per 2 neighbours -> 2 codes, as bytes or as bits

Every pixel compares the same Philox word with the same cdf as `Sensor.sample(engine="reference")`, but in float32, by
short sums (ladders.py) or along curves over light (curves.py). A pixel whose word comes so near to a step F_k that
float32 could not decide (about 40 in a million) is flagged by the kernel and drawn by the reference in float64
(pixels.py), so the codes are the reference's on every kind of machine; tails, where a second word is drawn, come out
right for the same reason.

Above 8 bits, or where a block is tiny, the reference itself draws; so it does single paralyzable pixels beyond 1000
arrivals, where many dead times fit into an exposure. Peak memory: the output, one frame, and what launches hold. They
have at most four million pixels, where the cost of starting one has faded, and hold, per pixel, 4 bytes of converted
light, 2 of places for each of two shapes, and 2.5 that each of two launches writes: at most 55 MB.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key
from qsim.sensor.compiled.jit import whole_packets
from qsim.sensor.compiled.kernel import available, fixed_scalars, launch
from qsim.sensor.compiled.plan import Plan, plan
from qsim.sensor.packing import pack, packed_width
from qsim.sensor.pixels import draw_at
from qsim.sensor.sensor import Sensor

SMALLEST = 1 << 14  # pixels; below, compiling costs more than it brings
_LARGEST = 1 << 22  # pixels of a launch: small frames share one, large frames take several


def sample(
    sensor: Sensor,
    photons: Array,
    exposure: float,
    *,
    key: Key,
    origin: tuple[int, int] = (0, 0),
    smallest: int = SMALLEST,
) -> Array:
    """Codes of photons [H, W] or [T, H, W]; as `Sensor.sample`, which is the door to this."""
    stack = photons if photons.ndim == 3 else photons[None]
    chosen = plan(sensor, exposure) if stack.size >= max(smallest, 1) and available() else None
    if chosen is None:
        return sensor.sample(photons, exposure, key=key, origin=origin, engine="reference")
    left, width = origin[1] & 3, stack.shape[2]
    codes = np.empty(stack.shape, np.uint8)
    doubtful = []
    for frames, rows, pairs, at in _parts(chosen, stack, key, origin, blocks=1):
        if 2 * pairs.shape[2] == width:
            codes[frames, rows].view(np.uint16)[...] = pairs
        else:
            codes[frames, rows] = pairs.astype(np.uint16).view(np.uint8)[..., left : left + width]
        at = np.repeat(at, 2, axis=1)
        at[2] = 2 * at[2] - left + np.tile([0, 1], at.shape[1] // 2)
        doubtful.append(at[:, (at[2] >= 0) & (at[2] < width)])
    at = np.concatenate(doubtful, axis=1)
    if at.size:
        codes[tuple(at)] = draw_at(sensor, stack, exposure, key, origin, at)
    return codes if photons.ndim == 3 else codes[0]


def sample_packed(
    sensor: Sensor,
    photons: Array,
    exposure: float,
    *,
    key: Key,
    origin: tuple[int, int] = (0, 0),
    smallest: int = SMALLEST,
) -> Array:
    """Packed codes uint8 [..., H, ceil(W bits / 8)] (codes.py), without writing a byte per code where a kernel serves.

    Equal to `codes.pack(sensor.sample(...), sensor.bits)`. Crops that do not start at a multiple of 4 take that way.
    """
    stack = photons if photons.ndim == 3 else photons[None]
    direct = stack.size >= max(smallest, 1) and origin[1] % 4 == 0 and available()
    chosen = plan(sensor, exposure) if direct else None
    if chosen is None:
        return pack(sensor.sample(photons, exposure, key=key, origin=origin), sensor.bits)
    width, bits = stack.shape[2], sensor.bits
    row = packed_width(width, bits)
    packed = np.empty((*stack.shape[:2], row), np.uint8)
    doubtful = []
    for frames, rows, pairs, at in _parts(chosen, stack, key, origin, blocks=2, bits=bits):
        packed[frames, rows] = _octets(pairs, bits)[..., :row]
        at[2] //= 4
        doubtful.append(np.unique(at, axis=1))
    if width * bits % 8:
        packed[..., -1] &= 0xFF << (8 * row - width * bits) & 0xFF
    at = np.concatenate(doubtful, axis=1)
    if at.size:
        _write_octets(sensor, stack, exposure, key, origin, at, packed)
    return packed if photons.ndim == 3 else packed[0]


def _octets(pairs: Array, bits: int) -> Array:
    """Rows of bytes of rows of pairs of codes: [..., 4 n] numbers of 2 `bits` each -> bytes [..., n bits]."""
    if bits == 1:
        # Four bytes of two bits: the product brings them side by side into the highest byte, and no other bits there
        return (pairs.view(np.uint32) * np.uint32(0x40100401)) >> np.uint32(24)
    eights = _join(_join(pairs, 2 * bits), 4 * bits)
    size = eights.dtype.itemsize
    whole = eights.byteswap().view(np.uint8).reshape(*eights.shape, size)[..., size - bits :]
    return whole.reshape(*eights.shape[:-1], -1)


def _join(numbers: Array, bits: int) -> Array:
    """Neighbours side by side: [..., 2 n] numbers of `bits` bits -> [..., n] twice as wide, the first one highest."""
    width, wide = 8 * numbers.itemsize, np.dtype(f"u{2 * numbers.itemsize}") if numbers.itemsize < 8 else None
    if wide is None:
        return numbers[..., ::2] << np.uint64(bits) | numbers[..., 1::2]
    both = numbers.view(wide)  # little-endian: the first one is in the low half
    low = wide.type(2 ** (2 * bits) - 1)
    return (both << wide.type(bits) | both >> wide.type(width)) & low


def _write_octets(
    sensor: Sensor,
    stack: Array,
    exposure: float,
    key: Key,
    origin: tuple[int, int],
    at: Array,
    packed: Array,
) -> None:
    """Write the reference's bytes of the octets of pixels `at` int [3, n] = (t, y, x // 8) into `packed`."""
    width, bits = stack.shape[2], sensor.bits
    pixels = np.repeat(at, 8, axis=1)
    pixels[2] = 8 * pixels[2] + np.tile(np.arange(8), at.shape[1])
    inside = pixels[2] < width
    codes = np.zeros(pixels.shape[1], sensor.dtype)
    codes[inside] = draw_at(sensor, stack, exposure, key, origin, pixels[:, inside])
    columns = bits * at[2][:, None] + np.arange(bits)
    octet, byte = np.nonzero(columns < packed.shape[2])
    packed[at[0][octet], at[1][octet], columns[octet, byte]] = pack(codes.reshape(-1, 8), bits)[octet, byte]


def _parts(
    chosen: Plan, stack: Array, key: Key, origin: tuple[int, int], blocks: int, bits: int | None = None
) -> Iterator[tuple[slice, slice, Array, Array]]:
    """Parts of a clip: frames, rows, what the kernel wrote [frames, rows, lanes], doubtful lanes [3, n] = (t, y, lane).

    Rows are padded to whole groups of `blocks` Philox blocks of the full frame. Small frames share a launch, large ones
    take several.
    """
    frames, height, width = stack.shape
    left = origin[1] & 3
    lanes = -(-(left + width) // (4 * blocks)) * 2 * blocks  # of a row
    rows = min(height, max(1, _LARGEST // (2 * lanes)))  # of a launch
    together = min(frames, max(1, _LARGEST // (2 * height * lanes))) if rows == height else 1
    direct = 2 * lanes == width and stack.dtype == np.float32 and stack.flags.c_contiguous
    light = np.zeros((0 if direct else together, rows, 2 * lanes), np.float32)
    fixed = fixed_scalars(key, origin)

    def start(part: tuple[slice, slice]) -> list[Any]:
        some = stack[part]
        shape = (*some.shape[:2], lanes)
        if not direct:
            with np.errstate(over="ignore"):  # beyond float32 the reference decides
                light[: shape[0], : shape[1], left : left + width] = some
            some = light[: shape[0], : shape[1]]
        pairs = whole_packets(np.ascontiguousarray(some).reshape(-1).view(np.uint64))
        first = (key.frame + part[0].start, origin[0] + part[1].start)
        return launch(chosen, pairs, shape, first, fixed, bits)

    # While the host finishes some frames the kernel of the next ones runs, unless both need the buffer
    running: tuple[tuple[slice, slice], list[Any]] | None = None
    times = [slice(t, min(t + together, frames)) for t in range(0, frames, together)]
    places = [(t, slice(y, min(y + rows, height))) for t in times for y in range(0, height, rows)]
    for place in (*places, None):
        done = [out.numpy() for out in running[1]] if running and not direct else []
        started = start(place) if place else None
        if running:
            (t, y), arrays = running
            written, flags = done or [out.numpy() for out in arrays]
            shape = (t.stop - t.start, y.stop - y.start, lanes)
            at = np.stack(np.unravel_index(np.flatnonzero(flags.view(bool)), shape))
            at += np.array([[t.start], [y.start], [0]])
            yield t, y, written.reshape(shape), at
        running = (place, started) if place and started else None

"""The compiled engine: the codes of the NumPy reference, many times faster.

    photons of one frame -> a lane per 2 neighbours -> 2 codes, as bytes or as bits

Every pixel compares the same Philox word with the same cdf as `Sensor.sample(engine="reference")`, but in float32 and
without ever writing the cdf down (ladders.py). A pixel whose word comes so near to a step F_k that float32 could not
decide (about 40 in a million) is flagged by the kernel and drawn by the reference in float64 (pixels.py), so the codes
are the reference's on every kind of machine; tails, where a second word is drawn, come out right for the same reason.

Where no short form exists (codes above 8 bits, paralyzable pixels, very long sums) or a block is tiny, the reference
itself draws. Peak memory: the output and one frame, or half a million pixels where frames are smaller.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import cache, lru_cache
from math import exp
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import engine
from qsim.codes import pack, packed_width
from qsim.keys import ROUNDS, Key
from qsim.ladders import Electrons, Live, Plan, plan
from qsim.pixels import draw_at
from qsim.sensor import Sensor

SMALLEST = 1 << 14  # pixels; below, compiling costs more than it brings
_MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)  # of Philox4x32; see keys.py
_KEY_STEPS = (0x9E3779B9, 0xBB67AE85)
_INFINITY = 0x7F800000  # float32; larger bit patterns are NaN or negative
_CHUNK = 1 << 19  # pixels of small frames that share a launch
_LARGEST = 1 << 19  # pixels of a launch, at most 2^22; larger frames take several
_CERTAIN = 80.0  # arrivals that are sure to bring 15: P(N < 15) = 1e-19
_CONSTANT_PLANS = 32  # sensors of a process that get kernels of their own


def available() -> bool:
    """Whether Dr.Jit can run here: CUDA or a usable LLVM, and not in a child forked from a process that used it."""
    return not _in_broken_child and _backend() is not None


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
    codes = np.empty(stack.shape, sensor.dtype)
    doubtful = []
    for t, top, pairs, lanes in _frames(chosen, stack, key, origin, blocks=1):
        padded, rows = 2 * pairs.shape[1], slice(top, top + len(pairs))
        if padded == width:
            codes[t, rows].view(np.uint16)[...] = pairs
        else:
            codes[t, rows] = pairs.astype(np.uint16).view(np.uint8)[:, left : left + width]
        y, x = np.divmod(np.repeat(2 * lanes, 2) + np.tile([0, 1], lanes.size), padded)
        inside = (x >= left) & (x < left + width)
        doubtful.append(np.stack([np.full(inside.sum(), t), y[inside] + top, x[inside] - left]))
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
    for t, top, pairs, lanes in _frames(chosen, stack, key, origin, blocks=2, bits=bits):
        packed[t, top : top + len(pairs)] = _octets(pairs, bits)[:, :row]
        octets = np.unique(lanes // 4)
        y, x = np.divmod(octets, pairs.shape[1] // 4)
        doubtful.append(np.stack([np.full(octets.size, t), y + top, x]))
    if width * bits % 8:
        packed[..., -1] &= 0xFF << (8 * row - width * bits) & 0xFF
    at = np.concatenate(doubtful, axis=1)
    if at.size:
        _write_octets(sensor, stack, exposure, key, origin, at, packed)
    return packed if photons.ndim == 3 else packed[0]


def steps(sensor: Sensor, photons: Array, exposure: float) -> Array:
    """The steps F_0 ... as the kernel has them, for validation: photons [p] -> float64 [p, steps] of one plane.

    `ValueError` if no kernel serves this sensor.
    """
    chosen = plan(sensor, exposure) if available() else None
    if chosen is None:
        raise ValueError(f"no compiled kernel serves {sensor}")
    import drjit as dr

    jit = _backend()
    real = jit.Float64 if chosen.double else jit.Float
    efficiency, dark, _, *scalars = [real(number) for number in _numbers(chosen)]
    mean = dr.fma(real(jit.Float(np.asarray(photons, np.float32))), efficiency, dark)
    values, unit = _steps(chosen.steps, mean, scalars)
    columns = [(value / unit).numpy().astype(float) for value in values]
    return np.stack(np.broadcast_arrays(*columns, photons)[:-1], axis=1)


def _octets(pairs: Array, bits: int) -> Array:
    """Rows of bytes of rows of pairs of codes: [H, 4 n] numbers of 2 `bits` each -> bytes [H, n bits]."""
    if bits == 1:
        # Four bytes of two bits: the product brings them side by side into the highest byte, and no other bits there
        return (pairs.view(np.uint32) * np.uint32(0x40100401)) >> np.uint32(24)
    eights = _join(_join(pairs, 2 * bits), 4 * bits)
    size = eights.dtype.itemsize
    whole = eights.byteswap().view(np.uint8).reshape(*eights.shape, size)[..., size - bits :]
    return whole.reshape(len(eights), -1)


def _join(numbers: Array, bits: int) -> Array:
    """Neighbours side by side: [H, 2 n] numbers of `bits` bits -> [H, n] of twice as many, the first one highest."""
    width, wide = 8 * numbers.itemsize, np.dtype(f"u{2 * numbers.itemsize}") if numbers.itemsize < 8 else None
    if wide is None:
        return numbers[:, ::2] << np.uint64(bits) | numbers[:, 1::2]
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
    for (t, y, octet), written in zip(at.T, pack(codes.reshape(-1, 8), bits), strict=True):
        end = min((octet + 1) * bits, packed.shape[2])
        packed[t, y, octet * bits : end] = written[: end - octet * bits]


def _frames(
    chosen: Plan, stack: Array, key: Key, origin: tuple[int, int], blocks: int, bits: int | None = None
) -> Iterator[tuple[int, int, Array, Array]]:
    """Parts of frames: frame, first row, what the kernel wrote [rows, lanes of a row], indices of its doubtful lanes.

    Rows are padded to whole groups of `blocks` Philox blocks of the full frame. Small frames share a launch, large ones
    take several.
    """
    frames, height, width = stack.shape
    left = origin[1] & 3
    padded = -(-(left + width) // (4 * blocks)) * 4 * blocks
    rows = min(height, max(1, _LARGEST // padded))  # of a launch
    together = min(frames, max(1, _CHUNK // (height * padded))) if rows == height else 1
    direct = padded == width and stack.dtype == np.float32 and stack.flags.c_contiguous
    light = np.zeros((0 if direct else together, rows, padded), np.float32)
    fixed = _fixed_scalars(key, origin, padded // 2)

    def launch(t: int, top: int) -> tuple[int, int, int, list[Any]]:
        n, h = min(together, frames - t), min(rows, height - top)
        part = stack[t : t + n, top : top + h]
        if not direct:
            with np.errstate(over="ignore"):  # beyond float32 the reference decides
                light[:n, :h, left : left + width] = part
            part = light[:n, :h]
        pairs = np.ascontiguousarray(part).reshape(-1).view(np.uint64)
        return t, top, n, _launch(chosen, pairs, (key.frame + t, origin[0] + top, h), fixed, bits)

    # While the host finishes some frames the kernel of the next ones runs, unless both need the buffer
    running: tuple[int, int, int, list[Any]] | None = None
    places = [(t, top) for t in range(0, frames, together) for top in range(0, height, rows)]
    for place in (*places, None):
        done = [out.numpy() for out in running[3]] if running and not direct else []
        started = launch(*place) if place else None
        if running:
            first, top, n, arrays = running
            pairs, flags = done or [out.numpy() for out in arrays]
            doubtful, lanes = _set(flags), pairs.size // n
            for i in range(n):
                here = doubtful[(doubtful >= i * lanes) & (doubtful < (i + 1) * lanes)] - i * lanes
                yield first + i, top, pairs[i * lanes : (i + 1) * lanes].reshape(-1, padded // 2), here
        running = started


def _set(flags: Array) -> Array:
    """Indices of the few non-zero bytes among many, found in blocks of 512."""
    whole = flags.size // 512 * 512
    eights = flags[:whole].view(np.uint64).reshape(-1, 64)
    blocks = np.flatnonzero(np.bitwise_or.reduce(eights, axis=1))
    near = np.append(512 * blocks[:, None] + np.arange(512), np.arange(whole, flags.size))
    return near[flags[near] != 0]


# ---- What a kernel computes


def _fixed_scalars(key: Key, origin: tuple[int, int], lanes: int) -> list[Any]:
    """What every launch of a clip shares: first block, the generator's key, rows of `lanes` lanes."""
    import drjit as dr

    jit = _backend()
    numbers = (origin[1] >> 2, key.philox_key >> 32, key.philox_key, lanes)
    integers = [dr.opaque(jit.UInt32, number & 0xFFFFFFFF) for number in numbers]
    return [*integers, dr.opaque(jit.Float, 1 / lanes)]


def _launch(plan: Plan, light: Array, place: tuple[int, int, int], fixed: list[Any], bits: int | None) -> list[Any]:
    """Start a kernel: pairs of float32 photons as uint64 [n] -> what each lane writes, and 1 where it is doubtful.

    `place` = number of the first frame, its first row, rows of a frame. Without `bits` a lane writes a byte per code,
    the first one lowest; with `bits` the codes follow each other bit by bit, the first one highest.
    """
    import drjit as dr

    jit = _backend()
    frame, row, height = place
    numbers = [dr.opaque(jit.UInt32, frame), dr.opaque(jit.UInt32, row), dr.opaque(jit.UInt32, height)]
    return list(
        _kernel(plan, bits)(jit.UInt64(light), *numbers, dr.opaque(jit.Float, 1 / height), _arguments(plan), *fixed)
    )


@lru_cache(maxsize=64)
def _kernel(plan: Plan, bits: int | None) -> Callable[..., tuple[Any, Any]]:
    """The kernel of a plan, traced once and replayed after that (`drjit.freeze`)."""
    import drjit as dr

    jit = _backend()
    real = jit.Float64 if plan.double else jit.Float

    def draw(
        pair: Any, frame: Any, row: Any, height: Any, inverse_height: Any, arguments: list[Any], *fixed: Any
    ) -> tuple[Any, Any]:
        block, high, low, lanes, inverse_lanes = fixed
        y, x = _divmod(dr.arange(jit.UInt32, dr.width(pair)), lanes, inverse_lanes)
        t, y = _divmod(y, height, inverse_height)
        first_plane = (frame + t) * plan.planes
        photons = [dr.reinterpret_array(jit.Float, jit.UInt32(half)) for half in (pair, pair >> 32)]

        def words(plane: Any) -> list[Any]:
            """Two neighbouring lanes share a block of four words."""
            w = _philox(x // 2 + block, y + row, first_plane + plane, high, low)
            right = (x & 1) == 1
            return [dr.select(right, w[2], w[0]), dr.select(right, w[3], w[1])]

        codes, doubt = _count(plan, photons, words, arguments or [real(number) for number in _numbers(plan)])
        if bits is None:
            out = codes[0] | (codes[1] << 8)
        else:
            out = (codes[0] << bits) | codes[1]
            out = jit.UInt8(out) if bits <= 4 else out
        return out, jit.UInt8(dr.select(doubt, jit.UInt32(1), jit.UInt32(0)))

    return dr.freeze(draw, warn_after=1000)


def _divmod(number: Any, divisor: Any, inverse: Any) -> tuple[Any, Any]:
    """Quotient and remainder of integers below 2^22, without a division: a float32 product misses by 1 at most."""
    import drjit as dr

    quotient = type(number)(type(inverse)(number) * inverse)
    rest = number - quotient * divisor
    below = rest >= 0x80000000
    quotient, rest = dr.select(below, quotient - 1, quotient), dr.select(below, rest + divisor, rest)
    above = rest >= divisor
    return dr.select(above, quotient + 1, quotient), dr.select(above, rest - divisor, rest)


def _philox(x: Any, y: Any, frame: Any, high: Any, low: Any) -> list[Any]:
    """Four words of one block; the compiled twin of keys.philox4x32 at redraw 0."""
    import drjit as dr

    u32 = type(x)
    c0, c1, c2, c3 = x, y, frame, u32(0)
    for _ in range(ROUNDS):
        a, b = u32(_MULTIPLIERS[0]), u32(_MULTIPLIERS[1])
        c0, c1, c2, c3 = dr.mul_hi(b, c2) ^ c1 ^ high, b * c2, dr.mul_hi(a, c0) ^ c3 ^ low, a * c0
        high, low = high + _KEY_STEPS[0], low + _KEY_STEPS[1]
    return [c0, c1, c2, c3]


def _count(
    plan: Plan, photons: list[Any], words: Callable[[Any], list[Any]], scalars: list[Any]
) -> tuple[list[Any], Any]:
    """Codes of the pixels of a lane, and whether one of them is doubtful."""
    import drjit as dr

    jit = _backend()
    real = jit.Float64 if plan.double else jit.Float
    efficiency, dark, margin, *scalars = scalars
    doubt: Any = jit.Bool(False)
    for theta in photons:  # negative, infinite and NaN by their bits: the reference says what is wrong
        pattern: Any = dr.reinterpret_array(jit.UInt32, theta)
        doubt |= pattern >= _INFINITY
    arrivals = [dr.fma(real(theta), efficiency, dark) for theta in photons]

    def uniform32(word: Any) -> Any:
        return dr.fma(real(word), 2.0**-32, 2.0**-33)

    if plan.planes == 1:
        codes = []
        for mean, word in zip(arrivals, words(jit.UInt32(0)), strict=True):
            steps, unit = _steps(plan.steps, mean, scalars)
            code, near = _search(steps, uniform32(word) * unit)
            codes.append(code)
            doubt |= ~(near >= margin * unit)
        return codes, doubt
    nothing = [_steps(plan.steps, mean, scalars)[0][0] for mean in arrivals]

    def add_plane(plane: Any, near: Any, *counts: Any) -> tuple[Any, ...]:
        sums = []
        for count, word, step in zip(counts, words(plane), nothing, strict=True):
            code, distance = _search([step], uniform32(word))
            sums.append(count + code)
            near = _smaller(near, distance)
        return (plane + 1, near, *sums)

    state = (jit.UInt32(0), real(1), *(jit.UInt32(0) for _ in photons))
    _, near, *codes = dr.while_loop(state, lambda plane, *_: plane < plan.planes, add_plane)
    return codes, doubt | ~(near >= margin)


def _smaller(a: Any, b: Any) -> Any:
    """The smaller one, in one instruction: `drjit.minimum` minds NaN and signed zeros, which do not come here."""
    import drjit as dr

    return dr.select(a < b, a, b)


def _search(steps: list[Any], u: Any) -> tuple[Any, Any]:
    """How many of 2^b - 1 ascending steps are at or under u, by bisection, and the distance to the nearest step.

    The step before u and the one behind it are both on the way, so nothing else need be looked at.
    """
    import drjit as dr

    count = _backend().UInt32
    code, near = count(0), type(u)(dr.inf)
    while steps:
        half = len(steps) // 2
        distance = u - steps[half]
        passed = distance >= 0
        near = _smaller(near, dr.abs(distance))
        code += dr.select(passed, count(half + 1), count(0))
        steps = [dr.select(passed, steps[half + 1 + i], steps[i]) for i in range(half)]
    return code, near


def _steps(steps: Electrons | Live, mean: Any, scalars: list[Any]) -> tuple[list[Any], Any]:
    """The steps F_k of one pixel, in a unit of its own."""
    import drjit as dr

    real = type(mean)
    if isinstance(steps, Live):
        result = []
        for k in range(len(steps.shares)):
            live = _smaller(mean * scalars[k], real(_CERTAIN))
            total = real(1)
            for n in range(k, 0, -1):
                total = dr.fma(total, live * (1 / n), 1)
            result.append(total * dr.exp(-live))
        return result + [real(2)] * (steps.levels - 1 - len(result)), real(1)  # no live time: never passed
    n = len(steps.full)
    highest, shift, scale, seed = scalars[:4]
    full, bands = scalars[4 : 4 + n], iter(scalars[4 + n :])
    mean = _smaller(mean, highest)
    unit, grow = dr.exp(mean - shift), mean * scale
    terms = [seed]
    for _ in range(1, n):
        terms.append(terms[-1] * grow)
    result, total, summed = [], real(0), 0
    for prefix, band, floor in zip(steps.prefix, steps.band, steps.floor, strict=True):
        for m in range(summed, prefix):
            total = dr.fma(terms[m], full[m], total)
        summed = max(summed, prefix)
        step = total if prefix else real(0)
        for m in range(len(band)):
            step = dr.fma(terms[prefix + m], next(bands), step)
        result.append(dr.fma(unit, next(bands), step) if floor else step)
    return result, unit


def _numbers(plan: Plan) -> list[float]:
    """The numbers of a plan, in the order in which `_count` and `_steps` take them."""
    values = [plan.efficiency, plan.dark, plan.margin]
    steps = plan.steps
    if isinstance(steps, Live):
        return [*values, *steps.shares]
    values += [steps.highest, steps.shift, 1 / steps.scale, exp(-steps.shift), *steps.full]
    for band, floor in zip(steps.band, steps.floor, strict=True):
        values += [*band, floor] if floor else [*band]
    return [float(value) for value in values]


@lru_cache(maxsize=64)
def _arguments(plan: Plan) -> list[Any]:
    """Nothing for the first sensors of a process, whose numbers are constants of kernels of their own; for the rest the
    numbers, as arguments of a shared (about 20 % slower) kernel: a training that varies its sensors compiles once.
    """
    import drjit as dr

    if _arguments.cache_info().misses <= _CONSTANT_PLANS:
        return []
    real = _backend().Float64 if plan.double else _backend().Float
    return [dr.opaque(real, number) for number in _numbers(plan)]


# ---- Which Dr.Jit


@cache
def _backend() -> Any:
    """`drjit.cuda` or `drjit.llvm`; None where neither works here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Sensor.sample says that the reference draws
        chosen = engine.choose()
    if chosen.backend == "scalar":
        return None
    if chosen.llvm_path:
        os.environ["DRJIT_LIBLLVM_PATH"] = chosen.llvm_path
    import drjit as dr

    return getattr(dr, chosen.backend)


_in_broken_child: list[int] = []  # the process id, in a child of a process that had loaded Dr.Jit


def _after_fork() -> None:
    """Dr.Jit's threads do not survive a fork: such a child draws with the reference."""
    if "drjit" in sys.modules:
        _in_broken_child[:] = [os.getpid()]


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)

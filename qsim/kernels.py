"""The compiled engine: the codes of the NumPy reference, many times faster.

    photons of one frame -> a lane per 2 pixels (or 8, for packed codes) -> codes

Every pixel compares the same Philox word with the same cdf as `Sensor.sample(engine="reference")`, but in float32 and
without ever writing the cdf down (ladders.py). A pixel whose word comes so near to a step F_k that float32 could not
decide (about 40 in a million) is flagged by the kernel and decided by the reference in float64, so the codes are the
reference's on every kind of machine; tails, where a second word is drawn, come out right for the same reason.

Where no short form exists (codes above 8 bits, paralyzable pixels, very long sums) or a block is tiny, the reference
itself draws. Peak memory: the output and one frame.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import engine
from qsim.codes import pack, packed_width
from qsim.keys import ROUNDS, Key, philox4x32, uniform
from qsim.ladders import Electrons, Live, Plan, plan
from qsim.sensor import Sensor
from qsim.spad import BinarySPAD

SMALLEST = 1 << 14  # pixels; below, compiling costs more than it brings
_MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)  # of Philox4x32; see keys.py
_KEY_STEPS = (0x9E3779B9, 0xBB67AE85)


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
    frames, height, width = stack.shape
    # Blocks of four start at multiples of four in the full frame: pad the crop to whole blocks
    left = origin[1] & 3
    padded = -(-(left + width) // 4) * 4
    light = np.zeros((height, padded), np.float32)
    direct = padded == width and stack.dtype == np.float32 and stack.flags.c_contiguous
    codes = np.empty(stack.shape, sensor.dtype)
    doubtful = []
    for t in range(frames):
        if not direct:
            with np.errstate(over="ignore"):  # beyond float32 the reference decides
                light[:, left : left + width] = stack[t]
        frame = stack[t] if direct else light
        place = (key.frame + t, origin[0], origin[1] >> 2)
        pairs, flags = _launch(chosen, [frame.reshape(-1).view(np.uint64)], padded, key, place)
        drawn = pairs.astype(np.uint16).view(np.uint8).reshape(height, padded)
        codes[t] = drawn[:, left : left + width]
        lanes = np.flatnonzero(flags)
        y, x = np.divmod(np.repeat(2 * lanes, 2) + np.tile([0, 1], lanes.size), padded)
        inside = (x >= left) & (x < left + width)
        doubtful.append(np.stack([np.full(inside.sum(), t), y[inside], x[inside] - left]))
    at = np.concatenate(doubtful, axis=1)
    if at.size:
        codes[tuple(at)] = decide(sensor, stack, exposure, key, origin, at)
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
    """Packed codes uint8 [..., H, ceil(W bits / 8)] (codes.py), in one step where a kernel serves.

    Equal to `codes.pack(sensor.sample(...), sensor.bits)`. Crops that do not start at a multiple of 4 take that way.
    """
    stack = photons if photons.ndim == 3 else photons[None]
    direct = stack.size >= max(smallest, 1) and origin[1] % 4 == 0 and available()
    chosen = plan(sensor, exposure) if direct else None
    if chosen is None:
        return pack(sensor.sample(photons, exposure, key=key, origin=origin), sensor.bits)
    frames, height, width = stack.shape
    groups, bits = -(-width // 8), sensor.bits
    row = packed_width(width, bits)
    light = np.zeros((4, height, groups), np.uint64)  # two photons each: columns 8 i + 0 and 1, 2 and 3, ...
    padded = np.zeros((height, groups * 8), np.float32)
    whole = width % 8 == 0 and stack.dtype == np.float32 and stack.flags.c_contiguous
    packed = np.empty((frames, height, row), np.uint8)
    doubtful = []
    for t in range(frames):
        if not whole:
            with np.errstate(over="ignore"):
                padded[:, :width] = stack[t]
        pairs = (stack[t] if whole else padded).view(np.uint64)
        for j in range(4):
            light[j] = pairs[:, j::4]
        place = (key.frame + t, origin[0], origin[1] >> 2)
        octets, flags = _launch(chosen, [part.reshape(-1) for part in light], groups * 8, key, place, bits)
        # The eight codes of a lane are the low `bits` bytes of a number, first pixel highest
        size = octets.dtype.itemsize
        rows = octets.byteswap().view(np.uint8).reshape(height, groups, size)[..., size - bits :]
        packed[t] = rows.reshape(height, groups * bits)[:, :row]
        lanes = np.flatnonzero(flags)
        doubtful.append(np.stack([np.full(lanes.size, t), *np.divmod(lanes, groups)]))
    if width * bits % 8:
        packed[..., -1] &= 0xFF << (8 * row - width * bits) & 0xFF
    at = np.concatenate(doubtful, axis=1)
    if at.size:
        _decide_lanes(sensor, stack, exposure, key, origin, at, packed)
    return packed if photons.ndim == 3 else packed[0]


def decide(sensor: Sensor, photons: Array, exposure: float, key: Key, origin: tuple[int, int], at: Array) -> Array:
    """The reference draw at single pixels: `at` int [3, p] = (t, y, x) in photons [T, H, W] -> codes [p].

    `ValueError` if any of these photons is no light level (all such pixels are among the doubtful ones).
    """
    t, y, x = at
    light = np.asarray(photons[t, y, x], np.float64)
    if not (np.isfinite(light) & (light >= 0)).all():
        sensor.arrivals(photons, exposure)
    frames, rows, columns = key.frame + t, y + origin[0], x + origin[1]
    if not (isinstance(sensor, BinarySPAD) and sensor.bits > 1):
        return _decide(sensor, light, exposure, key, (columns, rows, frames))
    single, m = replace(sensor, bits=1), sensor.planes
    planes = (_decide(single, light / m, exposure / m, key, (columns, rows, frames * m + plane)) for plane in range(m))
    return np.sum(list(planes), axis=0)


def _decide(sensor: Sensor, light: Array, exposure: float, key: Key, place: tuple[Array, Array, Array]) -> Array:
    first, second = (_words(key, place, redraw) for redraw in (0, 1))
    cdf, u = sensor.cdf(light, exposure)[..., :-1], uniform(first)[:, None]
    drawn = np.count_nonzero(u >= cdf, axis=-1)
    tail = (np.abs(u - cdf) <= 2.0**-32).any(axis=-1)
    if tail.any():
        drawn[tail] = sensor.codes_at(first[tail], second[tail], light[tail], exposure)
    return drawn


def _words(key: Key, place: tuple[Array, Array, Array], redraw: int) -> Array:
    """The words of single pixels (x, y, frame) of the full frame: uint32 [p]."""
    x, y, frame = place
    blocks = philox4x32(np.stack(np.broadcast_arrays(x >> 2, y, frame, redraw)), key.philox_key)
    return blocks[x & 3, np.arange(x.size)]


def _decide_lanes(
    sensor: Sensor,
    stack: Array,
    exposure: float,
    key: Key,
    origin: tuple[int, int],
    at: Array,
    packed: Array,
) -> None:
    """Write the reference's bytes of the lanes (t, y, group of 8 columns) `at` [3, lanes] into `packed`."""
    width, bits = stack.shape[2], sensor.bits
    pixels = np.repeat(at, 8, axis=1)
    pixels[2] = 8 * pixels[2] + np.tile(np.arange(8), at.shape[1])
    inside = pixels[2] < width
    codes = np.zeros(pixels.shape[1], sensor.dtype)
    codes[inside] = decide(sensor, stack, exposure, key, origin, pixels[:, inside])
    for (t, y, group), octet in zip(at.T, pack(codes.reshape(-1, 8), bits), strict=True):
        end = min((group + 1) * bits, packed.shape[2])
        packed[t, y, group * bits : end] = octet[: end - group * bits]


# ---- What a kernel computes


def _launch(
    plan: Plan, light: list[Array], width: int, key: Key, place: tuple[int, int, int], bits: int | None = None
) -> tuple[Array, Array]:
    """One frame: photons as uint64 pairs of float32, [lanes] per pair -> codes of each lane, 1 where one is doubtful.

    `width` is that of the padded rows, `place` = (frame, first row, first block). Without `bits` the codes of a pair
    are the bytes of a number, first pixel lowest; with `bits` they follow each other bit by bit, first pixel highest.
    """
    import drjit as dr

    jit = _backend()
    per_lane = 2 * len(light)
    frame, row, block, high, low = (
        dr.opaque(jit.UInt32, value & 0xFFFFFFFF)
        for value in (place[0] * plan.planes, place[1], place[2], key.philox_key >> 32, key.philox_key)
    )
    lane = dr.arange(jit.UInt32, light[0].size)
    y = lane // (width // per_lane)
    x = lane - y * (width // per_lane)
    pairs = [jit.UInt64(pair) for pair in light]
    halves = [jit.UInt32(half) for pair in pairs for half in (pair, pair >> 32)]
    photons = [dr.reinterpret_array(jit.Float, half) for half in halves]

    def words(plane: Any) -> list[Any]:
        """One word per pixel of the lane; two lanes share the block of four."""
        counter = frame + plane
        if per_lane == 2:
            w, right = _philox(x // 2 + block, y + row, counter, high, low), (x & 1) == 1
            return [dr.select(right, w[2], w[0]), dr.select(right, w[3], w[1])]
        first = x * (per_lane // 4) + block
        return [word for i in range(per_lane // 4) for word in _philox(first + i, y + row, counter, high, low)]

    codes, doubt = _count(plan, photons, words)
    if bits is None:
        out = codes[0] | (codes[1] << 8)
    else:
        number = jit.UInt32 if bits <= 4 else jit.UInt64
        out = number(0)
        for code in codes:
            out = (out << bits) | number(code)
        out = jit.UInt8(out) if bits == 1 else out
    flags = jit.UInt8(dr.select(doubt, jit.UInt32(1), jit.UInt32(0)))
    dr.eval(out, flags)
    return out.numpy(), flags.numpy()


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


def _count(plan: Plan, photons: list[Any], words: Callable[[Any], list[Any]]) -> tuple[list[Any], Any]:
    """Codes of the pixels of a lane, and whether one of them is doubtful."""
    import drjit as dr

    jit = _backend()
    real = jit.Float64 if plan.double else jit.Float
    scalar = _scalars(plan)
    efficiency, dark, margin = scalar[:3]
    doubt = jit.Bool(False)
    for theta in photons:
        doubt |= ~((theta >= 0) & (theta < dr.inf))  # NaN too: the reference says what is wrong
    arrivals = [dr.fma(real(theta), efficiency, dark) for theta in photons]

    def around(word: Any) -> tuple[Any, Any]:
        u = (real(word) + 0.5) * 2.0**-32
        return u - margin, u + margin

    counts = [jit.UInt32(0) for _ in photons]
    if plan.planes == 1:
        for i, word in enumerate(words(jit.UInt32(0))):
            counts[i], passed = _passed(plan.steps, arrivals[i], *around(word), scalar[3:])
            doubt |= counts[i] != passed
        return counts, doubt
    nothing = [dr.exp(-mean) for mean in arrivals]

    def add_plane(plane: Any, doubt: Any, *counts: Any) -> tuple[Any, ...]:
        sums = []
        for count, word, step in zip(counts, words(plane), nothing, strict=True):
            below, above = around(word)
            fired = below >= step
            doubt |= fired != (above >= step)
            sums.append(count + dr.select(fired, jit.UInt32(1), jit.UInt32(0)))
        return (plane + 1, doubt, *sums)

    state = (jit.UInt32(0), doubt, *counts)
    _, doubt, *counts = dr.while_loop(state, lambda plane, *_: plane < plan.planes, add_plane)
    return counts, doubt


def _passed(steps: Electrons | Live, mean: Any, below: Any, above: Any, scalar: list[Any]) -> tuple[Any, Any]:
    """How many steps lie at or under `below`, and under `above`."""
    import drjit as dr

    one, zero = _backend().UInt32(1), _backend().UInt32(0)
    counts = [zero, zero]

    def compare(step: Any, factor: Any, floor: Any = None) -> None:
        for i, u in enumerate((below, above)):
            u = u if floor is None else u - floor
            counts[i] = counts[i] + dr.select(u * factor >= step, one, zero)

    if isinstance(steps, Live):
        for k in range(len(steps.shares)):
            live = mean * scalar[k]
            total = type(mean)(1)
            for n in range(k, 0, -1):
                total = dr.fma(total, live * (1 / n), 1)
            compare(total, dr.exp(live))
        return counts[0], counts[1]
    shift, scale, seed, *scalar = scalar
    n = len(steps.full)
    full, bands = scalar[:n], iter(scalar[n:])
    terms = [type(mean)(seed)]
    for _ in range(1, n):
        terms.append(terms[-1] * (mean * scale))
    factor = dr.exp(mean - shift)
    total, summed = type(mean)(0), 0
    for prefix, band, floor in zip(steps.prefix, steps.band, steps.floor, strict=True):
        for m in range(summed, prefix):
            total = dr.fma(terms[m], full[m], total)
        summed = max(summed, prefix)
        step = total if prefix else type(mean)(0)
        for m in range(len(band)):
            step = dr.fma(terms[prefix + m], next(bands), step)
        compare(step, factor, next(bands) if floor else None)
    return counts[0], counts[1]


@lru_cache(maxsize=64)
def _scalars(plan: Plan) -> list[Any]:
    """The plan's numbers as kernel arguments: sensors of one structure share one compiled kernel."""
    import drjit as dr

    jit = _backend()
    real = jit.Float64 if plan.double else jit.Float
    values = [plan.efficiency, plan.dark, plan.margin]
    if isinstance(plan.steps, Live):
        values += plan.steps.shares
    else:
        values += [plan.steps.shift, 1 / plan.steps.scale, np.exp(-plan.steps.shift), *plan.steps.full]
        for band, floor in zip(plan.steps.band, plan.steps.floor, strict=True):
            values += [*band, floor] if floor else [*band]
    return [dr.opaque(real, float(value)) for value in values]


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

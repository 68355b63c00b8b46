"""Draws codes in a Dr.Jit kernel: one thread draws two neighbouring pixels of one frame.

    photons of 2 pixels + their index -> 2 words of Philox -> their steps F_k (plan.py) -> 2 codes, and "uncertain"

`start` runs a kernel over a block. A kernel is traced once per plan and replayed after that; launch.py draws clips.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.device_lock import one_thread_at_a_time
from qsim.keys import Key
from qsim.sensor.compiled import lookup
from qsim.sensor.compiled.curves import Curves
from qsim.sensor.compiled.jit import backend, exp_below_zero, no_light, philox, smaller, uniform32, whole_packets
from qsim.sensor.compiled.plan import Electrons, Live, Plan

_CERTAIN = 80.0  # arrivals at which 15 are certain: P(N < 15) = 1e-19
CONSTANT_PLANS = 32  # plans of a process whose numbers are constants of their kernels


@one_thread_at_a_time
def cdf_steps(plan: Plan, photons: Array) -> Array:
    """Return the kernel's steps F_0 ... of one plane, for validation: photons [p] -> float64 [p, steps]."""
    import drjit as dr

    jit = backend()
    light = jit.Float(np.asarray(photons, np.float32))
    if isinstance(plan.steps, Curves):
        efficiency, dark, _, _, *curves = lookup.arguments(plan.efficiency, plan.dark, plan.margin, plan.steps)
        x = dr.sqrt(dr.fma(jit.Float64(light), efficiency, dark))
        each = [lookup.curve(curves, jit.UInt32(k), x).numpy().astype(float) for k in range(len(plan.steps.rate))]
        return np.stack(np.broadcast_arrays(*each, photons)[:-1], axis=1)
    efficiency, dark, _, *scalars = [jit.Float(number) for number in _numbers(plan)]
    mean = dr.fma(light, efficiency, dark)
    values, unit = _steps(_sums(plan), mean, scalars)
    columns = [(value / unit).numpy().astype(float) for value in values]
    return np.stack(np.broadcast_arrays(*columns, photons)[:-1], axis=1)


def fixed_scalars(key: Key, origin: tuple[int, int]) -> list[Any]:
    """Return the arguments that every launch of a clip shares: first block, the generator's key."""
    import drjit as dr

    numbers = (origin[1] >> 2, key.philox_key >> 32, key.philox_key)
    return [dr.opaque(backend().UInt32, number & 0xFFFFFFFF) for number in numbers]


@lru_cache(maxsize=2)  # of one clip: full parts, and the last one
def _pixel_indices(shape: tuple[int, int, int]) -> list[Any]:
    """Return the index of each thread of [frames, rows, threads], and shifts and masks to take it apart.

    An index holds t, y and x in the bits of one number. Reading it is cheaper than two divisions.
    """
    import drjit as dr

    u32 = backend().UInt32
    t, y, x = np.ogrid[: shape[0], : shape[1], : shape[2]]
    below_y = (shape[2] - 1).bit_length()
    below_t = below_y + (shape[1] - 1).bit_length()
    number = (t << below_t | y << below_y | x).astype(np.uint32)
    masks = (1 << below_y) - 1, (1 << below_t) - 1
    return [u32(whole_packets(number.reshape(-1))), *(dr.opaque(u32, n) for n in (below_y, below_t, *masks))]


def start(
    plan: Plan,
    light: Array,
    shape: tuple[int, int, int],
    first: tuple[int, int],
    fixed: list[Any],
    bits: int | None,
) -> list[Any]:
    """Start a kernel: pairs of float32 photons as uint64 [n] -> two codes per thread, and 1 where one is uncertain.

    `shape` = frames, rows, threads; `first` = frame and row. Without `bits` a thread writes a byte per code, the first
    one lowest. With `bits` the codes follow each other bit by bit, the first one highest.
    """
    import drjit as dr

    jit = backend()
    numbers = [dr.opaque(jit.UInt32, number) for number in first]
    if isinstance(plan.steps, Curves):
        kernel = _curve_kernel(len(plan.steps.rate), bits)
    else:
        kernel = _kernel(plan, bits)
    return list(kernel(jit.UInt64(light), *numbers, arguments(plan), _pixel_indices(shape), *fixed))


@lru_cache(maxsize=64)
def _kernel(plan: Plan, bits: int | None) -> Callable[..., tuple[Any, Any]]:
    """Return the kernel of a plan, traced once and replayed after that (`drjit.freeze`)."""
    real = backend().Float
    return _traced(
        lambda photons, words, given: _count(plan, photons, words, given or [real(n) for n in _numbers(plan)]),
        plan.planes,
        bits,
    )


@cache
def _curve_kernel(steps: int, bits: int | None) -> Callable[..., tuple[Any, Any]]:
    """Return the one kernel of all sensors with so many steps whose sums are too long."""
    return _traced(lambda photons, words, given: lookup.count(steps, photons, words, given), 1, bits)


def _traced(
    count: Callable[[list[Any], Callable[[Any], list[Any]], list[Any]], tuple[list[Any], Any]],
    planes: int,
    bits: int | None,
) -> Callable[..., tuple[Any, Any]]:
    """Return a kernel that draws with `count`.

    `count`: photons, words and arguments of a thread -> its codes, and "uncertain".
    """
    import drjit as dr

    jit = backend()

    def draw(
        pair: Any, frame: Any, row: Any, arguments: list[Any], indices: list[Any], block: Any, high: Any, low: Any
    ) -> tuple[Any, Any]:
        index, below_y, below_t, mask_x, mask_y = indices
        # A thread's index holds t, y and x in bit fields, whose widths are arguments: other sizes need no other kernel.
        t = index >> below_t
        y = (index & mask_y) >> below_y
        x = index & mask_x
        first_plane = (frame + t) * planes
        photons = [dr.reinterpret_array(jit.Float, jit.UInt32(half)) for half in (pair, pair >> 32)]

        def words(plane: Any) -> list[Any]:
            """Return two words: two neighbouring threads share a block of four."""
            w = philox(x // 2 + block, y + row, first_plane + plane, high, low)
            right = (x & 1) == 1
            return [dr.select(right, w[2], w[0]), dr.select(right, w[3], w[1])]

        codes, uncertain = count(photons, words, arguments)
        if bits is None:
            out = codes[0] | (codes[1] << 8)
        else:
            out = (codes[0] << bits) | codes[1]
            out = jit.UInt8(out) if bits <= 4 else out
        return out, jit.UInt8(dr.select(uncertain, jit.UInt32(1), jit.UInt32(0)))

    return dr.freeze(draw, warn_after=1000)


def _count(
    plan: Plan, photons: list[Any], words: Callable[[Any], list[Any]], scalars: list[Any]
) -> tuple[list[Any], Any]:
    """Return the codes of the pixels of a thread, and whether one of them is uncertain."""
    import drjit as dr

    jit = backend()
    real = backend().Float
    sums = _sums(plan)
    efficiency, dark, margin, *scalars = scalars
    uncertain = no_light(photons)
    arrivals = [dr.fma(theta, efficiency, dark) for theta in photons]

    if plan.planes == 1:
        codes = []
        for mean, word in zip(arrivals, words(jit.UInt32(0)), strict=True):
            steps, unit = _steps(sums, mean, scalars)
            code, near = _search(steps, uniform32(word) * unit)
            codes.append(code)
            # Written so that NaN counts as uncertain, and is named by the reference.
            uncertain |= ~(near >= margin * unit)
        return codes, uncertain
    # All planes of a code have the same light, so their one step is computed once.
    nothing = [_steps(sums, mean, scalars)[0][0] for mean in arrivals]

    def add_plane(plane: Any, near: Any, *counts: Any) -> tuple[Any, ...]:
        sums = []
        for count, word, step in zip(counts, words(plane), nothing, strict=True):
            code, distance = _search([step], uniform32(word))
            sums.append(count + code)
            near = smaller(near, distance)
        return (plane + 1, near, *sums)

    state = (jit.UInt32(0), real(1), *(jit.UInt32(0) for _ in photons))
    _, near, *codes = dr.while_loop(state, lambda plane, *_: plane < plan.planes, add_plane)
    return codes, uncertain | ~(near >= margin)


def _search(steps: list[Any], u: Any) -> tuple[Any, Any]:
    """Return how many of 2^b - 1 ascending steps are at or under u, by bisection, and the distance to the nearest step.

    The steps just before and behind u are both on the way, so no other step needs to be compared.
    """
    import drjit as dr

    count = backend().UInt32
    code = count(0)
    near = type(u)(dr.inf)
    while steps:
        half = len(steps) // 2
        distance = u - steps[half]
        passed = distance >= 0
        near = smaller(near, dr.abs(distance))
        code += dr.select(passed, count(half + 1), count(0))
        steps = [dr.select(passed, steps[half + 1 + i], steps[i]) for i in range(half)]
    return code, near


def _steps(steps: Electrons | Live, mean: Any, scalars: list[Any]) -> tuple[list[Any], Any]:
    """Return the steps F_k of one pixel, and the unit in which they are."""
    import drjit as dr

    real = type(mean)
    if isinstance(steps, Live):
        result = []
        for k in range(len(steps.shares)):
            live = smaller(mean * scalars[k], real(_CERTAIN))
            # Horner's scheme of the sum of live^n / n! up to k: all terms are positive, and nothing cancels in float32.
            total = real(1)
            for n in range(k, 0, -1):
                total = dr.fma(total, live * (1 / n), 1)
            result.append(total * exp_below_zero(-live))
        return result + [real(2)] * (steps.levels - 1 - len(result)), real(1)  # no live time: never passed
    n = len(steps.full)
    highest, scale = scalars[:2]
    full = scalars[2 : 2 + n]
    bands = iter(scalars[2 + n :])
    mean = smaller(mean, highest)
    # Terms are Poisson probabilities times exp(mean), so that the recursion starts at 1; of bright
    # means exp would overflow float32, and half of the exponent is left to the first term.
    unit = dr.exp(mean * 0.5 if steps.halved else mean)
    grow = mean * scale
    terms = [1 / unit if steps.halved else real(1)]
    for _ in range(1, n):
        terms.append(terms[-1] * grow)
    result = []
    total = real(0)
    summed = 0
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
    """Return the numbers of a plan, in the order in which `_count` and `_steps` take them."""
    values = [plan.efficiency, plan.dark, plan.margin]
    steps = _sums(plan)
    if isinstance(steps, Live):
        return [*values, *steps.shares]
    values += [steps.highest, 1 / steps.scale, *steps.full]
    for band, floor in zip(steps.band, steps.floor, strict=True):
        values += [*band, floor] if floor else [*band]
    return [float(value) for value in values]


@lru_cache(maxsize=32)
def arguments(plan: Plan) -> list[Any]:
    """Return nothing for the first plans of a process: their numbers are constants of separate kernels.

    For later plans the numbers are arguments of a shared kernel, about 20 % slower. So a training that varies its
    sensors compiles once.
    """
    import drjit as dr

    if isinstance(plan.steps, Curves):
        return lookup.arguments(plan.efficiency, plan.dark, plan.margin, plan.steps)
    if arguments.cache_info().misses <= CONSTANT_PLANS:
        return []
    return [dr.opaque(backend().Float, number) for number in _numbers(plan)]


def _sums(plan: Plan) -> Electrons | Live:
    assert not isinstance(plan.steps, Curves)
    return plan.steps

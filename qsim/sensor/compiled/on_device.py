"""Draws clips by the compiled engine into the memory of the device: codes for torch, by DLPack, past the host.

    photons on the device or host -> pairs of photons -> kernel.py -> codes, one byte each, on the device

The codes equal those of launch.py for the same float32 photons. Of the pixels that float32 cannot decide (about 40 in
a million), indices and photons go to the host and codes come back; nothing else does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.device_lock import one_thread_at_a_time
from qsim.keys import Key
from qsim.sensor.compiled.jit import backend
from qsim.sensor.compiled.kernel import fixed_scalars, start
from qsim.sensor.compiled.launch import LARGEST
from qsim.sensor.compiled.plan import Plan

Exact = Callable[[Array, Array], Array]  # photons float32 [p], pixels int [3, p] = (t, y, x) -> the reference's codes


@one_thread_at_a_time
def sample(
    plan: Plan, photons: Any, shape: tuple[int, int, int], key: Key, origin: tuple[int, int], exact: Exact
) -> Any:
    """Return codes as Dr.Jit's tensor uint8 [T, H, W]; frame t is drawn under `key.at(key.frame + t)`.

    `photons` are float32 [T H W], a NumPy array or one of a library that knows DLPack. `origin` (y, x) places a crop in
    the full frame; `exact` draws the pixels that the kernel leaves uncertain.
    """
    import drjit as dr

    jit = backend()
    light = jit.Float(photons)
    codes = dr.zeros(jit.UInt8, int(np.prod(shape)))
    fixed = fixed_scalars(key, origin)
    for frames, rows, threads in _parts(shape, origin):
        part = (frames.stop - frames.start, rows.stop - rows.start, threads)
        places = [_places(part, frames.start, rows.start, shape, origin, side) for side in (0, 1)]
        pair = [
            jit.UInt64(dr.reinterpret_array(jit.UInt32, dr.gather(jit.Float, light, at, inside)))
            for at, inside in places
        ]
        both = pair[0] | pair[1] << 32
        dr.eval(both)
        out, uncertain = start(plan, both, part, (key.frame + frames.start, origin[0] + rows.start), fixed, None)
        for side, (index, inside) in enumerate(places):
            dr.scatter(codes, jit.UInt8(jit.UInt32(out) >> 8 * side & 0xFF), index, inside)
            undecided: Any = dr.compress((uncertain != 0) & inside)
            pixels = dr.gather(jit.UInt32, index, undecided)
            if len(pixels):
                at = np.stack(np.unravel_index(pixels.numpy(), shape))
                known = exact(dr.gather(jit.Float, light, pixels).numpy(), at)
                dr.scatter(codes, jit.UInt8(known.astype(np.uint8)), pixels)
    dr.eval(codes)
    dr.sync_thread()  # torch has another stream
    return jit.TensorXu8(codes, shape)


def _parts(shape: tuple[int, int, int], origin: tuple[int, int]) -> Iterator[tuple[slice, slice, int]]:
    """Yield the launches of a clip: frames, rows, and threads of a row, in complete Philox blocks of the full frame."""
    frames, height, width = shape
    threads = -(-((origin[1] & 3) + width) // 4) * 2
    rows = min(height, max(1, LARGEST // (2 * threads)))
    together = min(frames, max(1, LARGEST // (2 * height * threads))) if rows == height else 1
    for t in range(0, frames, together):
        for y in range(0, height, rows):
            yield slice(t, min(t + together, frames)), slice(y, min(y + rows, height)), threads


def _places(
    part: tuple[int, int, int], t: int, y: int, shape: tuple[int, int, int], origin: tuple[int, int], side: int
) -> tuple[Any, Any]:
    """Return for each thread of a launch the index of its left or right pixel in [T H W], and whether it exists."""
    import drjit as dr

    jit = backend()
    _, rows, threads = part
    number = dr.arange(jit.UInt32, int(np.prod(part)))
    frame = number // (rows * threads)
    rest = number % (rows * threads)
    row = rest // threads
    column = 2 * (rest % threads) + side
    # Threads begin at a multiple of four columns, as blocks of words do; the first may lie outside the crop.
    left = origin[1] & 3
    inside = (column >= left) & (column < left + shape[2])
    return ((frame + t) * shape[1] + row + y) * shape[2] + column - left, inside

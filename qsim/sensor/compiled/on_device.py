"""Draws a clip into the memory of the device as bytes: codes for torch, by DLPack, past the host.

photons on the device or host -> one row of draw_rows.py -> codes, one byte each, on the device
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.device_lock import one_thread_at_a_time
from qsim.sensor.compiled.draw_rows import Draw, draw
from qsim.sensor.compiled.jit import backend, in_aligned, no_light

Refuse = Callable[[Array, Array], None]  # photons float32 [p], pixels int [3, p] = (t, y, x): raises for wrong ones


@one_thread_at_a_time
def sample(photons: Any, shape: tuple[int, int, int], row: Draw, refuse: Refuse) -> Any:
    """Return codes as Dr.Jit's tensor uint8 [T, H, W].

    `photons` are float32 [T H W], a NumPy array or one of a library that knows DLPack.
    """
    import drjit as dr

    jit = backend()
    given = in_aligned(photons) if isinstance(photons, np.ndarray) else photons
    light = jit.Float(given)
    wrong = no_light([light])
    if dr.any(wrong):
        pixels: Any = dr.compress(wrong)
        found: Any = dr.gather(jit.Float, light, pixels)
        refuse(found.numpy(), np.stack(np.unravel_index(pixels.numpy(), shape)))
    fours = draw(given, "f", (1, *shape), [row])
    codes = _bytes(fours, shape)
    dr.eval(codes)
    dr.sync_thread()  # torch has another stream
    return jit.TensorXu8(codes, shape)


def _bytes(fours: Any, shape: tuple[int, int, int]) -> Any:
    """Return codes UInt8 [T H W] of numbers of four; without a copy on the host where rows are whole fours."""
    import drjit as dr

    jit = backend()
    width = shape[2]
    if width % 4 == 0 and dr.backend_v(fours) == dr.JitBackend.LLVM:
        return jit.UInt8(fours.numpy().view(np.uint8))
    number = dr.arange(jit.UInt32, int(np.prod(shape)))
    line = number // width
    column = number - line * width
    four = dr.gather(jit.UInt32, jit.UInt32(fours), line * -(-width // 4) + (column >> 2))
    return jit.UInt8((four >> ((column & 3) * 8)) & 0xFF)

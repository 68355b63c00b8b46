"""Draws the codes of a batch of windows in one launch, on the device; each row has its own sensor, key and exposure.

    light [B, T, H, W] on the device, and a Row for each of the B -> compiled/rows_kernel.py -> codes on the device

The codes are those of `Sensor.sample`, or binary ones packed by rows as packing.py packs them. No code goes to the
host, and a GPU is not waited for. Another key, clip, frame, exposure, light level or size compiles nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, prod
from typing import Any

import numpy as np

from qsim.device_lock import one_thread_in_order
from qsim.keys import require_counters
from qsim.sensor.distribution import check_exposure
from qsim.sensor.row import Row
from qsim.sensor.sensor import MOST_PIXELS, fast_engine_works

LIGHT = {"float16": "f16", "float32": "f", "float64": "f64"}  # types of light, and their names in Dr.Jit


@one_thread_in_order
def draw_rows(light: Any, shape: tuple[int, int, int, int], rows: Sequence[Row], packed: bool = False) -> Any:
    """Return codes as Dr.Jit's Int32 [B T H ceil(W / 4)] on the device: four in a number, the first one lowest.

    With `packed` binary codes are packed: UInt8 [B T H ceil(W / 8)], each row of pixels as `numpy.packbits` packs it.
    `light` holds the B T H W numbers of `shape` in a line, float16, float32 or float64: a NumPy array, or one of a
    library that knows DLPack, which stays on its device. Light is finite and not negative: nobody looks at it, and
    codes of other light have no meaning.
    `ValueError` for rows that do not fit the shape, for codes of more bits to pack, for a sensor whose law no table
    holds, and for a machine without a compiled engine.
    """
    kind = LIGHT.get(str(light.dtype).rpartition(".")[2])
    if len(shape) != 4 or not 0 < prod(shape) <= MOST_PIXELS or tuple(light.shape) != (prod(shape),) or kind is None:
        wanted = "light has the shape [B, T, H, W] in float16, float32 or float64, 1 to 2^31 numbers"
        raise ValueError(f"{wanted}; got {list(shape)} in {light.dtype}")
    if len(rows) != shape[0]:
        raise ValueError(f"light has {shape[0]} rows, and {len(rows)} are described; give one Row for each")
    for row in rows:
        check_exposure(row.exposure)
        require_counters(row.key, shape[1:], row.origin, 1 if row.at_once else row.sensor.counters)
        if not (isfinite(row.scale) and row.scale >= 0):
            raise ValueError(f"Row.scale is finite and not negative, got {row.scale!r}")
        if packed and row.sensor.bits != 1:
            raise ValueError(f"packed= is for codes of 1 bit, and {row.sensor!r} has {row.sensor.bits}; leave it out")
    if fast_engine_works():
        from qsim.sensor.compiled import draw_rows as compiled
        from qsim.sensor.compiled import jit

        draws = []
        for row in rows:
            draw = row.sensor.device_draw(row.exposure, row.key, row.origin, row.scale, row.at_once)
            if draw is None:
                raise ValueError(f"{row.sensor!r}: no table holds the law of its codes; use `sample`")
            draws.append(draw)
        if jit.available():
            given = jit.in_aligned(light) if isinstance(light, np.ndarray) else light
            return compiled.draw(given, kind, shape, draws, packed)
    raise ValueError("no compiled engine draws codes on this machine; use `sample`")

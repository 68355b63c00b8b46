"""Draws a batch of rows: looks up their laws, writes a record for each and launches rows_kernel.py once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from qsim.keys import Key
from qsim.sensor.compiled import rows_kernel
from qsim.sensor.compiled.jit import aligned, backend, is_aligned
from qsim.sensor.compiled.law_table import LawTable
from qsim.sensor.compiled.row_tables import tables


@dataclass(frozen=True)
class Draw:
    """How a kernel draws one row, [T, H, W] of light."""

    table: LawTable  # of the number of a pixel, or of each plane of one
    efficiency: float  # arrivals per unit of light, of one number
    dark: float  # arrivals without light, of one number
    planes: int  # numbers whose codes are summed
    key: Key
    origin: tuple[int, int]


def draw(light: Any, kind: str, shape: tuple[int, int, int, int], draws: Sequence[Draw], packed: bool = False) -> Any:
    """Return codes Int32 [B T H ceil(W / 4)], four in a number, or binary ones UInt8 [B T H ceil(W / 8)], packed.

    `kind` of light as in `rows_kernel.kernel`.
    """
    jit = backend()
    held = tables(max(each.table.bits for each in draws))
    held.hold({each.table for each in draws})
    records = aligned((len(draws), rows_kernel.RECORD), np.float64)
    for each, own in zip(draws, records, strict=True):
        first, cells = held.places[each.table]
        y, x = each.origin
        own[:] = rows_kernel.Record(
            efficiency=each.efficiency,
            dark=each.dark,
            rate=each.table.rate,
            margin=each.table.margin,
            first=first,
            last=cells - 1,
            frame=each.key.frame,
            planes=each.planes,
            y=y,
            x=x,
            key=each.key.philox_key,
        ).numbers()
    pixels = rows_kernel.EIGHT if packed else rows_kernel.FOUR
    kernel = rows_kernel.kernel(
        bits=held.bits,
        light=kind,
        summing=any(each.planes > 1 for each in draws),
        shifted=any(each.origin[1] % 4 for each in draws),
        whole=shape[3] % pixels == 0 and is_aligned(light),
        pixels=pixels,
    )
    given = getattr(jit, rows_kernel.LIGHT[kind])(light)
    return kernel(rows_kernel.places(shape, pixels), given, jit.Float64(records.reshape(-1)), held.fast, held.exact)

"""Draws a batch of rows (rows.py): looks up their laws, writes a record for each and launches rows_kernel.py once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from qsim.sensor.compiled import rows_kernel
from qsim.sensor.compiled.jit import aligned, backend
from qsim.sensor.compiled.row_tables import Law, table_of, tables
from qsim.sensor.row import Row


def law_of(row: Row) -> Law | None:
    """Return the law of the number that a row draws for each pixel, or for each plane of one; None without a table."""
    sensor = row.sensor
    if not sensor.tabulated or sensor.bits > 8:
        return None
    drawn = sensor if row.at_once else sensor.plane
    law = (drawn, row.exposure if drawn.law_follows_exposure else 1.0)
    return None if table_of(law) is None else law


def draw(light: Any, kind: str, whole: bool, shape: tuple[int, int, int, int], rows: Sequence[Row]) -> Any:
    """Return codes Int32 [B T H ceil(W / 4)]; `kind` of light as in `rows_kernel.kernel`.

    `whole`: the memory of the light begins at a multiple of four numbers. Each row has a law.
    """
    jit = backend()
    laws = [law_of(row) for row in rows]
    held = tables(max(row.sensor.bits for row in rows))
    held.hold({law for law in laws if law is not None})
    records = aligned((len(rows), rows_kernel.RECORD), np.float64)
    planes = [1 if row.at_once else row.sensor.counters for row in rows]
    for row, law, count, own in zip(rows, laws, planes, records, strict=True):
        assert law is not None
        table = table_of(law)
        assert table is not None
        first, cells = held.places[law]
        y, x = row.origin
        own[:] = rows_kernel.Record(
            efficiency=row.scale * row.sensor.efficiency / count,
            dark=row.sensor.dark_rate * row.exposure / count,
            rate=table.rate,
            margin=table.margin,
            first=first,
            last=cells - 1,
            frame=row.key.frame,
            planes=count,
            y=y,
            x=x,
            key=row.key.philox_key,
        ).numbers()
    kernel = rows_kernel.kernel(
        bits=held.bits,
        light=kind,
        summing=max(planes) > 1,
        shifted=any(row.origin[1] % 4 for row in rows),
        whole=whole and shape[3] % 4 == 0,
    )
    given = getattr(backend(), rows_kernel.LIGHT[kind])(light)
    return kernel(rows_kernel.places(shape), given, jit.Float64(records.reshape(-1)), held.fast, held.exact)

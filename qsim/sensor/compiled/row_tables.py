"""Keeps the tables of laws on the device, so that each is made and copied there once, and rows name theirs."""

from __future__ import annotations

from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.compiled.jit import aligned, backend
from qsim.sensor.compiled.law_table import LawTable
from qsim.sensor.sensor import Sensor

_MOST_LAWS = 64  # held on the device; beyond them those that are not in use are left out

Law = tuple[Sensor, float]  # and the exposure [s]


@lru_cache(maxsize=2 * _MOST_LAWS)
def table_of(law: Law) -> LawTable | None:
    """Return the table of a law, made once; None where it would be too large."""
    sensor, exposure = law
    return LawTable.of(sensor, exposure)


class Tables:
    """The tables of laws of so many bits, one behind the other, in the memory of the device."""

    def __init__(self, bits: int) -> None:
        self.bits = bits
        self.places: dict[Law, tuple[int, int]] = {}  # the first cell and the number of cells
        self.fast: Any = None
        self.exact: Any = None

    def hold(self, laws: set[Law]) -> None:
        """Copy the tables of laws to the device, unless they are there; `table_of` has a table for each."""
        if laws <= self.places.keys():
            return
        import drjit as dr

        held = [law for law in self.places if len(self.places.keys() | laws) <= _MOST_LAWS or law in laws]
        held += [law for law in laws if law not in held]
        tables = [_table(law).padded((1 << self.bits) - 1) for law in held]
        counts = [len(table.fast) for table in tables]
        firsts = np.cumsum([0, *counts[:-1]]).tolist()
        self.places = dict(zip(held, zip(firsts, counts, strict=True), strict=True))
        jit = backend()
        self.fast = jit.Float(_joined([table.fast for table in tables]))
        self.exact = jit.Float64(_joined([table.exact for table in tables]))
        dr.eval(self.fast, self.exact)


@cache
def tables(bits: int) -> Tables:
    """Return the tables of this process for codes of so many bits."""
    return Tables(bits)


def _joined(parts: list[Array]) -> Array:
    """Return all numbers of some arrays of one type, one behind the other."""
    found = aligned((sum(part.size for part in parts),), parts[0].dtype)
    return np.concatenate([part.ravel() for part in parts], out=found)


def _table(law: Law) -> LawTable:
    found = table_of(law)
    assert found is not None
    return found

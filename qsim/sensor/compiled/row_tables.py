"""Keeps the tables of laws on the device, so that each is made and copied there once, and rows name theirs."""

from __future__ import annotations

from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.compiled.jit import aligned, backend
from qsim.sensor.compiled.law_table import LawTable
from qsim.sensor.distribution import Distribution

_MOST_LAWS = 64  # held on the device; beyond them those that are not in use are left out


@lru_cache(maxsize=2 * _MOST_LAWS)
def table_of(distribution: Distribution, exposure: float) -> LawTable | None:
    """Return the table of a law at an exposure [s], made once; None where it would be too large."""
    return LawTable.of(distribution, exposure)


class Tables:
    """The tables of laws of so many bits, one behind the other, in the memory of the device."""

    def __init__(self, bits: int) -> None:
        self.bits = bits
        self.places: dict[LawTable, tuple[int, int]] = {}  # the first cell and the number of cells
        self.fast: Any = None
        self.exact: Any = None

    def hold(self, wanted: set[LawTable]) -> None:
        """Copy tables of at most these bits to the device, unless they are there."""
        if wanted <= self.places.keys():
            return
        import drjit as dr

        others = [table for table in self.places if table not in wanted]
        held = [*others[: max(0, _MOST_LAWS - len(wanted))], *wanted]
        padded = [table.padded((1 << self.bits) - 1) for table in held]
        counts = [len(table.fast) for table in padded]
        firsts = np.cumsum([0, *counts[:-1]]).tolist()
        self.places = dict(zip(held, zip(firsts, counts, strict=True), strict=True))
        jit = backend()
        self.fast = jit.Float(_joined([table.fast for table in padded]))
        self.exact = jit.Float64(_joined([table.exact for table in padded]))
        dr.eval(self.fast, self.exact)


@cache
def tables(bits: int) -> Tables:
    """Return the tables of this process for laws of at most so many bits."""
    return Tables(bits)


def _joined(parts: list[Array]) -> Array:
    """Return all numbers of some arrays of one type, one behind the other."""
    found = aligned((sum(part.size for part in parts),), parts[0].dtype)
    return np.concatenate([part.ravel() for part in parts], out=found)

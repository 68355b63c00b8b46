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

Law = tuple[Distribution, float]  # and the exposure [s]


@lru_cache(maxsize=2 * _MOST_LAWS)
def _made(law: Law) -> LawTable | None:
    distribution, exposure = law
    return LawTable.of(distribution, exposure)


def has_table(law: Law) -> bool:
    """Return whether a law has a table; that of some would be too large."""
    return _made(law) is not None


def table_of(law: Law) -> LawTable:
    """Return the table of a law that has one, made once."""
    found = _made(law)
    assert found is not None
    return found


class Tables:
    """The tables of laws of so many bits, one behind the other, in the memory of the device."""

    def __init__(self, bits: int) -> None:
        self.bits = bits
        self.places: dict[Law, tuple[int, int]] = {}  # the first cell and the number of cells
        self.fast: Any = None
        self.exact: Any = None

    def hold(self, laws: set[Law]) -> None:
        """Copy the tables of laws to the device, unless they are there; each has a table of at most these bits."""
        if laws <= self.places.keys():
            return
        import drjit as dr

        others = [law for law in self.places if law not in laws]
        held = [*others[: max(0, _MOST_LAWS - len(laws))], *laws]
        padded = [table_of(law).padded((1 << self.bits) - 1) for law in held]
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

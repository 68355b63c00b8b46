"""Reads an array of an open .npy by parts. Its file may be cut or overwritten meanwhile: reading then ends in an error.

A memory map would end the process (SIGBUS) where the file became shorter, and mix old values with new ones.
"""

from __future__ import annotations

import math
import os
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim.lazy_array import Crop, LazyArray

PIECE = 1 << 24  # bytes read at once of an array in Fortran order, of which most are dropped


class StoredArray(LazyArray):
    """An array [N, ...] of a .npy, read when it is used; of an index of rows only these are read.

    It is that of the file that was opened, also if another one was given its name since. `ValueError` where this file
    itself was cut or overwritten. A copy by `pickle` or `deepcopy` is an array in memory.
    """

    def __init__(
        self, path: Path, descriptor: int, start: int, shape: tuple[int, ...], dtype: np.dtype[Any], *, fortran: bool
    ) -> None:
        """Take over the descriptor of a regular file whose values begin at byte `start`."""
        self.shape = shape
        self.dtype = dtype
        self.ndim = len(shape)
        self._path = path
        self._descriptor = descriptor
        self._start = start
        self._fortran = fortran and self.ndim > 1
        self._state = _state(descriptor)
        weakref.finalize(self, os.close, descriptor)

    def __getitem__(self, index: Any) -> Array:
        """Return what the array holds there; integers and slices of the first two axes read these rows alone."""
        if self._fortran or not (isinstance(index, tuple) and len(index) > 1 and self.ndim > 2):
            return super().__getitem__(index)
        first, second, *rest = index
        if not (isinstance(first, slice) and isinstance(second, slice)):
            return super().__getitem__(index)
        frames = range(self.shape[0])[first]
        rows = range(self.shape[1])[second]
        if frames.step != 1 or rows.step != 1 or not frames or not rows:
            return super().__getitem__(index)
        found = np.empty((len(frames), len(rows), *self.shape[2:]), self.dtype)
        self._fill(found, [t * self.shape[1] + rows.start for t in frames], found[:1].nbytes, found[:1, :1].nbytes)
        return found[(slice(None), slice(None), *rest)]

    def _read(self, first: int, last: int, crop: Crop | None) -> Array:
        """Return rows first ... last - 1 of the first axis, or the crop of them."""
        if crop is not None:
            y, x, height, width = crop
            return self[first:last, y : y + height, x : x + width]
        if self._fortran:
            return self._of_columns(first, last)
        found = np.empty((last - first, *self.shape[1:]), self.dtype)
        self._fill(found, [first], found.nbytes, found[:1].nbytes)
        return found

    def _of_columns(self, first: int, last: int) -> Array:
        """Return rows of an array whose first axis varies fastest: all its bytes are read."""
        shape = self.shape[::-1]
        found = np.empty((*shape[:-1], last - first), self.dtype)
        row = math.prod(shape[1:]) * self.dtype.itemsize
        step = max(1, PIECE // max(row, 1))
        for start in range(0, shape[0], step):
            piece = np.empty((min(step, shape[0] - start), *shape[1:]), self.dtype)
            self._fill(piece, [start], piece.nbytes, row)
            found[start : start + step] = piece[..., first:last]
        return found.transpose()

    def _fill(self, block: Array, firsts: Sequence[int], size: int, row: int) -> None:
        """Read an array in memory: so many bytes from each of these rows on, of rows of so many bytes.

        `ValueError` if the file was written to since it was opened: what was read may be of two states.
        """
        if not block.size:
            return
        into = block.reshape(-1).view(np.uint8).data
        for number, first in enumerate(firsts):
            place = self._start + first * row
            rest = into[number * size : (number + 1) * size]
            while rest:
                done = os.preadv(self._descriptor, [rest], place)
                if not done:
                    raise ValueError(f"{self._path}: became shorter since it was opened; write it again")
                place += done
                rest = rest[done:]
        if _state(self._descriptor) != self._state:
            raise ValueError(f"{self._path}: was changed since it was opened; start again when it is complete")

    def __reduce__(self) -> tuple[Any, ...]:
        return np.array, (np.asarray(self),)


def _state(descriptor: int) -> tuple[int, int]:
    """Return what changes when a file is written to."""
    found = os.fstat(descriptor)
    return found.st_size, found.st_mtime_ns

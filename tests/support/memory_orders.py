"""The same values in every memory that NumPy knows: orders, strides, byte orders, alignments, maps of files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy import ndarray as Array


def _padded(array: Array) -> Array:
    """Every second value of a larger array, along each axis."""
    wide = np.zeros([2 * n + 1 for n in array.shape], array.dtype)
    places = tuple(slice(1, 2 * n + 1, 2) for n in array.shape)
    wide[places] = array
    return wide[places]


def _backwards(array: Array) -> Array:
    turned = (slice(None, None, -1),) * array.ndim
    return np.ascontiguousarray(array[turned])[turned]


def _transposed(array: Array) -> Array:
    return np.ascontiguousarray(np.moveaxis(array, 0, -1)).transpose(array.ndim - 1, *range(array.ndim - 1))


def _unaligned(array: Array) -> Array:
    memory = np.zeros(array.nbytes + 1, np.uint8)
    found = np.frombuffer(memory.data, array.dtype, array.size, offset=1).reshape(array.shape)
    memory[1:] = np.frombuffer(np.ascontiguousarray(array).tobytes(), np.uint8)
    return found


def _read_only(array: Array) -> Array:
    found = np.array(array)
    found.setflags(write=False)
    return found


ORDERS: dict[str, Callable[[Array], Array]] = {
    "Fortran": np.asfortranarray,
    "transposed": _transposed,
    "backwards": _backwards,
    "every second": _padded,
    "unaligned": _unaligned,
    "read-only": _read_only,
    "swapped bytes": lambda array: array.astype(array.dtype.newbyteorder("S")),
    "swapped Fortran": lambda array: np.asfortranarray(array.astype(array.dtype.newbyteorder("S"))),
    "a subclass": lambda array: np.array(array).view(np.recarray),
}


def mapped(array: Array, folder: Path, fortran: bool) -> Array:
    """The array as a memory map of a .npy in C or Fortran order."""
    path = folder / f"mapped_{fortran}.npy"
    np.save(path, np.asfortranarray(array) if fortran else array)
    return np.load(path, mmap_mode="r")


def all_of(array: Array, folder: Path) -> dict[str, Array]:
    """Every form of an array, by name; `a view` repeats one frame without memory of its own where that is the same."""
    forms = {name: make(array) for name, make in ORDERS.items()}
    forms["mapped"] = mapped(array, folder, False)
    forms["mapped Fortran"] = mapped(array, folder, True)
    if array.ndim and (array == array[:1]).all():
        forms["a view"] = np.broadcast_to(array[:1], array.shape)
    return forms

"""Defines `LazyArray`, frames [T, H, W] or [T, 3, H, W] on disk that are used as an array and read when they are."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy import ndarray as Array
from numpy.lib.mixins import NDArrayOperatorsMixin

Crop = tuple[int, int, int, int]  # y, x, height, width


class LazyArray(NDArrayOperatorsMixin):
    """Frames [T, H, W]: `frames[3]` reads one frame; NumPy functions, operators and array methods read all of them.

    `read(start, stop, crop)` returns frames start ... stop - 1, or the crop = (y, x, height, width) of them.
    """

    def __init__(
        self, shape: tuple[int, ...], dtype: np.dtype[Any], read: Callable[[int, int, Crop | None], Array]
    ) -> None:
        self.shape = shape
        self.dtype = dtype
        self.ndim = len(shape)
        self._read = read

    def __call__(self, start: int = 0, stop: int | None = None, crop: Crop | None = None) -> Array:
        """Return frames start ... stop - 1, [stop - start, h, w]; crop = (y, x, height, width) [px]."""
        return self._read(start, len(self) if stop is None else stop, crop)

    def __len__(self) -> int:
        return self.shape[0]

    @property
    def size(self) -> int:
        """The number of values."""
        return math.prod(self.shape)

    @property
    def nbytes(self) -> int:
        """The bytes of all values in memory."""
        return self.size * self.dtype.itemsize

    def channel(self, number: int) -> LazyArray:
        """Return entry `number` of the last axis, [T, ...], read when it is used."""
        return LazyArray(self.shape[:-1], self.dtype, lambda start, stop, _: self(start, stop)[..., number])

    def __iter__(self) -> Iterator[Array]:
        return (self[t] for t in range(len(self)))

    def __getitem__(self, index: Any) -> Array:
        """Return what the array [T, H, W] holds there; an integer or a slice first reads these frames alone."""
        first, *rest = index if isinstance(index, tuple) else (index,)
        if isinstance(first, int | np.integer) and not isinstance(first, bool):
            t = range(len(self))[first]  # an IndexError outside
            return self(t, t + 1)[0][tuple(rest)]
        if isinstance(first, slice) and (frames := range(len(self))[first]):
            low = min(frames)
            high = max(frames)
            return self(low, high + 1)[(slice(frames[0] - low, None, frames.step), *rest)]
        return np.asarray(self)[index]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        """Return all frames [T, H, W]. `ValueError` for `copy=False`: they are read into new memory."""
        if copy is False:
            raise ValueError("frames on disk are copied when they become an array; leave copy=False out")
        return self().astype(dtype or self.dtype, copy=False)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        arrays = [np.asarray(value) if isinstance(value, LazyArray) else value for value in inputs]
        return getattr(ufunc, method)(*arrays, **options)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the array of all frames: `mean`, `astype`, `T`."""
        if name.startswith("_"):
            raise AttributeError(f"frames on disk have no attribute {name!r}")
        return getattr(np.asarray(self), name)

    def __repr__(self) -> str:
        return f"<frames {list(self.shape)} of {self.dtype}, read when used>"

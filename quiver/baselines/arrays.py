"""Chooses the array library of QBP and BM3D: torch where it is installed, else NumPy.

`xp` is the module torch or numpy. The methods call only what both have under one name and order of arguments; the rest
is here. NumPy takes as long as torch with one thread, but uses no more threads. Both compute in single precision and
round in another order, so a shift or a block that is as good as another may be chosen differently: PSNR differs by a
few thousandths of a decibel (`test_without_torch.py`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import sparse

if TYPE_CHECKING:
    import torch as xp
    from torch import Tensor
else:
    try:
        import torch as xp
    except ModuleNotFoundError:
        import numpy as xp

TORCH = xp is not np


def whole(values: Any) -> Tensor:
    """Return an array with its values as 64-bit integers, towards zero."""
    return xp.asarray(values, dtype=xp.int64)


def single(values: Any) -> Tensor:
    """Return an array with its values as 32-bit floats."""
    return xp.asarray(values, dtype=xp.float32)


def zeros(*shape: int) -> Tensor:
    """Return 32-bit zeros of this shape."""
    return xp.zeros(shape, dtype=xp.float32)


def mixed(first: Any, second: Any, share: Any) -> Any:
    """Return the values between two arrays: the first where the share is 0, the second where it is 1."""
    return xp.lerp(first, second, share) if TORCH else first + (second - first) * share


def strided(values: Any, shape: tuple[int, ...], strides: tuple[int, ...], offset: int = 0) -> Any:
    """Return a view of an array from an offset on; strides and offset count elements of its C order.

    An array of another order is copied first: strides of C order on its memory would mix its rows.
    """
    if TORCH:
        return values.contiguous().as_strided(shape, strides, offset)
    size = values.itemsize
    flat = np.ascontiguousarray(values).reshape(-1)[offset:]
    return np.lib.stride_tricks.as_strided(flat, shape, [size * stride for stride in strides])


def smallest(values: Any, count: int) -> tuple[Any, Any]:
    """Return the `count` smallest values along the last axis, ascending, and their indices."""
    if TORCH:
        return values.topk(count, largest=False)
    index = np.argpartition(values, count - 1)[..., :count]
    index = np.take_along_axis(index, np.argsort(np.take_along_axis(values, index, -1)), -1)
    return np.take_along_axis(values, index, -1), index


def add_at(total: Any, index: Any, rows: Any) -> None:
    """Add rows [n, ...] to the rows of `total` with these indices [n], in place; an index may occur often."""
    if TORCH:
        total.index_add_(0, index, rows)
        return
    count = len(index)
    places = sparse.csc_array((np.ones(count, np.float32), index, np.arange(count + 1)), shape=(len(total), count))
    total += (places @ rows.reshape(count, -1)).reshape(total.shape)

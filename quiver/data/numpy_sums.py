"""Sums numbers on any device in the order of NumPy, so that means are equal to the bit.

NumPy adds up to 128 numbers in eight partial sums, and halves longer rows (pairwise summation).
"""

from __future__ import annotations

from torch import Tensor

LEAF = 128  # numbers that are added in eight partial sums
LANES = 8


def mean(values: Tensor) -> Tensor:
    """Return the mean of each row [B] of values [B, n], float64."""
    return total(values) / values.shape[1]


def total(values: Tensor) -> Tensor:
    """Return the sum of each row [B] of values [B, n], float64, in the order of `numpy.sum` of a row."""
    rows, count = values.shape
    if count < LANES:
        return _in_order(values)
    if count <= LEAF:
        whole = count - count % LANES
        lanes = _in_order(values[:, :whole].reshape(rows, -1, LANES))
        while lanes.shape[1] > 1:
            lanes = lanes[:, ::2] + lanes[:, 1::2]
        return _in_order(values[:, whole:], lanes[:, 0])
    half = count // 2 - count // 2 % LANES
    if 2 * half == count:  # both halves at once
        halves = total(values.reshape(2 * rows, half)).view(rows, 2)
        return halves[:, 0] + halves[:, 1]
    return total(values[:, :half]) + total(values[:, half:])


def _in_order(values: Tensor, before: Tensor | None = None) -> Tensor:
    """Return the sum [B, ...] along axis 1 of values [B, n, ...], one after another."""
    for each in values.unbind(1):
        before = each if before is None else before + each
    assert before is not None
    return before

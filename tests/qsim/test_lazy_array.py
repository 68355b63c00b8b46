"""Tests frames that are read when they are used: they equal the array of all frames, under every use."""

import copy
import pickle

import numpy as np
import pytest

from qsim.lazy_array import LazyArray

SHAPE = (9, 7, 5)


def pair(rng: np.random.Generator) -> tuple[LazyArray, np.ndarray, list[tuple[int, int]]]:
    """Frames, the same as an array, and the list of reads (start, stop)."""
    array = rng.integers(0, 200, SHAPE).astype(np.uint8)
    reads: list[tuple[int, int]] = []

    def read(start: int, stop: int, crop: tuple[int, int, int, int] | None) -> np.ndarray:
        reads.append((start, stop))
        y, x, h, w = crop or (0, 0, *SHAPE[1:])
        return array[start:stop, y : y + h, x : x + w].copy()

    return LazyArray(SHAPE, array.dtype, read), array, reads


def random_axis(rng: np.random.Generator, n: int) -> int | slice:
    if rng.random() < 0.5:
        return int(rng.integers(-n, n))
    start, stop = (None if rng.random() < 0.2 else int(rng.integers(-n - 3, n + 3)) for _ in "ab")
    return slice(start, stop, None if rng.random() < 0.4 else int(rng.choice([-3, -2, -1, 1, 2, 3])))


def test_random_indices_give_what_an_array_gives():
    rng = np.random.default_rng(0)
    lazy, array, _ = pair(rng)
    for _ in range(3000):
        index = tuple(random_axis(rng, n) for n in SHAPE[: int(rng.integers(1, 4))])
        index = index[0] if len(index) == 1 and rng.random() < 0.5 else index
        np.testing.assert_array_equal(lazy[index], array[index], err_msg=str(index))
    for other in (..., (..., 2), array > 100, [3, 1], (slice(2), None), np.int64(4)):
        np.testing.assert_array_equal(lazy[other], array[other])
    for outside in (9, -10, (3, 7), (0, 0, -6)):
        with pytest.raises(IndexError):
            lazy[outside]


def test_only_the_frames_of_an_index_are_read():
    lazy, _, reads = pair(np.random.default_rng(1))
    lazy[3], lazy[-1], lazy[2:8:3], lazy[5:1:-2]
    assert reads == [(3, 4), (8, 9), (2, 6), (3, 6)]
    reads.clear()
    assert [frame.shape for frame in lazy] == [(7, 5)] * 9
    assert reads == [(t, t + 1) for t in range(9)]


def test_a_call_reads_a_crop():
    lazy, array, _ = pair(np.random.default_rng(2))
    np.testing.assert_array_equal(lazy(2, 4, (1, 2, 3, 2)), array[2:4, 1:4, 2:4])
    np.testing.assert_array_equal(lazy(), array)


def test_functions_operators_and_methods_see_an_array():
    lazy, array, reads = pair(np.random.default_rng(3))
    assert (lazy.shape, lazy.dtype, lazy.ndim, len(lazy)) == (SHAPE, np.uint8, 3, 9)
    assert repr(lazy) == "<frames [9, 7, 5] of uint8, read when used>"
    assert not reads
    assert lazy.mean() == array.mean() == np.mean(lazy)
    assert np.array_equal(lazy, array)
    np.testing.assert_array_equal(lazy == array, np.ones(SHAPE, bool))
    np.testing.assert_array_equal(2.0 * lazy - lazy, array.astype(float))
    np.testing.assert_array_equal(np.bincount(lazy.ravel()), np.bincount(array.ravel()))
    assert np.asarray(lazy, np.float32).dtype == np.float32
    assert np.add.reduce(lazy, axis=None) == array.sum()
    with pytest.raises(ValueError, match="copied"):
        np.asarray(lazy, copy=False)
    with pytest.raises(AttributeError, match="nothing"):
        _ = lazy.nothing
    copy.copy(lazy)  # looks for __deepcopy__ and the like, which an array must not answer
    with pytest.raises((AttributeError, pickle.PicklingError)):
        pickle.dumps(lazy)  # the function that reads is local here

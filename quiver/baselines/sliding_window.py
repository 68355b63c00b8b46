"""Checks the frames of a stream, continues a clip beyond its ends, and sums codes over a sliding window.

    codes [T, H, W] -> for every frame t the sum of the codes of `window` frames around it

A window of w frames covers t - w//2 ... t + (w-1)//2: centred for odd w, one frame more of the past for even w. Single
pixels (naive, moment, likelihood) take those frames of it that exist. Paths (path_merge) move it into the stream. For
BM3D, frames before the first and after the last are reflections that do not repeat the end frame (-1 is frame 1),
several times for short clips.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence

import numpy as np
from numpy import ndarray as Array

from qsim.arrays import plain
from qsim.sensor.sensor import Sensor


def checked_codes(codes: Array, sensor: Sensor) -> Array:
    """Return codes [T, H, W] as a plain array (qsim/arrays.py).

    `ValueError` unless they are a non-empty integer stack that this sensor can produce.
    """
    codes = plain(codes)
    if codes.ndim != 3 or codes.size == 0 or not np.issubdtype(codes.dtype, np.integer):
        raise ValueError(f"codes: expected integers [T, H, W] with at least one frame, got {codes.dtype} {codes.shape}")
    if codes.max() >= sensor.levels or codes.min() < 0:
        bad = (codes < 0) | (codes >= sensor.levels)
        where = tuple(int(i) for i in np.unravel_index(np.argmax(bad), codes.shape))
        raise ValueError(
            f"codes: expected 0..{sensor.levels - 1} for a {sensor.bits}-bit sensor, "
            f"found {codes[where]} at (t, y, x) = {where}"
        )
    return codes


def check_window(window: int) -> None:
    """Raise `ValueError` unless a window holds at least one frame."""
    if window < 1:
        raise ValueError(f"window is a number of frames, got {window}; use 1 or more")


def look_ahead(window: int) -> int:
    """Return the number of future frames in a window of this many frames."""
    return (window - 1) // 2


def reflect(index: Array, length: int) -> Array:
    """Return frame numbers inside 0 ... length-1 for any integers: -1 -> 1, length -> length-2; 0 for one frame."""
    if length == 1:
        return np.zeros_like(index)
    folded = np.abs(index) % (2 * length - 2)
    return np.where(folded < length, folded, 2 * length - 2 - folded)


def window_frames(frame: int, window: int, length: int) -> Array:
    """Return the `window` frame numbers around `frame`, reflected at both ends of a clip of `length` frames."""
    return reflect(np.arange(frame - window // 2, frame + look_ahead(window) + 1), length)


def existing_frames(frame: int, window: int, length: int) -> slice:
    """Return the frames of the window around `frame` that a clip of `length` frames has."""
    return slice(max(0, frame - window // 2), min(length, frame + look_ahead(window) + 1))


def moved_window(frame: int, window: int, length: int) -> slice:
    """Return the frames of the window around `frame`, moved into a clip of `length` frames where it would reach out."""
    first = max(0, min(frame - window // 2, length - window))
    return slice(first, min(first + window, length))


def alike(keys: Sequence[Hashable], frames: range, most: int) -> Iterator[range]:
    """Yield successive frames of equal keys, at most `most` at a time; `keys` has one of each frame."""
    first = 0
    for i in range(1, len(keys) + 1):
        if i == len(keys) or keys[i] != keys[first] or i - first == most:
            yield range(frames.start + first, frames.start + i)
            first = i


def equal_windows(
    frames: range,
    window: int,
    length: int,
    most: int,
    taken: Callable[[int, int, int], slice] = existing_frames,
) -> Iterator[tuple[range, int, int]]:
    """Yield successive frames whose windows have the same frames beside them, at most `most` at a time; how many frames
    of such a window come before its own, and how many it has in all. `taken` returns the frames of a window.
    """
    shapes = []
    for frame in frames:
        here = taken(frame, window, length)
        shapes.append((frame - here.start, here.stop - here.start))
    for part in alike(shapes, frames, most):
        yield part, *shapes[part.start - frames.start]


def frame_times(frame: int, window: int, length: int) -> tuple[int, ...]:
    """Return how often each different frame counts in the window around `frame`, in falling order.

    These are `window` ones away from the ends of a clip. A mean of codes that count n times each has the deviation of
    one code times sqrt(sum of n^2) / window, which is more than 1 / sqrt(window) where frames are reflected.
    """
    counts = np.unique(window_frames(frame, window, length), return_counts=True)[1]
    return tuple(sorted((int(count) for count in counts), reverse=True))


def window_sums(codes: Array, window: int, top: int) -> Iterator[Array]:
    """Yield the sum of the codes over the window around each frame: T unsigned arrays [H, W], 0 ... window * top.

    It is a running sum: one frame enters, one leaves. The caller may change each array.
    """
    dtype = np.uint16 if window * top < 2**16 else np.uint32
    length = len(codes)
    total = codes[window_frames(0, window, length)].sum(axis=0, dtype=dtype)
    yield total
    for frame in range(1, length):
        leaves, enters = reflect(np.array([frame - 1 - window // 2, frame + look_ahead(window)]), length)
        total = np.add(total, codes[enters], dtype=dtype, casting="unsafe")
        np.subtract(total, codes[leaves], out=total, casting="unsafe")
        yield total


def existing_sums(codes: Array, window: int, frames: range, top: int) -> Iterator[tuple[int, Array]]:
    """Yield how many codes are summed, and their sum [H, W], of the existing frames of the window around each frame.

    The sum is a running one, and must not be changed.
    """
    dtype = np.uint16 if window * top < 2**16 else np.uint32
    taken = existing_frames(frames.start, window, len(codes))
    total = codes[taken].sum(axis=0, dtype=dtype)
    for frame in frames:
        here = existing_frames(frame, window, len(codes))
        for enters in range(taken.stop, here.stop):
            np.add(total, codes[enters], out=total, casting="unsafe")
        for leaves in range(taken.start, here.start):
            np.subtract(total, codes[leaves], out=total, casting="unsafe")
        taken = here
        yield here.stop - here.start, total


def restore_by_sums(
    codes: Array,
    sensor: Sensor,
    window: int,
    table_of: Callable[[int], Array],
    photons_per_unit: float,
    frames: range | None = None,
) -> Array:
    """Return restored frames [T, H, W], all or those in `frames`, of a method that uses the sum of a window's codes.

    `table_of` gives the photons of every sum of so many codes, 0 ... codes * top. `ValueError` for codes that the
    sensor cannot produce, an empty window and an impossible unit.
    """
    codes = checked_codes(codes, sensor)
    check_window(window)
    top = sensor.levels - 1
    tables: dict[int, Array] = {}
    frames = range(len(codes)) if frames is None else frames
    restored = np.empty((len(frames), *codes.shape[1:]), np.float32)
    for i, (count, total) in enumerate(existing_sums(codes, window, frames, top)):
        if count not in tables:
            tables[count] = table_of(count).astype(np.float32)
        np.take(tables[count], total, out=restored[i], mode="clip")  # no index is clipped; this mode needs no buffer
    return in_units(restored, photons_per_unit)


def in_units(photons: Array, photons_per_unit: float) -> Array:
    """Return photons, float32, in a unit of this many photons. `ValueError` unless the unit is finite and above 0."""
    if not 0 < photons_per_unit < np.inf:
        raise ValueError(f"photons_per_unit must be a finite number above 0, got {photons_per_unit!r}")
    return photons if photons_per_unit == 1 else photons / np.float32(photons_per_unit)

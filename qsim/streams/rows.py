"""Rows at their own time: light of a clip as a sensor sees it that reads its rows or columns one after the other.

    frame j of a clip shows the light from j to j + 1 frame times; a row with a delay of s frame times shows
    (1 - f) frame[j + i] + f frame[j + i + 1],   s = i + f, 0 <= f < 1

This is the exact light of the delayed interval where the light of a frame is constant within it, and it counts every
photon once: the sum of all delayed frames is that of the clip. Where something moves, a row mixes two frames. The error
of a code falls with the clip frames in its exposure, because only the first and the last are mixed; docs/physics.md has
the figures. A delay of whole frame times takes frames as they are.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

from qsim import records
from qsim.kinds import Positive, RowOrder
from qsim.lazy_array import Crop

Read = Callable[[int, Crop], Array]  # clip frame, crop (y, x, height, width) -> light [h, w]


@dataclass(frozen=True)
class Rows:
    """A rolling readout: each row (or column) begins `delay` seconds after the one before it."""

    delay: Positive  # s
    order: RowOrder = "down"  # right and left: columns

    def __post_init__(self) -> None:
        records.settle(self)

    def __str__(self) -> str:
        """Return the readout in words: `each row 2e-06 s later, down`."""
        return f"each {self.line} {self.delay:g} s later, {self.order}"

    @property
    def axis(self) -> int:
        """0 where rows have their own time, 1 where columns have it."""
        return 0 if self.order in ("down", "up") else 1

    @property
    def line(self) -> str:
        """What has its own time: `row` or `column`."""
        return ("row", "column")[self.axis]

    def shifts(self, height: int, width: int, frame_rate: float) -> Array:
        """Return the delay of each row [H] or column [W], in frame times of a clip of this rate, float64."""
        lines = np.arange((height, width)[self.axis], dtype=np.float64)
        found = (lines if self.order in ("down", "right") else lines[::-1]) * (self.delay * frame_rate)
        whole = np.rint(found)
        return np.where(np.abs(found - whole) < 1e-9, whole, found)  # 100 x 0.55 is 55, not 55 + 7e-15

    def reach(self, height: int, width: int, frame_rate: float) -> int:
        """Return how many clip frames after its own the last line still needs."""
        return math.ceil(float(self.shifts(height, width, frame_rate).max()))

    def check(self, height: int, width: int, frame_rate: float, planes: int, name: str) -> None:
        """Raise `ValueError` if a frame of `planes` clip frames is over before its lines are read."""
        lines = (height, width)[self.axis]
        taken = lines * self.delay
        period = planes / frame_rate
        if taken > period * (1 + 1e-9):
            raise ValueError(
                f"{name}: {lines} {self.line}s of {self.delay:g} s take {taken:g} s, longer than a frame or plane of "
                f"{period:g} s; the largest delay is {period / lines:.6g} s"
            )

    def delayed(self, read: Read, t: int, crop: Crop, shifts: Array) -> Array:
        """Return the light [h, w] of a crop that begins at clip frame t; `shifts` are those of all lines."""
        found = np.empty(crop[2:])
        for ahead, part, lines in self._blocks(np.floor(shifts).astype(int), crop):
            # Lines of one whole shift share two clip frames; what is left of their shift mixes these two.
            share = np.expand_dims((shifts - np.floor(shifts))[lines], 1 - self.axis)
            light = read(t + ahead, part)
            if share.any():
                light = (1 - share) * light + share * read(t + ahead + 1, part)
            found[self._place(part, crop)] = light
        return found

    def picked(self, read: Read, frames: Array, crop: Crop) -> Array:
        """Return images [..., h, w] of which each line is that of its clip frame in `frames`, int [lines]."""
        blocks = [(part, read(frame, part)) for frame, part, _ in self._blocks(frames, crop)]
        first = blocks[0][1]
        found = np.empty((*first.shape[:-2], *crop[2:]), first.dtype)
        for part, image in blocks:
            found[..., *self._place(part, crop)] = image
        return found

    def _blocks(self, numbers: Array, crop: Crop) -> Iterator[tuple[int, Crop, slice]]:
        """Yield (number, crop of these lines, lines) for each run of lines of a crop with the same number."""
        start = crop[self.axis]
        own = numbers[start : start + crop[2 + self.axis]]
        # Lines of one number are read together: one block of a frame instead of many lines.
        edges = [0, *(np.flatnonzero(np.diff(own)) + 1).tolist(), len(own)]
        for first, last in itertools.pairwise(edges):
            y, x, h, w = crop
            lines = (start + first, last - first)
            part = (lines[0], x, lines[1], w) if self.axis == 0 else (y, lines[0], h, lines[1])
            yield int(own[first]), part, slice(start + first, start + last)

    def _place(self, part: Crop, crop: Crop) -> tuple[slice, slice]:
        """Return where a part of a crop lies in the image of the crop."""
        y = part[0] - crop[0]
        x = part[1] - crop[1]
        return slice(y, y + part[2]), slice(x, x + part[3])

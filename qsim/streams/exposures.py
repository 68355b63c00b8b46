"""Lists the exposures behind the codes of a stream: which clip frames, with which share, and from when to when.

    Timing --over(clip)--> Exposures     exposures[t]: those of code t, one, or one for each plane that it sums

A code takes one clip frame or several: binary planes that are summed (clocked pixels), or slices of one exposure in
which the light changes (counting pixels, and a QIS that is read once, which blurs motion).

**Schedules.** Code t collects light in its share of a full exposure, around its middle: shares (1, 0.25) take turns. A
sensor sees share * light and share * dark counts, and the dead time of a short exposure. A gate takes those slices in
its time, the outer two in part: short exposures blur motion less. Planes that are summed have a gate each. Light levels
and truth are those of a full exposure, so all codes share one scale.

**Rows** with their own time (rows.py) see every exposure later, each row by its delay.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clip_folder import ClipFolder
from qsim.lazy_array import Crop
from qsim.streams.rows import Rows

UNEVEN = 0.01  # of the mean strength of a light, a difference that is stated
Read = Callable[[int, Crop | None], Array]  # clip frame, crop (None: all of it) -> [..., h, w]


@dataclass(frozen=True)
class Timing:
    """When the codes of a stream collect light, for clips of any size and length."""

    frames: int = 1  # clip frames of a code
    summed: bool = False  # each of them is a plane of its own; otherwise all are slices of one exposure
    rows: Rows | None = None  # rows or columns at their own time; None: all at once
    shares: tuple[float, ...] | None = None  # exposures of codes in turn, over a full one; None: all are full
    drift: float = 0.0  # rise of the light from the first code to the last, over that of the first

    def over(self, clip: ClipFolder) -> Exposures:
        """Return the exposures of the codes that a clip gives."""
        return Exposures(self, clip.shape, clip.frame_rate, clip.exposure)

    def words(self) -> str:
        """Return what differs from equal exposures of all rows at once: `; each row 2e-06 s later, down`, or ``."""
        rows = "" if self.rows is None else f"; {self.rows}"
        if self.drift:
            rows += f"; light changes by {100 * self.drift:+g} % to the last code"
        if self.shares is None:
            return rows
        return f"{rows}; exposures of {', '.join(f'{share:g}' for share in self.shares)} of a code's time in turn"

    @property
    def even(self) -> bool:
        """Whether all codes have a full exposure of the clip's light."""
        return self.shares is None and self.drift == 0

    def share(self, t: int) -> float:
        """Return the exposure of code t over a full one."""
        return 1.0 if self.shares is None else self.shares[t % len(self.shares)]


@dataclass(frozen=True, eq=False)
class Exposure:
    """One exposure of all pixels: parts of successive clip frames."""

    frames: range  # of the clip
    parts: Array  # how much of the light of each frame, float64 [frames]
    seconds: float  # of light
    begin: Array  # s, of each row or column, float64 [lines], or [1] where all are exposed at once
    end: Array  # s, likewise


@dataclass(frozen=True)
class Exposures:
    """The exposures of the codes that a clip gives; time 0 is the begin of the first one."""

    timing: Timing
    shape: tuple[int, int, int]  # of the clip: frames, height, width
    frame_rate: float  # of the clip, 1/s
    exposure: float  # s, of a clip frame

    def __len__(self) -> int:
        """Return the number of codes: the clip's frames over those of a code; late rows need the frames after it."""
        return (self.shape[0] - self.reach) // self.timing.frames

    def __getitem__(self, t: int) -> tuple[Exposure, ...]:
        """Return the exposures of code t: one, or one for each plane that it sums."""
        share = self.timing.share(t)
        strength = self.strength(t)
        first = t * self.timing.frames
        numbers = range(first, first + self.timing.frames)
        if self.timing.summed:
            return tuple(self._of(range(n, n + 1), np.array([share * strength]), share) for n in numbers)
        return (self._of(numbers, gate(share, self.timing.frames) * strength, share),)

    def strength(self, t: int) -> float:
        """Return the light of code t over that of the clip: 1 + drift t / (T - 1) of T codes."""
        return 1.0 + self.timing.drift * t / max(len(self) - 1, 1)

    def _of(self, frames: range, parts: Array, share: float) -> Exposure:
        """Return the exposure of clip frames that is open for a share of their time, around its middle."""
        full = len(frames) * self.exposure
        seconds = share * full
        # The gate is cut from both ends of the full exposure, so that codes
        # of unequal exposures keep even distances in time.
        begin = (frames.start + self.shifts) / self.frame_rate + (full - seconds) / 2
        return Exposure(frames, parts, seconds, begin, begin + seconds)

    @property
    def shifts(self) -> Array:
        """The delay of each row or column [clip frames], float64 [lines]; [0] where all are exposed at once."""
        rows = self.timing.rows
        return np.zeros(1) if rows is None else rows.shifts(*self.shape[1:], self.frame_rate)

    @property
    def reach(self) -> int:
        """Clip frames after its own that a code still needs."""
        rows = self.timing.rows
        return 0 if rows is None else rows.reach(*self.shape[1:], self.frame_rate)

    def seconds(self, t: int) -> float:
        """Return the seconds of light in each exposure of code t."""
        return self[t][0].seconds

    def number(self, t: int) -> int:
        """Return the frame number in the key of code t: planes are numbered one by one."""
        return t * self.timing.frames if self.timing.summed else t

    def light(self, read: Read, start: int, stop: int, crop: Crop | None = None) -> Array:
        """Return the photons [n, h, w] of each exposure of codes start ... stop - 1; `read` gives those of a frame."""
        return np.stack([self._total(read, exposure, crop) for t in range(start, stop) for exposure in self[t]])

    def _total(self, read: Read, exposure: Exposure, crop: Crop | None) -> Array:
        """Return the photons [h, w] of one exposure."""
        if len(exposure.frames) > 1:
            return np.asarray(self.slices(read, exposure, crop).sum(axis=0))
        (part,) = exposure.parts
        return part * self.delayed(read, exposure.frames.start, crop)

    def slices(self, read: Read, exposure: Exposure, crop: Crop | None = None) -> Array:
        """Return the photons [frames, h, w] of each part of an exposure; crop = (y, x, height, width) [px]."""
        frames = np.stack([self.delayed(read, t, crop) for t in exposure.frames])
        return frames * exposure.parts[:, None, None]

    def delayed(self, read: Read, t: int, crop: Crop | None = None) -> Array:
        """Return the photons [h, w] of one frame time from clip frame t on, of each row at its own time."""
        rows = self.timing.rows
        if rows is None:
            return read(t, crop)
        whole = (0, 0, *self.shape[1:])
        return rows.delayed(read, t, crop or whole, self.shifts)

    def middle(self, read: Read, t: int, at: str = "row", crop: Crop | None = None) -> Array:
        """Return `read` [..., h, w] of the clip frame in the middle of code t: of each row's exposure, or (`at` is
        "frame") of all of them together. Of an even number of frames it is the later of two.
        """
        rows = self.timing.rows
        if rows is None or at == "frame":
            return read(self.middle_frame(t), crop)
        # The middle of a row's exposure is late by its delay; the clip frame that contains it has the row's truth.
        numbers = np.floor(self._middle(t) + self.shifts).astype(int)
        return rows.picked(read, numbers, crop or (0, 0, *self.shape[1:]))

    def middle_frame(self, t: int) -> int:
        """Return the clip frame in the middle of code t, of all its rows together."""
        return math.floor(self._middle(t) + self.shifts.mean())

    def _middle(self, t: int) -> float:
        """Return the middle of code t of the first row [clip frames]."""
        return (t + 0.5) * self.timing.frames

    def about_flicker(self, strengths: Mapping[str, Array]) -> str:
        """Return how the light of a code differs from its truth, that of its middle clip frame; empty below UNEVEN.

        `strengths` [T] are those of each light in the frames of the clip.
        """
        apart = 0.0  # of the mean strength of the light that differs most
        n = self.timing.frames
        for each in strengths.values():
            codes = each[: len(each) // n * n].reshape(-1, n)
            apart = max(apart, float(np.abs(codes.mean(axis=1) - codes[:, n // 2]).max()))
        if apart < UNEVEN:
            return ""
        what = "its truth has the light of its middle clip frame; render at the code rate with an open shutter"
        return f"; light flickers within a code, by up to {100 * apart:.3g} % of its mean: {what}"


def gate(share: float, slices: int) -> Array:
    """Return how much of each of `slices` equal parts of a full exposure lies in a gate around its middle, [slices]."""
    return np.diff(np.clip(np.arange(slices + 1.0), slices * (1 - share) / 2, slices * (1 + share) / 2))


def steps(start: int, stop: int, step: int) -> Iterator[tuple[int, int]]:
    """Yield (first, last + 1) of successive blocks of codes start ... stop - 1."""
    for t in range(start, stop, step):
        yield t, min(t + step, stop)

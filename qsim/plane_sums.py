"""Sums planes of a recording: every so many successive frames of one bit become one code.

    planes [T, H, W] of 0 and 1, at R planes per second  --PlaneSums-->  codes 0 ... N [T', H, W], at R / step

A clocked SPAD stores single planes, and which sum is best depends on the scene. So the sum is chosen when a recording
is read (`planes`). A code of N planes has the exposure of N planes and N + 1 values; N need not be 2^b - 1. A camera
may have summed its planes itself: a file without a description does not say how many (`summed`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta
from numpy import ndarray as Array

from qsim.checks import ArgumentError
from qsim.frame_times import Times
from qsim.kinds import Count, Whole
from qsim.settings import setting, settle

PLANE_PIXELS = 1 << 24  # read at a time: 16 MB
MOST = 65535  # planes of a code of 16 bits

Summed = Annotated[int, Meta(ge=1, le=MOST)]
Read = Callable[[int, int], Array]  # frames start ... stop - 1, [stop - start, H, W]


@dataclass(frozen=True)
class PlaneRange:
    """Which frames of a recording are used."""

    SECTION: ClassVar[str] = "planes of a recording"

    start: Annotated[
        Count | None, setting("number of the first plane (or code) to use, from 0", unset="0", option="from")
    ] = None
    stop: Annotated[
        Whole | None, setting("number of the plane (or code) before which to end", unset="all", option="to")
    ] = None
    every: Annotated[
        Whole | None,
        setting("planes (or codes) from the begin of one code to that of the next", unset="those of a code"),
    ] = None

    def __post_init__(self) -> None:
        settle(self)


@dataclass(frozen=True)
class PlaneSums(PlaneRange):
    """Which frames of a recording are used, how many of them make a code, and how many planes each sums already."""

    planes: Annotated[
        Summed | None,
        setting(
            "sum so many successive binary planes to a code",
            unset="1",
        ),
    ] = None
    summed: Annotated[
        Summed | None,
        setting(
            "bare file: the camera summed so many binary planes to each code",
            unset="2^bits - 1",
        ),
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.planes is not None and self.summed is not None:
            raise ArgumentError(
                "planes", f"sums single planes, and with summed={self.summed} the codes are sums already; leave it out"
            )
        if self.every is not None and self.every < (self.planes or 1):
            raise ArgumentError(
                "every", f"{self.every}: codes of {self.planes} planes would share planes; give {self.planes} or more"
            )

    @property
    def any(self) -> bool:
        """Whether a recording is changed at all."""
        return any(value is not None for value in vars(self).values())

    def over(self, frames: int, where: str, *, bits: int | None = 1, bare: bool = False) -> Sums:
        """Return the sums of a recording of so many frames of these bits.

        Those of a `bare` one, which states no sums, lie within `stored`. `ArgumentError` for frames that do not exist,
        for sums of frames of several bits, and for `summed` of a recording that states it; `ValueError` where no code
        is left.
        """
        if self.summed is not None and not bare:
            raise ArgumentError("summed", f"{where} states what its codes sum; leave it out")
        planes = self.planes or 1
        start = self.start or 0
        stop = frames if self.stop is None else self.stop
        if planes > 1 and bits != 1:
            raise ArgumentError(
                "planes", f"sums planes of one bit, and {where} holds codes of {bits} bits; leave it out"
            )
        if start >= frames:
            raise ArgumentError("start", f"{start}: {where} has planes 0..{frames - 1}; give one of them")
        if stop > frames:
            raise ArgumentError("stop", f"{stop}: {where} has {frames} planes; give {frames} or less")
        if stop <= start:
            raise ArgumentError("stop", f"{stop}: ends before the first plane, {start}; give more than {start}")
        if stop - start < planes:
            raise ValueError(f"{where}: {stop - start} planes are fewer than the {planes} of one code")
        step = self.every or planes
        return Sums(planes, start, step, (stop - start - planes) // step + 1)

    def stored(self, frames: int) -> Sums:
        """Return the planes behind so many frames of a recording without a description."""
        planes = self.summed or 1
        return Sums(planes, 0, planes, frames)


AS_STORED = PlaneSums()


def within_sum(read: Read, planes: int, where: str) -> Read:
    """Return a reader of codes that sum so many planes; it raises `ValueError` for a larger code."""

    def checked(start: int, stop: int) -> Array:
        codes = read(start, stop)
        wrong = codes > planes
        if wrong.any():
            t, y, x = (int(i) for i in np.argwhere(wrong)[0])
            raise ValueError(
                f"{where}: code {codes[t, y, x]} at (t, y, x) = {(start + t, y, x)} is no sum of {planes} planes; give "
                "the right summed="
            )
        return codes

    return checked


@dataclass(frozen=True)
class Sums:
    """The codes that the planes of one recording give."""

    planes: int  # of a code
    start: int  # first plane
    step: int  # planes from one code to the next
    codes: int

    @property
    def bits(self) -> int:
        """The bits of a sum."""
        return self.planes.bit_length()

    @property
    def range(self) -> PlaneRange:
        """The planes that are used, by their numbers in the recording."""
        return PlaneRange(self.start, self.start + (self.codes - 1) * self.step + self.planes, self.step)

    def within(self, stored: Sums) -> Sums:
        """Return the same in planes, where the frames that are summed or chosen here are sums of planes themselves."""
        return Sums(
            self.planes * stored.planes, stored.start + self.start * stored.step, self.step * stored.step, self.codes
        )

    def of(self, read: Read) -> Read:
        """Return a function that reads codes start ... stop - 1, uint8 or (above 8 bits) uint16 [n, H, W]."""
        kind = np.uint8 if self.bits <= 8 else np.uint16

        def summed(start: int, stop: int) -> Array:
            return np.stack([self._code(read, self.start + t * self.step) for t in range(start, stop)]).astype(kind)

        def picked(start: int, stop: int) -> Array:
            if self.step == 1:
                return read(self.start + start, self.start + stop)
            places = [self.start + t * self.step for t in range(start, stop)]
            return np.concatenate([read(at, at + 1) for at in places])

        return picked if self.planes == 1 else summed

    def _code(self, read: Read, first: int) -> Array:
        """Return the sum [H, W] of the planes from `first` on, read in blocks of PLANE_PIXELS."""
        stop = first + self.planes
        block = read(first, first + 1)
        # Planes are read in blocks: a code of 16 bits sums up to 65535 of them.
        total = block[0].astype(np.uint16)
        together = max(1, PLANE_PIXELS // block[0].size)
        for at in range(first + 1, stop, together):
            total += read(at, min(at + together, stop)).sum(axis=0, dtype=np.uint16)
        return total

    def times(self, rate: float, stated: Times | None = None, each: int = 1) -> Times:
        """Return the middle of each code: by the stamps of its frames, else seconds after the recording began.

        `rate` is that of the frames that are summed or chosen here, 1/s; `each` of them is a sum of so many planes.
        """
        firsts = self.start + self.step * np.arange(self.codes)
        if stated is None:
            values = (firsts + self.planes / 2) / rate
            return Times(tuple(values.tolist()), "s", f"middles of codes, counted at {rate * each:g} planes per second")
        stamps = np.array(stated.values)
        values = (stamps[firsts] + stamps[firsts + self.planes - 1]) / 2
        return replace(stated, values=tuple(values.tolist()))

    def words(self, plane_rate: float | None) -> str:
        """Return planes of a code and both rates: `7 planes per code, 10000 planes/s, 1428.57 codes/s`."""
        count = f"{self.planes} plane{'s' if self.planes > 1 else ''} per code"
        if self.step != self.planes:
            count += f", one code every {self.step} planes"
        if plane_rate is None:
            return f"{count}, rate not stated"
        return f"{count}, {plane_rate:g} planes/s, {plane_rate / self.step:g} codes/s"

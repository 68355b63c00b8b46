"""Sums the planes of a stored stream, or chooses some of its codes: when they are read, or as a stream of its own.

NAME.npy + NAME.json (planes of 1 bit)  --PlaneSums-->  a stream of codes, which states the rates of both
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from numpy import ndarray as Array

from qsim.checks import ArgumentError
from qsim.files import Progress
from qsim.formats.importing import free_stream
from qsim.lazy_array import Crop
from qsim.plane_sums import PlaneSums, Read, Sums
from qsim.sensor import packing
from qsim.streams.stream import Stream, write_packed
from qsim.streams.stream_info import StreamInfo

_TOGETHER = 1 << 22  # codes that are packed at a time


@dataclass(frozen=True, eq=False)
class SummedStream(Stream):
    """The codes that sums of a stored stream's planes make; they are computed when they are read."""

    read: Read | None = None

    def _read(self, start: int, stop: int, crop: Crop | None) -> Array:
        assert self.read is not None
        self._existing(start, stop)
        codes = self.read(start, stop)
        if crop is None:
            return codes
        y, x, height, width = crop
        return codes[:, y : y + height, x : x + width]


def summed(stream: Stream, sums: PlaneSums) -> Stream:
    """Return the codes that sums of a stream's planes make; the same stream if nothing is asked.

    Its truth is known where its codes follow each other from the first plane on. `ArgumentError` for frames that do not
    exist, and for planes that this sensor does not sum. `ValueError` for a stream whose codes have exposures or rows of
    their own times.
    """
    if not sums.any:
        return stream
    stream.require_even("a sum of planes")
    taken = sums.over(len(stream), str(stream.path), bits=stream.bits)
    return SummedStream(stream.path, _described(stream, taken), stream.keeps, taken.of(stream.codes))


def sum_planes(
    stream: Stream, sums: PlaneSums, path: Path, *, force: bool = False, progress: Progress | None = None
) -> Stream:
    """Write the codes that sums of a stream's planes make as PATH.npy and PATH.json; return them. Errors: `summed`."""
    made = summed(stream, sums)
    npy = free_stream(path, force)
    info = replace(made.info, clip="", planes_of=stream.info.planes_of or stream.info.clip)
    codes, height, width = made.shape
    npy.parent.mkdir(parents=True, exist_ok=True)
    step = max(1, _TOGETHER // (height * width))

    def packed() -> Iterator[Array]:
        for start in range(0, codes, step):
            stop = min(start + step, codes)
            yield packing.pack(made.codes(start, stop), made.bits)
            if progress is not None:
                progress(stop, codes)

    return write_packed(npy, packed(), info)


def _described(stream: Stream, taken: Sums) -> StreamInfo:
    """Return the description of the codes that are made of a stream."""
    info = stream.info
    _, height, width = stream.shape
    sensor = stream.sensor
    if taken.planes > 1:
        if not sensor.sums_planes:
            kind = type(sensor).__name__
            raise ArgumentError("planes", f"{stream.path}: only a clocked SPAD sums planes, this is a {kind}")
        sensor = sensor.of_planes(taken.planes)
    planes = info.planes_per_code * taken.planes
    rate = info.frame_rate / taken.step
    plane_rate = info.plane_rate or info.frame_rate * info.planes_per_code
    light = None if info.light is None else info.light.over(taken.planes)
    chosen = taken.codes != len(stream) or taken.planes > 1
    return StreamInfo.of(
        sensor,
        sensor_name=info.sensor_name,
        shape=(taken.codes, height, width),
        code_model=sensor.code_model if taken.planes > 1 else info.code_model,
        exposure=info.exposure * taken.planes,
        frame_rate=rate,
        planes_per_code=planes,
        plane_rate=None if abs(rate * planes - plane_rate) <= 1e-9 * plane_rate else plane_rate,
        defects=info.defects,
        colour=info.colour,
        origin=info.origin,
        temperature=info.temperature,
        clip=info.clip,
        light=light,
        planes_of=info.planes_of,
        orientation=info.orientation,
        source=info.source,
        times=taken.times(info.frame_rate, info.times, info.planes_per_code) if chosen else info.times,
    )

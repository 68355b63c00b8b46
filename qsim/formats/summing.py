"""Writes sums of the planes of a stored stream as a stream of its own, or for other programs.

NAME.npy + NAME.json (planes of 1 bit)  --PlaneSums-->  a stream of codes, which states the rates of both
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from numpy import ndarray as Array

from qsim.checks import ArgumentError
from qsim.files import Progress
from qsim.formats.importing import free_stream
from qsim.plane_sums import PlaneSums
from qsim.sensor import packing
from qsim.streams.stream import Stream, write_packed
from qsim.streams.stream_info import StreamInfo, StreamLight

_TOGETHER = 1 << 22  # codes that are packed at a time


def sum_planes(
    stream: Stream, sums: PlaneSums, path: Path, *, force: bool = False, progress: Progress | None = None
) -> Stream:
    """Write the codes that sums of a stream's planes make as PATH.npy and PATH.json; return them.

    `ArgumentError` for frames that do not exist, and for planes that this sensor does not sum. `ValueError` for a
    stream whose codes have exposures or rows of their own times.
    """
    stream.require_even("a sum of planes")
    npy = free_stream(path, force)
    info = stream.info
    length, height, width = stream.shape
    taken = sums.over(length, str(stream.path), bits=stream.bits)
    sensor = stream.sensor
    if taken.planes > 1:
        if not sensor.sums_planes:
            kind = type(sensor).__name__
            raise ArgumentError("planes", f"{stream.path}: only a clocked SPAD sums planes, this is a {kind}")
        sensor = sensor.of_planes(taken.planes)
    planes = info.planes_per_code * taken.planes
    rate = info.frame_rate / taken.step
    plane_rate = info.plane_rate or info.frame_rate * info.planes_per_code
    light = info.light
    if light is not None:
        light = StreamLight(
            factor=light.factor, ppp=light.ppp * taken.planes, before=light.before * taken.planes, lux=light.lux
        )
    made = StreamInfo.of(
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
        light=light,
        planes_of=info.planes_of or info.clip,
        orientation=info.orientation,
        source=info.source,
        times=None if info.times is None else taken.times(info.frame_rate, info.times),
    )
    npy.parent.mkdir(parents=True, exist_ok=True)
    read = taken.of(stream.codes)
    step = max(1, _TOGETHER // (height * width))

    def packed() -> Iterator[Array]:
        for start in range(0, taken.codes, step):
            stop = min(start + step, taken.codes)
            yield packing.pack(read(start, stop), sensor.bits)
            if progress is not None:
                progress(stop, taken.codes)

    return write_packed(npy, packed(), made)

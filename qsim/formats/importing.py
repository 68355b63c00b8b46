"""Opens foreign recordings and writes them as clips (light) or streams (codes).

    photon cube .npy (.gz), codes and light .npy, mp4, PNG, TIFF, SwissSPAD2 and SPAD512S .bin, visionsim, zarr, .mat,
    spike .dat  ->  Recording  ->  a clip of relative radiance (light), or a stream NAME.npy + NAME.json (codes)

Facts that a file does not state (size, rate, transfer curve, which of two layouts) must be given; they are not guessed.
The order of bits and the orientation follow from the layout; assumptions are stored in `source`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import files, scratch
from qsim.checks import ArgumentError, file_path
from qsim.clip import exr
from qsim.clip.clip_info import ClipInfo, Saturation
from qsim.clip.manifest import check_outside
from qsim.clip.source import Source
from qsim.clip.writer import ClipWriter
from qsim.files import Progress
from qsim.formats import gaps
from qsim.formats.between_frames import at_rate
from qsim.formats.detection import ASSUMED, LAYOUTS, detect
from qsim.formats.recording import Hints, Marked, Recording, reoriented, with_stated_layout
from qsim.host import own_numbers
from qsim.kinds import Split
from qsim.plane_sums import AS_STORED, PlaneSums, within_sum
from qsim.sensor import colour_filter, devices, packing
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.defects import defect_table
from qsim.sensor.defects.pixel_array import PixelArray
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD
from qsim.streams.clip import Clip
from qsim.streams.stream import Stream, is_stream, write_packed
from qsim.streams.stream_info import StreamInfo
from qsim.temporary_folder import TemporaryFolder


def read(
    path: Path | str, hints: Hints | None = None, *, compared: tuple[str, ...] = (), timed: bool = False
) -> Recording:
    """Open a foreign file or folder; frames are read on demand.

    Lost frames and uneven times are told, unless the caller takes frames at their times (`timed`). `ValueError` for a
    hint without effect on this file, except those that the caller `compared` with it.
    """
    path = file_path(path)
    hints = hints or Hints()
    layout = hints.layout or detect(path, hints)
    if layout not in LAYOUTS:
        raise ValueError(f"layout {layout!r}: known are {', '.join(LAYOUTS)}")
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    recording = LAYOUTS[layout].read(path, hints)
    acting = {"layout", "flip", "columns", *compared, *LAYOUTS[layout].takes(recording)}
    if recording.times is not None and not timed:
        acting.add("keep_gaps")
    hints.refuse(path, recording.format, *(field.name for field in fields(Hints) if field.name not in acting))
    if layout in ASSUMED:
        recording = with_stated_layout(recording, *ASSUMED[layout])
    turned = reoriented(recording, hints)
    return turned if timed else gaps.told(path, turned, hints.keep_gaps)


def read_at_rate(path: Path | str, hints: Hints, rate: float, frame_rate: float | None = None) -> Recording:
    """Open a foreign file of light with frames at an even `rate` [1/s], those between its own estimated.

    Its frames are at the times that it states, or with `frame_rate` evenly. The curve of a video is sRGB unless `hints`
    states another. Errors as of `read` and `between_frames.at_rate`.
    """
    path = file_path(path)
    if hints.transfer is None and (hints.layout or detect(path, hints)) == "video":
        hints = replace(hints, transfer="srgb")
    return at_rate(path, read(path, hints, timed=frame_rate is None), rate, frame_rate)


@own_numbers
def from_video(  # noqa: PLR0913 (settings of a public function)
    video: str | os.PathLike[str],
    path: str | os.PathLike[str] | None = None,
    *,
    rate: float,
    frame_rate: float | None = None,
    transfer: str = "srgb",
    black: float | None = None,
    white: float | None = None,
    split: Split | None = None,
    progress: Progress | None = None,
    force: bool = False,
) -> Clip:
    """Return the clip of a video at `rate` frames per second; those between its own are estimated by optical flow.

    Its frames are at the times that the file states, or at `frame_rate`: of a slow-motion film that is the rate of its
    capture. `transfer` is the curve of its light, `black` the pixel value of darkness and `white` that of saturation.
    The light is relative and luminance alone. `path` is the folder of the clip; without it, the clip lies in a
    temporary folder that is deleted after its last use. `progress(done, frames)` is called as frames are written.
    `ValueError`, `FileNotFoundError` or `FileExistsError` where the arguments do not fit.

        clip = qsim.from_video("phone.mp4", rate=2000)
    """
    if path is None and force:
        raise ValueError("force= replaces the clip of a folder, and no path is given; leave it out")
    recording = read_at_rate(Path(video), Hints(transfer=transfer, black=black, white=white), rate, frame_rate)
    temporary = TemporaryFolder() if path is None else None
    stem = Path(video).stem
    name = stem if files.NAME.fullmatch(stem) else "video"
    target = temporary.path / name if temporary else Path(path or "")
    clip = to_clip(recording, target, Import(rate, split=split), force=force, progress=progress)
    return replace(clip, keeps=temporary)


@dataclass(frozen=True)
class Import:
    """Facts about a recording that its files rarely state."""

    frame_rate: float  # Hz
    exposure: float | None = None  # s; None: the whole frame
    sensor: str | None = None  # of codes: a name of qsim.devices, or a .toml file
    ppp: float | None = None  # of codes: mean light level, where the sensor's gain follows it
    split: Split | None = None  # of light: train, val or test

    def __post_init__(self) -> None:
        if not 0 < self.frame_rate < float("inf"):
            raise ValueError(f"frame rate: expected frames per second above 0, got {self.frame_rate!r}")
        if self.exposure is not None and not 0 < self.exposure <= 1 / self.frame_rate * (1 + 1e-9):
            raise ValueError(
                f"exposure {self.exposure!r} s: expected more than 0 and at most a frame's {1 / self.frame_rate:g} s"
            )

    @property
    def seconds(self) -> float:
        return self.exposure if self.exposure is not None else 1 / self.frame_rate


def to_clip(
    recording: Recording, path: Path, capture: Import, *, force: bool = False, progress: Progress | None = None
) -> Clip:
    """Write light as a clip of relative radiance; `ValueError` for codes.

    All frames are read, also those that an interrupted import stored: the recording may be another one.
    """
    if not recording.is_light:
        raise ValueError(
            f"{path}: {recording.format} holds codes, not light; name a stream to make, as in out/capture.npy"
        )
    if capture.sensor is not None or capture.ppp is not None:
        name = "sensor" if capture.sensor is not None else "ppp"
        raise ValueError(f"{path}: {recording.format} holds light, which no sensor made; leave {name}= out")
    check_outside(path)
    capture = _as_stated(path, recording, capture)
    recording = _within_halves(recording)
    frames, height, width = recording.shape
    info = ClipInfo(
        shape=(frames, height, width),
        frame_rate=capture.frame_rate,
        shutter=capture.seconds * capture.frame_rate,
        exposure=capture.seconds,
        source=recording.source,
        split=capture.split,
        saturation=Saturation(white=recording.white, assumed=recording.white_assumed),
        times=recording.times,
    )
    marked = recording.marked or _unmarked(recording)
    with ClipWriter(path, info, force=force) as writer:
        for start, stop in _ranges(recording):
            for t, image, mask in zip(range(start, stop), *marked(start, stop), strict=True):
                writer.add(t, image, saturated=mask)
            if progress is not None:
                progress(stop, frames)
    return Clip.open(path)


def _within_halves(recording: Recording) -> Recording:
    """Return light in a unit in which half floats hold it: floats beyond their range are scaled by a power of 2.

    `scale` of its source is the light of the clip over that of the file.
    """
    if recording.full_scale:
        return recording
    largest = max(float(light.max(initial=0)) for _, light in blocks(recording))
    if largest == 0 or exr.SMALLEST <= largest <= exr.HALF_MAX:
        return recording
    most = exr.HALF_MAX if largest > exr.HALF_MAX else 1.0
    scale = 2.0 ** math.floor(math.log2(most / largest))
    marked = recording.marked or _unmarked(recording)

    def scaled(start: int, stop: int) -> tuple[Array, Array]:
        light, mask = marked(start, stop)
        return (light.astype(np.float64) * scale).astype(np.float32), mask

    said = f"light of up to {largest:g} is scaled by {scale:g}, because clips hold half floats"
    reading = "; ".join(filter(None, (recording.reading, said)))
    source = replace(recording.source, scale=scale)
    return replace(recording, read=lambda a, b: scaled(a, b)[0], marked=scaled, source=source, reading=reading)


def _unmarked(recording: Recording) -> Marked:
    """Return the light of a recording without information on saturation."""

    def marked(start: int, stop: int) -> tuple[Array, Array]:
        light = recording.read(start, stop)
        return light, np.zeros(light.shape, bool)

    return marked


def saturation_line(clip: Clip) -> str:
    """Return a line about the saturation of an imported clip: its white and the share of saturated pixels."""
    known = clip.info.saturation or Saturation(assumed=True)
    source = clip.info.source or Source()
    white = known.white
    count = (clip.info.saturated_pixels or 0) - len(source.missing_frames) * math.prod(clip.shape[1:])
    share = f"{100 * count / math.prod(clip.shape):.3g} % of pixels"
    cut = "" if source.scale is None else f"; the light of the file is scaled by {source.scale:g}"
    if white is None:
        return "saturation not known: floats have no largest value; give it with white=" + cut
    said = f"white {white:g}{' assumed' if known.assumed else ''}"
    if count:
        return f"{said}: {share} saturated{cut}"
    return f"{said}: no pixel reaches it{cut}" + (
        "; if the camera saturates below it, give white=" if known.assumed else ""
    )


def to_stream(
    recording: Recording,
    path: Path,
    capture: Import,
    *,
    sums: PlaneSums = AS_STORED,
    force: bool = False,
    progress: Progress | None = None,
) -> Stream:
    """Write codes as a stream without a clip: PATH.npy and PATH.json. The default sensor is an ideal counter.

    Planes of one bit are summed as asked; the rate and the exposure of `capture` are those of a frame of the recording:
    of a plane, or of a sum that the camera made. Codes that are chosen or summed have their times. Tables [defects]
    and [colour] of a sensor's file are stored: they belong to the frames as they are written.
    """
    if recording.bits is None:
        raise ValueError(
            f"{path}: {recording.format} holds light, not codes; name a clip folder to make, as in out/clip"
        )
    _check_stream(path, recording, capture)
    npy = free_stream(path, force)
    length, height, width = recording.shape
    capture = _as_stated(path, recording, capture)
    taken = sums.over(length, recording.format, bits=recording.bits, bare=recording.source.bitplanes is None)
    if sums.summed is not None:
        recording = _of_sums(recording, sums.summed, path)
    many = taken.planes * (sums.summed or 1)
    sensor, tables = _tables(capture, _sensor(recording, capture, many), height, width)
    model = recording.code_model if sensor.sums_planes else sensor.code_model
    chosen = taken.codes != length or taken.planes > 1
    times = taken.times(capture.frame_rate, recording.times, sums.summed or 1) if chosen else recording.times
    planes = many
    if planes == 1 and model == "binary_sum":
        planes = sensor.levels - 1
    frames = taken.codes
    if sums.any:
        recording = replace(recording, shape=(frames, height, width), read=taken.of(recording.read))
    npy.parent.mkdir(parents=True, exist_ok=True)

    def packed() -> Iterator[Array]:
        for start, block in blocks(recording):
            yield packing.pack(block, sensor.bits)
            if progress is not None:
                progress(start + len(block), frames)

    info = StreamInfo.of(
        sensor,
        sensor_name=capture.sensor or "",
        shape=(frames, height, width),
        orientation=recording.source.orientation or "unknown",  # upright only if a reader states it
        code_model=model,
        planes_per_code=planes,
        frame_rate=capture.frame_rate / taken.step,
        plane_rate=None if taken.step == taken.planes else capture.frame_rate * (sums.summed or 1),
        exposure=capture.seconds * taken.planes,
        source=recording.source,
        times=times,
        **tables,
    )
    return write_packed(npy, packed(), info)


def _of_sums(recording: Recording, planes: int, path: Path) -> Recording:
    """Return a recording whose codes a camera made as sums of so many planes."""
    bits = recording.bits or 1
    if planes.bit_length() > bits or recording.code_model != "binary_sum":
        held = f"{bits}-bit codes ({recording.code_model})"
        raise ArgumentError("summed", f"{recording.format} holds {held}, no sums of {planes} planes; leave it out")
    read = within_sum(recording.read, planes, str(path))
    return replace(recording, bits=planes.bit_length(), read=read)


def _check_stream(path: Path, recording: Recording, capture: Import) -> None:
    """Raise `ValueError` for what a stream cannot state, and for sums that are no codes of it."""
    if capture.split is not None:
        raise ValueError(f"{path}: split= is stored in clips, and {recording.format} becomes a stream; leave it out")
    if capture.ppp is not None and capture.sensor is None:
        raise ValueError(f"{path}: ppp= sets the gain of a named sensor; name it with sensor=, or leave ppp= out")
    device = devices.DEVICES.get(str(capture.sensor))
    if capture.ppp is not None and not (device is not None and device.follows_light):
        raise ValueError(f"{path}: ppp= changes nothing for {capture.sensor}, whose gain is fixed; leave it out")


def free_stream(path: Path, force: bool) -> Path:
    """Return the file of a stream's codes; `FileExistsError` if it or its description exists and is not replaced."""
    check_outside(path)
    scratch.sweep(path.parent)
    stem = path.with_suffix("") if path.suffix in (".npy", ".json") else path
    npy, description = (stem.with_name(f"{stem.name}{end}") for end in (".npy", ".json"))  # a stem may hold dots
    for file in (npy, description):
        if file.exists() and not force:
            raise FileExistsError(f"{file}: exists; name another, or replace it with force=True")
        if file.exists() and (not description.is_file() or not is_stream(description)):
            raise FileExistsError(
                f"{file}: is not a stream, which is all that is replaced; move it away, or name another"
            )
    return npy


def _as_stated(path: Path, recording: Recording, capture: Import) -> Import:
    """Return the capture with the exposure that the recording states; `ValueError` for rates that contradict it."""
    rate = recording.frame_rate
    exposure = recording.exposure
    if rate is None or exposure is None:
        return capture
    given = (("frame_rate", capture.frame_rate, rate), ("exposure", capture.exposure or exposure, exposure))
    for name, value, stated in given:
        if not math.isclose(value, stated, rel_tol=1e-6):
            raise ValueError(f"{path}: {name}={value:g}: {recording.format} state {stated:g}; leave it out")
    return replace(capture, exposure=exposure)


def blocks(recording: Recording) -> Iterator[tuple[int, Array]]:
    """Yield the frames in order as blocks: (number of the first, frames [t, H, W])."""
    for start, stop in _ranges(recording):
        yield start, recording.read(start, stop)


def _ranges(recording: Recording) -> Iterator[tuple[int, int]]:
    """Yield the range of each block: (first, last + 1)."""
    frames, height, width = recording.shape
    step = max(1, min(256, (1 << 25) // (height * width)))
    for start in range(0, frames, step):
        yield start, min(start + step, frames)


def _sensor(recording: Recording, capture: Import, planes: int) -> Sensor:
    """Return the sensor of the codes of a recording of which so many are summed, by default an ideal one."""
    stored = recording.source.bitplanes
    if capture.sensor is not None and (planes > 1 or stored is not None):
        many = stored or planes
        whole = (recording.bits or 1) > 1  # the seconds of a frame are those of its sum
        seconds = capture.seconds / (many if whole else 1)
        named = "summed" if whole else "planes"
        return devices.load_sum(capture.sensor, many, ppp=capture.ppp, exposure=seconds, argument=named)
    if capture.sensor is not None:
        return devices.load(capture.sensor, ppp=capture.ppp, bits=recording.bits, exposure=capture.seconds)
    if recording.code_model == CountingSPAD.code_model:
        return CountingSPAD(pde=1.0, dark_count_rate=0.0, dead_time=0.0, bits=recording.bits or 1)
    ideal = BinarySPAD(pde=1.0, dark_count_rate=0.0, bits=recording.bits or 1)
    many = stored or planes
    return ideal.of_planes(many) if many > 1 else ideal


def _tables(capture: Import, sensor: Sensor, height: int, width: int) -> tuple[Sensor, dict[str, Any]]:
    """Return the sensor with the dark rate of its measured map, and the other tables of its file, for a description."""
    if capture.sensor is None or not capture.sensor.endswith(".toml"):
        return sensor, {}
    defects = defect_table.from_toml(capture.sensor)
    filters = colour_filter.from_toml(capture.sensor)
    found: dict[str, Any] = {} if filters is None else {"colour": filters}
    if defects is None:
        return sensor, found
    return PixelArray.of(defects, sensor, height, width).sensor, found | {"defects": defects.to_dict()}

"""Few-bit streams of a clip: sensing, storing, reading, replaying.

    clip (radiance) --light level, optics--> photons --sensor, key--> codes --> streams/NAME.npy + streams/NAME.json

NAME.npy is uint8 [T, H, ceil(W*bits/8)], each row packed alone, most significant bit first: one bit is a photon cube.
NAME.json is written last and holds everything needed to draw any frame again: sensor, light factor, key, widths.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray as Array

from qsim import files, locks, structure
from qsim.clip.simulation import Draw, prepare, stored
from qsim.files import VERSION, Progress, check_name
from qsim.optics import radiometry
from qsim.sensor import packing

if TYPE_CHECKING:
    from qsim.clip.clip import Clip
    from qsim.sensor.sensor import Sensor

FORMAT_VERSION = 1
_DAMAGED = "the file is damaged, sense again with --force"


@dataclass(frozen=True, eq=False)
class Stream:
    """Codes of one clip seen by one sensor at one light level."""

    path: Path  # streams/NAME.npy
    meta: dict[str, Any]  # streams/NAME.json

    @staticmethod
    def open(json_path: Path) -> Stream:
        """`FileNotFoundError` if there is no such stream, `ValueError` if its description is damaged."""
        if not json_path.is_file():
            raise FileNotFoundError(f"{json_path}: no such stream")
        meta = files.read_json(json_path)
        files.check_version(json_path, meta.get("format_version"), FORMAT_VERSION)
        structure.structure(json_path, meta, structure.STREAM, _DAMAGED)
        bits, width = meta["sensor"].get("bits", meta["bits"]), meta["shape"][2]
        if (bits, width) != (meta["bits"], meta["width"]):
            raise ValueError(f"{json_path}: bits or width contradict the sensor or the shape; {_DAMAGED}")
        files.check_own(json_path, meta, _DAMAGED)
        return Stream(json_path.with_suffix(".npy") if json_path.suffix == ".json" else json_path, meta)

    def __len__(self) -> int:
        return int(self.meta["shape"][0])

    def __repr__(self) -> str:
        frames, height, width = self.shape
        ppp = self.meta.get("ppp")
        light = "" if ppp is None else f", {ppp:.4g} photons/pixel"
        return (
            f"<Stream {self.name}: {frames} codes of {self.bits} bit, {height} x {width} px, at "
            f"{float(self.meta['frame_rate']):g}/s, exposure {self.exposure * 1e6:.4g} us{light}>"
        )

    @property
    def name(self) -> str:
        return self.path.name.removesuffix(".npy")

    @property
    def bits(self) -> int:
        return int(self.meta["bits"])

    @property
    def shape(self) -> tuple[int, int, int]:
        """(T, H, W) of the codes, before packing."""
        frames, height, width = self.meta["shape"]
        return frames, height, width

    @property
    def exposure(self) -> float:
        """Seconds of one code (of one plane, where a code sums planes of its own clip frames, times their number)."""
        return float(self.meta["exposure"])

    @property
    def photons_factor(self) -> float:
        """photons seen by the sensor = this factor times the clip's expected photons."""
        return float(self.meta["ppp_factor"])

    @cached_property
    def sensor(self) -> Sensor:
        from qsim.sensor import devices

        return devices.from_dict(self.meta["sensor"], where=f"{self.path.with_suffix('.json')}: sensor")

    @cached_property
    def packed(self) -> Array:
        """The packed array [T, H, ceil(W*bits/8)] as a memory map; `ValueError` if the file does not fit its json.

        Also if both were replaced since the stream was opened. Once mapped, the codes stay those of this json.
        """
        while True:
            before = self._written()
            array = self._mapped()
            if self._written() == before:  # no writer came between json and codes
                return array

    def _written(self) -> tuple[int, ...]:
        """Which file the json is now; `ValueError` if it describes other codes than when it was opened."""
        described = self.path.with_suffix(".json")
        problem = f"{described}: was replaced since it was opened; open the stream again"
        try:
            status = described.stat()
            now = files.read_json(described)
        except FileNotFoundError:
            raise ValueError(problem) from None
        if now.get("sha256", now) != self.meta.get("sha256", self.meta):
            raise ValueError(problem)
        return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns

    def _mapped(self) -> Array:
        frames, height, width = self.shape
        expected = (frames, height, packing.packed_width(width, self.bits))
        if not self.path.is_file():
            raise FileNotFoundError(f"{self.path}: no such file, though its json is there; sense again with --force")
        array = files.load_array(self.path)
        if array.shape != expected or array.dtype != np.uint8:
            raise ValueError(
                f"{self.path}: expected uint8 {list(expected)}, found {array.dtype} {list(array.shape)}; "
                "sense again with --force"
            )
        return array

    def codes(self, start: int = 0, stop: int | None = None, crop: radiometry.Crop | None = None) -> Array:
        """Codes [stop - start, h, w] of frames start ... stop - 1: uint8, uint16 above 8 bits; crop = (y, x, h, w)."""
        frames, height, width = self.shape
        stop = frames if stop is None else stop
        if not 0 <= start < stop <= frames:
            raise ValueError(f"{self.path}: frames {start}..{stop} asked for, the stream has {frames}")
        if crop is None:
            return packing.unpack(np.asarray(self.packed[start:stop]), self.bits, width)
        y, x, h, w = check_crop(crop, height, width, str(self.path))
        # The packed bytes that hold the columns: from the last code that starts on a byte.
        step = 8 // math.gcd(8, self.bits)
        first = x // step * step
        low, high = first * self.bits // 8, packing.packed_width(x + w, self.bits)
        part = np.asarray(self.packed[start:stop, y : y + h, low:high])
        return packing.unpack(part, self.bits, x + w - first)[..., x - first :]

    def verify(self, progress: Progress | None = None) -> list[str]:
        """Problems of the stream's files in words; empty if they are what was written."""
        problems = files.differs(self.path, self.meta.get("sha256"))
        try:
            if problems:
                self._written()
        except ValueError as error:  # replaced meanwhile
            return [str(error)]
        return problems

    def unsealed(self) -> list[Path]:
        """The description, if it holds no checksum of its own: an earlier version made it."""
        return [] if "checksum" in self.meta else [self.path.with_suffix(".json")]


def check_crop(crop: radiometry.Crop, height: int, width: int, where: str) -> radiometry.Crop:
    """The crop (y, x, h, w) if it lies inside the frame, else `ValueError`."""
    y, x, h, w = crop
    if y < 0 or x < 0 or h < 1 or w < 1 or y + h > height or x + w > width:
        raise ValueError(f"{where}: crop (y, x, h, w) = {(y, x, h, w)} is not inside {height} x {width} pixels")
    return crop


def orientation(meta: dict[str, Any]) -> str:
    """Of a clip or stream: what its reader said of the file it was imported from; what we rendered is upright."""
    origin = meta.get("source")
    imported = origin.get("orientation", "upright") if isinstance(origin, dict) else "upright"
    return str(meta.get("orientation", imported))


def write_stream(clip: Clip, name: str, codes_iter: Iterable[Array], sensor: Sensor, meta: dict[str, Any]) -> Stream:
    """Store codes ([H, W] frames or [t, H, W] blocks, in order) as a stream of `clip`; the json comes last.

    `meta` must hold shape (T, H, W), ppp_factor, exposure and frame_rate. `ValueError` if there are not T frames.
    """
    shape = tuple(meta["shape"][1:])

    def packed() -> Iterator[Array]:
        done = 0
        for block in codes_iter:
            block = block if block.ndim == 3 else block[None]
            if block.shape[1:] != shape:
                raise ValueError(f"{clip.path}, {name}: frame {done} is {block.shape[1:]}, expected {shape}")
            yield packing.pack(block, sensor.bits)
            done += len(block)

    return write_packed(clip, name, packed(), sensor, meta)


def write_packed(clip: Clip, name: str, blocks: Iterable[Array], sensor: Sensor, meta: dict[str, Any]) -> Stream:
    """As `write_stream` for blocks that are packed already: uint8 [t, H, ceil(W bits / 8)]."""
    with writing(clip):
        return _write(clip, name, blocks, sensor, meta)


@contextlib.contextmanager
def writing(clip: Clip, on_wait: Callable[[], None] | None = None) -> Iterator[None]:
    """One process at a time writes streams of a clip; the others wait, after a call of `on_wait`."""
    folder = clip.path / "streams"
    folder.mkdir(exist_ok=True)
    lock = locks.Lock(folder / "lock")
    lock.acquire(wait=True, on_wait=on_wait)
    try:
        yield
    finally:
        lock.delete()


def _tidy(clip: Clip) -> None:
    """Delete the lock of a writer that was killed between writing its stream and deleting it."""
    lock = locks.Lock(clip.path / "streams" / "lock")
    with contextlib.suppress(OSError):  # a folder that may only be read
        if lock.path.exists() and lock.acquire():
            lock.delete()


def _write(clip: Clip, name: str, blocks: Iterable[Array], sensor: Sensor, meta: dict[str, Any]) -> Stream:
    """Write the codes and the json; the caller holds the clip's lock."""
    frames, height, width = meta["shape"]
    bits = sensor.bits
    row = packing.packed_width(width, bits)
    folder = clip.path / "streams"
    json_path, path = folder / f"{check_name(name)}.json", folder / f"{name}.npy"
    for file in (json_path, path):
        files.remove_leftovers(file)
    done, digest = 0, hashlib.sha256()
    with files.replacing_described(path, json_path) as (stored, described):
        head = _header(frames, height, row)
        stored.write(head)
        digest.update(head)
        for block in blocks:
            if block.shape[1:] != (height, row) or block.dtype != np.uint8:
                raise ValueError(f"{path}: packed frame {done} is {block.dtype} {block.shape[1:]}, not {(height, row)}")
            part = np.ascontiguousarray(block).data
            stored.write(part)
            digest.update(part)
            done += len(block)
        if done != frames:
            raise ValueError(f"{path}: got {done} frames, expected {frames}")
        full = {
            "format_version": FORMAT_VERSION,
            "bits": bits,
            "width": width,
            "bit_order": "msb",
            "orientation": orientation(clip.meta),
            "code_model": sensor.code_model,
            "sensor": sensor.to_dict(),
            "planes_per_code": 1,
            "sha256": digest.hexdigest(),
            "software": {"qsim": VERSION},
        } | meta
        full["shape"] = [frames, height, width]
        described.write(files.to_json(files.sealed(full)))
    return Stream.open(json_path)


def _header(*shape: int) -> bytes:
    """The head of a .npy of bytes."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "|u1", "fortran_order": False, "shape": shape})
    return file.getvalue()


@dataclass(frozen=True)
class Sensing:
    """What to draw: a sensor at a light level, with a seed; independent of the clip."""

    sensor: str  # a name of qsim.devices or a .toml file
    bits: int | None = None  # None: the device's own
    ppp: float | None = None  # photons per pixel and code over the whole clip; neither ppp nor lux: light as it is
    lux: float | None = None  # faceplate lux at 555 nm
    seed: int = 0
    name: str | None = None  # of the stream; made from the rest if None
    group: bool = False  # a code sums 2^bits - 1 binary planes, each its own clip frame
    diffraction: bool = False  # blur by the lens's Airy pattern
    defects: str | None = None  # .toml with a table [defects]; None: that of the sensor's file, if it has one
    slices: int = 1  # clip frames in one exposure of a counting SPAD: light that changes inside it

    @property
    def stream_name(self) -> str:
        """The given name, or for example `quiver-physical_3bit_3.25ppp`."""
        if self.name is not None:
            return check_name(self.name)
        light = (
            "asis" if self.ppp is self.lux is None else f"{self.ppp:g}ppp" if self.lux is None else f"{self.lux:g}lx"
        ).replace("e+", "e")  # a name holds no +
        bits = "" if self.bits is None else f"_{self.bits}bit"
        seed = f"_seed{self.seed}" if self.seed else ""
        sensor = Path(self.sensor).name.removesuffix(".toml")
        return check_name(f"{sensor}{bits}_{light}{seed}")


def describe(clip: Clip, sensing: Sensing, draw: Draw) -> dict[str, Any]:
    """The json of the stream that `draw` makes, without what only the written file knows."""
    frames, height, width = clip.shape
    return {
        "shape": [frames // draw.planes, height, width],
        "sensor_name": sensing.sensor,
        "ppp_target": sensing.ppp,
        "lux_target": sensing.lux,
        "ppp": draw.level.ppp * draw.planes,
        "ppp_factor": draw.level.factor,
        "mean_photons_before": draw.level.mean_before * draw.planes,
        "equivalent_lux_555nm": draw.level.lux,
        "radiance_unit": clip.meta["radiance_unit"],
        "transfer": "linear",
        "diffraction": draw.diffraction,
        "seed": draw.key.seed,
        "clip_key": draw.key.clip,
        "clip": clip.name,
        "frame_rate": clip.frame_rate / draw.planes,
        "exposure": clip.exposure * draw.planes,
        "planes_per_code": draw.planes,
        "drawn_by": draw.law,
    } | ({} if draw.flaws is None else {"defects": draw.flaws.to_dict()})


def sense(
    clip: Clip,
    sensing: Sensing,
    *,
    force: bool = False,
    progress: Progress | None = None,
    on_wait: Callable[[], None] | None = None,
) -> tuple[Stream, str]:
    """Draw and store a stream; returns it and its line of light. A stream that is already there as asked is kept.

    Waits, after a call of `on_wait`, while another process senses this clip. `FileExistsError` if the name is taken by
    another stream and `force` is not set.
    """
    draw = prepare(clip, sensing)
    meta = describe(clip, sensing, draw)
    line = draw.level.line(clip, draw.planes * electrons_per_photon(draw.sensor))
    missed = draw.missed(clip)
    if missed is not None:
        from qsim.sensor.defects.event_simulation import TOLERANCE

        draw = dataclasses.replace(draw, followed=missed if missed.largest > TOLERANCE else None)
        meta["drawn_by"] = draw.law
        meta["dead_time_effects"] = dataclasses.asdict(missed)
        line += f"; {missed}: {'photon by photon' if draw.followed else 'below ' + str(TOLERANCE) + ', closed form'}"
    kept = None if force else _kept(clip, sensing, draw, meta)
    if kept is not None:
        _tidy(clip)
        return kept, line
    with writing(clip, on_wait):
        kept = None if force else _kept(clip, sensing, draw, meta)  # made by the process that was waited for
        if kept is not None:
            return kept, line
        blocks = draw.packed(clip, meta["shape"][0], progress)
        return _write(clip, sensing.stream_name, blocks, draw.sensor, meta), line


def _kept(clip: Clip, sensing: Sensing, draw: Draw, meta: dict[str, Any]) -> Stream | None:
    """The stream that is there as asked, or None; `FileExistsError` if another one has its name."""
    json_path = clip.path / "streams" / f"{sensing.stream_name}.json"
    try:
        old = Stream.open(json_path)
    except FileNotFoundError:
        return None
    if (
        all(old.meta.get(key, value if key == "drawn_by" else None) == value for key, value in meta.items())
        and old.meta.get("defects") == meta.get("defects")
        and old.meta["sensor"] == draw.sensor.to_dict()
    ):
        return old
    raise FileExistsError(f"{json_path}: exists with other settings; name this stream with --name, or use --force")


def replay(clip: Clip, stream: Stream, frame: int) -> tuple[Array, Array]:
    """One frame drawn again from the stream's json alone, and the stored one: both codes [H, W]."""
    if not 0 <= frame < len(stream):
        raise ValueError(f"{stream.path}: frame {frame} asked for, the stream has frames 0..{len(stream) - 1}")
    return stored(stream).frames(clip, frame, frame + 1)[0], stream.codes(frame, frame + 1)[0]


def electrons_per_photon(sensor: Sensor) -> float:
    """Quantum or photon-detection efficiency of a sensor, for the line of light."""
    described = sensor.to_dict()
    return float(described.get("quantum_efficiency", described.get("pde", 1.0)))

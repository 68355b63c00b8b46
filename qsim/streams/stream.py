"""Reads and writes few-bit streams: packed codes and the description from which they can be drawn again.

NAME.npy is uint8 [T, H, ceil(W*bits/8)], each row packed alone, most significant bit first: one bit is a photon cube.
NAME.json is written last. It holds all that a frame is drawn from: sensor, light factor, key, widths.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import ndarray as Array

from qsim import colour, descriptions, files, locks, scratch
from qsim.clip.clip_folder import ClipFolder
from qsim.clip.film import Film, card
from qsim.files import VERSION, Progress
from qsim.host import own_numbers
from qsim.lazy_array import Crop, LazyArray
from qsim.optics.radiometry import check_crop
from qsim.plane_sums import Sums
from qsim.sensor import packing
from qsim.sensor.defects import defect_table, good_pixels
from qsim.sensor.defects.defect_table import Defects
from qsim.streams.code_truth import CodeTruth
from qsim.streams.exposures import Timing
from qsim.streams.rows import Rows
from qsim.streams.stream_info import StreamInfo

if TYPE_CHECKING:
    from qsim.sensor.colour_filter import ColourFilter
    from qsim.sensor.sensor import Sensor

IN_CACHE = 1 << 18  # packed bytes that are unpacked at once
_DAMAGED = "the file is damaged: sense it again and replace it"


@own_numbers
@dataclass(frozen=True, eq=False)
class Stream:
    """Codes of one clip seen by one sensor at one light level."""

    path: Path  # streams/NAME.npy
    info: StreamInfo  # streams/NAME.json
    keeps: object = field(default=None, repr=False)  # a temporary folder: it lasts as long as a reference to it

    @staticmethod
    def open(json_path: str | Path) -> Stream:
        """Open a stream; `FileNotFoundError` if it does not exist, `ValueError` if its description is damaged."""
        return Stream(*descriptions.opened(json_path, StreamInfo, "stream", _DAMAGED))

    def __len__(self) -> int:
        return self.info.shape[0]

    @property
    def times(self) -> Array | None:
        """When each code was taken, as the source of an imported stream states it, float64 [T]; else None."""
        times = self.info.times
        return None if times is None else np.array(times.values, np.float64)

    def __repr__(self) -> str:
        frames, height, width = self.shape
        light = "" if self.info.light is None else f", {self.info.light.ppp:.4g} photons/pixel"
        return (
            f"<Stream {self.name}: {frames} codes of {self.bits} bit, {height} x {width} px, at "
            f"{self.info.frame_rate:g}/s, exposure {self.exposure * 1e6:.4g} us{light}>"
        )

    def _repr_html_(self) -> str:
        """Return the codes of the middle frame and the facts of `repr`, for notebooks."""
        middle = self[len(self) // 2]
        return card(repr(self), colour.tone(middle, colour.peak(middle)))

    def show(self, start: int = 0, stop: int | None = None, fps: float = 12.0) -> Film:
        """Return the codes of frames start ... stop - 1 (at most 100 by default) as a film that notebooks show.

        `fps` is the speed of the film, in frames per second.
        """
        return Film.of(self.name, self.codes, start, stop, fps)

    def __getitem__(self, index: Any) -> Array:
        """Return codes as an array [T, H, W] would: `stream[3]` is [H, W], `stream[2:5]` is [3, H, W]."""
        return self.codes[index]

    def __iter__(self) -> Iterator[Array]:
        """Yield the codes of each frame, [H, W]."""
        return iter(self.codes)

    @property
    def codes(self) -> LazyArray:
        """All codes [T, H, W], uint8 or (above 8 bits) uint16, read when they are used: `stream.codes[3]`.

        `stream.codes(start, stop, crop)` reads a part; crop = (y, x, height, width) [px]. `ValueError` for frames or
        pixels that do not exist.
        """
        return LazyArray(self.shape, np.dtype(packing.code_dtype(self.bits)), self._read)

    @property
    def colour_filter(self) -> ColourFilter | None:
        """The colour filter array over the pixels, from the first one on; None: all pixels see one band."""
        return self.info.colour

    @property
    def defects(self) -> Defects | None:
        """The defects of the pixels; None without any. `ValueError` or `OSError` if a measured map has changed."""
        where = f"{self.path.with_suffix('.json')}: defects"
        return defect_table.from_dict(self.info.defects, where) if self.info.defects else None

    def good_pixels(self) -> tuple[Sensor, str]:
        """Return the sensor of the pixels without defects, and which defects its response leaves out, as text."""
        light = None if self.info.light is None else self.info.light.ppp
        return good_pixels.of_table(
            self.sensor, self.info.defects, light, self.exposure, self.info.shape[1:], self.info.origin
        )

    @cached_property
    def clip(self) -> ClipFolder:
        """The clip that these codes were sensed from; `FileNotFoundError` if they do not lie in its folder."""
        folder = self.path.absolute().parents[1]
        if not (folder / "clip.json").is_file():
            raise FileNotFoundError(f"{self.path}: does not lie in the folder of a clip, so its light is not known")
        return replace(ClipFolder.open(folder), keeps=self.keeps)

    def truth(self, start: int = 0, stop: int | None = None, *, at: str = "row") -> Array:
        """Return the photons that a perfect restorer would find, float64 [stop - start, H, W].

        Those of a colour clip are [stop - start, 3, H, W]. They are expected photons per pixel and exposure at
        mid-exposure, without blur. A code of several clip frames has the light of its middle one times their number:
        of an even number the later of two, half a clip frame late. Where rows have their own time, each is that of the
        frame nearest to its mid-exposure; `at="frame"` takes all from the middle of the code, undistorted by motion.
        `ValueError` for frames that do not exist and imported streams, `FileNotFoundError` for a stream without a clip.
        """
        if at not in ("row", "frame"):
            raise ValueError(f"{self.path}: truth at the time of each row or of the middle of the frame, got {at!r}")
        frames = self._existing(start, len(self) if stop is None else stop)
        return self.code_truth.video(frames.start, frames.stop, at=at)

    @cached_property
    def code_truth(self) -> CodeTruth:
        """The truth of each code: sharp and mean light, flow to the next, validity, depth and bodies.

        `ValueError` for an imported stream, `FileNotFoundError` for one without a clip.
        """
        return CodeTruth(self.clip, self.timing, self.photons_factor)

    def known(self) -> Array | None:
        """Return bool [T, H, W], False where light of `truth` is cut off (`Clip.saturated`); None if all is known."""
        return CodeTruth(self.clip, self.timing).known()

    @cached_property
    def timing(self) -> Timing:
        """When codes collect light: clip frames, rows and schedule."""
        frames = self.info.planes_per_code
        return self.info.sensing.timing(frames, frames > 1 and self.sensor.sums_planes)

    @property
    def sums(self) -> Sums | None:
        """The planes behind the codes, if they are sums of planes, or some of all planes; else None."""
        planes = self.info.planes_per_code
        if (planes == 1 and self.info.plane_rate is None) or not self.sensor.sums_planes:
            return None
        rate = self.info.plane_rate or self.info.frame_rate * planes
        return Sums(planes, 0, round(rate / self.info.frame_rate), len(self))

    @property
    def rates(self) -> str:
        """The rate of the codes, and where they are sums that of their planes, as text."""
        return (
            self.sums.words(self.info.frame_rate * self.sums.step) if self.sums else f"{self.info.frame_rate:g} codes/s"
        )

    @property
    def rows(self) -> Rows | None:
        """The delay of rows or columns; None: all are read at once."""
        return self.timing.rows

    def require_even(self, what: str) -> None:
        """Raise `ValueError` if rows have their own time or codes different light, which `what` does not know."""
        if self.rows is not None or not self.timing.even:
            raise ValueError(f"{self.path}: {what} needs rows read at once and equal exposures; leave this stream out")

    def _existing(self, start: int, stop: int) -> range:
        """Return frames start ... stop - 1; `ValueError` if they do not all exist."""
        if not 0 <= start < stop <= len(self):
            raise ValueError(f"{self.path}: frames {start}..{stop} do not all exist; the stream has {len(self)}")
        return range(start, stop)

    @property
    def name(self) -> str:
        return self.path.name.removesuffix(".npy")

    @property
    def bits(self) -> int:
        return self.info.bits

    @property
    def shape(self) -> tuple[int, int, int]:
        """(T, H, W) of the codes, before packing."""
        return self.info.shape

    @property
    def origin(self) -> tuple[int, int]:
        """(y, x) of the first pixel in the full frame."""
        return self.info.origin

    @property
    def exposure(self) -> float:
        """Seconds of light in one code: in all its planes if it sums some, in a full one under a schedule."""
        return self.info.exposure

    @property
    def shares(self) -> tuple[float, ...] | None:
        """The exposures of codes in turn, over a full one; None: all are full."""
        return self.timing.shares

    @property
    def exposures(self) -> Array:
        """Seconds of light in each code, float64 [T]."""
        return np.array([self.timing.share(t) for t in range(len(self))]) * self.exposure

    @property
    def photons_factor(self) -> float:
        """Photons at the sensor over the clip's expected photons; `ValueError` for an imported stream."""
        if self.info.light is None:
            raise ValueError(f"{self.path}: was imported, so its light is not known")
        return self.info.light.factor

    @cached_property
    def sensor(self) -> Sensor:
        from qsim.sensor import devices

        return devices.from_dict(self.info.sensor, where=f"{self.path.with_suffix('.json')}: sensor")

    @cached_property
    def packed(self) -> LazyArray:
        """The packed array uint8 [T, H, ceil(W*bits/8)], read when it is used.

        `ValueError` if the file does not fit its json, or if both were replaced since the stream was opened. Once
        open, the codes stay those of this json. Reading raises `ValueError` if the file was cut or overwritten.
        """
        while True:
            before = self._written()
            array = self._stored()
            if self._written() == before:  # nothing was replaced between reading json and codes
                return array

    def _written(self) -> tuple[int, ...]:
        """Return the identity of the json file; `ValueError` if its codes differ from those at opening."""
        described = self.path.with_suffix(".json")
        problem = f"{described}: was replaced since it was opened; open the stream again"
        try:
            status = described.stat()
            now = files.read_json(described)
        except FileNotFoundError:
            raise ValueError(problem) from None
        if now.get("sha256") != self.info.sha256:
            raise ValueError(problem)
        return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns

    def _stored(self) -> LazyArray:
        """Return the open array uint8 [T, H, ceil(W*bits/8)]; `ValueError` for another shape or type."""
        frames, height, width = self.shape
        expected = (frames, height, packing.packed_width(width, self.bits))
        if not self.path.is_file():
            raise FileNotFoundError(f"{self.path}: no such file, but its json exists; sense it again and replace it")
        array = files.load_array(self.path, self.path.parent)
        if array.shape != expected or array.dtype != np.uint8:
            raise ValueError(
                f"{self.path}: expected uint8 {list(expected)}, found {array.dtype} {list(array.shape)}; "
                "sense it again and replace it"
            )
        return array

    def _read(self, start: int, stop: int, crop: Crop | None) -> Array:
        """Return codes [stop - start, h, w] of frames start ... stop - 1; only the bytes of the crop are read."""
        self._existing(start, stop)
        _, height, width = self.shape
        y, x, h, w = check_crop(crop, height, width, str(self.path))
        # The packed bytes that hold the columns: from the last code that starts on a byte.
        first = x - x % (8 // math.gcd(8, self.bits))
        low = first * self.bits // 8
        high = packing.packed_width(x + w, self.bits)

        def block(begin: int, end: int) -> Array:
            part = self.packed[begin:end, y : y + h, low:high]
            return packing.unpack(part, self.bits, x + w - first)[..., x - first :]

        step = max(1, IN_CACHE // max(1, h * (high - low)))
        if stop - start <= step:
            return block(start, stop)
        codes = np.empty((stop - start, h, w), packing.code_dtype(self.bits))
        for begin in range(start, stop, step):
            end = min(begin + step, stop)
            codes[begin - start : end - start] = block(begin, end)
        return codes

    @property
    def _bytes(self) -> int:
        """Bytes of the packed array with its header."""
        frames, height, width = self.shape
        row = packing.packed_width(width, self.bits)
        return len(_header(frames, height, row)) + frames * height * row

    def verify(self, progress: Progress | None = None) -> list[str]:
        """Return one message per file whose checksum differs; empty if the stream is intact."""
        problems = files.differs(self.path, self.info.sha256, self._bytes, self.path.parent)
        try:
            if problems:
                self._written()
        except ValueError as error:  # replaced meanwhile
            return [str(error)]
        return problems


def is_stream(json_path: Path) -> bool:
    """Return whether a description is that of a stream; errors as of `files.read_json`."""
    return "code_model" in files.read_json(json_path)


@contextlib.contextmanager
def writing(folder: Path, on_wait: Callable[[], None] | None = None) -> Iterator[None]:
    """Hold the lock of a folder of streams; while another process holds it, wait after a call of `on_wait`."""
    folder.mkdir(exist_ok=True)
    if folder.is_symlink():  # streams would be written anywhere
        raise ValueError(
            f"{folder}: is a link, and streams are written into the clip alone; put the folder itself there"
        )
    lock = locks.Lock(folder / "lock")
    lock.acquire(wait=True, on_wait=on_wait)
    try:
        yield
    finally:
        lock.delete()


def tidy(folder: Path) -> None:
    """Delete what a writer left in a folder of streams that was killed after its stream was written."""
    scratch.sweep(folder)
    lock = locks.Lock(folder / "lock")
    with contextlib.suppress(OSError):  # a read-only folder
        if lock.path.exists() and lock.acquire():
            lock.delete()


def write_packed(path: Path, blocks: Iterable[Array], info: StreamInfo) -> Stream:
    """Store packed codes (uint8 [t, H, ceil(W bits / 8)], in order) as `path`, NAME.npy; the json comes last.

    `ValueError` if there are not as many frames as `info` states.
    """
    frames, height, width = info.shape
    row = packing.packed_width(width, info.bits)
    json_path = path.with_suffix(".json")
    done = 0
    digest = hashlib.sha256()
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
        complete = replace(info, sha256=digest.hexdigest(), software={"qsim": VERSION})
        described.write(files.to_json(descriptions.values_of(complete)))
    return Stream.open(json_path)


def _header(*shape: int) -> bytes:
    """Return the header of a .npy file of bytes."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "|u1", "fortran_order": False, "shape": shape})
    return file.getvalue()

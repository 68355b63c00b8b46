"""Writes and reads the time stamps of single photons: the events behind the codes of a counting SPAD.

    NAME.npz   times  float64 [N], s from the start of the first exposure, rising within each pixel
               kind   uint8 [N], sum of 1 (the pixel counted it) and 2 (a released carrier, that is an afterpulse)
               first  int64 [H W + 1]: pixel (y, x) has the events first[y W + x] ... first[y W + x + 1] - 1
               meta   uint8, a JSON text: format, shape [T, H, W], exposure, frame_rate, sensor; rows, if delayed

Time 0 is the start of the exposure of frame 0; in scenes and flicker it is its middle, half an exposure later.
Frame t is exposed from t / frame_rate on, by each row's clock if rows have delays. Times are not rounded, so dead times
hold exactly. Events of kind 0 came while the pixel was dead: with them the file holds the photons that other pixels
would have seen.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from numpy import ndarray as Array

from qsim import files, limits, opening
from qsim.checks import check_shape
from qsim.clip.source import Source
from qsim.files import decoding_errors
from qsim.formats.recording import Hints, Recording
from qsim.kinds import Positive, Whole
from qsim.records import convert, plain
from qsim.sensor.defects.event_simulation import DETECTED, RELEASED
from qsim.streams.rows import Rows
from qsim.streams.storing import stored
from qsim.streams.stream import Stream

FORMAT = "qsim-photons-1"
_AT_ONCE = 1 << 22  # counts of 8 bytes that are held while codes are made of them
_ARRAYS = {"times": "f8", "kind": "u1", "first": "i8", "meta": "u1"}


class About(TypedDict):
    """What `meta` states of the exposures."""

    shape: tuple[Whole, Whole, Whole]
    exposure: Positive  # s
    frame_rate: Positive  # Hz


@dataclass(frozen=True, eq=False)
class PhotonTimes:
    """The events of every pixel in T exposures."""

    shape: tuple[int, int, int]  # T, H, W
    exposure: float  # s
    frame_rate: float  # Hz
    times: Array  # [N]
    kind: Array  # [N]
    first: Array  # [H W + 1]
    rows: Rows | None = None  # rows or columns at their own time

    def detections(self, y: int, x: int) -> Array:
        """Return the times [s] of what pixel (y, x) counted, float64 [n]."""
        events = self._events(y, x)
        return np.asarray(self.times[events][self.kind[events] & DETECTED > 0])

    def intervals(self, y: int, x: int) -> Array:
        """Return the times [s] between successive counts of a pixel within one exposure, float64 [n]."""
        found = self.detections(y, x)
        frame = self._frame(found)
        return np.diff(found)[frame[1:] == frame[:-1]]

    def counts(self, start: int = 0, stop: int | None = None) -> Array:
        """Return the counts of exposures start ... stop - 1, not clipped, int64 [T, H, W]."""
        last = self.shape[0] if stop is None else stop
        frame = self._frame(self.times)
        counted = (self.kind & DETECTED > 0) & (frame >= start) & (frame < last)
        return self._histogram(frame[counted] - start, self._pixel()[counted], last - start)

    def counter_codes(self, bits: int, start: int = 0, stop: int | None = None) -> Array:
        """Return the codes of a counter of so many bits, uint8 or uint16 [T, H, W]: its counts, clipped."""
        top = (1 << bits) - 1
        return self._in_blocks(lambda a, b: np.minimum(self.counts(a, b), top), top, 1, start, stop)

    def sums(self, planes: int, start: int = 0, stop: int | None = None) -> Array:
        """Return sums of the planes of exposures start ... stop - 1, uint8 or uint16 [T, H, W]; see `clocked`."""

        def block(a: int, b: int) -> Array:
            return self.clocked(planes, a, b).reshape(-1, planes, *self.shape[1:]).sum(axis=1)

        return self._in_blocks(block, planes, planes, start, stop)

    def _in_blocks(
        self, made: Callable[[int, int], Array], top: int, planes: int, start: int, stop: int | None
    ) -> Array:
        """Return what is made of exposures, up to `top`; few of these are counted at a time."""
        last = self.shape[0] if stop is None else stop
        if (last - start) * planes * math.prod(self.shape[1:]) > limits.COUNTS:
            raise ValueError(
                f"{last - start} exposures of {planes} planes of {list(self.shape[1:])} are too many to read at once"
            )
        found = np.empty((last - start, *self.shape[1:]), np.uint8 if top < 256 else np.uint16)
        step = max(1, _AT_ONCE // (planes * math.prod(self.shape[1:])))
        for first in range(start, last, step):
            end = min(first + step, last)
            found[first - start : end - start] = made(first, end)
        return found

    def first_photons(self) -> Array:
        """Return the time [s] from the start of each exposure to its first count, float64 [T, H, W]; NaN for none."""
        frames, height, width = self.shape
        found = np.full((frames, height * width), np.inf)
        counted = self.kind & DETECTED > 0
        times = self.times[counted]
        frame = self._frame(times)
        np.minimum.at(found, (frame, self._pixel()[counted]), times - frame / self.frame_rate)
        found[np.isinf(found)] = np.nan
        return found.reshape(self.shape)

    def clocked(self, planes: int, start: int = 0, stop: int | None = None) -> Array:
        """Return the planes of a clocked SPAD that saw the same photons, bool [T planes, H, W], of some exposures.

        Each exposure is divided into `planes` equal ones; a plane fires if any photon or dark count came in it, dead
        time or not. Released carriers are the counter's own and do not count.
        """
        last = self.shape[0] if stop is None else stop
        frame = self._frame(self.times)
        arrived = (self.kind & RELEASED == 0) & (frame >= start) & (frame < last)
        times = self.times[arrived]
        frame = frame[arrived]
        # A time at the end of the exposure rounds to `planes`, which is one too many.
        part = np.clip((times - frame / self.frame_rate) / self.exposure * planes, 0, planes - 1).astype(np.int64)
        plane = (frame - start) * planes + part
        return self._histogram(plane, self._pixel()[arrived], (last - start) * planes) > 0

    def _events(self, y: int, x: int) -> slice:
        _, height, width = self.shape
        if not (0 <= y < height and 0 <= x < width):
            raise ValueError(f"pixel ({y}, {x}) does not exist in frames of {height} x {width}")
        return slice(int(self.first[y * width + x]), int(self.first[y * width + x + 1]))

    def _pixel(self) -> Array:
        """Return the number of the pixel of every event, [N]."""
        return np.repeat(np.arange(len(self.first) - 1), np.diff(self.first))

    def _frame(self, times: Array) -> Array:
        """Return the frame of every time [n]; the start of an exposure belongs to it."""
        # Events at the very start of an exposure must not round into the one before.
        frame = np.floor(times * self.frame_rate + 1e-12).astype(np.int64)
        return np.clip(frame, 0, self.shape[0] - 1)

    def _histogram(self, frame: Array, pixel: Array, frames: int) -> Array:
        _, height, width = self.shape
        if frames * height * width > limits.COUNTS:
            raise ValueError(
                f"{frames} exposures or planes of {height} x {width} pixels are more counts than the {limits.COUNTS} "
                "that are held in memory; take fewer"
            )
        found = np.bincount(frame * (height * width) + pixel, minlength=frames * height * width)
        return found.reshape(frames, height, width)


def write(stream: Stream, path: Path) -> int:
    """Write the events behind the codes of a stream, drawn again from its clip; return their number.

    `ValueError` for a stream that was not drawn photon by photon, or whose codes are not the counts of these events.
    """
    frames, height, width = stream.shape
    pixels = list(stored(stream).trace(stream.clip, frames))
    first = np.concatenate([[0], np.cumsum([len(times) for times, _ in pixels])]).astype(np.int64)
    times = np.concatenate([times for times, _ in pixels])
    kind = np.concatenate([kind for _, kind in pixels])
    rate = stream.info.frame_rate
    found = PhotonTimes((frames, height, width), stream.exposure, rate, times, kind, first)
    if not np.array_equal(np.minimum(found.counts(), stream.sensor.levels - 1), stream.codes()):
        raise ValueError(f"{stream.path}: its codes are not the counts of its photons; sense it again and replace it")
    meta = {"format": FORMAT, "shape": [frames, height, width], "exposure": stream.exposure, "frame_rate": rate}
    rows = {} if stream.rows is None else {"rows": plain(stream.rows, complete=True)}
    text = files.to_json(meta | {"sensor": stream.info.sensor} | rows)
    with files.replacing(path) as file:
        np.savez(file, times=times, kind=kind, first=first, meta=np.frombuffer(text, np.uint8))
    return len(times)


def read(path: Path) -> PhotonTimes:
    """Return the time stamps of a file; `ValueError` names the file if it is damaged or of another kind."""
    with decoding_errors(path, "photon times (.npz)"):
        found = _arrays(path)
        meta = json.loads(found["meta"].tobytes())
        if not isinstance(meta, dict) or meta.get("format") != FORMAT:
            raise ValueError(f"{path}: does not hold photon times of the format {FORMAT}")
        about = convert(meta, About, str(path))
        shape = check_shape(path, about["shape"])
        exposure = about["exposure"]
        rate = about["frame_rate"]
        if not exposure * rate < 1 + 1e-9:
            raise ValueError(f"{path}: an exposure of {exposure!r:.40} s at {rate!r:.40} frames per second")
        rows = convert(meta["rows"], Rows, f"{path}: rows") if "rows" in meta else None
        events = (found["times"], found["kind"], found["first"])
        photons = PhotonTimes(shape, exposure, rate, *events, rows=rows)
        _check(path, photons)
    return photons


def read_photons(path: Path, hints: Hints) -> Recording:
    """Read photon times as the codes of a clocked SPAD that saw the same photons: 2^bits - 1 planes per exposure."""
    photons = read(path)
    bits = hints.bits or 1
    if not 1 <= bits <= 8:
        raise ValueError(f"{path}: sums of planes of {bits} bits; 1 to 8 are made of photon times")
    planes = 2**bits - 1
    if planes * math.prod(photons.shape) > limits.COUNTS:
        raise ValueError(f"{path}: states {planes} planes of {list(photons.shape)}, too many to read at once")
    rate = photons.frame_rate
    exposure = photons.exposure
    rows = photons.rows
    source = Source(format="photon times")
    if rows is not None:
        source = replace(source, row_delay=rows.delay, row_order=rows.order)
    return Recording(
        photons.shape, lambda a, b: photons.sums(planes, a, b), source, bits, frame_rate=rate, exposure=exposure
    )


def _arrays(path: Path) -> dict[str, Array]:
    """Return the arrays of the file; `ValueError` unless each has its type, one axis, and the bytes that it states."""
    with opening.opened(path) as opened, zipfile.ZipFile(opened) as archive:
        sizes = {item.filename: item.file_size for item in archive.infolist()}
        if set(sizes) != {f"{name}.npy" for name in _ARRAYS} or any(
            item.compress_type != zipfile.ZIP_STORED for item in archive.infolist()
        ):
            raise ValueError(
                f"{path}: holds {', '.join(sorted(sizes)) or 'nothing'}; an .npz is read as photon times ("
                f"{', '.join(_ARRAYS)}), so save frames alone, with np.save as .npy"
            )
        found: dict[str, Any] = {}
        for name, kind in _ARRAYS.items():
            with archive.open(f"{name}.npy") as file:
                found[name] = files.read_npy(path, file)
            if found[name].dtype != np.dtype(f"<{kind}") or found[name].ndim != 1:
                raise ValueError(f"{path}: {name} is {found[name].dtype} {list(found[name].shape)}, not {kind} [n]")
    return found


def _check(path: Path, photons: PhotonTimes) -> None:
    """Raise `ValueError` unless the events belong to the pixels and exposures that the file states."""
    frames, height, width = photons.shape
    first = photons.first
    times = photons.times
    sizes = len(first) == height * width + 1 and len(times) == len(photons.kind)
    if not sizes or first[0] != 0 or first[-1] != len(times) or (np.diff(first) < 0).any():
        raise ValueError(f"{path}: {len(times)} events do not fit {height} x {width} pixels")
    end = (frames - 1) / photons.frame_rate + photons.exposure
    inside = np.isfinite(times) & (times >= 0) & (times <= end * (1 + 1e-9))
    if not inside.all() or (photons.kind > DETECTED + RELEASED).any():
        raise ValueError(f"{path}: event {int(np.argmin(inside))} is outside of the exposures, or of unknown kind")
    pixel = photons._pixel()
    if ((np.diff(times) < 0) & (np.diff(pixel) == 0)).any():
        raise ValueError(f"{path}: the events of a pixel are not in the order of time")

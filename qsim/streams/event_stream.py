"""Reads and writes the events of one clip: CLIP/events/NAME.npy and its description NAME.json.

NAME.npy is an array [N] with the fields t (int64, us), x and y (uint16, px) and p (int8, 1 brighter, 0 darker), in the
order of t. Time 0 is the middle of the exposure of frame 0; frame k is at k / frame_rate. Rows and
columns are those of the clip. NAME.json is written last and holds all that the events are drawn from.
"""

from __future__ import annotations

import bisect
import os
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy import ndarray as Array

from qsim import descriptions, files, opening, records
from qsim.files import VERSION, Progress
from qsim.host import own_numbers
from qsim.kinds import Count, Digest, Positive, Text, Whole
from qsim.optics.radiometry import LightLevel
from qsim.sensor.event_camera import EventCamera, from_dict
from qsim.stored_array import StoredArray

EVENT = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])
SIZE = 8  # bytes of an event in statements of data rates: what cameras send is 2 to 8
FOLDER = "events"  # of a clip
_DAMAGED = "the file is damaged: draw the events again and replace it"
_HEADER = 128  # bytes before the events: NumPy leaves room for the largest number of them


@dataclass(frozen=True, kw_only=True)
class EventInfo:
    """The description of the events of a clip: NAME.json without its format version and its own checksum."""

    FORMAT: ClassVar[str] = "qsim-events-1"

    shape: tuple[Whole, Whole, Whole]  # frames of the clip, height, width [px]
    frame_rate: Positive  # of the clip, Hz
    camera: dict[str, Any]  # model and parameters
    camera_name: str = ""  # name or file; of a record, nothing
    settings: dict[str, Any] = field(default_factory=dict)  # of `EventSensing`, where they differ from their defaults
    clip: str  # its name
    clip_key: Count  # of the random numbers, beside the seed
    origin: tuple[Count, Count] = (0, 0)  # y, x of the first pixel in the full frame
    light: LightLevel  # per clip frame
    orientation: Text = "upright"
    events: Count = 0
    brighter: Count = 0  # of these events
    following: Count = 0  # of these events: those after another of their pixel between the same two frames
    sha256: Digest | None = None  # of the file of events
    software: dict[str, str] = field(default_factory=lambda: {"qsim": VERSION})

    def __post_init__(self) -> None:
        records.settle(self)

    @property
    def compared(self) -> dict[str, object]:
        """What makes these events others than asked for: equal for equal events."""
        found = records.plain(self)
        for name in ("events", "brighter", "following", "sha256", "software", "orientation"):
            found.pop(name, None)
        return found | {"camera_name": Path(self.camera_name).name}

    @property
    def seconds(self) -> float:
        """The time from the first frame to the last [s], in which events can come."""
        return (self.shape[0] - 1) / self.frame_rate


@own_numbers
@dataclass(frozen=True, eq=False)
class EventStream:
    """The events of one clip seen by one event camera at one light level."""

    path: Path  # events/NAME.npy
    info: EventInfo  # events/NAME.json
    keeps: object = field(default=None, repr=False)  # a temporary folder: it lasts as long as a reference to it

    @staticmethod
    def open(json_path: str | Path) -> EventStream:
        """Open events; `FileNotFoundError` if they do not exist, `ValueError` if their description is damaged."""
        return EventStream(*descriptions.opened(json_path, EventInfo, "events", _DAMAGED))

    def __len__(self) -> int:
        return self.info.events

    def __repr__(self) -> str:
        return f"<EventStream {self.name}: {self.said}>"

    @property
    def said(self) -> str:
        """Number, size and rate of the events, as text."""
        info = self.info
        _, height, width = info.shape
        rate = len(self) / (height * width * info.seconds)
        share = f", {100 * info.brighter / len(self):.3g} % of them ON" if len(self) else ""
        return f"{len(self)} events of {height} x {width} pixels in {info.seconds:.4g} s, {rate:.4g}/s per pixel{share}"

    @property
    def name(self) -> str:
        return self.path.name.removesuffix(".npy")

    @property
    def shape(self) -> tuple[int, int, int]:
        """(frames of the clip, height, width)."""
        return self.info.shape

    @cached_property
    def camera(self) -> EventCamera:
        """The camera, with the photocurrent of bright light at which its effects were drawn."""
        return from_dict(self.info.camera, f"{self.path.with_suffix('.json')}: camera")

    @cached_property
    def array(self) -> StoredArray:
        """All events [N] with the fields t, x, y and p, read when they are used: `array[:1000]["t"]`.

        `ValueError` if the file does not fit its description.
        """
        if not self.path.is_file():
            raise FileNotFoundError(f"{self.path}: no such file, but its json exists; draw the events again")
        with opening.opened(self.path, beside=self.path.parent) as file:
            size = os.fstat(file.fileno()).st_size
            expected = _HEADER + len(self) * EVENT.itemsize
            if size != expected:
                raise ValueError(f"{self.path}: has {size} bytes, and {len(self)} events take {expected}; {_DAMAGED}")
            return StoredArray(self.path, os.dup(file.fileno()), _HEADER, (len(self),), EVENT, fortran=False)

    def between(self, start: float, stop: float) -> Array:
        """Return the events [n] with start <= t < stop, in s from the middle of the first frame."""
        return self.array[self._first(start * 1e6) : self._first(stop * 1e6)]

    def _first(self, microseconds: float) -> int:
        """Return the number of the first event at a time or after it."""
        return bisect.bisect_left(range(len(self)), microseconds, key=lambda n: float(self.array[n]["t"]))

    def verify(self, progress: Progress | None = None) -> list[str]:
        """Return one message per file whose checksum differs; empty if the events are intact."""
        most = _HEADER + len(self) * EVENT.itemsize
        return files.differs(self.path, self.info.sha256, most, self.path.parent)


def is_events(json_path: Path) -> bool:
    """Return whether a description is that of events; errors as of `files.read_json`."""
    return files.read_json(json_path).get("format") == EventInfo.FORMAT


def write(path: Path, blocks: Iterable[tuple[Array, int]], info: EventInfo) -> EventStream:
    """Store blocks of events [n] in the order of time as `path`, NAME.npy; the json comes last.

    Each block comes with the number of its events that follow another of their pixel between the same two frames.
    """
    json_path = path.with_suffix(".json")
    events = 0
    brighter = 0
    following = 0
    with files.replacing_described(path, json_path) as (stored, described):
        stored.write(_header(0))
        for block, more in blocks:
            stored.write(np.ascontiguousarray(block, EVENT).tobytes())
            events += len(block)
            brighter += int(block["p"].sum())
            following += more
        stored.seek(0)
        stored.write(_header(events))
        stored.flush()
        stored.seek(0)
        digest = files.digest_of(stored)
        counted = replace(info, events=events, brighter=brighter, following=following, sha256=digest)
        described.write(files.to_json(descriptions.values_of(counted)))
    return EventStream.open(json_path)


def _header(events: int) -> bytes:
    """Return the header of a .npy file of so many events, always of the same length."""
    descr = ", ".join(f"('{name}', '{EVENT[name].str}')" for name in EVENT.names or ())
    text = f"{{'descr': [{descr}], 'fortran_order': False, 'shape': ({events},), }}"
    body = text.encode().ljust(_HEADER - 11) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(body).to_bytes(2, "little") + body

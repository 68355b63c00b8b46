"""Describes and reads restored video: NAME.npy, float32 photons [T, H, W] or [T, 3, H, W], and NAME.json.

`quiver` writes it (quiver/restoration/restored_file.py); `qsim` checks, converts and shows it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

from msgspec import Meta

from qsim import descriptions, files, records
from qsim.checks import check_video
from qsim.files import Progress, load_array
from qsim.frame_times import Times
from qsim.kinds import Count, Digest, NotNegative, Positive, Text, Whole
from qsim.lazy_array import LazyArray
from qsim.plane_sums import PlaneRange

_CURE = "restore the video again"


@dataclass(frozen=True, kw_only=True)
class VideoInfo:
    """What is known of a video before it is restored, and what must agree to resume it."""

    method: Text
    description: str = ""  # of the method, in words
    identity: dict[str, Any] = field(default_factory=dict)  # settings and weights of the method that change the video
    unit: Text = "photons"
    white: Positive | None = None  # photons at the brightest code of the sensor
    shape: Annotated[tuple[Whole, ...], Meta(min_length=3, max_length=4)] | None = None  # [T, H, W] or [T, 3, H, W]
    frame_rate: Positive | None = None  # Hz
    plane_rate: Positive | None = None  # Hz, of the planes behind the codes, where codes are sums of planes
    planes_per_code: Whole = 1
    planes: PlaneRange | None = None  # of the recording that are used, where codes are sums or some of all
    times: Times | None = None  # of the frames
    exposure: Positive | None = None  # s
    sensor: dict[str, Any] = field(default_factory=dict)  # as its record describes itself
    colour: dict[str, Any] = field(default_factory=dict)  # the colour filters, as their record describes itself
    scan: str = ""  # what a scan for hot pixels found, in words; empty: there was none
    cuts: tuple[Count, ...] = ()  # frames at which another scene or light begins
    not_inverted: str = ""  # effects of the sensor that the method leaves in the light
    source: str = ""  # the codes: a file, or in words
    codes_sha256: Text | None = None
    quiver: str = ""  # version of the program

    @property
    def rates(self) -> str:
        """The rate of the frames, and that of the planes that a code sums, as text; empty if it is not known."""
        if self.frame_rate is None:
            return ""
        planes = (
            "" if self.plane_rate is None else f"{self.planes_per_code} planes per code, {self.plane_rate:g} planes/s, "
        )
        return f"{planes}{self.frame_rate:g} codes/s"

    def __post_init__(self) -> None:
        records.settle(self)
        if self.shape is not None and len(self.shape) == 4 and self.shape[1] != 3:
            raise ValueError(f"shape: expected [frames, height, width] or [frames, 3, height, width], got {self.shape}")


@dataclass(frozen=True, kw_only=True)
class RestoredInfo(VideoInfo):
    """The description of restored video: NAME.json without its format version and its own checksum."""

    FORMAT: ClassVar[str] = "quiver-restored"

    seconds_per_frame: NotNegative
    threads: Count | None = None
    device: str = ""
    look_ahead: Count = 0  # frames of the future that the method saw
    chosen: str = ""  # by `auto`, and why; empty: the method was named
    source_sha256: Digest | None = None  # of the codes' file
    sha256: Digest | None = None  # of NAME.npy


def describes_restored(found: Mapping[str, Any]) -> bool:
    """Return whether the contents of a JSON file are those of a `RestoredInfo`, damaged or not."""
    return found.get("format") == RestoredInfo.FORMAT


@dataclass(frozen=True)
class Restored:
    """Restored video on disk."""

    path: Path  # NAME.npy
    info: RestoredInfo  # NAME.json

    @staticmethod
    def open(description: Path) -> Restored:
        """Open a restored video by its description; `ValueError` if that is damaged."""
        return Restored(description.with_suffix(".npy"), descriptions.read(description, RestoredInfo, _CURE))

    def frames(self) -> LazyArray:
        """Return the video, float32 photons, read when it is used; `ValueError` if it differs from its .json."""
        array = load_array(self.path, self.path.parent)
        check_video(self.path, array.shape)
        if array.dtype.kind != "f" or self.info.shape not in (None, array.shape):
            raise ValueError(f"{self.path}: {array.dtype} {list(array.shape)} is not what its .json describes")
        return array

    def verify(self, progress: Progress | None = None) -> list[str]:
        """Return the problems of the video's file."""
        shape = self.info.shape
        most = None if shape is None else 65536 + 4 * math.prod(shape)  # the header of a .npy is shorter
        return files.differs(self.path, self.info.sha256, most, self.path.parent)

"""Describes an export: what the .json beside it states of its source and of how its values were written.

ClipInfo | StreamInfo | EventInfo  ->  the facts that still hold of an export
ExportInfo                         ->  bit order, transfer curve, white, ...; both stand in one table
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, TypedDict

import msgspec

from qsim import files, records
from qsim.clip.clip_info import ClipInfo
from qsim.files import VERSION
from qsim.kinds import Text, Whole
from qsim.streams.event_stream import EventInfo
from qsim.streams.stream_info import StreamInfo

FORMAT_VERSION = 1
_OF_CLIP = ("shape", "frame_rate", "exposure", "radiance_unit", "scene", "split", "seed", "bands", "origin")
_OF_STREAM_ALONE = ("sha256", "software", "clip_key")


@dataclass(frozen=True, kw_only=True)
class CubesInfo:
    """The cubes of the challenge that were made of a clip."""

    cubes: int
    planes: int  # in a cube
    width: int  # pixels, before packing
    left_out: int  # planes that fill no cube
    detections_at_white: float  # expected per plane
    clipped: float  # share of the truth above white
    seeds: tuple[int | None, ...]  # of the bands
    sensors: tuple[dict[str, Any], ...]
    benchmark: bool  # planes and size are those of the benchmark


@dataclass(frozen=True, kw_only=True)
class ExportInfo:
    """How an export was written; fields that do not concern its kind are unset."""

    source: ClipInfo | StreamInfo | EventInfo
    orientation: Text
    bit_order: str | None = None
    transfer: str | None = None  # of pictures of light
    white: float | None = None  # light at full scale
    stretched: bool | None = None  # codes, to 0 ... 255
    lossless: bool | None = None  # of a video
    events: int | None = None  # photons and releases
    time_unit: str | None = None
    time_zero: str | None = None
    cubes: CubesInfo | None = None

    def but(self, **changes: Any) -> Self:
        return replace(self, **changes)

    @property
    def values(self) -> dict[str, object]:
        """What the file holds: one table of the facts of the source and of the export."""
        own = {key: value for key, value in records.plain(self, complete=True).items() if value is not None}
        del own["source"]
        cubes = own.pop("cubes", {})
        stated = {"format_version": FORMAT_VERSION, "software": {"qsim": VERSION}}
        return self._of_source | own | cubes | stated

    @property
    def _of_source(self) -> dict[str, object]:
        if isinstance(self.source, ClipInfo):
            facts = records.plain(self.source, complete=True)
            return {key: facts[key] for key in _OF_CLIP if facts[key] is not None}
        return {key: value for key, value in records.plain(self.source).items() if key not in _OF_STREAM_ALONE}


class Stated(TypedDict, total=False):
    """What a reader takes from the file beside an export, or from one of another program."""

    software: dict[str, Any]
    shape: tuple[Whole, Whole, Whole]  # frames, height, width
    orientation: str


def beside(path: Path) -> Stated:
    """Return what the file of an export's description states; nothing if there is none, or none of that form."""
    try:
        return msgspec.convert(files.read_json(path), Stated)
    except (OSError, ValueError):  # a validation error is one
        return {}


def is_ours(stated: Stated) -> bool:
    return "qsim" in stated.get("software", {})

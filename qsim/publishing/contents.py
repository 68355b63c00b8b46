"""States what is published of a clip: arrays by the name of their field, and what describes them.

    radiance   float16 [T, H, W], or [T, 3, H, W] of a colour clip; mean over the exposure, in `info.radiance_unit`
    sharp      float16, the same at mid-exposure; only of frames for which it differs
    flow       float32 [T, 2, H, W] px, u right and v down, to the next frame; flow_back to the previous one
    valid      bool [T, H, W], False where a point is hidden in the next frame
    depth      float32 [T, H, W] m; inf where no body is
    body_id    int32 [T, H, W]; -1 where no body is
    saturated  bool [T, H, W], True where light is a lower bound; only of frames with such pixels
    codes      uint8 or (above 8 bits) uint16 [N, H, W]; packed: uint8 [N, H, ceil(W bits / 8)]
    truth      float32 [N, H, W] or [N, 3, H, W], sharp photons per pixel and code

Of several streams the fields are codes_0, truth_0, codes_1 and so on. Frames for which a field is not stored are
missing in its array; `frames` of the description lists those that are there. Values are those of the clip, bit by bit.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NotRequired, TypedDict

import numpy as np
from numpy import ndarray as Array

from qsim import colour, descriptions
from qsim.clip.clip_info import ClipInfo
from qsim.host import own_numbers
from qsim.sensor import packing
from qsim.streams.clip import Clip
from qsim.streams.code_truth import CodeTruth
from qsim.streams.sensing import Sensing
from qsim.streams.storing import drawn
from qsim.streams.stream_info import StreamInfo

Field = Literal["radiance", "sharp", "truth", "flow", "flow_back", "valid", "depth", "body_id", "saturated", "codes"]
FIELDS: tuple[Field, ...] = (
    *("radiance", "sharp", "codes", "truth", "flow", "flow_back", "valid", "depth", "body_id", "saturated"),
)
CHANNELS: dict[str, tuple[str, ...]] = {  # field -> channels of truth/*.exr, in this order
    "flow": ("u", "v"),
    "flow_back": ("bu", "bv"),
    "valid": ("valid",),
    "depth": ("Z",),
    "body_id": ("id",),
}
FOLDERS = {"radiance": "radiance", "sharp": "sharp", "saturated": "saturated"} | dict.fromkeys(CHANNELS, "truth")


@dataclass(frozen=True)
class Sensed:
    """Codes of a clip with their description."""

    name: str
    info: StreamInfo
    packed: Callable[[], Array]  # uint8 [N, H, ceil(W bits / 8)]
    truth: Callable[[], Array] | None  # float32 [N, H, W] or [N, 3, H, W]; None: not known


class DescribedStream(TypedDict):
    """A stream of a published clip: the names of its arrays, and its description."""

    codes: NotRequired[str]
    truth: NotRequired[str]
    packed: bool  # whether codes keep their bits in bytes
    info: dict[str, Any]  # as the stream's own file holds it; read by `descriptions`, which checks its version


class Description(TypedDict):
    """What a shard states of a clip beside its arrays."""

    clip: str
    split: str | None
    frames: dict[str, list[int]]  # of fields that not all frames have
    streams: dict[str, DescribedStream]
    info: dict[str, Any]  # as clip.json holds it, likewise


@dataclass(frozen=True)
class Sample:
    """A clip as it is published."""

    key: str  # of all its files in a shard
    clip: Clip
    description: Description
    streams: dict[str, StreamInfo]
    arrays: dict[str, Callable[[], Array]]  # by field, computed when they are written

    def picture(self) -> bytes:
        """Return the radiance of the middle frame as a PNG."""
        middle = self.clip.radiance(len(self.clip) // 2)
        shown = colour.tone_picture(middle, colour.peak(middle), colours=self.clip.bands is not None)
        return png(shown)


def png(picture: Array) -> bytes:
    """Return a picture, uint8 [H, W] or [H, W, 3], as the bytes of a PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "png")
    return buffer.getvalue()


def field_frames(info: ClipInfo, field: str) -> list[int]:
    """Return the frames for which a clip stores a field."""
    return [t for t in range(info.shape[0]) if info.has(FOLDERS[field], t)]


def stored(clip: Clip, name: str) -> Sensed:
    """Return the codes of a stored stream."""
    stream = clip.stream(name)

    def truth() -> Array:
        return np.asarray(stream.truth().astype(np.float32))

    known = stream.info.light is not None and stream.info.clip_key is not None
    return Sensed(name, stream.info, lambda: np.asarray(stream.packed), truth if known else None)


def sensed(clip: Clip, sensing: Sensing) -> Sensed:
    """Return the codes that a sensor draws from a clip; nothing is stored."""
    info, draw, blocks = drawn(clip, sensing)

    def truth() -> Array:
        return np.asarray(CodeTruth(clip, draw.timing, draw.level.factor).video().astype(np.float32))

    return Sensed(sensing.stream_name, info, lambda: np.concatenate(list(blocks())), truth)


@own_numbers
def sample_of(
    clip: Clip,
    key: str,
    *,
    fields: Sequence[str] = FIELDS,
    streams: Sequence[str] = (),
    sensings: Sequence[Sensing] = (),
    packed: bool = False,
    split: str | None = None,
) -> Sample:
    """Return what is published of a clip: those of the `fields` that it has, with stored streams or sensed codes.

    `streams` are all names of the set, of which a clip may lack some. `packed` keeps the bits of codes in bytes.
    """
    arrays: dict[str, Callable[[], Array]] = {}
    frames: dict[str, list[int]] = {}
    for field in fields:
        if field not in FOLDERS:
            continue
        listed = _frames_of(clip, field)
        if not listed:
            continue
        arrays[field] = partial(_array, clip, field, listed)
        if len(listed) < len(clip):
            frames[field] = listed
    every = [*streams, *(sensing.stream_name for sensing in sensings)]
    found = [stored(clip, name) for name in streams if name in clip.streams]
    found += [sensed(clip, sensing) for sensing in sensings]
    described: dict[str, DescribedStream] = {}
    for one in found:
        # Numbered among all streams of the set, so that a field is the same stream in every clip.
        suffix = "" if len(every) == 1 else f"_{every.index(one.name)}"
        own: DescribedStream = {"packed": packed, "info": descriptions.values_of(one.info)}
        if "codes" in fields:
            own["codes"] = f"codes{suffix}"
            arrays[own["codes"]] = one.packed if packed else partial(_unpacked, one)
        if "truth" in fields and one.truth is not None:
            own["truth"] = f"truth{suffix}"
            arrays[own["truth"]] = one.truth
        described[one.name] = own
    about: Description = {
        "clip": clip.name,
        "split": split,
        "frames": frames,
        "streams": described,
        "info": descriptions.values_of(clip.info if clip.info.name else replace(clip.info, name=clip.name)),
    }
    return Sample(key, clip, about, {one.name: one.info for one in found}, arrays)


def _frames_of(clip: Clip, field: str) -> list[int]:
    """Return the frames of a field that a clip stores; empty for a channel that its ground truth lacks."""
    listed = field_frames(clip.info, field)
    if listed and field in CHANNELS:
        there = clip.channels_of_truth(listed[0])
        if not all(channel in there for channel in CHANNELS[field]):
            return []
    return listed


def _array(clip: Clip, field: str, frames: Iterable[int]) -> Array:
    """Return the frames of a field."""
    return np.stack([_frame(clip, field, t) for t in frames])


def _frame(clip: Clip, field: str, t: int) -> Array:
    """Return one frame of a field, in the type in which it is published."""
    if field in ("radiance", "sharp"):
        light: Array = getattr(clip, field)(t)
        return light.astype(np.float16)
    found: Array = getattr(clip, field)(t)
    return found


def _unpacked(one: Sensed) -> Array:
    """Return codes [N, H, W]."""
    return packing.unpack(one.packed(), one.info.bits, one.info.shape[2])

"""Holds `Recording`, the common form of imported frames, and the checks that all readers share.

A `Recording` holds codes (0 ... 2^bits - 1, of a photon counting sensor) or light (linear, in arbitrary units). Headers
are compared with the size of the file before memory is allocated. Errors and warnings of decoders become one
`ValueError` with the name of the file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from numpy import ndarray as Array

from qsim.arrays import plain
from qsim.clip.source import Flip, Source
from qsim.colour import TRANSFERS, to_linear
from qsim.frame_times import Times
from qsim.kinds import Bits, Count, Positive, Text, Whole
from qsim.settings import setting

Marked = Callable[[int, int], tuple[Array, Array]]

ORDERS = ("msb", "lsb")  # of bits in a byte
ENDIANS = ("little", "big")  # of bytes in a pixel


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames [T, H, W] that are read on demand."""

    shape: tuple[int, int, int]
    read: Callable[[int, int], Array]  # frames start ... stop - 1: codes (uint8, uint16), or light (float32)
    source: Source  # its format, further facts of the file, and assumptions of its reader
    bits: int | None = None  # of codes; None: light
    code_model: str = "binary_sum"
    marked: Marked | None = None  # light, and bool [t, H, W]: True where the camera was saturated
    white: float | None = None  # pixel value at which the camera saturates; None: not known
    white_assumed: bool = False  # it is the largest value that the pixels can hold
    frame_rate: float | None = None  # Hz, if the file states it
    exposure: float | None = None  # s, if the file states it
    reading: str = ""  # how the bytes or axes were read, in words; empty: only one way is known
    times: Times | None = None  # of the frames, if the file states them
    full_scale: bool = True  # light of whole numbers, at most 1; False: of floats, in any unit

    def __post_init__(self) -> None:
        """Make every reader's arrays plain, whatever memory its library returns (arrays.py)."""
        read = self.read
        marked = self.marked
        object.__setattr__(self, "read", lambda start, stop: plain(read(start, stop)))
        if marked is not None:
            object.__setattr__(self, "marked", lambda start, stop: tuple(plain(part) for part in marked(start, stop)))

    @property
    def format(self) -> str:
        """The name of its format, for messages."""
        return self.source.format

    @property
    def is_light(self) -> bool:
        return self.bits is None


@dataclass(frozen=True)
class Layout:
    """Where the values of a file lie, which it may not state: for frames of light and for codes."""

    SECTION: ClassVar[str] = "what a foreign file may not state"

    layout: Annotated[Text | None, setting("kind of the input, as in tiff or raw; a wrong name lists all")] = None
    height: Annotated[Whole | None, setting("pixels")] = None
    width: Annotated[Whole | None, setting("pixels per row, before packing")] = None
    order: Annotated[
        str | None, setting("raw: pixels are packed to bits, and this bit of a byte comes first", choices=ORDERS)
    ] = None
    endian: Annotated[
        str | None, setting("raw: pixels fill whole bytes, and this byte comes first", choices=ENDIANS)
    ] = None
    skip_bytes: Annotated[Count | None, setting("raw: bytes before the first frame of a file", shown="N")] = None
    row_padding: Annotated[
        Count | None,
        setting("raw: rows begin at a byte, and N bytes follow each", unset="rows follow bit by bit", shown="N"),
    ] = None
    axes: Annotated[Text | None, setting("names of the axes of an array, as in TCYX or YXT")] = None
    channel: Annotated[Count | None, setting("index of an axis C to read, from 0", shown="N")] = None
    slice: Annotated[Count | None, setting("index of an axis Z to read, from 0", shown="N")] = None
    dataset: Annotated[
        Text | None,
        setting("HDF5: path of the array in the file, as in entry/data", unset="the only one", shown="PATH"),
    ] = None
    variable: Annotated[Text | None, setting("array of a .mat file", unset="OUTPUT, or the only one")] = None


@dataclass(frozen=True)
class Hints(Layout):
    """Facts that a file may not state and the user can."""

    bits: Annotated[Bits | None, setting("the input holds codes of this many bits")] = None
    transfer: Annotated[
        str | None, setting(f"how pictures code light: {', '.join(TRANSFERS)} (also for writing)", shown="TRANSFER")
    ] = None
    stretched: Annotated[bool, setting("codes were stretched to 0..255")] = False
    flip: Annotated[Flip, setting("mirror the frames: left-right, up-down or both")] = "none"
    columns: Annotated[Whole | None, setting("keep only the first columns (Vidar dumps: 400 of 416)")] = None
    black: Annotated[
        Positive | None, setting("pixel value without light, as in 64, which is subtracted", unset="0")
    ] = None
    keep_gaps: Annotated[
        bool,
        setting("store lost frames, which numbers or time stamps show, as frames without valid pixels (light)"),
    ] = False
    white: Annotated[
        Positive | None,
        setting("reading: pixel value at which the camera saturates; writing pictures: light at full scale"),
    ] = None

    def refuse(self, path: Path, kind: str, *names: str) -> None:
        """Raise `ValueError` if one of these hints is given: it has no effect on this `kind` of input."""
        for name in names:
            if getattr(self, name) != getattr(Hints, name):
                raise ValueError(f"{path}: {name}= changes nothing for {kind}; leave it out")


def check_size(path: Path, size: int, frame_bytes: int, what: str, footer: tuple[int, ...] = (0,)) -> int:
    """Return the number of frames in a raw file of `size` bytes; `ValueError` if it is not a whole number."""
    frames, rest = divmod(size, frame_bytes)
    if rest not in footer or frames < 1:
        raise ValueError(
            f"{path}: {size} bytes are not a whole number of {what} frames of {frame_bytes} bytes; "
            "the file is truncated, has bytes too many, or has another layout"
        )
    return frames


def light_recording(
    path: Path,
    shape: tuple[int, int, int],
    marked: Marked,
    source: Source,
    hints: Hints,
    full: float,
) -> Recording:
    """Return a recording of light; `full` is the largest value of the file's pixels, infinite for floats."""
    white, assumed = white_of(path, hints, full)
    if hints.black is not None and white is not None and hints.black >= white:
        raise ValueError(f"{path}: black={hints.black:g}: expected less than the white, {white:g}")
    if hints.black is not None:
        marked = _without_black(path, marked, hints.black, source.transfer, full)
        source = replace(source, black=hints.black)
    whole = full != float("inf")
    return Recording(shape, lambda a, b: marked(a, b)[0], source, None, "", marked, white, assumed, full_scale=whole)


def _without_black(path: Path, marked: Marked, black: float, transfer: str, full: float) -> Marked:
    """Return linear light without that of the pixel value of darkness; what was darker becomes 0.

    Pixels of whole numbers, of which `full` is the largest, are light of 0 ... 1 again; floats keep their unit.
    """
    floats = full == float("inf")
    dark = np.float32(black if floats else to_linear(np.array(black), transfer, full))
    gain = np.float32(1.0 if floats else 1 / (1 - dark))

    def subtracted(start: int, stop: int) -> tuple[Array, Array]:
        light, mask = marked(start, stop)
        return np.maximum(light - dark, 0) * gain, mask

    return subtracted


def values_recording(
    path: Path,
    shape: tuple[int, int, int],
    raw: Callable[[int, int], Array],
    bits: int,
    source: Source,
    hints: Hints,
) -> Recording:
    """Return whole numbers 0 ... 2^bits - 1 [t, H, W] as codes, or with a transfer curve or a white as light."""
    if hints.transfer is None and hints.white is None:
        return Recording(shape, lambda a, b: checked_codes(path, raw(a, b), bits, a), source, bits)
    transfer = need_transfer(path, hints)
    full = float(2**bits - 1)
    white, _ = white_of(path, hints, full)

    def marked(start: int, stop: int) -> tuple[Array, Array]:
        values = checked_codes(path, raw(start, stop), bits, start)
        return to_linear(values, transfer, full), reached(values, white)

    return light_recording(path, shape, marked, replace(source, transfer=transfer), hints, full)


def white_of(path: Path, hints: Hints, full: float) -> tuple[float | None, bool]:
    """Return the pixel value at which the camera saturates and whether it is assumed; `ValueError` beyond `full`."""
    if hints.white is None:
        return (None, True) if full == float("inf") else (full, True)
    if not 0 < hints.white <= full or hints.white == float("inf"):
        raise ValueError(f"{path}: white={hints.white:g}: pixels hold values up to {full:g}; give one of them")
    return hints.white, False


def reached(values: Array, white: float | None, colour: bool = False) -> Array:
    """Return bool [..., H, W]: pixels at or above the white of the camera (in colour: any of the three)."""
    if white is None:
        return np.zeros(values.shape[:-1] if colour else values.shape, bool)
    found: Array = values >= white
    return np.asarray(found.any(axis=-1)) if colour else found


def need_transfer(path: Path, hints: Hints) -> str:
    """Return the transfer curve that the user states; `ValueError` without one."""
    if hints.transfer is None:
        known = " or ".join(f"transfer='{name}'" for name in TRANSFERS)
        raise ValueError(f"{path}: a picture does not state its transfer curve; add {known}")
    if hints.transfer not in TRANSFERS:
        raise ValueError(f"transfer {hints.transfer!r}: known are {', '.join(TRANSFERS)}")
    return hints.transfer


def with_stated_layout(recording: Recording, bit_order: str, orientation: str) -> Recording:
    """Return the recording with a bit order and an orientation; statements of its reader are kept."""
    source = recording.source
    stated = replace(source, bit_order=source.bit_order or bit_order, orientation=source.orientation or orientation)
    return replace(recording, source=stated)


def reoriented(recording: Recording, hints: Hints) -> Recording:
    """Return the recording with the user's flips and columns; `orientation` states a flip."""
    frames, height, width = recording.shape
    columns = width if hints.columns is None else hints.columns
    if not 0 < columns <= width:
        raise ValueError(f"columns={columns}: the frames have {width} columns")
    if hints.flip not in ("none", "lr", "ud", "both"):
        raise ValueError(f"flip={hints.flip!r}: known are lr, ud, both")
    if hints.flip == "none" and columns == width:
        return recording
    rows = slice(None, None, -1 if hints.flip in ("ud", "both") else 1)
    across = slice(None, None, -1 if hints.flip in ("lr", "both") else 1)

    def read(start: int, stop: int) -> Array:
        return np.ascontiguousarray(recording.read(start, stop)[..., :columns][:, rows, across])

    def marked(start: int, stop: int) -> tuple[Array, Array]:
        assert recording.marked is not None
        light, mask = (block[..., :columns][:, rows, across] for block in recording.marked(start, stop))
        return np.ascontiguousarray(light), np.ascontiguousarray(mask)

    source = replace(recording.source, flip=hints.flip, columns_kept=columns)
    if hints.flip != "none":
        source = replace(source, orientation=f"{source.orientation or 'unknown'}; then flip={hints.flip}")
    kept = marked if recording.marked is not None else None
    return replace(recording, shape=(frames, height, columns), read=read, source=source, marked=kept)


def checked_codes(path: Path, values: Array, bits: int, first: int) -> Array:
    """Return codes as uint8 (uint16 above 8 bits).

    `ValueError` with frame and pixel of the first that is not a whole number 0 ... 2^bits - 1.
    """
    top = 2**bits - 1
    wrong = values > top
    if values.dtype.kind in "if":
        wrong |= ~(values >= 0) | (values != np.floor(values))
    if wrong.any():
        t, y, x = (int(i) for i in np.argwhere(wrong)[0])
        cure = (
            "give the right bits=, or stretched=True" if values[t, y, x] > top else "codes are whole numbers from 0 on"
        )
        raise ValueError(
            f"{path}: value {values[t, y, x]} at (t, y, x) = ({first + t}, {y}, {x}) is not a {bits}-bit code "
            f"(0..{top}); {cure}"
        )
    return values.astype(np.uint8 if bits <= 8 else np.uint16)

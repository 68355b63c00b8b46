"""Reads raw frames of any layout that the user or a file beside them states, whole or packed to bits.

    bytes skipped, then per frame: H rows of W pixels of B bits (and bytes after each row)  ->  codes or light

Pixels of B bits follow one another as a stream of bits (`order`: which bit of a byte comes first), or each fills whole
bytes (`endian`: which byte comes first). GenICam's Mono10p and Mono12p are streams, lowest bit first; Mono10Packed and
Mono12Packed of GigE Vision hold two pixels in three bytes. Photron's .mraw is described by a .cihx or .cih beside it.
Sources: GenICam Pixel Format Naming Convention 2.4, section 6; GigE Vision 2.0, section 25.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim import limits, opening
from qsim.checks import check_shape
from qsim.clip.source import Source
from qsim.file_order import numbered
from qsim.formats import gaps
from qsim.formats.recording import ENDIANS, ORDERS, Hints, Recording, check_size, values_recording
from qsim.kinds import Bits
from qsim.records import convert


@dataclass(frozen=True)
class Layout:
    """Where the pixels of a raw file lie."""

    height: int
    width: int
    bits: int
    order: str | None = None  # of a stream of bits: msb or lsb; None: whole bytes, or `pairs`
    endian: str = "little"  # of pixels of two bytes
    skip: int = 0  # bytes before the first frame
    padding: int | None = None  # bytes after each row, which begins at a byte; None: rows follow bit by bit
    pairs: bool = False  # GigE Vision's packed pixels: two in three bytes
    shift: int = 0  # bits below a pixel's value in its bytes

    @property
    def row_bits(self) -> int:
        """The bits of a row, without bytes after it."""
        if self.pairs:
            return self.width * 12
        return self.width * (self.bits if self.order is not None else 8 * self.pixel_bytes)

    @property
    def pixel_bytes(self) -> int:
        return 1 if self.bits + self.shift <= 8 else 2

    @property
    def row_bytes(self) -> int:
        """The bytes from one row to the next, where rows begin at bytes."""
        return -(-self.row_bits // 8) + (self.padding or 0)

    @property
    def frame_bytes(self) -> int:
        bit_by_bit = -(-self.height * self.row_bits // 8)
        return bit_by_bit if self.padding is None else self.height * self.row_bytes

    @property
    def said(self) -> str:
        """The layout in words."""
        if self.pairs:
            pixels = f"{self.bits} bits, two pixels in three bytes"
        elif self.order is not None:
            pixels = f"{self.bits} bits, packed, {'highest' if self.order == 'msb' else 'lowest'} bit first"
        elif self.pixel_bytes == 1:
            pixels = f"{self.bits} bits in one byte"
        else:
            pixels = f"{self.bits} bits in two bytes, {self.endian} endian"
        rows = "rows follow without a gap" if not self.padding else f"{self.padding} bytes after each row"
        skipped = f", {self.skip} bytes skipped" if self.skip else ""
        return f"{self.height} x {self.width} pixels of {pixels}; {rows}{skipped}"

    def decoded(self, raw: Array) -> Array:
        """Return pixels [t, H, W] of the bytes of whole frames."""
        frames = raw.reshape(-1, self.frame_bytes)
        if self.padding is None:
            return self._pixels(frames, self.height * self.width).reshape(-1, self.height, self.width)
        rows = frames.reshape(-1, self.row_bytes)[:, : -(-self.row_bits // 8)]
        return self._pixels(np.ascontiguousarray(rows), self.width).reshape(-1, self.height, self.width)

    def _pixels(self, rows: Array, count: int) -> Array:
        """Return the first `count` pixels [n, count] of rows of bytes [n, bytes]."""
        if self.pairs:
            return _pixel_pairs(rows, self.bits)
        if self.order is not None:
            return _bit_stream(rows, count, self.bits, self.order)
        if self.pixel_bytes == 1:
            return rows.view(np.uint8) >> self.shift
        kind = np.dtype("<u2" if self.endian == "little" else ">u2")
        return (rows.view(kind) >> self.shift).astype(np.uint16)


def _bit_stream(rows: Array, count: int, bits: int, order: str) -> Array:
    """Return pixels [n, count] of a stream of bits; the first bit of a pixel is its highest (msb) or lowest (lsb)."""
    stream = np.unpackbits(rows, axis=1, count=count * bits, bitorder="big" if order == "msb" else "little")
    digits = stream.reshape(len(rows), count, bits)
    found = np.zeros((len(rows), count), np.uint8 if bits <= 8 else np.uint16)
    for i in range(bits):
        power = bits - 1 - i if order == "msb" else i
        found |= digits[..., i].astype(found.dtype) << power
    return found


def _pixel_pairs(rows: Array, bits: int) -> Array:
    """Return pixels [n, 2 m] of bytes [n, 3 m]: high bits of the first, low bits of both, high bits of the second."""
    parts = rows.reshape(len(rows), -1, 3).astype(np.uint16)
    low = bits - 8
    mask = (1 << low) - 1
    first = (parts[..., 0] << low) | (parts[..., 1] & mask)
    second = (parts[..., 2] << low) | ((parts[..., 1] >> 4) & mask)
    return np.stack([first, second], axis=-1).reshape(len(rows), -1)


def read_raw(path: Path, hints: Hints) -> Recording:
    """Raw frames of the stated layout: codes of `bits`, or light with a transfer curve; a file, or a folder of .bin."""
    _need(path, {"height": hints.height, "width": hints.width, "bits": hints.bits})
    assert hints.height is not None
    assert hints.width is not None
    assert hints.bits is not None
    convert(hints.bits, Bits, f"{path}: bits")
    if hints.bits == 8:
        hints.refuse(path, "pixels of 8 bits", "order", "endian")
    if hints.bits == 16:
        hints.refuse(path, "pixels of 16 bits", "order")
    if hints.order is not None and hints.endian is not None:
        raise ValueError(f"{path}: order= states packed pixels, endian= pixels of whole bytes; leave one of them out")
    layout = _with_gaps(Layout(hints.height, hints.width, hints.bits), hints)
    if hints.bits == 1 or (hints.bits not in (8, 16) and hints.endian is None):
        if hints.order is None:
            more = "" if hints.bits == 1 else ", or endian=little or big if each pixel fills whole bytes"
            raise ValueError(f"{path}: pixels of {hints.bits} bits; add order=msb or lsb if they are packed{more}")
        layout = replace(layout, order=_one_of(path, "order", hints.order, ORDERS))
    elif layout.pixel_bytes == 2:
        if hints.endian is None:
            raise ValueError(f"{path}: pixels of 16 bits; add endian=little or endian=big")
        layout = replace(layout, endian=_one_of(path, "endian", hints.endian, ENDIANS))
    return _recording(path, raw_files(path), layout, "raw", hints)


def _packed(bits: int, order: str | None) -> Callable[[Path, Hints], Recording]:
    def read_packed(path: Path, hints: Hints) -> Recording:
        _need(path, {"height": hints.height, "width": hints.width})
        assert hints.height is not None
        assert hints.width is not None
        layout = Layout(hints.height, hints.width, bits, order, pairs=order is None)
        layout = _with_gaps(layout, hints)
        if layout.pairs and (layout.width if layout.padding is not None else layout.width * layout.height) % 2:
            raise ValueError(f"{path}: Mono{bits}Packed holds pixels in pairs, not {layout.height} x {layout.width}")
        name = f"Mono{bits}{'Packed' if layout.pairs else 'p'}"
        return _recording(path, raw_files(path), layout, name, hints)

    return read_packed


read_mono10p = _packed(10, "lsb")
read_mono12p = _packed(12, "lsb")
read_mono10packed = _packed(10, None)
read_mono12packed = _packed(12, None)


def read_mraw(path: Path, hints: Hints) -> Recording:
    """Photron .mraw: size, depth and rate are in the .cihx or .cih beside it; 12 bits packed, highest bit first."""
    if path.suffix.lower() in (".cihx", ".cih"):
        beside = path
        path = _beside(path, (".mraw", ".MRAW", ".raw"))
    else:
        beside = _beside(path, (".cihx", ".cih", ".CIHX", ".CIH"))
    facts = _photron_facts(beside)
    if facts["format"].lower() != "mraw" or "raw" in facts["type"].lower() or "colo" in facts["type"].lower():
        raise ValueError(
            f"{beside}: holds {facts['type']} frames as {facts['format']}; read are monochrome frames as MRaw"
        )
    stored = _whole(beside, "bit", facts)
    depth = _whole(beside, "depth", facts)
    side = facts["side"].lower()
    if not (stored in (8, 12, 16) and 1 <= depth <= stored and side in ("lower", "higher")):
        raise ValueError(
            f"{beside}: {depth} bits ({facts['side']}) in pixels of {stored}; read are 8, 12 and 16, Lower or Higher"
        )
    height = _whole(beside, "height", facts)
    width = _whole(beside, "width", facts)
    shift = stored - depth if side == "higher" and stored != 12 else 0
    layout = Layout(height, width, depth, "msb" if stored == 12 else None, shift=shift)
    if stored == 12:
        layout = replace(layout, bits=12)
    elif layout.pixel_bytes * 8 != stored:  # few bits in two bytes
        layout = replace(layout, bits=9)
    recording = _recording(path, [path], layout, "Photron .mraw", hints)
    stated = _whole(beside, "frames", facts)
    if recording.shape[0] != stated:
        raise ValueError(f"{path}: {recording.shape[0]} frames, and {beside.name} states {stated}; copy it again")
    rate = _number(beside, "rate", facts)
    shutter = _number(beside, "shutter", facts)
    exposure = shutter if shutter < 1 else 1 / shutter  # stated as seconds, or as the n of 1/n s
    source = replace(recording.source, camera=facts["camera"], exposure_stated=exposure)
    said = f"{recording.reading}; {rate:g} frames per second, exposure {exposure:g} s (shutter {facts['shutter']})"
    return replace(recording, reading=said, source=source, frame_rate=rate, exposure=exposure)


# The name of a fact, its path in a .cihx, and its name in a .cih.
_PHOTRON = (
    ("width", "imageDataInfo/resolution/width", "Image Width"),
    ("height", "imageDataInfo/resolution/height", "Image Height"),
    ("frames", "frameInfo/totalFrame", "Total Frame"),
    ("rate", "recordInfo/recordRate", "Record Rate(fps)"),
    ("shutter", "recordInfo/shutterSpeed", "Shutter Speed(s)"),
    ("bit", "imageDataInfo/colorInfo/bit", "Color Bit"),
    ("depth", "imageDataInfo/effectiveBit/depth", "EffectiveBit Depth"),
    ("side", "imageDataInfo/effectiveBit/side", "EffectiveBit Side"),
    ("format", "imageFileInfo/fileFormat", "File Format"),
)
_PHOTRON_MAY = (
    ("type", "imageFileInfo/type", "Color Type", "Mono"),
    ("camera", "deviceInfo/deviceName", "Camera Type", "not stated"),
)


def _photron_facts(path: Path) -> dict[str, str]:
    """Return the facts of a .cihx (an element <cih> among other bytes) or a .cih (lines `Name : value`)."""
    text = opening.content(path, "description", most=limits.SIDE_FILE).decode("utf-8", "ignore")
    if path.suffix.lower() == ".cih":
        lines = dict(re.findall(r"^\s*([^:\n]+?)\s*:[ \t]*(.*?)\s*$", text, re.MULTILINE))
        found = {name: lines.get(key) for name, _, key in _PHOTRON}
        found |= {name: lines.get(key, other) for name, _, key, other in _PHOTRON_MAY}
    else:
        found = _photron_xml(path, text)
    missing = [
        key for name, place, cih in _PHOTRON if not found.get(name) for key in (cih if lines_of(path) else place,)
    ]
    if missing:
        raise ValueError(f"{path}: lacks {', '.join(missing)}; copy the description of the recording again")
    return {name: str(value) for name, value in found.items()}


def lines_of(path: Path) -> bool:
    """Return whether a description of Photron is the older one of lines."""
    return path.suffix.lower() == ".cih"


def _photron_xml(path: Path, text: str) -> dict[str, str | None]:
    from xml.etree import ElementTree

    element = re.search(r"<cih>.*</cih>", text, re.DOTALL)
    if element is None or "<!" in element[0]:  # entities could grow without a limit
        raise ValueError(f"{path}: holds no element <cih>; copy the description of the recording again")
    try:
        root = ElementTree.fromstring(element[0])
    except ElementTree.ParseError as error:
        raise ValueError(f"{path}: not readable as XML ({error}); copy it again") from None
    found = {name: root.findtext(place) for name, place, _ in _PHOTRON}
    return found | {name: root.findtext(place, other) for name, place, _, other in _PHOTRON_MAY}


def _whole(path: Path, name: str, facts: dict[str, str]) -> int:
    if not re.fullmatch(r"\s*[0-9]{1,9}\s*", facts[name]) or int(facts[name]) < 1:
        raise ValueError(f"{path}: {name} is {facts[name]!r:.40}; a whole number from 1 is expected")
    return int(facts[name])


def _number(path: Path, name: str, facts: dict[str, str]) -> float:
    over, _, under = facts[name].partition("/")
    try:
        value = float(over) / float(under or 1)
    except (ValueError, ZeroDivisionError):
        value = math.nan
    if not 0 < value < math.inf:
        raise ValueError(f"{path}: {name} is {facts[name]!r:.40}; a number above 0 is expected")
    return value


def _beside(path: Path, endings: tuple[str, ...]) -> Path:
    for ending in endings:
        if (found := path.with_suffix(ending)).is_file():
            return found
    raise FileNotFoundError(f"{path}: {path.with_suffix(endings[0]).name} is not beside it; copy both files")


def _need(path: Path, facts: dict[str, int | None]) -> None:
    missing = [f"{name}=" for name, value in facts.items() if value is None]
    if missing:
        raise ValueError(f"{path}: raw frames do not state their layout; add {' and '.join(missing)}")


def _with_gaps(layout: Layout, hints: Hints) -> Layout:
    return replace(layout, skip=hints.skip_bytes or 0, padding=hints.row_padding)


def _one_of(path: Path, name: str, value: str, known: tuple[str, ...]) -> str:
    if value not in known:
        raise ValueError(f"{path}: {name}={value!r:.40}: known are {', '.join(known)}")
    return value


def raw_files(path: Path) -> list[Path]:
    """Return one file, or the .bin files of a folder tree in the order of their numbers."""
    if path.is_file():
        return [path]
    found = numbered(list(path.rglob("*.bin")), below=path)
    if not found:
        raise FileNotFoundError(f"{path}: no such file, or a folder without .bin files")
    gaps.tell_files(found)
    return found


def _recording(path: Path, files: list[Path], layout: Layout, form: str, hints: Hints) -> Recording:
    check_shape(path, (1, layout.height, layout.width))
    what = f"{form} ({layout.said})"
    counts = []
    for file in files:
        opening.regular(file)
        size = file.stat().st_size - layout.skip
        if size < 0:
            raise ValueError(f"{file}: {file.stat().st_size} bytes, fewer than the {layout.skip} to skip")
        counts.append(check_size(file, size, layout.frame_bytes, what))
    ends = np.cumsum(counts)

    def raw(start: int, stop: int) -> Array:
        parts = []
        for file, count, end in zip(files, counts, ends, strict=True):
            low = max(start - int(end - count), 0)
            high = min(stop - int(end - count), count)
            if low < high:
                size = (high - low) * layout.frame_bytes
                found = np.fromfile(file, np.uint8, size, offset=layout.skip + low * layout.frame_bytes)
                if found.size != size:
                    raise ValueError(f"{file}: became shorter while it was read")
                parts.append(layout.decoded(found))
        return np.concatenate(parts)

    shape = (int(ends[-1]), layout.height, layout.width)
    order = layout.order or f"none: {layout.said}"
    source = Source(format=form, bit_order=order, orientation="as stored", raw_layout=layout.said)
    reading = f"read as {shape[0]} frames of {layout.said}"
    return replace(values_recording(path, shape, raw, layout.bits, source, hints), reading=reading)

"""Reads and writes video through FFmpeg; memory does not grow with the number of frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import files, limits, opening
from qsim.checks import check_shape
from qsim.clip.source import Source
from qsim.files import decoding_errors
from qsim.formats.images import to_luminance
from qsim.formats.recording import (
    Hints,
    Recording,
    Times,
    light_recording,
    need_transfer,
    reached,
    white_of,
)

_FULL_RANGE = 2  # FFmpeg's AVCOL_RANGE_JPEG
EXACT = 2 | 0x2000 | 0x40000  # FFmpeg's BILINEAR, FULL_CHR_H_INT, ACCURATE_RND; else colours are a code too dark
# Containers that hold their frames; FFmpeg's "concat" and "hls" open any file that a text names.
_CONTAINERS = (
    "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpeg,mpegts,mpegvideo,m4v,h264,hevc,yuv4mpegpipe,flv,asf,ogg,mxf,nut,ivf,"
    "mjpeg,gif"
)


def read_video(path: Path, hints: Hints) -> Recording:
    """Read a video as light of full depth; the container's frame rate is not the capture rate.

    Frames are decoded in order and not kept: reading backwards decodes from the start again.
    """
    transfer = need_transfer(path, hints)
    with decoding_errors(path, "video"):
        about = _video_facts(path)
    full = about.full
    check_shape(path, (about.frames, about.height, about.width))
    shape = (about.frames, *(about.size if about.turn is None else about.turn.size(*about.size)))
    decoder = _Decoder(path, about)

    white, _ = white_of(path, hints, full)

    def marked(start: int, stop: int) -> tuple[Array, Array]:
        with decoding_errors(path, "video"):
            found = decoder.frames(start, stop)
            light = np.stack([to_luminance(f, transfer, full, f.ndim == 3) for f in found])
            return light, np.stack([reached(f, white, f.ndim == 3) for f in found])

    source = Source(format="video", transfer=transfer)
    reading = ""
    if about.turn is not None:
        source = replace(source, orientation=f"upright: {about.turn.said}")
        reading = about.turn.said
    found = light_recording(path, shape, marked, source, hints, full)
    return replace(found, reading=reading, times=about.times)


def write_video(path: Path, frames: Iterator[Array], frame_rate: float, *, lossless: bool) -> None:
    """Write 8-bit grey [H, W] (lossy: or colour [H, W, 3]) as H.264: exact (`qp 0`), or FFmpeg's yuv420p."""
    import av

    with files.replacing(path) as file, av.open(file, "w", format="mp4") as container:
        stream: Any = None
        for image in frames:
            if stream is None:
                rate = Fraction(frame_rate).limit_denominator(1001)  # 30000/1001 is a usual rate
                stream = container.add_stream("libx264", rate=rate, options={"qp": "0"} if lossless else {})
                stream.height, stream.width = image.shape[:2]
                stream.codec_context.pix_fmt = "gray" if lossless else "yuv420p"
                if not lossless and (image.shape[0] % 2 or image.shape[1] % 2):
                    other = "leave lossy=True out" if image.ndim == 2 else "write pictures, with to=png"
                    raise ValueError(f"{path}: lossy H.264 needs even sizes, the frames are {image.shape[:2]}; {other}")
            picture = av.VideoFrame.from_ndarray(image, format="gray" if image.ndim == 2 else "rgb24")
            if lossless:  # mark the range as 0 ... 255, or decoders stretch 16 ... 235
                picture.color_range = stream.codec_context.color_range = _FULL_RANGE
            for packet in stream.encode(picture):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)


def read_frames(path: Path) -> Iterator[Array]:
    """Yield the frames of a video as they are stored: grey of 8 bits [H, W], or red, green and blue [H, W, 3].

    `ValueError` for a video of more bits.
    """
    with decoding_errors(path, "video"):
        about = _video_facts(path)
        check_shape(path, (1, about.height, about.width))
        if about.full > 255:
            raise ValueError(f"{path}: pixels of more than 8 bits")
        yield from _decoded(path, about)


class _Decoder:
    """Decodes frames in order; an earlier frame starts again at the first."""

    def __init__(self, path: Path, about: Facts) -> None:
        self.path = path
        self.about = about
        self.next = 0
        self.source: Iterator[Array] | None = None

    def frames(self, start: int, stop: int) -> list[Array]:
        if self.source is None or start < self.next:
            self.source = _decoded(self.path, self.about)
            self.next = 0
        found = []
        while self.next < stop:
            frame = next(self.source, None)
            if frame is None:
                raise ValueError(
                    f"{self.path}: ends after {self.next} frames, fewer than stated: the file is truncated"
                )
            if self.next >= start:
                found.append(frame)
            self.next += 1
        return found


def _decoded(path: Path, about: Facts) -> Iterator[Array]:
    """Yield the frames upright."""
    for frame in _stored(path, about.size, about.full):
        yield frame if about.turn is None else about.turn(frame)


def _stored(path: Path, size: tuple[int, int], full: int) -> Iterator[Array]:
    with _open_video(path) as container:
        for frame in container.decode(video=0):
            if (frame.height, frame.width) != size or _full(path, frame.format) != full:
                kind = f"{frame.height} x {frame.width} pixels as {frame.format.name}"
                raise ValueError(f"{path}: a frame of {kind} among {size} with values up to {full}")
            if _is_grey(frame.format):
                yield frame.to_ndarray(format="gray" if full == 255 else frame.format.name)
            else:
                yield frame.to_ndarray(format="rgb24" if full == 255 else "rgb48le", interpolation=EXACT)


def _is_grey(pixels: Any) -> bool:
    return bool(pixels.name.startswith("gray"))


def _full(path: Path, pixels: Any) -> int:
    """Return the largest value of decoded pixels of FFmpeg's format: of grey, or of red, green and blue.

    `ValueError` for luma and chroma of more than 8 bits: FFmpeg's 16-bit colour of them has no stated white.
    """
    bits = max(component.bits for component in pixels.components)
    if bits <= 8:
        return 255
    if bits > 16 or not (_is_grey(pixels) or pixels.is_rgb):
        raise ValueError(
            f"{path}: colour of {bits} bits ({pixels.name}) would lose the lower ones; store it as TIFF, or with 8 bits"
        )
    return 2**bits - 1 if _is_grey(pixels) else 65535


def _open_video(path: Path) -> Any:
    """Open a container; files that name other files (playlists) and frames above limits.PIXELS are refused."""
    import av

    opening.regular(path, most=limits.ASSET if path.suffix.lower() == ".gif" else None)  # FFmpeg reads it to the end
    container = av.open(files.native(path), options={"format_whitelist": _CONTAINERS, "protocol_whitelist": "file"})
    for stream in container.streams.video:
        stream.codec_context.options = {"max_pixels": str(limits.PIXELS)}
    return container


@dataclass(frozen=True)
class Turn:
    """A display matrix of quarter turns and mirrors: stored (x, y) is shown at (a x + c y, b x + d y)."""

    a: int
    b: int
    c: int
    d: int

    @property
    def said(self) -> str:
        return f"turned as its display matrix states ({self.a}, {self.b}; {self.c}, {self.d})"

    def size(self, height: int, width: int) -> tuple[int, int]:
        return (width, height) if self.a == 0 else (height, width)

    def __call__(self, pixels: Array) -> Array:
        """Return a frame [H, W(, 3)] as it is shown."""
        if self.a == 0:
            found = pixels.swapaxes(0, 1)[:: self.b, :: self.c]
        else:
            found = pixels[:: self.d, :: self.a]
        return np.ascontiguousarray(found)


@dataclass(frozen=True)
class Facts:
    """What a video file states, its frames counted."""

    frames: int
    height: int
    width: int
    full: int  # largest value of a pixel
    times: Times | None
    turn: Turn | None

    @property
    def size(self) -> tuple[int, int]:
        return self.height, self.width


def _video_facts(path: Path) -> Facts:
    """Return what the file states; a cut off or unsized packet is no frame."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    with _open_video(path) as container:
        if not container.streams.video:
            raise ValueError(f"{path}: has no video stream")
        stream = container.streams.video[0]
        height = stream.codec_context.height
        width = stream.codec_context.width
        full = _full(path, stream.codec_context.format)
        packets = [packet for packet in container.demux(stream) if packet.size and not packet.is_discard]
        stamps = sorted(packet.pts for packet in packets if packet.pts is not None)
        base = float(stream.time_base) if stream.time_base is not None else 0.0
    times = None
    if len(stamps) == len(packets) and base > 0 and len(set(stamps)) == len(stamps):
        times = Times(tuple(stamp * base for stamp in stamps), "s", "presentation times of the video", base)
    return Facts(len(packets), height, width, full, times, _turn(path) if packets else None)


def _turn(path: Path) -> Turn | None:
    """Return how the first frame is to be turned; `ValueError` for an angle that is no quarter of a turn."""
    with _open_video(path) as container:
        frame = next(container.decode(video=0), None)
        data = None if frame is None else frame.side_data.get("DISPLAYMATRIX")
        if data is None:
            return None
        # A matrix of 3 x 3 fixed-point numbers of 16.16 bits, of which four turn the picture.
        numbers = np.frombuffer(bytes(data), np.int32)[[0, 1, 3, 4]]
    parts = np.rint(numbers / 65536).astype(int)
    if np.abs(numbers / 65536 - parts).max() > 1e-3 or abs(int(parts[0] * parts[3] - parts[1] * parts[2])) != 1:
        raise ValueError(f"{path}: its display matrix turns by no quarter of a turn; encode it again without it")
    found = Turn(*(int(part) for part in parts))
    return None if found == Turn(1, 0, 0, 1) else found

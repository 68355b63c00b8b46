"""Pictures and video: PNG, TIFF, mp4 in; mp4, PNG, EXR, zarr, photon cubes out.

A picture holds light (grey or colour, coded by a declared transfer curve) or codes (a given number of bits, one code a
pixel, or stretched to 0 ... 255). Colour becomes linear luminance (Rec. 709). Memory does not grow with T.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import files
from qsim.checks import MAX_PIXELS, check_shape
from qsim.clip import exr
from qsim.colour import from_linear, luminance, to_linear
from qsim.files import decoding_errors
from qsim.formats.array_files import checked_codes
from qsim.formats.recording import (
    Footage,
    Hints,
    light_footage,
    need_transfer,
    numbered,
    reached,
    white_of,
)
from qsim.sensor import packing

_FULL_RANGE = 2  # FFmpeg's AVCOL_RANGE_JPEG
EXACT = 2 | 0x2000 | 0x40000  # FFmpeg's BILINEAR, FULL_CHR_H_INT, ACCURATE_RND; else colours come a code dark
BLOCK = 16  # frames read at a time
# FFmpeg's readers of files that hold their frames themselves; its "concat" and "hls" open whatever a text names.
_CONTAINERS = (
    "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpeg,mpegts,mpegvideo,m4v,h264,hevc,yuv4mpegpipe,flv,asf,ogg,mxf,nut,ivf,"
    "mjpeg,gif"
)


def read_png(path: Path, hints: Hints) -> Footage:
    """A PNG, or a folder of PNGs in the order of their numbers: 1-bit pictures are codes, others as `picture` says."""
    pictures = [path] if path.is_file() else numbered(list(path.glob("*.png")))
    if not pictures:
        raise FileNotFoundError(f"{path}: holds no .png")
    first = _png(pictures[0])
    shape = check_shape(path, (len(pictures), *first.shape[:2]))

    def raw(start: int, stop: int) -> Array:
        return _same_size(pictures[start:stop], [_png(p) for p in pictures[start:stop]], first.shape, first.dtype)

    return picture(path, shape, raw, first.dtype, "PNG", hints)


def read_tiff(path: Path, hints: Hints) -> Footage:
    """A TIFF with one page per frame, or a folder of single-page TIFFs; MinIsWhite is turned to MinIsBlack."""
    found = [path] if path.is_file() else numbered([*path.glob("*.tif"), *path.glob("*.tiff")])
    if not found:
        raise FileNotFoundError(f"{path}: holds no .tif or .tiff")
    counts = [_tiff_pages(file) for file in found]
    where = [(file, page) for file, count in zip(found, counts, strict=True) for page in range(count)]
    first = _tiff(*where[0])
    shape = check_shape(path, (len(where), *first.shape[:2]))

    def raw(start: int, stop: int) -> Array:
        chosen = where[start:stop]
        return _same_size([file for file, _ in chosen], [_tiff(*place) for place in chosen], first.shape, first.dtype)

    return picture(path, shape, raw, first.dtype, "TIFF", hints)


def read_video(path: Path, hints: Hints) -> Footage:
    """An mp4 (or what else FFmpeg decodes) as light; the container's frame rate is not the capture rate.

    Frames are decoded in order and kept only while they are needed: ask for them in order.
    """
    transfer = need_transfer(path, hints)
    with decoding_errors(path, "video"):
        frames, height, width = _video_shape(path)
    shape = check_shape(path, (frames, height, width))
    decoder = _Decoder(path, height, width)

    white, _ = white_of(path, hints, 255)

    def marked(start: int, stop: int) -> tuple[Array, Array]:
        with decoding_errors(path, "video"):
            found = decoder.frames(start, stop)
            light = np.stack([to_luminance(f, transfer, 255, f.ndim == 3) for f in found])
            return light, np.stack([reached(f, white, f.ndim == 3) for f in found])

    return light_footage(path, shape, marked, "video", {"transfer": transfer}, hints, 255)


def read_light_npy(path: Path, hints: Hints) -> Footage:
    """Numbers [T, H, W] as light: integers are coded by --transfer (full scale of their type), floats are linear."""
    from qsim.formats.array_files import load_array

    array = load_array(path)
    shape = check_shape(path, array.shape)
    floats = array.dtype.kind == "f"
    transfer = "linear" if floats and hints.transfer is None else need_transfer(path, hints)
    top = 1.0 if floats else float(np.iinfo(array.dtype).max)
    full = float("inf") if floats else top
    white, _ = white_of(path, hints, full)

    def marked(start: int, stop: int) -> tuple[Array, Array]:
        values = _checked_light(path, array[start:stop], start)
        light = values.astype(np.float32) if floats and transfer == "linear" else to_linear(values, transfer, top)
        return light, reached(values, white)

    return light_footage(path, shape, marked, ".npy", {"transfer": transfer}, hints, full)


def picture(path: Path, shape: tuple[int, int, int], raw: Any, dtype: np.dtype, source: str, hints: Hints) -> Footage:
    """Pictures as codes, if they are 1-bit or --bits is given, else as light by --transfer.

    `ValueError` if codes seem to be stretched to 0 ... 255 and the user did not say so: the counts would be lost.
    """
    one_bit = dtype.kind == "b"  # then --bits and --stretched have nothing to say
    if one_bit or hints.bits is not None:
        bits = 1 if one_bit else int(hints.bits or 0)
        stretched = not one_bit and hints.stretched
        top = 2**bits - 1

        def read_codes(start: int, stop: int) -> Array:
            values = raw(start, stop)
            if values.ndim == 4:
                raise ValueError(f"{path}: colour pictures hold no codes")
            if stretched:
                return _unstretch(path, values, top, start)
            return checked_codes(path, values, bits, start)

        return Footage(shape, read_codes, source, bits)
    if dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path}: pixels of {dtype}; 1-, 8- and 16-bit pictures are read")
    transfer = need_transfer(path, hints)
    full = float(np.iinfo(dtype).max)

    white, _ = white_of(path, hints, full)

    def marked(start: int, stop: int) -> tuple[Array, Array]:
        values = raw(start, stop)
        colour = values.ndim == 4
        return to_luminance(values, transfer, full, colour), reached(values, white, colour)

    return light_footage(path, shape, marked, source, {"transfer": transfer}, hints, full)


def to_luminance(values: Array, transfer: str, top: float, colour: bool) -> Array:
    """Linear light of grey [..., H, W] or colour [..., H, W, 3] pictures: linearised first, then weighted."""
    if not colour:
        return to_linear(values, transfer, top)
    if (values == values[..., :1]).all():  # grey in three channels: exact without weights
        return to_linear(values[..., 0], transfer, top)
    return luminance(to_linear(values, transfer, top))


def write_video(path: Path, frames: Iterator[Array], frame_rate: float, *, lossless: bool) -> None:
    """8-bit grey frames [H, W] (lossy: colour [H, W, 3] too) as H.264: bit-exact grey (`qp 0`), or FFmpeg's yuv420p."""
    import av

    with files.replacing(path) as file, av.open(file, "w", format="mp4") as container:
        stream: Any = None
        for image in frames:
            if stream is None:
                stream = container.add_stream(
                    "libx264", rate=round(frame_rate), options={"qp": "0"} if lossless else {}
                )
                stream.height, stream.width = image.shape[:2]
                stream.codec_context.pix_fmt = "gray" if lossless else "yuv420p"
                if not lossless and (image.shape[0] % 2 or image.shape[1] % 2):
                    raise ValueError(
                        f"{path}: lossy H.264 needs even sizes, the frames are {image.shape[:2]}; use --lossless"
                    )
            picture = av.VideoFrame.from_ndarray(image, format="gray" if image.ndim == 2 else "rgb24")
            if lossless:  # say that 0 ... 255 are meant, or decoders stretch 16 ... 235
                picture.color_range = stream.codec_context.color_range = _FULL_RANGE
            for packet in stream.encode(picture):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)


def write_png(folder: Path, images: Iterator[Array]) -> None:
    """One PNG per image, 000000.png ...: bool as 1-bit, uint8 and uint16 as they are."""
    from PIL import Image

    for t, image in enumerate(images):
        with files.replacing(folder / f"{t:06d}.png") as file:
            Image.fromarray(image).save(file, format="png")


def write_exr(folder: Path, images: Iterator[Array]) -> None:
    """One float32 EXR with the channel Y per image, losslessly zipped."""
    for t, image in enumerate(images):
        files.write_bytes(folder / f"{t:06d}.exr", exr.encode({"Y": image.astype("<f4")}, compress=True))


def write_zarr(folder: Path, blocks: Iterator[Array], shape: tuple[int, int, int], attributes: dict[str, Any]) -> None:
    """A zarr v3 group with `frames` [T, H, W], chunks of whole frames; binary codes as quanta-spad-sim stores them."""
    import zarr

    group = zarr.open_group(str(folder), mode="w", zarr_format=3)
    group.attrs.update(attributes)
    per_chunk = max(1, min(max(shape[0], 1), (8 << 20) // (shape[1] * shape[2])))
    array = None
    start = 0
    for block in blocks:
        if array is None:
            chunks = (per_chunk, *shape[1:])
            array = group.create_array(
                "frames", shape=shape, chunks=chunks, dtype=block.dtype, config={"write_empty_chunks": True}
            )  # dark chunks too: a reader cannot tell one that was left out from one that was lost
        array[start : start + len(block)] = block
        start += len(block)


def write_cube(path: Path, blocks: Iterator[Array], shape: tuple[int, int, int]) -> None:
    """Binary planes as a photon cube: uint8 [T, H, ceil(W/8)], rows padded, most significant bit first."""
    frames, height, width = shape
    with files.replacing(path) as file:
        header = {"descr": "|u1", "fortran_order": False, "shape": (frames, height, packing.packed_width(width, 1))}
        np.lib.format.write_array_header_1_0(file, header)
        for block in blocks:
            file.write(packing.pack(block, 1).tobytes())


def stretch(values: Array, bits: int) -> Array:
    """Codes 0 ... 2^bits - 1 as 8-bit grey 0 ... 255, rounded; `_unstretch` inverts it exactly up to 8 bits."""
    return np.rint(values.astype(np.float64) * 255 / (2**bits - 1)).astype(np.uint8)


def grey(light: Array, white: float, transfer: str) -> Array:
    """Linear light as 8-bit grey, `white` becoming 255."""
    return from_linear(light / white, transfer, 255)


class _Decoder:
    """Frames of a video in order; going back starts again."""

    def __init__(self, path: Path, height: int, width: int) -> None:
        self.path, self.size = path, (height, width)
        self.next = 0
        self.source: Iterator[Array] | None = None

    def frames(self, start: int, stop: int) -> list[Array]:
        if self.source is None or start < self.next:
            self.source, self.next = self._decode(), 0
        found = []
        while self.next < stop:
            frame = next(self.source, None)
            if frame is None:
                raise ValueError(f"{self.path}: ends after {self.next} frames, though it says more; it is truncated")
            if self.next >= start:
                found.append(frame)
            self.next += 1
        return found

    def _decode(self) -> Iterator[Array]:
        with _open_video(self.path) as container:
            for frame in container.decode(video=0):
                if (frame.height, frame.width) != self.size:
                    raise ValueError(f"{self.path}: a frame of {frame.height} x {frame.width} among {self.size}")
                if frame.format.name.startswith("gray"):
                    yield frame.to_ndarray(format="gray")
                else:
                    yield frame.to_ndarray(format="rgb24", interpolation=EXACT)


def _open_video(path: Path) -> Any:
    """A video's container; a file that names other files (a playlist) or promises too large frames is not read."""
    import av

    container = av.open(str(path), options={"format_whitelist": _CONTAINERS, "protocol_whitelist": "file"})
    for stream in container.streams.video:
        stream.codec_context.options = {"max_pixels": str(MAX_PIXELS)}
    return container


def _video_shape(path: Path) -> tuple[int, int, int]:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    with _open_video(path) as container:
        if not container.streams.video:
            raise ValueError(f"{path}: has no video stream")
        stream = container.streams.video[0]
        height, width = stream.codec_context.height, stream.codec_context.width
        frames = sum(1 for packet in container.demux(stream) if packet.size)
    return frames, height, width


def _png(path: Path) -> Array:
    from PIL import Image

    with decoding_errors(path, "PNG"), Image.open(path, formats=["PNG"]) as opened:
        check_shape(path, (1, opened.height, opened.width))
        if opened.mode in ("RGB", "RGBA", "P", "LA"):
            return np.asarray(opened.convert("RGB"))
        if opened.mode not in ("1", "L", "I;16", "I"):
            raise ValueError(f"{path}: pixels of mode {opened.mode}; 1-, 8- and 16-bit pictures are read")
        pixels = np.asarray(opened)
        return pixels.astype(np.uint16) if pixels.dtype.kind == "i" or pixels.dtype.itemsize > 1 else pixels


def _tiff_pages(path: Path) -> int:
    import tifffile

    with decoding_errors(path, "TIFF"), tifffile.TiffFile(path) as opened:
        return len(opened.pages)  # a chain of pages that bites its tail is refused by the library


def _tiff(path: Path, page: int) -> Array:
    import tifffile

    with decoding_errors(path, "TIFF"), tifffile.TiffFile(path) as opened:
        found: Any = opened.pages[page]
        check_shape(path, (1, found.imagelength, found.imagewidth))
        promised, there = found.nbytes, path.stat().st_size
        if promised > 1032 * there or (found.compression == 1 and found.bitspersample >= 8 and promised > there):
            raise ValueError(f"{path}: page {page} promises {promised} bytes, the file has {there}")
        if float(np.prod(found.chunks, dtype=float)) > max(MAX_PIXELS, 4 * found.imagelength * found.imagewidth):
            raise ValueError(
                f"{path}: page {page} is stored in tiles of {list(found.chunks)} pixels, too large to read"
            )
        pixels: Array = found.asarray()
        size = (found.imagelength, found.imagewidth)
        if pixels.shape not in (size, (*size, 3), (*size, 4)):
            raise ValueError(
                f"{path}: page {page} is {list(pixels.shape)}; grey or colour pictures [H, W(, 3)] are read"
            )
        if found.bitspersample == 1:
            pixels = pixels.astype(bool)
        if found.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
            pixels = ~pixels if pixels.dtype == bool else np.iinfo(pixels.dtype).max - pixels
        if pixels.ndim == 3 and pixels.shape[2] > 3:
            pixels = pixels[..., :3]
        return pixels


def _checked_light(path: Path, values: Array, first: int) -> Array:
    """The values if they are light: finite, not negative, within single precision; else `ValueError` with the place."""
    good = (values >= 0) & (values < 3e38)
    if not good.all():
        t, y, x = (int(i) for i in np.argwhere(~good)[0])
        place = f"(t, y, x) = ({first + t}, {y}, {x})"
        raise ValueError(f"{path}: value {values[t, y, x]} at {place} is no light: expected finite numbers from 0 up")
    return np.asarray(values)


def _same_size(paths: list[Path], images: list[Array], shape: tuple[int, ...], dtype: np.dtype) -> Array:
    for path, image in zip(paths, images, strict=True):
        if image.shape != shape or image.dtype != dtype:
            raise ValueError(
                f"{path}: {image.dtype} {list(image.shape)}, but the first picture is {dtype} {list(shape)}"
            )
    return np.stack(images)


def _unstretch(path: Path, values: Array, top: int, first: int) -> Array:
    found = np.rint(values.astype(np.float64) * top / 255).astype(np.uint8 if top < 256 else np.uint16)
    back = np.rint(found.astype(np.float64) * 255 / top)
    if (back != values).any():
        t, y, x = (int(i) for i in np.argwhere(back != values)[0])
        raise ValueError(
            f"{path}: value {int(values[t, y, x])} at (t, y, x) = ({first + t}, {y}, {x}) is no code 0..{top} "
            "stretched to 0..255; the pictures were coded with loss"
        )
    return found

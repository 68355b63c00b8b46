"""A quick look: clips, streams and arrays as pictures with a caption that says how numbers became grey or colour.

    path -> Source (views: what a picture shows, and how) -> picture(t), uint8 [H, W, 3] -> PNG, GIF, mp4 or a terminal

Nothing is computed from these pictures. Whites and colour scales are those of the whole clip (from at most SAMPLES
frames), so that frames can be compared; a caption under every picture declares them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qsim import colour, files
from qsim.checks import check_shape
from qsim.clip.clip import Clip, Stream
from qsim.files import Progress, load_array
from qsim.formats.array_files import checked_codes
from qsim.sensor import packing

Picture = NDArray[np.uint8]  # [H, W, 3]

SAMPLES = 16  # frames that decide the scales of a clip
KINDS = ("sharp", "radiance", "codes", "average", "flow", "depth")  # that --what knows
CURVE = f"(value / white)^(1/{colour.GAMMA:g})"


@dataclass(frozen=True)
class View:
    """One thing to look at."""

    kind: str  # of KINDS, or "values"
    declared: str  # what it is and how numbers became colours, for caption and sidecar
    picture: Callable[[int], Picture]
    legend: Picture | None = None
    scale: dict[str, float] = field(default_factory=dict)  # the numbers of the declaration


@dataclass(frozen=True)
class Source:
    """What a path holds."""

    name: str
    length: int  # frames
    frame_rate: float | None  # per second of the scene, if known
    views: dict[str, View]


def open_source(path: Path, *, bits: int | None = None, width: int | None = None, stream: str | None = None) -> Source:
    """The views of a clip folder, a stream (.npy or .json) or an array [T, H, W] or [H, W] in a .npy.

    `bits` and `width` tell what a bare array of whole numbers holds: codes, or packed binary planes of so many columns;
    `stream` chooses one of a clip's streams (default: the first). `FileNotFoundError` or `ValueError` with the cure.
    """
    if (path / "dataset.json").is_file():
        raise ValueError(f"{path}: is a data set; name one of its clips, as in {path / 'clips'}/NAME")
    if path.is_dir() or not path.exists():
        clip = Clip.open(path)
        _refuse(path, "a clip, whose streams know their bits", bits=bits, width=width)
        return _clip_source(clip, stream)
    _refuse(path, "no clip", stream=stream)
    sidecar = path.with_suffix(".json")
    described = files.read_json(sidecar) if sidecar.is_file() else {}
    if "ppp_factor" in described:
        _refuse(path, "a stream, which knows its bits", bits=bits, width=width)
        return _stream_source(Stream.open(sidecar))
    if path.suffix != ".npy":
        raise ValueError(f"{path}: expected a clip folder, a stream or a .npy array; `qsim convert` reads other files")
    return _array_source(path, bits, width, described)


def _refuse(path: Path, what: str, **options: int | str | None) -> None:
    """A `ValueError` for options that change nothing of what a path holds."""
    for name, value in options.items():
        if value is not None:
            raise ValueError(f"{path}: is {what}; leave out --{name}")


def _clip_source(clip: Clip, chosen: str | None) -> Source:
    unit = "relative" if clip.camera is None else "W/m2/sr"
    views = {"sharp": _light_view("sharp", "sharp radiance", unit, len(clip), clip.sharp)}
    if any(name.startswith("sharp/") for name in clip.meta["checksums"]):
        views["radiance"] = _light_view("radiance", "radiance of the exposure", unit, len(clip), clip.radiance)
    if chosen is not None or clip.streams:
        views |= _stream_source(clip.stream(chosen or clip.streams[0])).views
    if clip.has_truth:
        views |= {"flow": _flow_view(clip), "depth": _depth_view(clip)}
    shortest = len(clip)
    if "codes" in views:
        shortest = min(shortest, len(clip.stream(chosen or clip.streams[0])))
    return Source(clip.name, shortest, clip.frame_rate, views)


def _stream_source(stream: Stream) -> Source:
    def read(start: int, stop: int) -> NDArray[Any]:
        return stream.codes(start, stop)

    views = _code_views(stream.name, stream.bits, len(stream), read)
    return Source(stream.name, len(stream), float(stream.meta["frame_rate"]), views)


def _array_source(path: Path, bits: int | None, width: int | None, described: dict[str, Any]) -> Source:
    array = load_array(path)
    array = array[None] if array.ndim == 2 else array
    length = check_shape(path, array.shape)[0]
    rate = described.get("frame_rate")
    if array.dtype.kind == "f":
        _refuse(path, "an array of values, no codes", bits=bits, width=width)
        what, unit = described.get("method", "values"), described.get("unit", "as stored")
        title = f"restored by {what}" if "method" in described else what
        view = _light_view("values", title, unit, length, lambda t: np.asarray(array[t], np.float64))
        return Source(path.stem, length, rate, {"values": view})
    if array.dtype.kind == "b":
        _refuse(path, "an array of truth values", bits=bits, width=width)
        bits = 1
    elif width is not None:
        _refuse(path, "packed planes of 1 bit, as --width says", bits=bits)
        return _packed_source(path, array, width)
    if bits is None:
        raise ValueError(f"{path}: whole numbers are codes or packed planes; say --bits 3, or --width 320 for planes")
    if not 1 <= bits <= 16:
        raise ValueError(f"--bits: expected 1 to 16, got {bits}")

    def read(start: int, stop: int) -> NDArray[Any]:
        return checked_codes(path, np.asarray(array[start:stop]), bits, start)

    return Source(path.stem, length, rate, _code_views(path.stem, bits, length, read))


def _packed_source(path: Path, array: NDArray[Any], width: int) -> Source:
    if array.dtype != np.uint8 or width < 1 or packing.packed_width(width, 1) != array.shape[2]:
        raise ValueError(
            f"{path}: {array.dtype} {list(array.shape)} holds no packed planes of {width} columns; "
            f"a row of those is {packing.packed_width(max(width, 1), 1)} bytes of uint8"
        )

    def read(start: int, stop: int) -> NDArray[Any]:
        return packing.unpack(np.asarray(array[start:stop]), 1, width)

    return Source(path.stem, len(array), None, _code_views(path.stem, 1, len(array), read))


# Views


def _samples(length: int) -> list[int]:
    return sorted({int(t) for t in np.linspace(0, length - 1, min(length, SAMPLES))})


def _grey(levels: NDArray[np.uint8]) -> Picture:
    return np.repeat(levels[..., None], 3, axis=-1)


def _light_view(kind: str, title: str, unit: str, length: int, read: Callable[[int], NDArray[Any]]) -> View:
    white = colour.peak(np.stack([read(t) for t in _samples(length)]))
    declared = f"{title}: white = {white:.4g} {unit}, curve {CURVE}"
    return View(kind, declared, lambda t: _grey(colour.tone(read(t), white)), None, {"white": white})


def _code_views(name: str, bits: int, length: int, read: Callable[[int, int], NDArray[Any]]) -> dict[str, View]:
    top = 2**bits - 1
    reach = colour.AVERAGE // 2

    def average(t: int) -> NDArray[np.float64]:
        mean: NDArray[np.float64] = read(max(t - reach, 0), min(t + reach + 1, length)).mean(axis=0) / top
        return mean

    def code(t: int) -> Picture:
        return _grey(colour.code_levels(read(t, t + 1)[0], bits))

    white = colour.peak(np.stack([average(t) for t in _samples(length)]))
    shown = f"codes of {name}: 0 black, {top} white, no curve"
    mean = f"plain average of {colour.AVERAGE} frames: white = {white * top:.4g} codes, curve {CURVE}"
    return {
        "codes": View("codes", shown, code, None, {"bits": bits}),
        "average": View("average", mean, lambda t: _grey(colour.tone(average(t), white)), None, {"white": white}),
    }


def _flow_view(clip: Clip) -> View:
    speeds = np.stack([np.hypot(*clip.flow(t)) for t in _samples(len(clip))])
    finite = speeds[np.isfinite(speeds)]
    largest = max(float(np.percentile(finite, 99.9)) if finite.size else 0.0, 0.5)
    declared = f"flow to the next frame: rim of the wheel = {largest:.3g} px/frame, white still, grey unknown"
    return View(
        "flow",
        declared,
        lambda t: colour.flow_colours(clip.flow(t), largest),
        colour.flow_legend(48),
        {"largest": largest},
    )


def _depth_view(clip: Clip) -> View:
    near, far = colour.depth_range(np.stack([clip.depth(t) for t in _samples(len(clip))]))
    declared = f"depth: {near:.3g} m (left of the bar) to {far:.3g} m, even in 1/depth, black where nothing is"
    return View(
        "depth",
        declared,
        lambda t: colour.depth_colours(clip.depth(t), near, far),
        colour.depth_legend(),
        {"near": near, "far": far},
    )


def choose(source: Source, wanted: list[str] | None, *, several: bool = True) -> list[View]:
    """The views asked for, or the usual ones: all of a clip but `radiance` and `average` (one if not `several`)."""
    if wanted is None:
        usual = [view for kind, view in source.views.items() if kind not in ("radiance", "average")]
        return usual if several else usual[:1]
    for kind in wanted:
        if kind not in source.views:
            raise ValueError(f"{source.name}: has no '{kind}' to show; there are: {', '.join(source.views)}")
    return [source.views[kind] for kind in wanted]


# Layout


@dataclass(frozen=True)
class Sheet:
    """Views side by side, each enlarged by a whole factor, with their captions and legends below."""

    views: list[View]
    scale: int
    caption: Picture  # drawn once: it is the same under every frame

    def frame(self, t: int) -> Picture:
        """One picture, of an even number of rows and columns as video codecs want them."""
        enlarged = [v.picture(t).repeat(self.scale, axis=0).repeat(self.scale, axis=1) for v in self.views]
        column = (self.caption.shape[1] + GAP) // len(self.views)
        row = [np.pad(p, ((0, 0), (0, column - p.shape[1]), (0, 0)), constant_values=PAPER) for p in enlarged]
        sheet = np.concatenate([np.concatenate(row, axis=1)[:, :-GAP], self.caption])
        return np.pad(sheet, ((0, sheet.shape[0] % 2), (0, sheet.shape[1] % 2), (0, 0)), constant_values=PAPER)


GAP, PAPER, INK = 6, 250, (40, 40, 44)
SMALLEST = 224  # columns of an enlarged picture, so that its caption can be read
NARROWEST = 112  # columns of a caption and its legend


def sheet(views: list[View], scale: int | None = None) -> Sheet:
    """Lay out views; `scale` is the enlargement (default: so that a picture is at least SMALLEST columns wide)."""
    width = views[0].picture(0).shape[1]
    scale = scale or max(1, -(-SMALLEST // width))
    captions = [_caption(view, max(width * scale, NARROWEST)) for view in views]
    height = max(caption.shape[0] for caption in captions)
    padded = [np.pad(c, ((0, height - len(c)), (0, GAP), (0, 0)), constant_values=PAPER) for c in captions]
    return Sheet(views, scale, np.concatenate(padded, axis=1)[:, :-GAP])


def _caption(view: View, width: int) -> Picture:
    """The declaration in lines that fit `width`, with the legend below it."""
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(size=11)
    lines: list[str] = []
    for word in view.declared.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and font.getlength(longer) <= width - 8:
            lines[-1] = longer
        else:
            lines.append(word)
    legend = view.legend
    height = 8 + 14 * len(lines) + (0 if legend is None else legend.shape[0] + 6)
    image = Image.new("RGB", (width, height), (PAPER,) * 3)
    pen = ImageDraw.Draw(image)
    for i, line in enumerate(lines):
        pen.text((4, 4 + 14 * i), line, fill=INK, font=font)
    if legend is not None:
        image.paste(Image.fromarray(legend), (4, 8 + 14 * len(lines)))
    return np.asarray(image)


# Files


def write(
    path: Path, page: Sheet, frames: range, fps: float, about: dict[str, Any], progress: Progress | None = None
) -> None:
    """PNG (the first of `frames`), GIF or mp4 by the name of `path`, and beside it .json: `about` and what is declared.

    The sidecar of OUT.mp4 is OUT.mp4.json. Both are whole or absent.
    """
    declared = {"format": "qsim-preview-1", "curve": CURVE, "views": [declaration(view) for view in page.views]}
    drawn = _drawn(page, frames, progress)
    if path.suffix == ".png":
        _write_png(path, next(drawn), declared)
    elif path.suffix == ".gif":
        _write_gif(path, drawn, fps)
    else:
        from qsim.formats.video import write_video

        write_video(path, drawn, fps, lossless=False)
    files.write_json(path.with_name(path.name + ".json"), declared | about)


def _drawn(page: Sheet, frames: range, progress: Progress | None) -> Iterator[Picture]:
    for n, t in enumerate(frames, 1):
        yield page.frame(t)
        if progress is not None:
            progress(n, len(frames))


def declaration(view: View) -> dict[str, Any]:
    """What a view shows and how, for programs."""
    return {"what": view.kind, "declared": view.declared} | view.scale


def _write_png(path: Path, picture: Picture, declared: dict[str, Any]) -> None:
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    text = PngInfo()
    text.add_text("Description", json.dumps(declared))
    with files.replacing(path) as file:
        Image.fromarray(picture).save(file, format="png", pnginfo=text)


def _write_gif(path: Path, frames: Iterator[Picture], fps: float) -> None:
    from PIL import Image

    images = [Image.fromarray(frame).quantize(256) for frame in frames]
    with files.replacing(path) as file:
        duration = max(20, round(1000 / fps))
        images[0].save(file, format="gif", save_all=True, append_images=images[1:], duration=duration, loop=0)

"""Opens clips, streams and arrays as views: pictures whose relation to the numbers is declared.

    path -> Source -> View.picture(t), uint8 [H, W, 3]

One brightest value and one colour scale apply to all frames (measured on at most SAMPLES of them), so that frames can
be compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qsim import colour, files
from qsim.checks import ArgumentError, check_shape, check_video
from qsim.colour import bright_end
from qsim.files import load_array
from qsim.formats.recording import checked_codes
from qsim.lazy_array import LazyArray
from qsim.plane_sums import AS_STORED, PlaneSums, within_sum
from qsim.restored_video import Restored, RestoredInfo, describes_restored
from qsim.sensor import packing
from qsim.sensor.demosaicing import demosaic, determines_bands
from qsim.streams.clip import Clip
from qsim.streams.stream import Stream

Picture = NDArray[np.uint8]  # [H, W, 3]
SAMPLES = 16  # frames on which the scales of a clip are measured
KINDS = ("sharp", "radiance", "codes", "average", "flow", "depth")  # of views, by name
CURVE = f"(value / brightest shown)^(1/{colour.GAMMA:g})"


@dataclass(frozen=True)
class View:
    """One kind of picture of a source."""

    kind: str  # of KINDS, or "values"
    declared: str  # quantity and scale, for caption and sidecar
    picture: Callable[[int], Picture]
    legend: Picture | None = None
    scale: dict[str, float] = field(default_factory=dict)  # the numbers of the declaration


@dataclass(frozen=True)
class Source:
    """The views of a path, with its length and rate."""

    name: str
    length: int  # frames
    frame_rate: float | None  # per second of the scene, if known
    views: dict[str, View]
    rates: str = ""  # of codes and of the planes that they sum, in words


def open_source(
    path: Path,
    *,
    bits: int | None = None,
    width: int | None = None,
    stream: str | None = None,
    sums: PlaneSums = AS_STORED,
) -> Source:
    """Open a clip folder, a stream (.npy or .json) or an array [T, H, W] or [H, W] in a .npy.

    For an array of whole numbers, `bits` means codes and `width` packed binary planes of that many columns. `stream`
    selects one of a clip's streams (default: the first). Of a stream or an array of codes, `sums` are shown.
    Raise `FileNotFoundError` or `ValueError` for other paths.
    """
    if (path / "dataset.json").is_file():
        raise ValueError(f"{path}: is a data set; name one of its clips, as in {path / 'clips'}/NAME")
    if path.is_dir() or not path.exists():
        clip = Clip.open(path)
        _refuse(path, "a clip, whose streams state their bits", bits=bits, width=width)
        if sums.any:
            raise ValueError(f"{path}: is a clip; planes are summed in a stream, as in {path / 'streams'}/NAME.npy")
        return _clip_source(clip, stream)
    _refuse(path, "not a clip", stream=stream)
    sidecar = path.with_suffix(".json")
    described = files.read_json(sidecar) if sidecar.is_file() else {}
    if "code_model" in described:
        _refuse(path, "a stream, which states its bits", bits=bits, width=width)
        return _stream_source(Stream.open(sidecar), sums)
    if path.suffix != ".npy":
        raise ValueError(f"{path}: expected a clip folder, a stream or a .npy array; `qsim convert` reads other files")
    video = Restored.open(sidecar).info if describes_restored(described) else None
    if video is not None and sums.any:
        raise ValueError(f"{path}: is restored video, and planes are summed in a recording of codes")
    return _array_source(path, bits, width, video, sums)


def _refuse(path: Path, what: str, **options: int | str | None) -> None:
    """Raise `ValueError` for options that do not apply to the content of a path."""
    for name, value in options.items():
        if value is not None:
            raise ValueError(f"{path}: is {what}; leave out {name}=")


def _clip_source(clip: Clip, chosen: str | None) -> Source:
    unit = "relative" if clip.camera is None else "W/m2/sr"
    views = {"sharp": _light_view("sharp", "sharp radiance", unit, len(clip), clip.sharp)}
    if clip.info.has_sharp:
        views["radiance"] = _light_view("radiance", "radiance of the exposure", unit, len(clip), clip.radiance)
    length = len(clip)
    rates = ""
    if chosen is not None or clip.streams:
        stream = clip.stream(chosen or clip.streams[0])
        length, held = _held_views(clip, stream)
        views |= held
        rates = stream.rates if chosen is not None else ""
    if clip.holds("u"):
        views["flow"] = _flow_view(clip)
    if clip.holds("Z"):  # clips of warped pictures have none
        views["depth"] = _depth_view(clip)
    return Source(clip.name, length, clip.frame_rate, views, rates)


def _held_views(clip: Clip, stream: Stream) -> tuple[int, dict[str, View]]:
    """Return how many clip frames have a code, and views that show at each of them the code exposed at that time.

    Where rows have their own time, the middle of the readout counts.
    """
    per = stream.info.planes_per_code
    if len(stream) * per > len(clip):  # of a bit-depth study: the planes are those of another clip
        per = 1
    views = _stream_source(stream).views
    if per == 1:
        return min(len(clip), len(stream)), views
    late = 0.0 if stream.rows is None else float(stream.rows.shifts(*stream.shape[1:], clip.frame_rate).mean())
    held = {kind: _held(view, per, late) for kind, view in views.items()}
    return min(len(clip), len(stream) * per + math.floor(late)), held


def _held(view: View, per: int, late: float) -> View:
    """Return the view by clip frames of codes over `per` frames each; the first begins `late` frames after the clip."""
    return replace(
        view,
        declared=f"{view.declared}; each over {per} frames of the clip",
        picture=lambda t: view.picture(max(math.floor((t + 0.5 - late) / per), 0)),
    )


def _stream_source(stream: Stream, sums: PlaneSums = AS_STORED) -> Source:
    filters = stream.colour_filter
    own = stream.sensor.efficiency
    bands = None
    if filters is not None and determines_bands(filters, own):  # else one filter over all pixels, shown in grey
        bands = partial(demosaic, filters=filters, efficiency=own)
    rate = stream.info.frame_rate
    if not sums.any:
        top = stream.sensor.levels - 1
        views = _code_views(stream.name, top, len(stream), stream.codes, bands)
        return Source(stream.name, len(stream), rate, views, stream.rates)
    taken = sums.over(len(stream), str(stream.path), bits=stream.bits)
    of_planes = taken if stream.sums is None else taken.within(stream.sums)
    top = taken.planes if taken.planes > 1 else stream.sensor.levels - 1
    views = _code_views(stream.name, top, taken.codes, taken.of(stream.codes), bands)
    rates = of_planes.words(rate / taken.step * of_planes.step)
    return Source(stream.name, taken.codes, rate / taken.step, views, rates)


def _array_source(
    path: Path, bits: int | None, width: int | None, video: RestoredInfo | None, sums: PlaneSums
) -> Source:
    stored = load_array(path)
    array = stored[None] if stored.ndim == 2 else stored
    in_colour = video is not None and bool(video.colour)
    length = (check_video if in_colour else check_shape)(path, array.shape)[0]
    rate = None if video is None else video.frame_rate
    if array.dtype.kind == "f":
        _refuse(path, "an array of values, not of codes", bits=bits, width=width)
        if sums.any:
            raise ValueError(f"{path}: is an array of values, and planes are summed in a recording of codes")
        title = "values" if video is None else f"restored by {video.method}"
        unit = "as stored" if video is None else video.unit
        view = _light_view("values", title, unit, length, lambda t: np.asarray(array[t], np.float64))
        return Source(path.stem, length, rate, {"values": view}, "" if video is None else video.rates)
    if array.dtype.kind == "b":
        _refuse(path, "an array of truth values", bits=bits, width=width)
        bits = 1
    elif width is not None:
        _refuse(path, "packed planes of 1 bit (width=)", bits=bits)
        return _packed_source(path, array, width, sums)
    if bits is None and (sums.planes or 1) > 1:
        bits = _bits_of_planes(path, array)
    if sums.summed is not None:
        _refuse(path, "said to hold sums of planes (summed=)", bits=bits)
        bits = sums.summed.bit_length()
    if bits is None:
        raise ValueError(f"{path}: whole numbers are codes or packed planes; add bits=3, or width=320 for planes")
    if not 1 <= bits <= 16:
        raise ValueError(f"bits=: expected 1 to 16, got {bits}")

    def read(start: int, stop: int) -> NDArray[Any]:
        return checked_codes(path, np.asarray(array[start:stop]), bits, start)

    return _bare_source(path, bits, length, read, sums)


def _bits_of_planes(path: Path, array: NDArray[Any] | LazyArray) -> int:
    """Return the bits of single planes; `ValueError` for values that are none, as bytes of packed planes."""
    if array[0].max() > 1:
        raise ValueError(f"{path}: whole numbers above 1 are no single planes; of packed planes give width=")
    return 1


def _bare_source(
    path: Path, bits: int, length: int, read: Callable[[int, int], NDArray[Any]], sums: PlaneSums
) -> Source:
    """Return the views of codes of these bits in a bare array, or of sums of them."""
    taken = sums.over(length, str(path), bits=bits, bare=True)
    of_planes = taken.within(sums.stored(length))
    if sums.summed is not None:
        read = within_sum(read, sums.summed, str(path))
    top = of_planes.planes if of_planes.planes > 1 else 2**bits - 1
    views = _code_views(path.stem, top, taken.codes, taken.of(read))
    return Source(path.stem, taken.codes, None, views, of_planes.words(None) if sums.any else "")


def _packed_source(path: Path, array: NDArray[Any] | LazyArray, width: int, sums: PlaneSums) -> Source:
    if array.dtype != np.uint8 or width < 1 or packing.packed_width(width, 1) != array.shape[2]:
        raise ValueError(
            f"{path}: {array.dtype} {list(array.shape)} does not hold packed planes of {width} columns; "
            f"a row of those has {packing.packed_width(max(width, 1), 1)} bytes of uint8"
        )

    def read(start: int, stop: int) -> NDArray[Any]:
        return packing.unpack(np.asarray(array[start:stop]), 1, width)

    if sums.summed is not None:
        raise ArgumentError("summed", f"{path}: packed planes (width=) are single ones; leave it out")
    return _bare_source(path, 1, len(array), read, sums)


def _samples(length: int) -> list[int]:
    return sorted({int(t) for t in np.linspace(0, length - 1, min(length, SAMPLES))})


def _grey(levels: NDArray[np.uint8]) -> Picture:
    return np.repeat(levels[..., None], 3, axis=-1)


def _light_view(kind: str, title: str, unit: str, length: int, read: Callable[[int], NDArray[Any]]) -> View:
    brightest = colour.peak(np.stack([read(t) for t in _samples(length)]))
    declared = f"{title}: brightest shown = {brightest:.4g} {unit}, curve {CURVE}"
    return View(kind, declared, lambda t: _toned(read(t), brightest), None, {"brightest_shown": brightest})


def _toned(light: NDArray[Any], brightest: float) -> Picture:
    """Return light, [H, W] or the bands [3, H, W], as a picture."""
    return (
        _grey(colour.tone(light, brightest)) if light.ndim == 2 else colour.tone_picture(light, brightest, colours=True)
    )


def _code_views(
    name: str,
    top: int,
    length: int,
    read: Callable[[int, int], NDArray[Any]],
    bands: Callable[[NDArray[Any]], NDArray[Any]] | None = None,
) -> dict[str, View]:
    """Return the views of codes 0 ... `top`.

    `bands` makes the mean of a mosaic [H, W] a picture of three bands [3, H, W].
    """
    reach = colour.AVERAGE // 2

    def average(t: int) -> NDArray[np.float64]:
        mean: NDArray[np.float64] = read(max(t - reach, 0), min(t + reach + 1, length)).mean(axis=0) / top
        return mean if bands is None else bands(mean)

    def code(t: int) -> Picture:
        return _grey(colour.code_levels(read(t, t + 1)[0], top))

    brightest = colour.peak(np.stack([average(t) for t in _samples(length)]))
    shown = f"codes of {name}: 0 black, {top} white, no curve"
    after = "" if bands is None else ", demosaiced"
    mean = f"naive mean of {colour.AVERAGE} frames{after}: brightest shown = {brightest * top:.4g} codes, curve {CURVE}"
    return {
        "codes": View("codes", shown, code, None, {"bits": top.bit_length()}),
        "average": View("average", mean, lambda t: _toned(average(t), brightest), None, {"brightest_shown": brightest}),
    }


def _flow_view(clip: Clip) -> View:
    speeds = np.stack([np.hypot(*clip.flow(t)) for t in _samples(len(clip))])
    largest = max(bright_end(speeds), 0.5)
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
    declared = f"depth: {near:.3g} m (left of the bar) to {far:.3g} m, even in 1/depth, black without a surface"
    return View(
        "depth",
        declared,
        lambda t: colour.depth_colours(clip.depth(t), near, far),
        colour.depth_legend(),
        {"near": near, "far": far},
    )


def choose(source: Source, wanted: list[str] | None, *, several: bool = True) -> list[View]:
    """Return the wanted views; by default all but `radiance` and `average` (the first of them if not `several`)."""
    if wanted is None:
        usual = [view for kind, view in source.views.items() if kind not in ("radiance", "average")]
        return usual if several else usual[:1]
    for kind in wanted:
        if kind not in source.views:
            raise ValueError(f"{source.name}: has no view '{kind}'; it has: {', '.join(source.views)}")
    return [source.views[kind] for kind in wanted]


def declaration(view: View) -> dict[str, object]:
    """Return kind, declaration and scale of a view, for JSON."""
    return {"what": view.kind, "declared": view.declared, **view.scale}

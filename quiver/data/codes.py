"""Gives few-bit streams and their sensor to restorers: from memory, from a file, or drawn from a clip when read.

    clip, light -> codes [T, H, W]

Nothing here needs torch.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import records
from qsim.arrays import plain
from qsim.checks import ArgumentError
from qsim.files import read_json, sha256, to_json, wording
from qsim.formats import summing
from qsim.frame_times import Times
from qsim.keys import Key, hash_name
from qsim.lazy_array import LazyArray
from qsim.plane_sums import PlaneSums, Sums
from qsim.restored_video import describes_restored
from qsim.sensor.colour_filter import ColourFilter
from qsim.sensor.demosaicing import demosaic, determines_bands, kernels_of
from qsim.sensor.sensor import Sensor
from qsim.streams.clip import Clip
from qsim.streams.code_truth import CodeTruth
from qsim.streams.exposures import Timing
from qsim.streams.photons import clip_photons
from qsim.streams.preparation import followed
from qsim.streams.storing import describe
from qsim.streams.stream import Stream
from quiver.data import defects
from quiver.data.code_table import draw_codes
from quiver.data.illumination import Illumination

__all__ = [
    "CodeTruth",
    "Codes",
    "LazyArray",
    "Sensor",
    "Stream",
    "array_codes",
    "array_digest",
    "codes_of",
    "filled",
    "frame_reader",
    "open_stream",
    "repaired",
    "sensed",
    "stored",
    "stream_codes",
    "summed",
    "windows_sensed",
]

BLOCK_PIXELS = 1 << 22  # codes that `frame_reader` reads at a time: 4 MB
DIGEST_BYTES = 1 << 24  # of an array, hashed at a time
LIGHT_FRAMES = 11  # spread over a stream, from which its light is estimated where it is not stated
POOLED = 4  # px, side of the squares whose mean code is inverted for it: of single codes the inverse is not the light
DARKEST = 1e-9  # of white: the light that is returned where codes tell none
START = 0.01  # of the rise of the mean code, whose slope holds below that of a dark pixel, too
WINDOW_STAGE = 1000  # of the random keys of published test windows, + frame; 0 is `qsim sense`


@dataclass(frozen=True)
class Codes:
    """A few-bit stream with everything that a restorer needs; frames are read on request."""

    name: str
    shape: tuple[int, int, int]  # T, H, W
    sensor: Sensor
    exposure: float  # s, of one code
    frame_rate: float  # codes per second
    read: Callable[[int, int], Array]  # codes uint8 [stop - start, H, W] of frames start .. stop - 1
    source: str  # of the codes, for provenance
    digest: Callable[[], str] = str  # SHA-256 of the codes, computed on request; empty: not known
    sensor_name: str = ""  # of a device or a file; empty: the sensor's model
    ppp: float | None = None  # mean photons per pixel and code; None: not known
    shares: tuple[float, ...] | None = None  # exposures of codes in turn, over `exposure`; None: all are full
    defective: Array | None = field(default=None, compare=False)  # bool [H, W]; pixels that `read` fills from others
    colour: ColourFilter | None = None  # over the pixels, from the first one on; None: all see one band
    source_sha256: str | None = None  # of a stored stream's codes as its description states it
    not_inverted: str = ""  # defects that add detections, which the sensor's response leaves out: crosstalk, afterpulse
    sums: Sums | None = None  # of a recording's planes; None: its frames are taken as they are
    times: Times | None = None  # of the codes; None: not known
    unmapped: bool = False  # a recording whose hot pixels nothing states: they are looked for (hot_pixels.py)
    scan: str = ""  # what was found, in words
    cuts: tuple[int, ...] = ()  # frames at which another scene or light begins (cuts.py); no method looks across them
    faulty: tuple[int, ...] = ()  # frames that are unlike both neighbours
    unfilled: Codes | None = field(default=None, compare=False, repr=False)  # the same without filled pixels

    @property
    def rates(self) -> str:
        """Return the rate of the codes, and where they are sums that of their planes, as text."""
        if self.sums is not None:
            return self.sums.words(self.frame_rate * self.sums.step)
        planes = self.sensor.levels - 1
        if self.sensor.sums_planes and planes > 1:  # nothing states the planes: those of the sensor's codes
            return Sums(planes, 0, planes, self.shape[0]).words(self.frame_rate * planes)
        return f"{self.frame_rate:g} codes/s"

    @property
    def white(self) -> float:
        """Return the photons at which restored video has the value 1."""
        return self.sensor.white(self.exposure)

    @property
    def video_shape(self) -> tuple[int, ...]:
        """Return the shape of the restored video: [T, H, W], or [T, 3, H, W] behind colour filters."""
        return self.shape if self.colour is None else (self.shape[0], 3, *self.shape[1:])

    @property
    def tile(self) -> tuple[int, int]:
        """Return rows and columns of the pattern of colour filters; (1, 1) without any."""
        return (1, 1) if self.colour is None else self.colour.tile

    @property
    def bands_determined(self) -> bool:
        """Return whether the colours of the stream's filters determine R, G and B; one filter does not."""
        return self.colour is None or determines_bands(self.colour, self.sensor.efficiency)

    @property
    def demosaicing_filters(self) -> Array:
        """Return the linear filters behind `demosaiced`, float64 [rows, columns, 3, n, n], by place of the tile."""
        assert self.colour is not None
        return kernels_of(self.colour, self.sensor.efficiency)

    def demosaiced(self, light: Array) -> Array:
        """Return the photons of R, G and B [3, H, W] of the light [H, W] behind the stream's colour filters.

        They have no floor at 0: of a dim band half the estimates lie below 0, and their mean is right.
        """
        assert self.colour is not None
        return demosaic(light, self.colour, self.sensor.efficiency, floor=False)


def filled(codes: Codes, bad: Array | None) -> Codes:
    """Return the codes of a stream with its defective pixels, bool [H, W], filled (defects.py); the same without any.

    `ValueError` for a map of another size, and for one without a good pixel.
    """
    if bad is None:
        return codes
    if bad.shape != codes.shape[1:]:
        raise ValueError(
            f"{codes.name}: the map of defective pixels has {' x '.join(map(str, bad.shape))} pixels, the frames "
            f"{codes.shape[1]} x {codes.shape[2]}; give the map of this sensor, cut to these frames"
        )
    if not bad.any():
        return codes
    marked = bad if codes.defective is None else bad | codes.defective
    rows, columns = codes.tile  # neighbours of one colour fill a pixel
    places = {(i, j): marked[i::rows, j::columns] for i in range(rows) for j in range(columns)}
    picks = defects.skips_codes(codes.sensor)
    fillers = {place: defects.Filler(own, picks) for place, own in places.items() if own.any()}

    def read(start: int, stop: int) -> Array:
        part = codes.read(start, stop)
        if codes.colour is None:
            return fillers[0, 0].fill(part, start)
        part = part.copy()
        for (i, j), filler in fillers.items():
            part[:, i::rows, j::columns] = filler.fill(part[:, i::rows, j::columns], start)
        return part

    def digest() -> str:
        before = codes.digest()
        return before and hashlib.sha256(before.encode() + np.packbits(marked).tobytes()).hexdigest()

    unfilled = codes.unfilled or codes
    return replace(codes, read=read, digest=digest, defective=marked, unmapped=False, unfilled=unfilled)


def summed(codes: Codes, asked: PlaneSums) -> Codes:
    """Return the codes that sums of a recording's planes make (plane_sums.py); the same if nothing is asked.

    Of codes that are sums already, and of exposures that take turns, some are chosen. Defective pixels are filled in
    the sums. `ArgumentError` for frames that do not exist, and for planes that this sensor does not sum.
    """
    if not asked.any:
        return codes
    if codes.unfilled is not None:
        return filled(summed(codes.unfilled, asked), codes.defective)
    length, height, width = codes.shape
    if (asked.planes or 1) > 1 and codes.sums is not None and codes.sums.planes > 1:
        raise ArgumentError("planes", f"{codes.name} has sums of {codes.sums.planes} planes already; leave it out")
    sums = asked.over(length, codes.name, bits=codes.sensor.bits)
    sensor = codes.sensor
    if sums.planes > 1:
        if not sensor.sums_planes:
            kind = type(sensor).__name__
            raise ArgumentError(
                "planes",
                f"{codes.sensor_name or kind}: only a clocked SPAD sums planes, this is a {kind}; give another sensor, "
                "as in spad-320x240",
            )
        if codes.shares is not None:
            raise ArgumentError("planes", f"{codes.name} has exposures that take turns; leave it out")
        sensor = sensor.of_planes(sums.planes)
    # Exposures take turns by the number of the code: those that are chosen keep theirs
    turns = codes.shares
    if turns is not None:
        turns = tuple(turns[(sums.start + n * sums.step) % len(turns)] for n in range(len(turns)))
    plane_rate = codes.frame_rate

    def digest() -> str:
        before = codes.digest()
        return before and hashlib.sha256(before.encode() + repr(sums).encode()).hexdigest()

    return replace(
        codes,
        shape=(sums.codes, height, width),
        sensor=sensor,
        exposure=codes.exposure * sums.planes,
        frame_rate=plane_rate / sums.step,
        read=sums.of(codes.read),
        digest=digest,
        ppp=None if codes.ppp is None else codes.ppp * sums.planes,
        shares=turns,
        sums=sums if codes.sums is None else sums.within(codes.sums),
        times=sums.times(plane_rate, codes.times, 1 if codes.sums is None else codes.sums.step),
    )


def frame_reader(codes: Codes) -> Callable[[int], Array]:
    """Return a function of t that returns frame t [H, W]; it reads, and draws, blocks of frames and keeps two."""
    length, height, width = codes.shape
    step = max(1, BLOCK_PIXELS // (height * width))  # blocks are faster than frames

    @lru_cache(maxsize=2)
    def block(i: int) -> Array:
        return codes.read(i * step, min((i + 1) * step, length))

    def frame(t: int) -> Array:
        found: Array = block(t // step)[t % step]
        return found

    return frame


def light_of(codes: Codes) -> float:
    """Return the mean photons per pixel and code of a stream: as stated, else estimated from LIGHT_FRAMES frames.

    The estimate is the mean of the moment inverse of squares of POOLED pixels, negative below the mean code of a dark
    pixel, so that noise adds no light; where codes do not determine the light, the mean code in units of white.
    Saturated pixels make it too low: no code tells how bright they are. At least DARKEST of white.
    """
    if codes.ppp is not None and codes.ppp > 0:
        return float(codes.ppp)
    length = codes.shape[0]
    taken = np.unique(np.linspace(0, length - 1, min(LIGHT_FRAMES, length)).round().astype(int))
    mean = np.mean([codes.read(int(t), int(t) + 1)[0] for t in taken], axis=0)
    try:
        table = codes.sensor.response(codes.exposure)
        rise = START * (table.mean[-1] - table.mean[0])
        slope = np.interp(table.mean[0] + rise, table.mean, table.photons) / rise
        pooled, pixels = _pooled(mean)
        # Below the code of a dark pixel light goes on as a straight line, to negative values: their mean is right.
        light = table.invert(pooled, len(taken) * int(pixels.max())) + slope * np.minimum(pooled - table.mean[0], 0)
        found = float(np.average(light, weights=pixels))
    except ValueError:
        found = float(mean.mean()) / (codes.sensor.levels - 1) * codes.white
    return max(found, DARKEST * codes.white)


def _pooled(image: Array) -> tuple[Array, Array]:
    """Return means of squares of POOLED pixels of an image [H, W], and their pixels: fewer at its end."""
    places = [np.arange(0, length, POOLED) for length in image.shape]
    sums, pixels = (
        np.add.reduceat(np.add.reduceat(x, places[0], axis=0), places[1], axis=1) for x in (image, np.ones_like(image))
    )
    return sums / pixels, pixels


def array_digest(array: Array | LazyArray) -> str:
    """Return the SHA-256 of an array's type, shape and values. One in a file is read in blocks."""
    found = hashlib.sha256(f"{array.dtype.newbyteorder('=').str} {array.shape}".encode())
    step = max(1, DIGEST_BYTES // max(1, array[:1].nbytes))
    for start in range(0, len(array), step):
        found.update(plain(array[start : start + step]).data)
    return found.hexdigest()


def array_codes(
    codes: Array | LazyArray, sensor: Sensor, exposure: float, name: str = "codes", source: str = "memory"
) -> Codes:
    """Return codes [T, H, W] in memory or in a file; truth values are codes of 0 and 1. `ValueError` if empty, or
    for codes that the sensor cannot produce.
    """
    if codes.ndim != 3 or codes.size == 0 or codes.dtype.kind not in "iub":
        raise ValueError(
            f"{name}: expected whole codes [T, H, W] without an empty axis, got {codes.dtype} {codes.shape}"
        )

    def read(start: int, stop: int) -> Array:
        part = plain(codes[start:stop])
        if part.dtype == np.bool_:
            return part.view(np.uint8)
        if part.max() >= sensor.levels or part.min() < 0:
            t, y, x = (int(i) for i in np.argwhere((part < 0) | (part >= sensor.levels))[0])
            wrong = "bits=" if sensor.levels == 1 << sensor.bits else "summed="
            raise ValueError(
                f"{name}: code {part[t, y, x]} at (t, y, x) = {(t + start, y, x)}; a {sensor.bits}-bit sensor has "
                f"0..{sensor.levels - 1}; give the right {wrong}"
            )
        return part

    frames, height, width = codes.shape
    return Codes(
        name, (frames, height, width), sensor, exposure, 1 / exposure, read, source, lambda: array_digest(codes)
    )


def sensed(clip: Clip, light: Illumination, seed: int = 0) -> tuple[Codes, CodeTruth]:
    """Return the codes of a clip under a light level, those that `qsim sense` would store, and their truth.

    Codes are drawn when they are read, those of pixels followed photon by photon all at once; dead and hot pixels of
    the sensor's defects are filled.
    """
    sensing = replace(light.sensing, seed=seed)
    draw, _ = followed(clip, sensing, light.draw(clip, seed))
    shape = clip.shape[1], clip.shape[2]
    bad = defects.of_draw(draw, clip.exposure, shape)
    truth = CodeTruth(clip, draw.timing, draw.level.factor)

    @cache
    def complete() -> Array:
        return draw.frames(clip, 0, len(truth))

    def read(start: int, stop: int) -> Array:
        try:
            return draw.frames(clip, start, stop) if draw.followed is None else complete()[start:stop]
        except ValueError as error:
            raise ValueError(f"{clip.path}: frames {start}..{stop - 1}: {error}") from None

    codes = Codes(
        name=f"{clip.name}, {light.label}",
        shape=(len(truth), *shape),
        sensor=defects.behind(bad, draw.defects, draw.sensor, shape, draw.origin),
        exposure=clip.exposure * draw.planes,
        frame_rate=clip.frame_rate / draw.planes,
        read=read,
        source=f"{clip.path} seen by {light.sensor} ({light.label}), seed {seed}",
        digest=lambda: sha256(to_json([records.plain(clip.info), records.plain(describe(clip, sensing, draw))])),
        sensor_name=light.sensor,
        ppp=draw.level.ppp * draw.planes,
        shares=draw.timing.shares,
        sums=Sums(draw.planes, 0, draw.planes, len(truth)) if draw.timing.summed and draw.planes > 1 else None,
        colour=draw.colour,
        not_inverted=_not_inverted(vars(draw.defects) if draw.defects else {}),
    )
    return filled(codes, bad), truth


def stream_codes(stream: Stream) -> Codes:
    """Return the codes of a stored stream; its dead and hot pixels, where it states them, are filled."""
    info = stream.info
    bad, sensor = defects.of_stream(stream)
    codes = Codes(
        stream.name,
        stream.shape,
        sensor,
        stream.exposure,
        info.frame_rate,
        stream.codes,
        str(stream.path),
        lambda: array_digest(stream.packed),
        info.sensor_name,
        None if info.light is None else info.light.ppp,
        stream.shares,
        colour=stream.colour_filter,
        source_sha256=info.sha256,
        not_inverted=_not_inverted(info.defects),
        sums=stream.sums,
        times=info.times,
    )
    return filled(codes, bad)


def codes_of(stream: Stream) -> Codes:
    """Return the codes of a stored stream, dead and hot pixels filled; a warning where a map is missing.

    An imported stream states no light: pixels are hot beside the light that its codes tell.
    """
    codes = stream_codes(stream)
    table = stream.info.defects
    if stream.info.light is not None:
        return codes
    if not table:
        return replace(codes, unmapped=True)
    try:
        return repaired(codes, defects.read_defects(table))
    except (OSError, ValueError) as error:
        warnings.warn(f"{stream.path}: its hot and dead pixels are not filled: {wording(error)}", stacklevel=2)
        return codes


def repaired(codes: Codes, found: defects.Defects | None) -> Codes:
    """Return the codes of a sensor with these defects: dead and hot pixels filled, the dark rate that of the others."""
    left = _not_inverted(vars(found) if found else {})
    shape = codes.shape[1:]
    # Twice: the light, which decides who is hot beside it, is estimated with the dark rate of the sensor's own law.
    codes = replace(codes, sensor=defects.behind(None, found, codes.sensor, shape), not_inverted=left)
    bad = defects.defective(found, codes.sensor, codes.exposure, light_of(codes), shape)
    return filled(replace(codes, sensor=defects.behind(bad, found, codes.sensor, shape)), bad)


def _not_inverted(table: Mapping[str, Any]) -> str:
    """Return which of the defects of a table add detections that no response takes off, as text."""
    return " and ".join(key for key in ("crosstalk", "afterpulse") if table.get(key))


def open_stream(path: Path) -> Stream:
    """Return the stored stream with this .npy or .json. `ValueError` for video written by `quiver restore`."""
    if describes_restored(read_json(path.with_suffix(".json"))):
        raise ValueError(f"{path}: is restored video; name the stream or the clip that it was made from")
    return Stream.open(path.with_suffix(".json"))


def stored(clip: Clip, name: str, planes: int | None = None) -> tuple[Codes, CodeTruth]:
    """Return a stored stream of a clip, of which so many planes are summed to a code, and its truth.

    `ValueError` for codes of another clip, and for planes that are not those of a clocked SPAD.
    """
    asked = PlaneSums(planes=planes)
    stream = clip.stream(name)
    truth = summing.summed(stream, asked).code_truth
    summed_elsewhere = bool(stream.info.planes_of) and clip.info.grouped is None  # a study groups its clip alike
    if summed_elsewhere or stream.shape != (len(stream.code_truth), *clip.shape[1:]):
        raise ValueError(f"{stream.path}: its codes are not those of its clip, so their truth is not known")
    return summed(stream_codes(stream), asked), truth


def check_published(light: Illumination) -> None:
    """Raise `ValueError` for the clip's own light, to which no window can be brought, and for codes of several."""
    if light.ppp is None:
        raise ValueError("the published protocol forces the exposure of every window; give ppp=")
    if light.timing != Timing():
        raise ValueError(
            "the published protocol has codes of one full clip frame; leave planes= out, or published=True"
        )


def windows_sensed(clip: Clip, light: Illumination, seed: int, centres: range) -> Iterator[Codes]:
    """Draw the windows of the published test: 11 codes each, brought to the light level one by one, with separate
    noise.

    `ValueError` as of `check_published`, and for a colour clip.
    """
    check_published(light)
    assert light.ppp is not None
    clip.require_one_band("the published protocol")
    sensor = light.device(clip.exposure)
    for t in centres:
        photons = np.stack([clip_photons(clip, i) for i in range(t - 5, t + 6)])
        codes = draw_codes(
            sensor,
            photons * (light.ppp / max(float(photons.mean()), 1e-9)),
            clip.exposure,
            Key(seed=seed, clip=hash_name(clip.name), stage=WINDOW_STAGE + t),
        )
        yield array_codes(codes, sensor, clip.exposure, name=f"{clip.name} window {t}", source=str(clip.path))

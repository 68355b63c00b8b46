"""Compares readouts of the same light: streams and events of one clip, each over the same span of time.

    codes within the span -> mean code -> exact inverse response -> photons per clip frame, against the sharp truth

A stream of short codes averages many of them, one of long codes few, and all see the same motion. The truth is that of
the clip frame in the middle of the averaged codes, of an even number the later of two. Light is compared in the clip's
own unit, so streams at other light levels are compared, too. A first row states the error of the light itself: the
mean of the span without noise, which is what blur leaves. Of a stream with defects the response is that of its good
pixels; remarks name what it leaves out.

Events hold changes alone. Their row is given the light of the first frame and adds the contrast of all events since,
each by the nominal threshold: what mismatch, noise and lost changes make of it grows with time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clamped_error import rms
from qsim.colour import psnr
from qsim.optics.radiometry import WHITE_PER_MEAN
from qsim.sensor.estimation import Response
from qsim.sensor.event_camera import EventCamera
from qsim.streams.clip import Clip
from qsim.streams.event_stream import SIZE, EventStream
from qsim.streams.photons import clip_photons
from qsim.streams.stream import Stream

_GIVEN = (
    f"its row is given the light of the first frame, and adds the contrast of all events since; {SIZE} bytes per event"
)
_POINTS = 1024  # of a response: interpolation errs by less than 2e-5 of the full scale, and 12 bits take seconds


@dataclass(frozen=True)
class ReadoutRow:
    """One stream of a comparison, or the light itself."""

    stream: str  # empty: the light without noise
    model: str  # of its sensor
    bits: int | None  # of a code; None: there are none
    codes: int  # averaged for one estimate; of an event camera the events of all pixels in a mean span
    seconds: float  # that these codes take
    ppp: float | None  # photons per pixel in these codes
    psnr_db: float  # against the sharp light, below 2.5 x the mean light of the clip
    megabytes_per_second: float | None


@dataclass(frozen=True)
class Readouts:
    """The rows of one clip."""

    clip: str
    span: float  # s, as asked
    instants: tuple[int, ...]  # clip frames in the middle of each span
    rows: tuple[ReadoutRow, ...]
    remarks: tuple[str, ...] = ()  # defects of streams that estimates do not invert


def compare(clip: Clip, names: Sequence[str] = (), span: float | None = None) -> Readouts:
    """Return the comparison of streams and events (by default all) over `span` [s], by default the longest code.

    Instants end with the stream that ends first. Of a colour clip every pixel is scored in the light behind its filter.
    `ValueError` for a clip without streams, and for a span below a clip frame or above what all streams cover.
    """
    streams, events = _named(clip, names)
    if not streams and not events:
        raise ValueError(f"{clip.path}: has no streams to compare; make some with `qsim sense` or `qsim events`")
    for stream in streams:
        stream.require_even("a comparison of readouts")
    frame = 1 / clip.frame_rate
    longest = max((_frames_per_code(stream) for stream in streams), default=1)
    seconds = frame * longest if span is None else span
    window = round(seconds / frame)
    covered = {stream.name: len(stream) * _frames_per_code(stream) for stream in streams}
    first = min(covered, key=lambda name: covered[name], default="")
    end = min(covered.get(first, len(clip)), len(clip))
    if not 1 <= window <= end:
        where = "the clip has" if end == len(clip) else f"stream {first} covers"
        raise ValueError(
            f"{clip.path}: a span of {seconds:.4g} s; {where} {end} frames of {frame:.4g} s: give a span between"
        )
    centres = tuple(range(window // 2, end - window + window // 2 + 1, window))
    peak = WHITE_PER_MEAN * float(np.mean([clip_photons(clip, t).mean() for t in range(len(clip))]))

    def score(found: Array, middles: Sequence[int], stream: Stream | None = None) -> float:
        truth = np.stack([_seen(clip_photons(clip, t, sharp=True), stream) for t in middles])
        return psnr(peak, rms(found - truth))

    blurred = np.stack([_light(clip, t - window // 2, window) for t in centres])
    rows = [ReadoutRow("", "light", None, window, window * frame, None, score(blurred, centres), None)]
    remarks: list[str] = []
    for stream in streams:
        per_code = _frames_per_code(stream)
        codes = max(1, round(window / per_code))
        sensor, left = stream.good_pixels()
        remarks += [f"{stream.name}: {left}"] if left else []
        response = sensor.response(stream.exposure, _POINTS)
        firsts = [_first_code(stream, t, codes) for t in centres]
        found = np.stack([_estimate(stream, response, first, codes) for first in firsts])
        middles = [first * per_code + codes * per_code // 2 for first in firsts]
        rows.append(_row(stream, codes, codes * per_code * frame, score(found, middles, stream)))
    for each in events:
        found = np.stack(list(_from_events(clip, each, centres)))
        rows.append(_event_row(clip, each, window, score(found, centres)))
        remarks.append(f"{each.name}: {_GIVEN}")
    return Readouts(clip.name, seconds, centres, tuple(rows), tuple(remarks))


def _named(clip: Clip, names: Sequence[str]) -> tuple[list[Stream], list[EventStream]]:
    """Return the streams and the events of these names, by default all; a name may be that of both."""
    if not names:
        return [clip.stream(name) for name in clip.streams], [clip.event_stream(name) for name in clip.event_streams]
    events = [clip.event_stream(name) for name in names if name in clip.event_streams]
    codes = [name for name in names if name in clip.streams or name not in clip.event_streams]
    return [clip.stream(name) for name in codes], events


def _from_events(clip: Clip, stream: EventStream, instants: Sequence[int]) -> Iterator[Array]:
    """Yield photons per clip frame, float64 [H, W], at rising frames: the first frame and all contrast since."""
    camera = stream.camera
    height, width = clip.shape[1:]
    # e-/s of photocurrent per photon of a clip frame.
    per_photon = stream.info.light.factor * camera.quantum_efficiency / clip.exposure
    first = np.log(clip_photons(clip, 0) * per_photon + camera.dark_current).ravel()
    # Each event says that log current has changed by a threshold since the last one of its pixel.
    steps = np.array([-camera.threshold_off, camera.threshold_on])  # by polarity
    contrast = np.zeros(height * width)
    seen = 0.0
    for t in instants:
        until = t / clip.frame_rate + 0.5e-6  # s; times of events are rounded to 1 us
        block = stream.between(seen, until)
        seen = until
        pixels = block["y"].astype(np.int64) * width + block["x"]
        contrast += np.bincount(pixels, steps[block["p"]], height * width)
        current = np.exp(first + contrast) - camera.dark_current
        yield np.maximum(current / per_photon, 0).reshape(height, width)


def _event_row(clip: Clip, stream: EventStream, window: int, psnr_db: float) -> ReadoutRow:
    """Return the row of events; their rate is that of 8 bytes each."""
    info = stream.info
    seconds = window / clip.frame_rate
    per_second = len(stream) / info.seconds
    return ReadoutRow(
        stream.name,
        EventCamera.__name__,
        None,
        round(per_second * seconds),
        seconds,
        info.light.ppp * window,
        psnr_db,
        per_second * SIZE / 1e6,
    )


def _seen(photons: Array, stream: Stream | None) -> Array:
    """Return photons [H, W] behind the colour filters of a stream; without filters or stream they are unchanged."""
    filters = None if stream is None else stream.colour_filter
    if filters is None:
        return photons
    assert stream is not None
    return filters.mosaic(photons, stream.sensor.efficiency)


def _frames_per_code(stream: Stream) -> int:
    return stream.info.planes_per_code


def _light(clip: Clip, first: int, window: int) -> Array:
    """Return the mean photons [H, W] or [3, H, W] of clip frames first ... first + window - 1."""
    return np.mean([clip_photons(clip, t) for t in range(first, first + window)], axis=0)


def _first_code(stream: Stream, centre: int, codes: int) -> int:
    """Return the first of the `codes` codes around a clip frame."""
    first = round((centre + 0.5) / _frames_per_code(stream) - codes / 2)
    return min(max(first, 0), len(stream) - codes)


def _estimate(stream: Stream, response: Response, first: int, codes: int) -> Array:
    """Return photons per clip frame, float64 [H, W], from codes first ... first + codes - 1, in the clip's light."""
    mean = stream.codes(first, first + codes).mean(axis=0)
    return np.asarray(response.invert(mean, codes) / (_frames_per_code(stream) * stream.photons_factor))


def _row(stream: Stream, codes: int, seconds: float, score: float) -> ReadoutRow:
    height, width = stream.shape[1:]
    rate = stream.bits * height * width * stream.info.frame_rate / 8e6
    ppp = None if stream.info.light is None else stream.info.light.ppp
    model = type(stream.sensor).__name__
    light = None if ppp is None else float(ppp) * codes
    return ReadoutRow(stream.name, model, stream.bits, codes, seconds, light, score, rate)

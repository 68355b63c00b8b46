"""Builds the section of a clip: moving pictures, light, motion, codes, modelled effects and error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from qsim import colour
from qsim.clip.clamped_error import rms, stated
from qsim.clip.clip_info import ClipInfo
from qsim.clip.motion_statistics import CODE_BITS, CODE_PLANES, MOVING, SLOWEST, moving_mean
from qsim.colour import bright_end
from qsim.report import html as page
from qsim.report.panels import (
    FRAMES,
    Photons,
    chosen_frames,
    fit,
    legend,
    light_name,
    mosaic_step,
    of_first,
    stream_panels,
    toned,
    truth_panels,
    truth_photons,
    truth_stack,
)
from qsim.sensor.defects import fixed_pattern
from qsim.sensor.defects.pixel_array import PixelArray
from qsim.streams.clip import Clip
from qsim.streams.storing import stored
from qsim.streams.stream import Stream

if TYPE_CHECKING:
    from markupsafe import Markup

BANDS = ("tab:red", "tab:green", "tab:blue")  # curves of the bands R, G and B
# about the largest numbers of frames, and of pixels of each, in an expected histogram
_SAMPLES = 6
_PIXELS = 4096


def motion(clip: Clip, frames: Sequence[int]) -> tuple[float | None, float]:
    """Return the mean motion of pixels that move (None if none does) and the 99.9th percentile of all [px/frame]."""
    speed = np.stack([np.hypot(*clip.flow(t)) for t in frames])
    return moving_mean(speed), bright_end(speed)


def clip_section(clip: Clip) -> page.Section:
    """Return light, streams and ground truth of a clip, its motion, modelled effects, and the error of its frames."""
    frames = chosen_frames(*clip.shape)
    truth = truth_stack(clip, frames)
    lines = [light_line(clip), *(stream_line(clip.stream(name)) for name in clip.streams)]
    figures = [_light_histogram(truth, clip)]
    players = _players(clip, frames, truth)
    if clip.has_truth:
        panels, largest, speed = truth_panels(clip, frames)
        players += [page.player(panels, left=1), legend(largest)]
        lines.append(motion_line(clip, frames))
        figures.append(_motion_histogram(speed, of_first(frames, len(clip))))
    if clip.strengths:
        lines.append(flicker_line(clip))
        figures.append(_strengths(clip))
    figures += [code_histogram(clip, clip.stream(name)) for name in clip.streams]
    lines += error_lines(clip.info)
    if clip.info.error_per_frame:
        figures.append(error_curve(clip.info.error_per_frame))
    count, height, width = clip.shape
    story = f"{clip.name} has {count} frames of {height} × {width} pixels at {clip.frame_rate:g} frames/s."
    parts = [*players, page.bullets(lines), modelled(clip.info), page.grid(figures)]
    return page.section(f"Clip {clip.name}", *parts, story=story, facts=_facts(clip, frames))


def _players(clip: Clip, frames: range, truth: Photons) -> list[Markup]:
    """Return the light with all streams of one code per frame, and a player of each other stream."""
    panels = [page.Panel(light_name(clip), fit(toned(truth, colour.peak(truth))))]
    others = []
    for name in clip.streams:
        stream = clip.stream(name)
        if len(stream) == len(clip):
            panels += stream_panels(stream, frames, truth_photons(clip, stream, frames))
        else:
            others.append(page.player(stream_panels(stream, chosen_frames(*stream.shape)), right=1, left=0))
    left = 1 if len(panels) > 1 else 0
    return [page.player(panels, left=left), *others]


def _facts(clip: Clip, frames: range) -> list[page.Fact]:
    """Return the headline numbers of a clip."""
    facts = [page.Fact(" × ".join(map(str, clip.shape)), f"frames × rows × columns of {clip.name}")]
    if clip.has_truth and (mean := motion(clip, frames)[0]) is not None:
        facts.append(page.Fact(f"{mean:.3g} px", f"per frame: mean motion of what moves{of_first(frames, len(clip))}"))
    if (found := stated(clip.info)) is not None:
        facts.append(page.Fact(f"{found.psnr:.1f} dB", "PSNR of the rendered light itself"))
    return facts


def light_line(clip: Clip) -> str:
    """Return size, rate and light of a clip as one line."""
    frames, height, width = clip.shape
    unit = "(relative)" if clip.camera is None else "W m⁻² sr⁻¹"
    photons = "" if clip.camera is None else f", {clip.mean_photons:.4g} photons per pixel and exposure"
    return (
        f"{frames} frames of {height} × {width} at {clip.frame_rate:g} fps, exposure {clip.exposure * 1e6:.4g} µs, "
        f"mean radiance {clip.mean_radiance:.4g} {unit}{photons}{in_bands(clip)}{_stated_times(clip)}"
    )


def _stated_times(clip: Clip) -> str:
    """Return the first and last time that the source of an imported clip states, or an empty text."""
    times = clip.info.times
    if times is None:
        return ""
    return f", taken from {times.values[0]:.10g} to {times.values[-1]:.10g} {times.unit} by the {times.source}"


def flicker_line(clip: Clip) -> str:
    """Return the lights that flicker, and their strengths in the frames of a clip, as one line."""
    each = []
    for name, found in clip.strengths.items():
        own = clip.info.flicker[name]
        what = f"{own.kind}, {own.frequency:g} Hz"
        each.append(f"{name} ({what}) {found.min():.3g} to {found.max():.3g} of its mean")
    return f"Flicker, exact means over the exposures: {'; '.join(each)}"


def in_bands(clip: Clip) -> str:
    """Return ", in each of the bands R 610, G 540, B 460 nm" of a colour clip, else ""."""
    if clip.bands is None:
        return ""
    named = (f"{name} {wavelength * 1e9:g}" for name, wavelength in zip("RGB", clip.bands, strict=True))
    return f", mean of the bands {', '.join(named)} nm"


def stream_line(stream: Stream) -> str:
    """Return sensor and light level of a stream as one line."""
    level = stream.info.light
    ppp = None if level is None else level.ppp
    lux = None if level is None else level.lux
    light = "" if ppp is None else f": {ppp:.4g} photons per pixel (the clip's light × {stream.photons_factor:.4g})"
    light += "" if lux is None else f", equal to {lux:.4g} lx at 555 nm"
    efficiency = stream.sensor.efficiency
    colours = stream.colour_filter
    if ppp is not None:
        if colours is None:
            light += f", {ppp * efficiency:.3g} e⁻ per pixel"
        else:
            light += f", about {ppp * colours.mean_efficiency(efficiency):.3g} e⁻ per pixel with equal bands"
    filters = "" if colours is None else f"; colour filters {' '.join(colours.mask)}"
    words = f"{filters}{timing_words(stream)}{defects_words(stream)}"
    return f"Stream {stream.name}{light}; {stream.bits} bit, {stream.sensor}{words}"


def timing_words(stream: Stream) -> str:
    """Return "; each row 2e-06 s later, down", and a schedule of exposures; "" where all are read at once and alike."""
    return stream.timing.words()


def defects_words(stream: Stream) -> str:
    """Return "; defects: prnu 0.01, dark_map my_dark.npy", or "" without defects."""
    words = []
    for name, value in stream.info.defects.items():
        text = f"{value:g}" if isinstance(value, float) else str(value)
        if isinstance(value, dict):
            parts = (f"{key} {v:g}" for key, v in value.items() if isinstance(v, int | float))
            text = Path(str(value["file"])).name if "file" in value else f"({', '.join(parts)})"
        words.append(f"{name} {text}")
    return f"; defects: {', '.join(words)}" if words else ""


def motion_line(clip: Clip, frames: range) -> str:
    """Return the motion of a clip as one line; it states `frames` if these are not all."""
    mean, largest = motion(clip, frames)
    moving = (
        "nothing moves"
        if mean is None
        else f"moving pixels (more than {MOVING:g} px/frame) move {mean:.3g} px/frame on average"
    )
    if mean is not None and clip.frame_rate >= SLOWEST:  # frames of a bit-depth study
        speed = np.stack([np.hypot(*clip.flow(t)) for t in frames])
        moving += f" ({moving_mean(speed, CODE_PLANES):.3g} px per {CODE_BITS}-bit frame of {CODE_PLANES} planes)"
    return f"Motion{of_first(frames, len(clip))}: {moving}; 99.9 % of all pixels at most {largest:.3g} px/frame"


def error_lines(info: ClipInfo) -> list[str]:
    """Return the stated error of the frames as lines."""
    lines = []
    errors = info.error_per_frame
    if errors:
        error = rms(np.asarray(errors))
        lines.append(
            f"Error of a frame (noise, blur, omitted bounces): {error:.3g} rms in the unit of the radiance, "
            f"worst {max(errors):.3g}"
        )
    found = stated(info)
    if found is not None:
        lines.append(f"PSNR of the radiance itself: {found.line}")
    return lines


def modelled(info: ClipInfo) -> Markup | None:
    """Return a table of the effects that were modelled or omitted, with their sizes; None for clips without it."""
    if info.render is None or not info.render.findings:
        return None
    rows = [[finding.effect, finding.chosen, finding.size] for finding in info.render.findings]
    return page.table(
        page.Table("Effects that were modelled or omitted, and their size", ["effect", "chosen", "size"], rows)
    )


def code_histogram(clip: Clip, stream: Stream) -> Markup:
    """Return the histogram of the codes of up to FRAMES frames, with the exact expectation from the light."""
    count = min(len(stream), FRAMES)
    levels = 2**stream.bits
    drawn = np.bincount(stream.codes(0, count).ravel(), minlength=levels) / (count * stream.shape[1] * stream.shape[2])
    axes, save = page.axes("code", "share of pixels")
    few = levels <= 64
    axes.bar(np.arange(levels), drawn, width=0.8 if few else 1.0, color="tab:blue", alpha=0.6, label="drawn")
    words = f"codes of {stream.name}{of_first(range(count), len(stream))}: drawn"
    missing = unexpected(clip, stream)
    if missing is None:
        try:
            expected = expected_codes(clip, stream, count)
        except (ValueError, OSError) as error:  # a measured map is missing or has changed
            missing = str(error)
        else:
            axes.plot(np.arange(levels), expected, "k_", markersize=14, label="expected")
            mixed = " and its map of defects" if stream.info.defects else ""
            words += f", and expected from the light by the exact distribution of the sensor{mixed}"
    if missing is not None:
        words += f"; no expectation is shown: {missing}"
    axes.legend()
    return save(words)


def unexpected(clip: Clip, stream: Stream) -> str | None:
    """Return why the codes of a stream have no exact expectation; None if they have one."""
    own = stream.info.defects
    if 2**stream.bits > 64:
        return "more than 64 codes"
    if stream.info.planes_of:
        return "its codes sum planes of another clip"
    if stream.info.light is None or stream.info.clip_key is None:
        return "its light is unknown"
    if own.get("crosstalk") or own.get("afterpulse"):
        return "crosstalk and afterpulses make a code depend on its neighbours or on the frame before"
    if stream.info.drawn_by == "events":
        return "dead time inside and between exposures was followed photon by photon"
    return None


def expected_codes(clip: Clip, stream: Stream, count: int) -> NDArray[np.float64]:
    """Return the mean probability of each code over every n-th pixel of some of the first codes, float64 [2^bits].

    Each has the light of its own exposures. Under flicker, and where exposures take turns, all `count` codes are taken,
    so that none of their phases is left out; a mosaic keeps all its colours. The maps of defects are included. Raise
    `ValueError` or `OSError` if a measured map has changed or is missing.
    """
    samples = count if clip.strengths or not stream.timing.even else min(count, _SAMPLES)
    chosen = np.unique(np.linspace(0, count - 1, samples).astype(int))
    height, width = clip.shape[1:]
    share = max(1.0, len(chosen) / _SAMPLES)  # more codes, fewer pixels of each
    step = mosaic_step(max(1, int(np.sqrt(height * width * share / _PIXELS))), stream.colour_filter)
    draw = stored(stream)
    exposures = draw.exposures(clip)
    sensor = draw.plane
    maps = fixed_pattern.PERFECT
    if draw.defects is not None:
        device = PixelArray.of(draw.defects, sensor, height, width, stream.origin)
        thinned = {name: None if m is None else m[::step, ::step] for name, m in vars(device.maps).items()}
        sensor = device.sensor
        maps = fixed_pattern.Maps(**thinned)
    total = np.zeros(2**stream.bits)
    for t in chosen:
        light = draw.light(clip, int(t), int(t) + 1)[:, ::step, ::step]
        each = fixed_pattern.pmf(sensor, light, exposures.seconds(int(t)), maps)
        found = _of_sum(each.reshape(len(each), -1, each.shape[-1])).mean(axis=0)
        total[: len(found)] += found / len(chosen)
    return total


def _of_sum(chances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probability of each sum of codes, [P, levels], from those of each code, [n, P, levels of one]."""
    found = chances[0]
    for more in chances[1:]:
        longer = np.zeros((found.shape[0], found.shape[1] + more.shape[1] - 1))
        for code in range(more.shape[1]):
            longer[:, code : code + found.shape[1]] += found * more[:, code : code + 1]
        found = longer
    return found


def _motion_histogram(speed: NDArray[np.floating], which: str) -> Markup:
    axes, save = page.axes("motion [px/frame]", "share of pixels")
    known = speed[np.isfinite(speed)]
    axes.hist(known, bins=48, weights=np.full(known.size, 1 / max(known.size, 1)), color="tab:blue")
    axes.set_yscale("log")
    return save(f"motion between successive frames, all pixels{which}")


def _light_histogram(truth: NDArray[np.floating], clip: Clip) -> Markup:
    unit = "relative" if clip.camera is None else "W m⁻² sr⁻¹"
    axes, save = page.axes(f"radiance [{unit}]", "share of pixels")
    bands = [truth] if clip.bands is None else list(np.moveaxis(truth, 1, 0))
    for values, paint in zip(bands, ["tab:blue"] if clip.bands is None else BANDS, strict=True):
        weights = np.full(values.size, 1 / values.size)
        shown = {"color": paint} if clip.bands is None else {"color": paint, "histtype": "step"}
        axes.hist(values.ravel(), bins=64, weights=weights, **shown)
    axes.set_yscale("log")
    which = of_first(range(len(truth)), len(clip))
    return save(f"light of the {light_name(clip)}, all pixels{which}" + ("" if clip.bands is None else ", each band"))


def _strengths(clip: Clip) -> Markup:
    axes, save = page.axes("frame", "strength, 1 is the mean of the light")
    for name, found in clip.strengths.items():
        axes.plot(found, ".-", label=name)
    axes.legend()
    return save("strength of the lights that flicker, mean over the exposure of every frame")


def error_curve(errors: Sequence[float]) -> Markup:
    """Return the measured error of every frame as a figure."""
    axes, save = page.axes("frame", "rms error of the radiance")
    axes.plot(errors, ".-")
    axes.set_ylim(0, 1.15 * max(max(errors), 1e-30))
    return save("error of every frame: noise from independent halves, blur, omitted bounces")

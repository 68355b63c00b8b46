"""Builds the moving pictures of a page: light, codes as light, errors, and ground truth over the light.

All pictures of one player have one white and one tone curve. A code is shown as the light at which it is the mean code.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qsim import colour
from qsim.clip.clamped_error import Errors, white_in
from qsim.clip.clip_info import RELATIVE
from qsim.colour import bright_end
from qsim.report import html as page
from qsim.sensor.demosaicing import demosaic, determines_bands
from qsim.sensor.sensor import Sensor
from qsim.streams.clip import Clip
from qsim.streams.photons import clip_photons
from qsim.streams.stream import Stream

if TYPE_CHECKING:
    from markupsafe import Markup

    from qsim.sensor.colour_filter import ColourFilter

FRAMES = 48  # largest number in a player
WIDTH = 512  # columns of a panel; wider pictures are reduced by a whole factor
_BITS = 8  # of codes that are shown as light; deeper ones are shown as they are
_GOLDEN = 0.6180339887  # turns between the hues of successive bodies

Photons = NDArray[np.floating]  # [T, H, W] photons; of colour clips [T, 3, H, W]


def chosen_frames(count: int, height: int, width: int) -> range:
    """Return at most FRAMES frames from the start, without gaps, which would change the motion.

    Of tall pictures they are fewer: a panel holds its frames below each other, at most MAX_STRIP rows.
    """
    rows = -(-height // _step(width))
    return range(min(count, FRAMES, max(page.MAX_STRIP // rows, 1)))


def of_first(frames: range, count: int) -> str:
    """Return " in the first 48 of 132 frames", behind what numbers of `frames` describe; "" if these are all."""
    return "" if len(frames) == count else f" in the first {len(frames)} of {count} frames"


def fit(frames: NDArray[np.uint8], filters: ColourFilter | None = None) -> NDArray[np.uint8]:
    """Return every n-th row and column of [T, H, W] or [T, H, W, 3], so that a panel has at most WIDTH columns.

    Of a mosaic with these filters, n leaves pixels of every colour.
    """
    step = mosaic_step(_step(frames.shape[2]), filters)
    return frames[:, ::step, ::step]


def _step(width: int) -> int:
    return -(-width // WIDTH)


def mosaic_step(least: int, filters: ColourFilter | None) -> int:
    """Return the least step from `least` on that takes pixels from every place of a tile of filters alike."""
    tile = (1, 1) if filters is None else filters.tile
    return next(step for step in itertools.count(least) if all(math.gcd(step, side) == 1 for side in tile))


def toned(light: Photons, white: float) -> NDArray[np.uint8]:
    """Return light as pictures on the tone curve of all panels: [T, H, W], or [T, H, W, 3] of [T, 3, H, W]."""
    return colour.tone_picture(light, white, colours=light.ndim == 4)


def light_name(clip: Clip) -> str:
    """Return the name of a clip's light: "truth" if rendered; an imported video has the errors of its camera."""
    return "recorded video" if clip.info.radiance_unit == RELATIVE else "truth"


def truth_stack(clip: Clip, frames: range) -> NDArray[np.float32]:
    """Return the sharp radiance of these frames, float32 [T, H, W] or [T, 3, H, W], in the unit of the clip."""
    return np.stack([clip.sharp(t) for t in frames])


def truth_photons(clip: Clip, stream: Stream, frames: range) -> Photons | None:
    """Return the sharp light of these frames [photons] at the level of a stream; None if a code has other frames."""
    if stream.info.light is None or len(stream) != len(clip) or len(clip) < len(frames):
        return None
    return np.stack([clip_photons(clip, t, stream.photons_factor, sharp=True) for t in frames])


def score(light: Photons, truth: Photons | None) -> str:
    """Return the PSNR of light below the white of the truth, both clamped there, as "24.1 dB"; "" without a truth."""
    if truth is None:
        return ""
    white = white_in(truth)
    decibels = colour.psnr(white, Errors.between(light, truth, white).at_white)
    return f"{decibels:.1f} dB" if np.isfinite(decibels) else ""


def stream_panels(stream: Stream, frames: range, truth: Photons | None = None) -> list[page.Panel]:
    """Return panels of the codes, and of the naive mean of up to 11 frames around each, on the tone curve of the truth.

    `truth` is the light of these frames [photons]; with it, each panel states its PSNR. Captions name the defects that
    are left in the light.
    """
    reach = colour.AVERAGE // 2
    first = max(frames.start - reach, 0)
    last = min(frames.stop + reach, len(stream))
    codes = stream.codes(first, last)
    averages = np.stack([codes[max(t - reach - first, 0) : t + reach + 1 - first].mean(axis=0) for t in frames])
    shown = codes[frames.start - first : frames.stop - first]
    names = f"codes, {stream.bits} bit ({stream.name})", f"mean of {colour.AVERAGE} frames"
    sensor, left = stream.good_pixels()
    filters = stream.colour_filter
    one, many = (_inverse(stream, sensor, samples) for samples in (1, min(colour.AVERAGE, len(stream))))
    if one is None or many is None:
        shown_codes = colour.code_levels(shown, stream.sensor.levels - 1)
        return [
            page.Panel(names[0], fit(shown_codes, filters)),
            page.Panel(names[1], fit(colour.tone(averages, colour.peak(averages)), filters)),
        ]
    light = one(shown)
    average = many(averages)
    mosaic = truth
    picture = average
    if filters is not None:
        mosaic = None if truth is None else filters.mosaic(truth, stream.sensor.efficiency)
        if determines_bands(filters, stream.sensor.efficiency):
            names = names[0], f"{names[1]}, demosaiced"
            picture = demosaic(average, filters, stream.sensor.efficiency)
        else:  # one filter over all pixels: what it lets pass, in grey
            truth = mosaic
    white = colour.peak(picture if truth is None else truth)
    after = f"; {left}" if left else ""
    behind = filters if picture.ndim == 3 else None  # a demosaiced picture is no mosaic
    brightest = float(one(np.array([2.0**stream.bits - 1]))[0])
    own = f"; brightest shown: {brightest:.3g} photons" if brightest < 0.9 * white else ""  # less is not seen
    return [
        page.Panel(
            names[0] + own + after, fit(colour.tone(light, min(white, brightest)), filters), score(light, mosaic)
        ),
        page.Panel(names[1] + after, fit(toned(picture, white), behind), score(picture, truth)),
    ]


def _inverse(stream: Stream, sensor: Sensor, samples: int) -> Callable[[NDArray[np.number]], Photons] | None:
    """Return a function, means of this many codes [...] of a sensor -> light [photons].

    None for a sensor of more than _BITS bits or whose mean code does not rise, and for codes of different exposures.
    """
    if stream.bits > _BITS or not stream.timing.even:
        return None
    try:
        response = sensor.response(stream.exposure)
        response.cap(samples)
    except ValueError:
        return None
    return lambda codes: response.invert(codes, samples)


def error_panel(name: str, light: Photons, truth: Photons) -> page.Panel:
    """Return light - truth as colours: red is too bright, blue too dark, full colour at a fifth of white."""
    full = white_in(truth) / 5
    caption = f"error of {name}: red too bright, blue too dark, full colour at {full:.3g} photons"
    error = light - truth
    return page.Panel(caption, fit(colour.error_colours(error if error.ndim == 3 else error.mean(axis=1), full)))


def truth_panels(clip: Clip, frames: range) -> tuple[list[page.Panel], float, Photons]:
    """Return ground truth over the light: motion, depth, bodies, and points that have no place in the next frame.

    Also the motion of the full colour [px/frame], and the lengths of all motions [px/frame], [T, H, W].
    """
    truth = truth_stack(clip, frames)
    grey = colour.tone(truth if clip.bands is None else truth.mean(axis=1), white := colour.peak(truth))
    flow = np.stack([clip.flow(t) for t in frames])
    speed = np.hypot(flow[:, 0], flow[:, 1])
    largest = max(bright_end(speed), 0.5)
    panels = [page.Panel(light_name(clip), fit(toned(truth, white)))]
    panels.append(
        page.Panel(f"flow, full colour at {largest:.1f} px/frame", fit(_over(grey, colour.flow_colours(flow, largest))))
    )
    depth, bodies, valid = (_known(read, frames) for read in (clip.depth, clip.body_id, clip.valid))
    if depth is not None and np.isfinite(depth).any():
        near, far = colour.depth_range(depth)
        words = f"depth, {near:.3g} m (bright) to {far:.3g} m (dark), even in 1/depth"
        panels.append(page.Panel(words, fit(colour.depth_colours(depth, near, far))))
    if bodies is not None and bodies.max() > bodies.min():
        hues = np.rint(255 * (0.35 + 0.65 * colour.hue_from_turns(_GOLDEN * bodies))).astype(np.uint8)
        hues[bodies < 0] = 90
        panels.append(page.Panel("bodies, one colour each; dark grey: none", fit(_over(grey, hues))))
    if valid is not None and not valid.all():
        hidden = np.where(valid[..., None], np.uint8(255), np.array([255, 40, 40], np.uint8))
        panels.append(page.Panel("red: hidden or outside in the next frame", fit(_over(grey, hidden))))
    return panels, largest, speed


def _known(read: Callable[[int], NDArray[Any]], frames: range) -> NDArray[Any] | None:
    """Return the ground truth [T, H, W] that `read` gives for each frame; None if the clip has none of this kind."""
    try:
        return np.stack([read(t) for t in frames])
    except ValueError:
        return None


def _over(grey: NDArray[np.uint8], colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return colours [T, H, W, 3] shaded by a picture [T, H, W]; its black keeps a third of the colour."""
    shade = (85 + grey.astype(np.float32) * (170 / 255)) / 255
    return np.rint(colours * shade[..., None]).astype(np.uint8)


def legend(largest: float) -> Markup:
    """Return the colour wheel of the flow, whose rim is `largest` [px/frame]."""
    words = f"direction and length of the flow: rim = {largest:.2g} px/frame, white = still, grey = unknown"
    return page.picture(colour.flow_legend(72), words)

"""Draws the codes of one training window with the defects of its sensor, as `qsim sense` draws them.

    Illumination, clip, place -> window_codes

The defects of a window are those of its place in the full frame, so a pixel has the same ones as in `qsim sense`.
Effects that reach into a window are drawn with a margin: crosstalk of neighbours, and afterpulses of earlier frames as
far as the clip has them. Counting pixels whose codes depend on an earlier exposure are refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key
from qsim.sensor.defects.pixel_array import PixelArray
from qsim.sensor.sensor import Sensor
from qsim.streams.clip import Clip
from qsim.streams.photons import clip_photons
from qsim.streams.simulation import Draw
from quiver.data.code_table import draw_codes
from quiver.data.defects import Filler, behind, defective, skips_codes
from quiver.data.illumination import Illumination, stored_defects

NEGLIGIBLE = 1e-6  # chance of an afterpulse chain that is as long as the frames before a window


@dataclass(frozen=True)
class WindowPlace:
    """Place and orientation of sample n: enough to draw it again."""

    clip: int
    start: int
    y: int  # of the first frame taken
    x: int
    drift: tuple[int, int]  # px/frame along y and x: whole pixels, so that nothing is interpolated
    light: int
    turn: int  # quarter turns 0..3, + 4 = mirrored first
    backwards: bool
    key: Key


@lru_cache(maxsize=16)
def _pixel_array(defects: str, sensor: Sensor, shape: tuple[int, int], origin: tuple[int, int]) -> PixelArray:
    return PixelArray.of(stored_defects(defects), sensor, *shape, origin)


def check_windows(noise: Illumination, clip: Clip) -> None:
    """Raise `ValueError` if windows of this clip cannot be drawn one by one with this noise."""
    draw = noise.draw(clip)
    if draw.remembers:
        raise ValueError(f"{noise.sensor}: training windows cannot follow the charge of a spike camera; give sensor=")
    if draw.diffraction and clip.camera is None:
        raise ValueError(
            f"{clip.name}: diffraction needs a camera, and this clip's radiance is relative (imported video); leave "
            "its data set out, or sense the other clips without diffraction=True"
        )
    if noise.defects is not None:
        array = _pixel_array(noise.defects, draw.plane, clip.shape[1:], draw.origin)
        if array.follows_photons:
            raise ValueError(
                f"{noise.sensor}: carry_dead_time and afterpulse of counting pixels reach from exposure to exposure, "
                "which training windows cannot follow; give sensor= with a file without them"
            )


def behind_defects(noise: Illumination, draw: Draw, clip: Clip) -> tuple[Array | None, Sensor]:
    """Return the dead and hot pixels of a clip's frames, bool [H, W] or None, and the sensor of filled codes."""
    if noise.defects is None:
        return None, draw.sensor
    table = stored_defects(noise.defects)
    shape = clip.shape[1], clip.shape[2]
    bad = defective(table, draw.sensor, clip.exposure, draw.level.ppp, shape, draw.origin)
    return bad, behind(bad, table, draw.sensor, shape, draw.origin)


def window_filler(bad: Array | None, place: WindowPlace, side: int, sensor: Sensor) -> Filler | None:
    """Return what fills the dead and hot pixels `bad` of a window [side, side], not turned; None without any."""
    crop = None if bad is None else bad[place.y : place.y + side, place.x : place.x + side]
    return None if crop is None or not crop.any() else Filler(crop, skips_codes(sensor))


def window_codes(
    noise: Illumination, draw: Draw, clip: Clip, place: WindowPlace, frames: int, side: int, scale: float = 1.0
) -> Array:
    """Return codes [T, side, side] of a window with defects, in the order in which its frames are exposed, not turned.

    They equal the cropped codes of `qsim sense` under `place.key`, as far as both draw the same numbers. `draw` belongs
    to this noise and clip, `scale` is a factor on the light. A drifting crop keeps the pixels of its first place: the
    scene moves, the sensor does not.
    """
    assert noise.defects is not None
    array = _pixel_array(noise.defects, draw.plane, clip.shape[1:], draw.origin)
    length, height, width = clip.shape
    before = length - place.start - frames if place.backwards else place.start
    lead = min(array.lead(NEGLIGIBLE), before)
    dy, dx = place.drift
    last = frames - 1
    reach = array.reach
    y, x = (sorted((first, first + last * way)) for first, way in zip((place.y, place.x), (dy, dx), strict=True))
    top = min(reach, y[0])
    left = min(reach, x[0])
    rows = top + side + min(reach, height - y[1] - side)
    columns = left + side + min(reach, width - x[1] - side)

    def light(i: int) -> Array:
        moved = min(max(i, 0), last)  # frames outside of the window take the crop at its ends
        crop = (place.y + dy * moved - top, place.x + dx * moved - left, rows, columns)
        return scale * clip_photons(clip, place.start + i, draw.level.factor, crop, diffraction=draw.diffraction)

    order = range(last + lead, -1, -1) if place.backwards else range(-lead, frames)
    stack = np.stack([light(i) for i in order])
    part = array.crop(place.y - top, place.x - left, rows, columns)
    origin = (draw.origin[0] + place.y - top, draw.origin[1] + place.x - left)
    key = place.key.at(place.start - lead if not place.backwards else 0)
    codes = next(part.blocks([stack], clip.exposure, key, origin, draw_codes))
    return codes[lead:, top : top + side, left : left + side]

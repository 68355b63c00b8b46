"""Draws the codes of one training window exposure by exposure, as `qsim sense` draws them.

    Illumination, clip, place --WindowLight.of--> photons of every exposure --drawn--> codes

A code takes one clip frame or several (exposures.py). The defects of a window are those of its place in the full frame,
so a pixel has the same ones as in `qsim sense`. Effects that reach into a window are drawn with a margin: crosstalk of
neighbours, and afterpulses of earlier exposures as far as the clip has them. Counting pixels whose codes depend on an
earlier exposure are refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy import ndarray as Array

from qsim.keys import Key
from qsim.lazy_array import Crop
from qsim.sensor.defects.pixel_array import PixelArray
from qsim.sensor.sensor import Sensor
from qsim.streams.clip import Clip
from qsim.streams.exposures import Exposures
from qsim.streams.preparation import followed
from qsim.streams.simulation import Draw
from quiver.data.code_table import draw_codes
from quiver.data.defects import behind, of_draw
from quiver.data.illumination import Illumination, stored_defects
from quiver.data.mosaic_windows import filled_windows

NEGLIGIBLE = 1e-6  # chance of an afterpulse chain that is as long as the frames before a window


@dataclass(frozen=True)
class WindowPlace:
    """Place and orientation of sample n: enough to draw it again."""

    clip: int
    start: int  # the first code
    y: int  # of the first frame taken
    x: int
    drift: tuple[int, int]  # px per code along y and x: whole pixels, so that nothing is interpolated
    light: int
    turn: int  # quarter turns 0..3, + 4 = mirrored first
    backwards: bool
    key: Key


@lru_cache(maxsize=16)
def pixel_array(defects: str, sensor: Sensor, shape: tuple[int, int], origin: tuple[int, int]) -> PixelArray:
    """Return the pixels of frames [H, W] at their place (y, x) in the full frame, with a table of defects in JSON."""
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
        array = pixel_array(noise.defects, draw.plane, clip.shape[1:], draw.origin)
        if array.follows_photons:
            raise ValueError(
                f"{noise.sensor}: carry_dead_time and afterpulse of counting pixels reach from exposure to exposure, "
                "which training windows cannot follow; give sensor= with a file without them"
            )


def check_slices(noise: Illumination, clip: Clip) -> None:
    """Raise `ValueError` if light within an exposure of this clip changes more than counting pixels are drawn for."""
    if noise.planes == 1:
        return
    draw = noise.draw(clip)
    if draw.plane.follows_photons and followed(clip, noise.sensing, draw)[0].followed is not None:
        raise ValueError(
            f"{clip.name}: its light changes within an exposure of {noise.planes} slices, so that {noise.sensor} is "
            "drawn photon by photon, which training windows cannot follow; give fewer planes="
        )


def behind_defects(noise: Illumination, draw: Draw, clip: Clip) -> tuple[Array | None, Sensor]:
    """Return the dead and hot pixels of a clip's frames, bool [H, W] or None, and the sensor of filled codes."""
    if noise.defects is None:
        return None, draw.sensor
    shape = clip.shape[1], clip.shape[2]
    bad = of_draw(draw, clip.exposure, shape)
    return bad, behind(bad, draw.defects, draw.sensor, shape, draw.origin)


def filled_window(codes: Array, bad: Array | None, place: WindowPlace, sensor: Sensor, tile: tuple[int, int]) -> Array:
    """Return the codes [T, side, side] of a window, not turned, with the dead and hot pixels `bad` of the clip filled.

    They are filled from pixels at the same place of the tile of colour filters.
    """
    side = codes.shape[-1]
    own = None if bad is None else bad[place.y : place.y + side, place.x : place.x + side]
    return codes if own is None or not own.any() else filled_windows(codes, own, sensor, tile)


@dataclass(frozen=True)
class WindowLight:
    """The photons of every exposure of a window, in the order of exposure and not turned, with what reaches into it."""

    draw: Draw
    exposures: Exposures
    array: PixelArray  # of one exposure, under the window and its margin
    place: WindowPlace
    side: int  # px
    codes: list[int]  # of the stream, in the order of exposure
    lead: int  # codes before those of the window, whose afterpulses reach into it
    top: int  # px before those of the window, whose crosstalk reaches into it
    left: int
    photons: Array  # float64 [codes, exposures of a code, rows, columns]

    @classmethod
    def of(cls, noise: Illumination, draw: Draw, clip: Clip, place: WindowPlace, frames: int, side: int) -> WindowLight:
        """Read the light of a window. `draw` belongs to this noise and clip.

        A drifting crop keeps the pixels of its first place: the scene moves, the sensor does not.
        """
        exposures = draw.exposures(clip)
        _, height, width = clip.shape
        array = PixelArray(draw.plane)
        if noise.defects is not None:
            array = pixel_array(noise.defects, draw.plane, clip.shape[1:], draw.origin)
        # A window that runs backwards is exposed in that order: what came before it lies behind its end.
        before = len(exposures) - place.start - frames if place.backwards else place.start
        of_one = len(exposures[0])
        lead = min(-(-array.lead(NEGLIGIBLE) // of_one), before)
        last = frames - 1
        dy, dx = place.drift
        # A drifting crop covers more of the clip than its side; the margin must exist at both ends.
        y, x = (sorted((first, first + last * way)) for first, way in ((place.y, dy), (place.x, dx)))
        reach = array.reach
        top = min(reach, y[0])
        left = min(reach, x[0])
        rows = top + side + min(reach, height - y[1] - side)
        columns = left + side + min(reach, width - x[1] - side)
        crop = (place.y - top, place.x - left, rows, columns)

        def light(i: int) -> Array:
            moved = min(max(i, 0), last)  # codes outside of the window take the crop at its ends

            def read(t: int, part: Crop | None) -> Array:
                assert part is not None
                return draw.incident(clip, t, (part[0] + dy * moved, part[1] + dx * moved, *part[2:]))

            found = exposures.light(read, place.start + i, place.start + i + 1, crop)
            return found[::-1] if place.backwards else found

        order = range(last + lead, -1, -1) if place.backwards else range(-lead, frames)
        return cls(
            draw=draw,
            exposures=exposures,
            array=array.crop(place.y - top, place.x - left, rows, columns),
            place=place,
            side=side,
            codes=[place.start + i for i in order],
            lead=lead,
            top=top,
            left=left,
            photons=np.stack([light(i) for i in order]),
        )

    def _of_window(self, stack: Array) -> Array:
        """Return the part [T, side, side] of the window in [codes, rows, columns]."""
        return stack[self.lead :, self.top : self.top + self.side, self.left : self.left + self.side]

    def exposed(self) -> Array:
        """Return the photons of each code, float64 [T, side, side]."""
        return self._of_window(self.photons.sum(axis=1))

    def drawn(self, scale: float = 1.0) -> Array:
        """Return the codes [T, side, side]; `scale` is a factor on the light.

        They equal the cropped codes of `qsim sense` under `place.key`, as far as both draw the same numbers.
        """
        # Backwards, no stored stream has these codes in this order: their numbers begin anew.
        number = 0 if self.place.backwards else self.exposures.number(self.codes[0])
        origin = (self.draw.origin[0] + self.place.y - self.top, self.draw.origin[1] + self.place.x - self.left)
        of_one = self.photons.shape[1]
        even = self.draw.timing.shares is None
        step = len(self.codes) if even else 1  # codes of equal exposure are one block
        found = []
        for first in range(0, len(self.codes), step):
            block = scale * self.photons[first : first + step].reshape(-1, *self.photons.shape[2:])
            key = self.place.key.at(number + first * of_one)
            seconds = self.exposures.seconds(self.codes[first])
            found.append(next(self.array.blocks([block], seconds, key, origin, draw_codes)))
        each = np.concatenate(found).reshape(self.photons.shape)
        codes = each[:, 0] if of_one == 1 else each.sum(axis=1).astype(self.draw.sensor.dtype)
        return self._of_window(codes)


def window_codes(
    noise: Illumination, draw: Draw, clip: Clip, place: WindowPlace, frames: int, side: int, scale: float = 1.0
) -> Array:
    """Return the codes [T, side, side] of a window, in the order of exposure and not turned (`WindowLight`)."""
    return WindowLight.of(noise, draw, clip, place, frames, side).drawn(scale)

"""States all that decides the codes of a stream, a sensor and the light of a clip, and draws them.

Sensing --prepare--> Draw     Draw --packed--> packed codes of a stream      --frames--> codes of some frames
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

from numpy import ndarray as Array

from qsim.clip.clip_folder import ClipFolder
from qsim.files import Progress
from qsim.keys import Key
from qsim.lazy_array import Crop
from qsim.optics.radiometry import LightLevel
from qsim.sensor.colour_filter import ColourFilter
from qsim.sensor.defects import event_simulation
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.event_simulation import Effects
from qsim.sensor.defects.pixel_array import PixelArray
from qsim.sensor.sensor import Sensor
from qsim.streams.drawing import DRAWERS, Drawer, Followed
from qsim.streams.exposures import Exposures, Read, Timing
from qsim.streams.photons import clip_photons

Made = TypeVar("Made", bound=Drawer)
_BLOCK_PIXELS = 1 << 22  # photons held in memory at a time while sensing: 32 MiB of float64


@dataclass(frozen=True)
class Draw:
    """A `Sensing` applied to one clip: all parameters of its codes."""

    sensor: Sensor
    level: LightLevel  # per clip frame
    key: Key
    timing: Timing = field(default_factory=Timing)
    diffraction: bool = False
    defects: Defects | None = None
    followed: Effects | None = None  # counting pixels: the error of the closed form, if photons are followed instead
    engine: str = "auto"
    colour: ColourFilter | None = None  # from the first pixel of the clip; None: the clip has one band
    origin: tuple[int, int] = (0, 0)  # (y, x) of the first pixel in the full frame

    @property
    def planes(self) -> int:
        """Clip frames per code."""
        return self.timing.frames

    @property
    def plane(self) -> Sensor:
        """The sensor of one exposure: a single plane where planes are summed."""
        return self.sensor.plane if self.timing.summed else self.sensor

    @property
    def law(self) -> str:
        """How codes are drawn from random numbers, `drawn_by` of a stream: as the sensor states, or "events"."""
        if self.followed is not None:
            return "events"
        defects = self.defects or Defects()
        return self.sensor.law(summed=self.timing.summed, disturbed=defects.disturbed, read_out=defects.read_out)

    @property
    def remembers(self) -> bool:
        """Whether a pixel's planes are drawn in order, from the first: the charge of a spike camera."""
        return self.sensor.keeps_charge

    def exposures(self, clip: ClipFolder) -> Exposures:
        """Return the exposures of all codes of a clip."""
        return self.timing.over(clip)

    def light(self, clip: ClipFolder, start: int, stop: int) -> Array:
        """Return the photons [n, H, W] of each exposure of codes start ... stop - 1, each row at its time."""
        return self.exposures(clip).light(self._reader(clip), start, stop)

    def incident(self, clip: ClipFolder, t: int, crop: Crop | None = None) -> Array:
        """Return the expected photons [h, w] of clip frame t in a crop = (y, x, height, width) [px], behind filters."""
        photons = clip_photons(clip, t, self.level.factor, crop, diffraction=self.diffraction)
        if self.colour is None:
            return photons
        return self.colour.mosaic(photons, self.sensor.efficiency, (0, 0) if crop is None else crop[:2])

    def _reader(self, clip: ClipFolder) -> Read:
        """Return a function of (clip frame, crop) that returns its expected photons."""
        return partial(self.incident, clip)

    def drawer(self, clip: ClipFolder) -> Drawer:
        """Return what draws the codes of a clip."""
        return self._drawer(clip, DRAWERS[self.law])

    def _drawer(self, clip: ClipFolder, kind: type[Made]) -> Made:
        array = None
        if self.defects is not None or kind is Followed:
            array = PixelArray.of(self.defects or Defects(), self.plane, *clip.shape[1:], self.origin)
        return kind(
            self.sensor, self.plane, array, self.exposures(clip), self._reader(clip), self.key, self.origin, self.engine
        )

    def frames(self, clip: ClipFolder, start: int, stop: int) -> Array:
        """Return codes [stop - start, H, W] of stream frames start ... stop - 1.

        Pixels with a memory are simulated from the first frame of the clip.
        """
        return self.drawer(clip).frames(start, stop)

    def blocks(self, clip: ClipFolder, start: int, stop: int, step: int) -> Iterator[Array]:
        """Yield codes [t, H, W] of stream frames start ... stop - 1, `step` at a time, or (events) all at once."""
        return self.drawer(clip).blocks(start, stop, step)

    def packed(self, clip: ClipFolder, frames: int, progress: Progress | None = None) -> Iterator[Array]:
        """Yield all codes of a stream, packed row by row, some frames at a time: uint8 [t, H, ceil(W bits / 8)]."""
        step = max(1, _BLOCK_PIXELS // (clip.shape[1] * clip.shape[2] * self.planes))
        return self.drawer(clip).packed(frames, step, progress)

    def missed(self, clip: ClipFolder) -> Effects | None:
        """Return the error of the closed form of counting pixels in this clip; None if it is exact."""
        if not self.plane.follows_photons:
            return None
        memory = event_simulation.memory_of(self.defects)
        if self.planes == 1 and not (memory.carry or memory.afterpulse):
            return None
        return self._drawer(clip, Followed).missed()

    def trace(self, clip: ClipFolder, frames: int) -> Iterator[tuple[Array, Array]]:
        """Yield the times [n] in s and kinds [n] of the events behind the first codes of each pixel, row by row.

        Time 0 is the start of the first exposure. `ValueError` for codes that were not followed photon by photon.
        """
        if self.followed is None:
            raise ValueError(
                f"{clip.name}: its codes were not drawn photon by photon; sense a CountingSPAD with follow=True"
            )
        return self._drawer(clip, Followed).trace(frames)

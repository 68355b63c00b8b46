"""States the truth of codes: what a perfect restorer would find in each code, and how things move to the next.

    clip, Timing, light factor --CodeTruth--> sharp light, mean light, flow, validity, depth and bodies of code t

A code takes one clip frame or several (exposures.py). Its instant is the middle of them, at which it is sharp. Of an
even number of frames it is the middle of the later one of the two in the middle, half a clip frame late.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clip_folder import ClipFolder
from qsim.clip.composed_flow import composed
from qsim.lazy_array import Crop
from qsim.streams.exposures import Exposures, Timing
from qsim.streams.photons import clip_photons


@dataclass(frozen=True)
class CodeTruth:
    """The truth of the codes that a clip gives."""

    clip: ClipFolder
    timing: Timing
    factor: float = 1.0  # photons at the sensor over the clip's expected photons
    diffraction: bool = False  # light is blurred by the lens's Airy pattern

    def __len__(self) -> int:
        return len(self.exposures)

    @cached_property
    def exposures(self) -> Exposures:
        """The exposures of the codes."""
        return self.timing.over(self.clip)

    @property
    def mean_light(self) -> float:
        """The mean photons per pixel and full code over the clip."""
        clip = self.clip
        return self.factor * self.timing.frames * (clip.mean_radiance if clip.camera is None else clip.mean_photons)

    def sharp(self, t: int, crop: Crop | None = None, *, at: str = "row", moved: tuple[int, int] = (0, 0)) -> Array:
        """Return the sharp photons of code t, float64 [h, w] or [3, h, w], as if the middle lasted for all of it.

        Rows with their own time are those of the middle of each row's exposure, or (`at` is "frame") of all together.
        crop = (y, x, height, width) [px] is a part of the sensor, before which the scene is `moved` by (y, x) px.
        """
        # As if the instant lasted for the whole code: truth has the scale of the code, without its blur.
        factor = self.factor * self.timing.frames

        def instant(frame: int, part: Crop | None = None) -> Array:
            place = part if part is None else (part[0] + moved[0], part[1] + moved[1], *part[2:])
            return clip_photons(self.clip, frame, factor, place, sharp=True, diffraction=self.diffraction)

        return self.exposures.middle(instant, t, at, crop) * self.exposures.strength(t)

    def mean(self, t: int, crop: Crop | None = None) -> Array:
        """Return the photons that code t exposes, float64 [h, w] or [3, h, w]: those of all its clip frames."""

        def exposed(frame: int, part: Crop | None = None) -> Array:
            return clip_photons(self.clip, frame, self.factor, part)

        return np.asarray(self.exposures.light(exposed, t, t + 1, crop).sum(axis=0))

    def video(self, start: int = 0, stop: int | None = None, *, at: str = "row") -> Array:
        """Return `sharp` of codes start ... stop - 1, float64 [T, H, W] or [T, 3, H, W]; by default of all."""
        return np.stack([self.sharp(t, at=at) for t in range(start, len(self) if stop is None else stop)])

    def known(self, start: int = 0, stop: int | None = None) -> Array | None:
        """Return bool [T, H, W], False where light of `video` is cut off (`Clip.saturated`); None if all is known."""
        if self.clip.bands is not None or not self.clip.info.saturated_pixels:  # of colour they are counted only
            return None
        codes = range(start, len(self) if stop is None else stop)
        return ~np.stack([self.exposures.middle(self.clip.saturated, t) for t in codes])

    @property
    def has_truth(self) -> bool:
        """Whether motion, depth and bodies of the codes are known: not of rows that have their own time."""
        return self.clip.has_truth and self.timing.rows is None

    def flow(self, t: int) -> Array:
        """Return flow, float32 [2, H, W] (u right, v down) [px]: p of code t is at p + flow(p) in code t + 1.

        Over several clip frames it is composed of their flow; points that are lost on the way go on as they moved. NaN
        where the clip ends before, or has no motion for these codes.
        """
        return self.motion(t)[0]

    def valid(self, t: int) -> Array:
        """Return bool [H, W]: whether the point of code t is seen in every clip frame from it to code t + 1."""
        return self.motion(t)[1]

    def depth(self, t: int) -> Array:
        """Return the depth at the middle of code t, float32 [H, W] m along the optical axis; inf without a body."""
        return self.clip.depth(self.exposures.middle_frame(t))

    def body_id(self, t: int) -> Array:
        """Return the body at the middle of code t, int32 [H, W]; -1 without a body."""
        return self.clip.body_id(self.exposures.middle_frame(t))

    def motion(self, t: int) -> tuple[Array, Array]:
        """Return `flow` [2, H, W] and `valid` [H, W] of code t."""
        shape = self.clip.shape[1:]
        first = self.exposures.middle_frame(t)
        last = first + self.timing.frames
        if not self.has_truth or last > len(self.clip):
            return np.full((2, *shape), np.nan, np.float32), np.zeros(shape, bool)
        return composed(self.clip, first, last)

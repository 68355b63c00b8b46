"""What a pilot of a scene measures, for budget.py to decide on: every n-th pixel, in its true size, at a few times.

Noise is told from what noise is not by two independent halves. Equal frames draw equal paths, whatever the depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

from qsim.budget import COUNTS, Budget, Finding, grid_samples
from qsim.denoise import AROUND, DENOISE_COST, available, cleaned_mean
from qsim.render import Renderer, instants
from qsim.scene import Camera, Scene

PIXELS = 3000
WINDOW = 96  # px, side of the windows in which the denoiser is tried, one in the middle of each quarter of the frame
STAGE = 18  # of the random keys
MOST_DENOISED = 256  # samples per instant up to which the error of denoised pictures is foretold


@dataclass(frozen=True)
class Pilot:
    """A loaded scene seen in some of its pixels, and the frames at which it is looked at."""

    renderer: Renderer
    times: tuple[int, ...]

    @classmethod
    def of(cls, scene: Scene, frame_rate: float, frames: int, seed: int) -> Pilot:
        """About PIXELS pixels of the first, the middle and the last frame."""
        thinned = max(1, math.isqrt(scene.camera.height * scene.camera.width // PIXELS))
        renderer = Renderer(scene, frame_rate=frame_rate, seed=seed, budget=Budget(), thinned=thinned)
        return cls(renderer, tuple(sorted({0, frames // 2, frames - 1})))

    def halves(self, samples: int, bounces: int) -> Array:
        """Two independent estimates of the sharp radiance, float64 [2, times, H, W], W m^-2 sr^-1."""
        return np.stack([self._drawn(t, self.renderer.time(t), Budget(samples, bounces)) for t in self.times], axis=1)

    def mean(self, samples: int, bounces: int) -> Array:
        """The mean of the two [times, H, W]."""
        return self.halves(samples, bounces).mean(axis=0)

    def truths(self) -> list[dict[str, Array]]:
        """Flow, depth and the rest at each time."""
        return [self.renderer.truth(t) for t in self.times]

    def changes(self, shutter: float, count: int, bounces: int) -> float:
        """The rms difference between the means of K and of 3 K instants of the exposures [W m^-2 sr^-1].

        The K are among the 3 K, and all instants draw the same paths, so that what rests adds nothing. The square is
        the product of the differences of two independent halves, which noise changes by nothing on average.
        """
        square, budget = 0.0, Budget(COUNTS[1], bounces)
        for t in self.times:
            drawn = np.stack([self._drawn(t, instant, budget) for instant in self.exposed(t, shutter, 3 * count)])
            a, b = drawn[1::3].mean(axis=0) - drawn.mean(axis=0)
            square += float(np.mean(a * b)) / len(self.times)
        return math.sqrt(max(square, 0.0))

    def exposed(self, t: int, shutter: float, count: int) -> list[float]:
        """So many instants of the exposure of frame t [s]."""
        return instants(self.renderer.time(t), shutter / self.renderer.frame_rate, count)

    def _drawn(self, t: int, instant: float, budget: Budget) -> Array:
        return self.renderer.halves([instant], budget, self.renderer.key(t, STAGE))


def denoised_samples(
    pilot: Pilot, shutter: float, count: int, bounces: int, target: float, raw: int, wanted: bool | None
) -> tuple[int | None, Finding]:
    """Samples of a frame with which denoised windows have the error asked for, or None where `raw` ones cost less.

    Windows of the clip's middle frame, every pixel of them, with `count` instants. `wanted` None means: where it costs
    less.
    """
    renderer, t = pilot.renderer, pilot.times[len(pilot.times) // 2]
    camera = renderer.scene.camera
    if renderer.engine.backend == "scalar" or not available():
        return None, Finding("denoiser", "off", "not installed" if not available() else "needs LLVM or CUDA")
    if wanted is None and camera.height * camera.width < AROUND**2:
        return None, Finding("denoiser", "off", f"its error is not known well in fewer than {AROUND**2} pixels")
    cheap = Finding("denoiser", "off", f"{raw} raw samples cost no more")
    tried = [n for n in (count * each for each in COUNTS) if wanted or n + DENOISE_COST < raw]
    if not tried:
        return None, cheap
    windows = [renderer.window(crop) for crop in _windows(camera)]
    times, key = pilot.exposed(t, shutter, count), renderer.key(t, STAGE)
    surfaces = [window.surfaces(times, key) for window in windows]
    errors: list[float] = []
    for samples in tried:
        squares = 0.0
        for window, (albedo, normal) in zip(windows, surfaces, strict=True):
            squares += cleaned_mean(window.halves(times, Budget(samples, bounces), key), albedo, normal)[1] ** 2
        errors.append(math.sqrt(squares / len(windows)))
        if errors[-1] <= target:
            break
    where = f"{'' if len(windows) == 1 else 'four windows of '}frame {t}"
    needed, size = _needed(tried, errors, target), f"rms {target:.2g} in {where}"
    most = MOST_DENOISED * count
    if needed > most:
        if not wanted:
            return None, cheap
        needed, size = most, f"rms {errors[-1]:.2g} with {samples} samples, above the target"
    chosen = 2 * count * grid_samples(math.ceil(needed / count / 2))
    if not wanted and chosen + DENOISE_COST >= raw:
        return None, cheap
    return chosen, Finding("denoiser", "on", size)


def _windows(camera: Camera) -> list[tuple[int, int, int, int]]:
    """Where the denoiser is tried, (y, x, height, width): all of a small frame, else four places that stand for it."""
    height, width = camera.height, camera.width
    if height * width <= 4 * WINDOW**2:
        return [(0, 0, height, width)]
    rows, columns = (max(1, min(side // 2, WINDOW)) for side in (height, width))
    return [(height * i // 4 - rows // 2, width * j // 4 - columns // 2, rows, columns) for i in (1, 3) for j in (1, 3)]


def _needed(tried: list[int], errors: list[float], target: float) -> float:
    """Samples with which a falling error reaches the target: a power of them between the last two trials and beyond.

    `errors` are those of the first so many counts; inf where they do not fall.
    """
    if errors[0] <= target:
        return tried[0]
    if len(errors) < 2 or errors[-1] >= errors[-2]:
        return math.inf
    before, last = tried[len(errors) - 2 : len(errors)]
    share = math.log(errors[-2] / target) / math.log(errors[-2] / errors[-1])
    return before * math.exp(min(share * math.log(last / before), 100.0))  # a bias that samples do not help: no overflow

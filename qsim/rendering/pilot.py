"""Measures a scene at low cost (every n-th pixel at full resolution); `fidelity` chooses the budget from this.

Rays alone measure motion and bodies, in every frame or in MOST_LOOKS of them. Light is rendered in a few frames: the
first, the middle and the last, those with bodies that these do not show, and, with an open shutter, those with the
fastest motion. Under lights that flicker, frames of every strength take the place of the first three; the brightest is
added if they all miss its flash. Two independent half-renders separate Monte Carlo noise from signal. Equal frames use
equal paths at every depth.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clamped_error import Errors
from qsim.colour import bright_end
from qsim.optics.camera import Camera, Pose
from qsim.rendering.budget import DENOISE_COST, Allowed, Budget, Finding, grid_samples, instants, light_windows
from qsim.rendering.denoiser import AROUND, available, cleaned_mean, kinds, wording
from qsim.rendering.renderer import Renderer
from qsim.scene import Scene, Still

OF_PLANES = (4, 8, 16)  # samples of each plane that are tried where their mean is denoised
COUNTS = (8, 32, 128)  # samples of the pilots: 2x2, 4x4 and 8x8 in each half
# samples that are tried if COUNTS[0] leave room, and the least by which they raise the error
FEWEST = 4
RISE = 1.25
PIXELS = 3000  # of the frame that a pilot renders, about
MOST_MORE = 3  # frames added for hidden bodies, and as many for fast motion
STRENGTHS = 6  # frames in which flickering light is rendered
MOST_COUNTED = 32  # times that a dark frame counts beside a flash; more take memory
WINDOW = 192  # px, side of the windows in which the denoiser is tested, one in the middle of each quarter of the frame
MOST_LOOKS = 256  # frames of a clip in which motion and bodies are measured
STAGE = 18  # of the random keys
LUCK = 3.0  # a trial with this many times less raw noise than the pilot's missed rare paths by chance
CAREFUL = 2.0  # standard errors added to the error of a trial, whose result holds for the complete clip
MOST_DENOISED = 256  # samples per instant up to which the error of denoised pictures is extrapolated
MOST_FASTER = 32  # samples per instant up to which a faster denoiser is tried; with more, it saves less than it costs


@dataclass(frozen=True)
class Pilot:
    """A loaded scene, thinned to every n-th pixel, with its motion and the frames in which light is rendered."""

    renderer: Renderer
    extent: Array  # motion [frames, H, W] in px per exposure, or per frame time if the shutter is 0
    middle: int  # the frame in which the denoiser is tried: the middle one, or the brightest under flicker
    times: tuple[int, ...]  # frames in which light is rendered
    counts: int | tuple[int, ...] = 1  # how often each of them counts

    @classmethod
    def of(cls, scene: Scene, frame_rate: float, shutter: float, frames: int, seed: int) -> Pilot:
        """Return the pilot of a scene, with about PIXELS pixels."""
        thinned = max(1, math.isqrt(scene.camera.height * scene.camera.width // PIXELS))
        renderer = Renderer(scene, frame_rate=frame_rate, shutter=shutter, seed=seed, budget=Budget(), thinned=thinned)
        looks = np.unique(np.linspace(0, frames - 1, min(frames, MOST_LOOKS)).round().astype(int)).tolist()
        extent, bodies = (np.stack(each) for each in zip(*map(renderer.motion_extent, looks), strict=True))
        middle, counts = _lit(renderer, frames)
        times = set(counts)
        known = set(np.unique([renderer.motion_extent(t)[1] for t in times]).tolist())
        for _ in range(MOST_MORE):
            # A body that enters the picture late would be rendered in no
            # frame of the pilot, and its light known to none.
            hidden = ~np.isin(bodies, list(known))
            if not hidden.any():
                break
            most = int(np.argmax(hidden.sum(axis=(1, 2))))
            known |= set(np.unique(bodies[most]).tolist())
            times.add(looks[most])
        if shutter > 0:
            times.add(looks[int(np.argmax([bright_end(frame) for frame in extent]))])
            times |= _fastest(scene, {t: renderer.time(t) for t in {*looks, *times}}, times)
        ordered = tuple(sorted(times))
        return cls(renderer, extent, middle, ordered, tuple(counts.get(t, 1) for t in ordered))

    def counted(self, values: Array, axis: int = 0) -> Array:
        """Return an array with the values of `times` along an axis, each as often as it counts."""
        return np.repeat(values, self.counts, axis)

    def halves(self, samples: int, bounces: int) -> Array:
        """Return two independent estimates of the sharp radiance, float64 [2, counted times, H, W], W m^-2 sr^-1."""
        drawn = [self._drawn(t, self.renderer.time(t), Budget(samples, bounces)) for t in self.times]
        return self.counted(np.stack(drawn, axis=1), axis=1)

    def mean(self, samples: int, bounces: int) -> Array:
        """Return the mean of the two halves, float64 [counted times, H, W], W m^-2 sr^-1."""
        return self.halves(samples, bounces).mean(axis=0)

    def exposures(self, count: int, bounces: int) -> Array:
        """Return the mean of each exposure over `count` instants, float64 [counted times, H, W], W m^-2 sr^-1."""
        return self.counted(np.stack([self.blurred(t, count, bounces).mean(axis=0) for t in self.times]))

    def truths(self) -> list[dict[str, Array]]:
        """Return the ground truth of each frame in `times`, as `Renderer.truth`."""
        return [self.renderer.truth(t) for t in self.times]

    def changes(self, count: int, bounces: int, white: float) -> Errors:
        """Return the larger of the differences between the mean of K = `count` instants and those of 3 K and 5 K.

        Two comparisons are needed: motion with a period of a third of a step looks like rest with 3 K instants. Both
        contain the K instants, and all instants use the same paths, so that resting parts add nothing. The squared
        difference is the product over two independent halves, which has no bias from noise.
        """
        squares = []
        for t in self.times:
            means = [self.blurred(t, count * times, bounces) for times in (1, 3, 5)]
            both = (np.minimum(means, white), means)
            squares.append([[np.mean(np.prod(few - many, axis=0)) for many in more] for few, *more in both])
        # Products of independent halves may be negative by chance; their mean has no bias.
        largest = self.counted(np.array(squares)).mean(axis=0).max(axis=1)
        return Errors(*np.sqrt(np.maximum(largest, 0)).tolist())

    def blurred(self, t: int, count: int, bounces: int) -> Array:
        """Return two estimates (float64 [2, H, W]) of frame t's mean over `count` instants, all with equal paths."""
        budget = Budget(COUNTS[0], bounces)
        return np.mean([self._drawn(t, instant, budget) for instant in self.exposed(t, count)], axis=0)

    def exposed(self, t: int, count: int) -> list[float]:
        """Return `count` instants [s] of the exposure of frame t; without one, those of as many frames around it."""
        return instants(self.renderer.time(t), (self.renderer.shutter or count) / self.renderer.frame_rate, count)

    def unevenness(self, count: int) -> float:
        """Return how much more noise the mean of `count` instants has than under steady light: 1 without flicker.

        The root of mean square over mean of their strengths, of the light that varies most.
        """
        renderer = self.renderer
        most = 1.0
        windows = [np.transpose(light_windows(self.exposed(t, count), renderer.exposure)) for t in self.times]
        for flicker in renderer.scene.flickers.values():
            strengths = np.stack([flicker.mean(start, stop) for start, stop in windows])
            means = float(np.mean(strengths.mean(axis=1) ** 2))
            most = max(most, math.sqrt(float(np.mean(strengths**2)) / means) if means > 0 else 1.0)
        return most

    def _drawn(self, t: int, instant: float, budget: Budget) -> Array:
        return self.renderer.halves([instant], budget, self.renderer.key(t, STAGE))


def _lit(renderer: Renderer, frames: int) -> tuple[int, dict[int, int]]:
    """Return the frame for the denoiser, and those in which light is rendered at least, with how often each counts.

    Under flicker they are STRENGTHS frames whose strengths are spread as those of the clip: first, middle and last may
    all be dark. The strength of a frame is the sum over the lights. Where none of them has half of the largest
    strength, the brightest frame joins them. The others then count more often, as in the clip: its mean decides white.
    """
    if not renderer.scene.flickers:
        return frames // 2, dict.fromkeys((0, frames // 2, frames - 1), 1)
    strengths = np.sum(list(renderer.strengths(frames).values()), axis=0)
    places = (np.arange(STRENGTHS) + 0.5) / STRENGTHS * frames
    times = np.argsort(strengths, kind="stable")[places.astype(int)].tolist()
    brightest = int(np.argmax(strengths))
    bright = strengths >= strengths.max() / 2
    if bright[times].any():
        return brightest, dict.fromkeys(times, 1)
    # Rare flashes: the few bright frames decide white, and the dark ones how much light the clip has.
    flashes = int(np.count_nonzero(bright))  # less than a twelfth of the frames
    often = min(round((frames - flashes) / flashes / STRENGTHS), MOST_COUNTED)
    return brightest, dict.fromkeys(times, often) | {brightest: 1}


def rests(scene: Scene) -> bool:
    """Return whether nothing in a scene moves, visible or not."""
    return not _moving(scene)


def _moving(scene: Scene) -> list[Pose]:
    things = (scene.camera, *scene.bodies, *scene.lights, *scene.parts)
    motions = (getattr(thing, "motion", None) for thing in things)
    return [motion for motion in motions if motion is not None and not isinstance(motion, Still)]


def _fastest(scene: Scene, moments: dict[int, float], known: set[int]) -> set[int]:
    """Return at most MOST_MORE frames with fast motion that the known frames miss (below half of its largest speed).

    `moments` are the times [s] of all candidate frames, the known ones included.
    """
    frames = sorted(moments)
    speeds = np.array([[sum(map(np.linalg.norm, m.velocity(moments[t]))) for t in frames] for m in _moving(scene)])
    found: set[int] = set()
    while len(speeds) and len(found) < MOST_MORE:
        slow = speeds[:, [t in known | found for t in frames]].max(axis=1) < 0.5 * speeds.max(axis=1)
        if not slow.any():
            break
        speeds = speeds[slow]
        found.add(frames[int(np.argmax((speeds / speeds.max(axis=1, keepdims=True)).sum(axis=0)))])
    return found


@dataclass(frozen=True)
class Trials:
    """Which samples of a picture of several instants are tried with the denoiser, and which it can have."""

    instants: int
    counts: tuple[int, ...] = COUNTS  # of an instant
    rounded: Callable[[float], int] | None = None  # from those that each instant needs; None: the next grids

    def of_picture(self, needed: float) -> int:
        """Return the samples of a picture that needs so many."""
        each = needed / self.instants
        return self.rounded(each) if self.rounded else 2 * self.instants * grid_samples(math.ceil(each / 2))


def denoised_samples(
    pilot: Pilot,
    trials_of: Trials,
    bounces: int,
    allowed: Allowed,
    share: float,
    raw: int,
    wanted: bool | None,
    expected: Callable[[int], Errors],
) -> tuple[tuple[int, str] | None, Finding]:
    """Return samples and denoiser's quality that reach the error at the least cost, or None if `raw` samples cost less.

    Complete windows of the clip's middle frame are rendered with the instants of a picture. The error to reach is
    `share` of the allowed one. `wanted` None denoises only if that costs less. `expected(samples)` are the errors of
    raw samples; they replace a trial that missed rare paths, which shows as noise far below them.
    """
    renderer = pilot.renderer
    count = trials_of.instants
    t = pilot.middle
    camera = renderer.scene.camera
    reason = _cannot_denoise(renderer, wanted)
    if reason:
        return None, Finding("denoiser", "off", reason)
    cheap = Finding("denoiser", "off", f"{raw} raw samples cost no more")
    numbers = [count * each for each in trials_of.counts]
    names = {n: kinds(renderer.variant) if n <= MOST_FASTER * count else ("high",) for n in (FEWEST * count, *numbers)}
    least = {n: min(map(DENOISE_COST.__getitem__, names[n])) for n in numbers}
    tried = [n for n, cost in least.items() if wanted or n + cost < raw]
    if not tried:
        return None, cheap
    parts = [renderer.window(crop) for crop in windows(camera)]
    times = pilot.exposed(t, count)
    key = renderer.key(t, STAGE)
    # Albedo and normals do not depend on the samples that are tried: they are drawn once.
    surfaces = [window.surfaces(times, key) for window in parts]

    def trial(samples: int) -> dict[str, float]:
        """Return the error by quality, over what is allowed."""
        halves = [window.halves(times, Budget(samples, bounces), key) for window in parts]
        found = {}
        noisy = _root_mean([Errors.of_halves(pair, allowed.white).plain for pair in halves])
        for quality in names[samples]:
            each = zip(halves, surfaces, strict=True)
            mixed = [cleaned_mean(pair, *seen, allowed.white, quality) for pair, seen in each]
            at_white = _root_mean([one.error_at(allowed.white, CAREFUL) for one in mixed])
            cleaned = Errors(at_white, _root_mean([one.error for one in mixed]))
            missed = LUCK * noisy < expected(samples).plain
            found[quality] = allowed.fraction(expected(samples) if missed else cleaned)
        return found

    trials: list[dict[str, float]] = []
    for samples in tried:
        trials.append(trial(samples))
        # The error falls with the samples; more trials than the first that suffices only cost time.
        if trials[-1]["high"] <= share:
            break
    faster = min((error for quality, error in trials[0].items() if quality != "high"), default=math.inf)
    if tried[0] > FEWEST * count and faster * RISE <= share:
        tried = [FEWEST * count, *tried]
        trials = [trial(FEWEST * count), *trials]
    errors = {quality: [one[quality] for one in trials if quality in one] for quality in kinds(renderer.variant)}
    size = f"tried in {'' if len(parts) == 1 else 'four windows of '}frame {t}"
    options = _enough(tried, errors, share, trials_of)
    if wanted and not options:  # asked for: as many samples as there may be
        size = f"{trials[-1]['high']:.2g} times the error allowed with {tried[len(trials) - 1]} samples"
        options = [(2 * count * grid_samples(MOST_DENOISED // 2), "high")]
    chosen = min(options, key=lambda option: option[0] + DENOISE_COST[option[1]], default=None)
    if chosen is None or (not wanted and chosen[0] + DENOISE_COST[chosen[1]] >= raw):
        return None, cheap
    return chosen, Finding("denoiser", f"on, {wording(chosen[1])}", size)


def _cannot_denoise(renderer: Renderer, wanted: bool | None) -> str:
    """Return why frames of a renderer are not denoised, or nothing; `wanted` None weighs what is known of the error."""
    if not available():
        return "not installed"
    if renderer.engine.backend == "scalar":
        return "needs LLVM or CUDA"
    camera = renderer.scene.camera
    if wanted is None and camera.height * camera.width < AROUND**2:
        return f"its error is not known well in fewer than {AROUND**2} pixels"
    return ""


def _root_mean(errors: list[float]) -> float:
    return math.sqrt(float(np.mean(np.square(errors))))


def _enough(tried: list[int], errors: dict[str, list[float]], share: float, of: Trials) -> list[tuple[int, str]]:
    """Return samples and quality that reach `share` of the allowed error, by the trials of each quality."""
    found = []
    for quality, fractions in errors.items():
        needed = needed_samples(tried[: len(fractions)], fractions, share)
        if needed <= (MOST_DENOISED if quality == "high" else MOST_FASTER) * of.instants:
            found.append((of.of_picture(needed), quality))
    return found


def windows(camera: Camera) -> list[tuple[int, int, int, int]]:
    """Return the windows (y, x, height, width) for the denoiser's trial: a small frame itself, or four of its parts."""
    height = camera.height
    width = camera.width
    if height * width <= 4 * WINDOW**2:
        return [(0, 0, height, width)]
    rows, columns = (max(1, min(side // 2, WINDOW)) for side in (height, width))
    return [(height * i // 4 - rows // 2, width * j // 4 - columns // 2, rows, columns) for i in (1, 3) for j in (1, 3)]


def needed_samples(tried: list[int], errors: list[float], target: float) -> float:
    """Return the samples at which a falling error reaches the target, by a power law through the last two trials.

    `errors` belong to the first counts of `tried`; the result is inf if they do not fall.
    """
    if errors[0] <= target:
        return tried[0]
    if len(errors) < 2 or errors[-1] >= errors[-2]:
        return math.inf
    before, last = tried[len(errors) - 2 : len(errors)]
    share = math.log(errors[-2] / target) / math.log(errors[-2] / errors[-1])
    return before * math.exp(min(share * math.log(last / before), 100.0))  # no overflow if the error hardly falls

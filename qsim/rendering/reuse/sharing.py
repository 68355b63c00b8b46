"""Chooses samples, neighbours and denoiser of frames that share samples, by a trial in complete windows of one frame.

    pilot + error allowed + budget of frames alone -> samples, neighbours, denoised: the cheapest, those alone included

Two conditions hold. The error is reached, and it is known: the standard error of a frame's stated squared error is at
most DOUBT of the one allowed. It follows from the noise of the frame's own samples and the number of pixels
(choice.py), so that small frames share samples only if each has many.

Costs are predicted, not timed: an interrupted clip must choose again what it chose before.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clamped_error import Errors
from qsim.rendering.budget import DENOISE_COST, Allowed, Budget, Finding, grid_samples
from qsim.rendering.denoiser import available, kinds, wording
from qsim.rendering.pilot import CAREFUL, COUNTS, LUCK, STAGE, Pilot, needed_samples, windows
from qsim.rendering.reuse.carrying import REACH, unshared
from qsim.rendering.reuse.choice import best_of, reused_mean

DOUBT = 0.1  # largest standard error of a frame's stated squared error, of the squared error allowed: 0.4 dB
CARRY_COST = 0.05  # cost of carrying a sample, over that of tracing it
COVER_COST = 2.5  # cost of coverage rays and of the choice by tiles, in samples per pixel
FIXED_COST = 30000.0  # cost of starting the kernels of a frame, in samples
KERNEL_COST = 4e6  # cost of compiling the kernels of a clip, in samples
SAMPLE_BYTES = 12  # that a kept sample takes: depth, body, radiance
MOST_BYTES = 1.2e9  # that the kept samples of all neighbours may take
MOST_TRIED = 2  # of COUNTS: a trial renders eleven frames
MOST_TRIAL = 0.05  # of the predicted cost of a clip: what a trial may cost that nobody asked for
NAME = "reuse over time"
ALONE = "off, each frame alone"


@dataclass(frozen=True)
class Sharing:
    """How the frames of a clip share samples."""

    samples: int  # per pixel and frame
    neighbours: int  # frames on each side; 0: each frame alone
    denoise: str  # quality of the denoiser; empty: none

    @classmethod
    def of(cls, budget: Budget) -> Sharing:
        """Return the sharing of a budget."""
        return cls(budget.samples, budget.neighbours, budget.quality if budget.denoise else "")

    @property
    def about_denoiser(self) -> str:
        """Whether and how pictures are denoised, as text."""
        return f"on, {wording(self.denoise)}" if self.denoise else "off"

    def cost(self, pixels: int) -> float:
        """Return the cost of a frame of so many pixels, in samples per pixel."""
        alone = self.samples + DENOISE_COST.get(self.denoise, 0.0)
        if not self.neighbours:
            return alone
        return alone + 2 * self.neighbours * CARRY_COST * self.samples + COVER_COST + FIXED_COST / pixels


@dataclass(frozen=True)
class Need:
    """The error that frames may have, and how it is reached alone."""

    allowed: Allowed
    share: float  # of the allowed error, that noise and bias may take
    bounces: int
    frames: int  # of the clip
    alone: Sharing
    expected: Callable[[int], Errors]  # errors of raw samples of one frame, by their number


def most_neighbours(samples: int, pixels: int) -> int:
    """Return the most frames on each side of which `samples` per pixel are kept in MOST_BYTES; 0 if none."""
    kept = samples * pixels * SAMPLE_BYTES
    return max((k for k in REACH if (2 * k + 1) * kept <= MOST_BYTES), default=0)


def shared_samples(
    pilot: Pilot, need: Need, denoise: bool | None, wanted: bool | None = None
) -> tuple[Sharing, Finding]:
    """Return how the frames of a clip share samples, `need.alone` where that is predicted to cost no more.

    `denoise` None takes the cheaper; True and False leave no choice. `wanted` None tries only what costs little against
    the clip, True whatever could pay for itself, False nothing.
    """
    if wanted is False:
        return need.alone, Finding(NAME, ALONE, "not requested")
    renderer = pilot.renderer
    alone = need.alone
    reason = unshared(renderer.scene, renderer.shutter, renderer.engine.backend) or "one frame" * (need.frames == 1)
    if reason:
        return alone, Finding(NAME, ALONE, f"not with {reason}")
    camera = renderer.scene.camera
    pixels = camera.height * camera.width
    names = ("", *kinds(renderer.variant))
    tried = [kind for kind in names if denoise in (None, bool(kind)) and (available() or not kind)]
    clip = need.frames * pixels * alone.cost(pixels)
    trials: list[Trial] = []
    for samples in COUNTS[:MOST_TRIED]:
        # The most that sharing could save: as if so few samples and one neighbour were enough.
        saved = clip - need.frames * pixels * Sharing(samples, 1, tried[0]).cost(pixels)
        cost = _trial_cost(samples, pilot, tried)
        if saved <= cost or not most_neighbours(samples, pixels) or (wanted is None and cost > MOST_TRIAL * clip):
            break
        trials.append(Trial.of(pilot, need, samples, tried))
        if min(map(max, trials[-1].found.values())) <= 1:
            break
    best = _cheapest(trials, alone, pixels)
    if best is alone:
        dear = "more than it could save" if wanted else f"over {100 * MOST_TRIAL:g} % of the clip, or save nothing"
        why = "frames alone cost no more" if trials else f"a trial would cost {dear}"
        return alone, Finding(NAME, ALONE, why)
    where = f"{'' if len(windows(camera)) == 1 else 'four windows of '}frame {pilot.middle}"
    size = f"tried in {where}; {100 * best.cost(pixels) / alone.cost(pixels):.0f} % of the cost without, by prediction"
    return best, Finding(NAME, f"samples of {best.neighbours} frames on each side, where they err less", size)


@dataclass(frozen=True)
class Trial:
    """One frame with so many samples, by neighbours and denoiser."""

    samples: int
    found: dict[tuple[int, str], tuple[float, float]]  # error and doubt, both rms and over what is allowed

    @classmethod
    def of(cls, pilot: Pilot, need: Need, samples: int, kinds: list[str]) -> Trial:
        """Return the trial of the pilot's middle frame."""
        renderer = pilot.renderer
        t = pilot.middle
        white = need.allowed.white
        camera = renderer.scene.camera
        pixels = camera.height * camera.width
        most = most_neighbours(samples, pixels)
        reaches = [k for k in REACH if k <= most]
        squares: dict[tuple[int, str], list[Array]] = {(k, kind): [] for k in reaches for kind in kinds}
        for crop in windows(camera):
            window = renderer.window(crop)
            budget = Budget(samples, need.bounces, neighbours=most)
            # First: pictures move the scene to other frames.
            surfaces = window.surfaces([renderer.time(t)], renderer.key(t, STAGE)) if any(kinds) else None
            pictures = window.carrier(budget, need.frames, STAGE).pictures(t)
            pictures[:, :, ~np.isfinite(pictures[0]).all(axis=0)] = 0  # as in frames
            noisy = Errors.of_halves(pictures[0], white).plain
            for kind in kinds:
                for count, k in enumerate(reaches, 2):
                    best, _ = best_of(pictures[:count], white, bool(kind))
                    mixed = reused_mean(pictures[0], best, surfaces if kind else None, white, kind or "high")
                    doubt = mixed.deviation_at(white) / math.sqrt(pixels)
                    found = np.array([noisy, mixed.error_at(white, CAREFUL), mixed.error, math.sqrt(doubt)])
                    squares[k, kind].append(found**2)
        means = {choice: np.sqrt(np.mean(each, axis=0)).tolist() for choice, each in squares.items()}
        return cls(samples, {choice: _fractions(need, samples, t, choice[0], *m) for choice, m in means.items()})


def _fractions(
    need: Need, samples: int, t: int, neighbours: int, noisy: float, clamped: float, plain: float, doubt: float
) -> tuple[float, float]:
    """Return error and doubt over what is allowed, for a whole clip by those of its frame t."""
    raw = need.expected(samples)
    ends = math.sqrt(_fewer_at_ends(need.frames, t, neighbours))
    # A trial that met far less noise than so many samples have was lucky, and its error is not believed.
    errors = raw if LUCK * noisy < raw.plain else Errors(ends * clamped, ends * plain)
    return need.allowed.fraction(errors) / need.share, doubt / need.allowed.target / math.sqrt(DOUBT)


def _fewer_at_ends(frames: int, t: int, neighbours: int) -> float:
    """Return the mean squared noise of a clip's frames over that of frame t: its ends have fewer neighbours."""
    number = np.arange(frames)
    counts = 1 + np.minimum(number, neighbours) + np.minimum(frames - 1 - number, neighbours)
    return float(np.mean(counts[t] / counts))


def _trial_cost(samples: int, pilot: Pilot, kinds: list[str]) -> float:
    """Return the cost of a trial with its kernels, in samples."""
    pixels = sum(height * width for _, _, height, width in windows(pilot.renderer.scene.camera))
    denoising = len(REACH) * sum(DENOISE_COST.get(kind, 0.0) for kind in kinds)
    return KERNEL_COST + pixels * (2 * REACH[-1] * samples + Sharing(samples, REACH[-1], "").cost(pixels) + denoising)


def _cheapest(trials: list[Trial], alone: Sharing, pixels: int) -> Sharing:
    """Return the cheapest sharing that fulfils both conditions by the trials, or `alone`."""
    best = alone
    for neighbours, kind in trials[0].found if trials else ():
        made = [trial for trial in trials if (neighbours, kind) in trial.found]
        series = zip(*(trial.found[neighbours, kind] for trial in made), strict=True)
        # Both have to be reached: the error itself, and a standard error small enough to state it.
        needed = max(needed_samples([trial.samples for trial in made], list(values), 1.0) for values in series)
        if needed > COUNTS[-1]:
            continue
        found = Sharing(2 * grid_samples(math.ceil(needed / 2)), neighbours, kind)
        if neighbours <= most_neighbours(found.samples, pixels) and found.cost(pixels) < best.cost(pixels):
            best = found
    return best

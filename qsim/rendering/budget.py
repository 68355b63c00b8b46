"""Defines `Budget`, the samples, bounces and instants of a frame, and the grids and blur errors that follow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clamped_error import Errors
from qsim.clip.clip_info import Finding, Work

# Cost of two denoised halves, albedo and normals in samples per pixel, by quality (docs/log.md), best first. That of
# OptiX's denoiser was not measured: it is taken to be that of the fastest other one.
DENOISE_COST = {"high": 15.0, "balanced": 7.5, "fast": 5.0, "optix": 5.0}


@dataclass(frozen=True)
class Budget(Work):
    """The work for one frame, checked; clip.json stores it."""

    def __post_init__(self) -> None:
        for name in ("samples", "bounces", "sub_frames", "planes"):
            if getattr(self, name) < 1:
                raise ValueError(f"Budget.{name}: at least 1, got {getattr(self, name)!r}")
        if self.planes > 1 and (self.neighbours or self.sharp_samples < 1):
            raise ValueError("Budget.planes: frames that share noise have no neighbours, and need sharp_samples")
        if self.neighbours < 0:
            raise ValueError(f"Budget.neighbours: at least 0, got {self.neighbours!r}")
        if self.quality not in DENOISE_COST:
            raise ValueError(f"Budget.quality: {', '.join(DENOISE_COST)}; got {self.quality!r}")

    @property
    def left_out_clamped(self) -> float:
        """The error by later bounces of clamped pictures, W m^-2 sr^-1; the plain one if no white is known."""
        return self.left_out_at_white if self.white else self.left_out

    @property
    def of_middles(self) -> Budget:
        """The work for the sharp frame in the middle of a code."""
        return replace(
            self,
            samples=self.sharp_samples,
            denoise=bool(self.sharp_quality),
            quality=self.sharp_quality or "high",
            planes=1,
            codes=(),
        )

    def is_middle(self, t: int) -> bool:
        """Return whether frame t is in the middle of a code, the later of two, and has a sharp frame."""
        return self.planes > 1 and any(t % frames == frames // 2 for frames in self.codes)

    def grid(self, instants: int) -> int:
        """Return the samples per pixel of each half at each of `instants` instants."""
        half = math.ceil(self.samples / instants / 2)
        return plane_grid(half) if self.planes > 1 else grid_samples(half)


@dataclass(frozen=True)
class Allowed:
    """The errors that a frame may have, rms in W m^-2 sr^-1."""

    white: float
    target: float  # of picture and truth clamped at white
    sensor: float = math.inf  # without a clamp, of errors that are independent from frame to frame
    planes: float = 1.0  # frames that a code sums

    @property
    def repeated(self) -> Allowed:
        """The same for errors that repeat in all frames of a code, so that it does not average them."""
        return replace(self, sensor=self.sensor / math.sqrt(self.planes), planes=1.0)

    def fraction(self, errors: Errors) -> float:
        """Return the fraction of the allowed error that these errors take; 1 is all of it."""
        return max(errors.at_white / self.target, errors.plain / self.sensor)


LIMIT = "limit"  # the finding that names the stricter one, dB or PPP


def deciding(findings: Sequence[Finding]) -> str:
    """Return the limit that decided the samples, as `40 dB` or `7 PPP`; empty if none is stated."""
    return next((finding.chosen for finding in findings if finding.effect == LIMIT), "")


def explain(findings: Sequence[Finding]) -> str:
    """Return one line per finding: effects modelled, effects left out, and their sizes."""
    width = max((len(finding.effect) for finding in findings), default=0)
    return "\n".join(f"{f.effect:{width}}  {f.chosen}; {f.size}" for f in findings)


def grid_samples(samples: int) -> int:
    """Return the next size of an even, nearly square grid: 2, 4, 6, 8, 12, 16, 20, 24, 30, 36, 42, 48, 56, 64, ...

    Multijitter has larger errors on squares of odd numbers; on all other grids, error * samples^0.7 is nearly constant
    (docs/log.md).
    """
    size = max(2, samples)
    while not _is_grid(size):
        size += 1
    return size


def plane_grid(samples: int) -> int:
    """Return the next number of samples of half a plane: 1, 2, 3, and those of `grid_samples`."""
    return samples if samples < 4 else grid_samples(samples)


def _is_grid(size: int) -> bool:
    """Return whether the grid of multijitter, isqrt(size) cells high, has exactly `size` cells and is nearly square."""
    high = math.isqrt(size)
    return size % 2 == 0 and size % high == 0 and size // high - high <= 2


def instants(middle: float, exposure: float, count: int) -> list[float]:
    """Return the middles [s] of `count` equal parts of an exposure [s]."""
    return [middle + float(part) * exposure for part in (np.arange(count) + 0.5) / count - 0.5]


def light_windows(instants: Sequence[float], exposure: float) -> list[tuple[float, float]]:
    """Return, for each instant, start and stop [s] of the part of the exposure whose mean light it stands for.

    `instants` are those of `instants`. The parts cover the exposure evenly, so the mean light is exact at any count.
    Three instants share a part where the count allows it: every third one then sees the light of all, and `blur_left`
    compares motion only. A flash shorter than a part is spread over it, which no error counts (`fidelity.flickering`).
    """
    each = 3 if len(instants) % 3 == 0 else 1
    start = (instants[0] + instants[-1] - exposure) / 2
    count = len(instants) // each
    return [
        (start + exposure * (i // each) / count, start + exposure * (i // each + 1) / count)
        for i in range(len(instants))
    ]


def as_bright(means: Array) -> Array:
    """Return the means [3, 2, H, W] of `blur_left`, the middle one with the light of all in place of that of its part.

    A middle instant without light is replaced by every third one. Pixels that are not finite do not count.
    """
    known = np.isfinite(means).all(axis=(0, 1))
    every, middle = (float(np.sum(one, where=known)) for one in means[::2])
    return np.stack([*means[:2], means[2] * (every / middle) if middle > 0 else means[1]])


def blur_left(means: Array, count: int) -> float:
    """Return the rms error of the mean of `count` instants (3, 6, 9 ...), W m^-2 sr^-1.

    `means` [3, 2, H, W] are the means of all instants, of every third one, and the middle one alone, each in two
    independent halves. The product of the halves' differences is a squared error without bias from noise. The error
    falls as a power of the count, from 1/2 (separate thin ghosts) to 2 (steps below a pixel). The middle instant and
    the thirds determine that power. For three instants they are the same, and it is taken as 2, which holds for steps
    below a pixel: with larger ones the error of three is up to 6 times as large. Other counts have no thirds: 0, not
    measured.
    """
    if count % 3:
        return 0.0
    thirds, middle = (float(np.mean(np.prod(few - means[0], axis=0))) for few in means[1:])
    if thirds <= 0:
        return 0.0
    power = 2.0 if count == 3 else math.log(max(middle, thirds) / thirds) / math.log(count / 3) / 2
    return math.sqrt(thirds) / 3 ** min(max(power, 0.5), 2.0)


def blur_error(extent: float, instants: int) -> float:
    """Return the largest error of the mean of K instants at a moving edge, as a fraction of its contrast.

    An edge that moves by `extent` = m px in the exposure steps by d = m / K. While d < 1 px, a pixel's coverage is
    piecewise linear in time, and the midpoint rule errs by at most d^2 / (8 m) per kink. Larger steps leave separate
    ghosts of 1 / K.
    """
    step = extent / instants
    if step > 1:
        return 1 / instants
    return step**2 / (8 * extent) if step > 0 else 0.0

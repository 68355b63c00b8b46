"""What a frame costs and why: the record `Budget`, the sizes of sampling grids and the instants of an exposure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clamped_error import Errors


@dataclass(frozen=True)
class Finding:
    """One thing that a clip models or leaves out, and how large the rest is."""

    effect: str
    chosen: str
    size: str


@dataclass(frozen=True)
class Budget:
    """What a frame costs, and why; the same record is stored in clip.json."""

    samples: int = 32  # per pixel and frame, all instants and both halves together
    bounces: int = 6  # scatterings along a path
    sub_frames: int = 9  # instants per exposure when the shutter is open; their error is measured if 3, 6, 9 ...
    sharp: bool = True  # also render the instant at mid-exposure when the shutter is open
    denoise: bool = False  # Open Image Denoise; its error is measured against raw halves
    left_out: float = 0.0  # W m^-2 sr^-1, rms of later bounces by the pilot; part of the error that a frame states
    left_out_at_white: float = 0.0  # the same of pictures clamped at white
    white: float = 0.0  # W m^-2 sr^-1, by the pilot; 0: not known, each frame takes its own
    dimmed: float = 0.0  # share of the mean light that later bounces would add, by the pilot
    dimmed_error: float = 0.0  # standard error of that share
    findings: tuple[Finding, ...] = field(default=())

    def __post_init__(self) -> None:
        for name in ("samples", "bounces", "sub_frames"):
            if getattr(self, name) < 1:
                raise ValueError(f"Budget.{name}: at least 1, got {getattr(self, name)!r}")

    def grid(self, instants: int) -> int:
        """Samples per pixel of each half at each of these instants."""
        return grid_samples(math.ceil(self.samples / instants / 2))


@dataclass(frozen=True)
class Allowed:
    """The errors that a frame may have, rms in W m^-2 sr^-1."""

    white: float
    target: float  # of picture and truth clamped at white
    sensor: float = math.inf  # without a clamp

    def part(self, errors: Errors) -> float:
        """How much of what is allowed these errors take, 1 being all."""
        return max(errors.at_white / self.target, errors.plain / self.sensor)


def explain(budget: Budget) -> str:
    """What was modelled, what was left out, and how large it would have been; one line each."""
    width = max((len(finding.effect) for finding in budget.findings), default=0)
    return "\n".join(f"{f.effect:{width}}  {f.chosen}; {f.size}" for f in budget.findings)


def grid_samples(samples: int) -> int:
    """The next size of an even number of cells, nearly square: 4, 6, 8, 12, 16, 20, 24, 30, 36, 42, 48, 56, 64, ...

    Multijitter does worse on squares of odd numbers: measured under sun and sky, error * samples^0.7 is 0.012 to 0.015
    at 4, 16, ... 144, but 0.018 to 0.028 at 9, 25, ... 121. On all others it is alike: at 4, 6, 8, 12, 16, 20 and 24
    samples it stays within 5 % of its mean (fan, tumble, gears, flag, crowd).
    """
    size = max(4, samples)
    while not _is_grid(size):
        size += 1
    return size


def _is_grid(size: int) -> bool:
    """Whether multijitter, whose grid is isqrt(size) high, holds just that many, evenly and nearly square."""
    high = math.isqrt(size)
    return size % 2 == 0 and size % high == 0 and size // high - high <= 2


def instants(middle: float, exposure: float, count: int) -> list[float]:
    """The middles of `count` equal parts of an exposure [s]."""
    return [middle + float(part) * exposure for part in (np.arange(count) + 0.5) / count - 0.5]


def blur_left(means: Array, count: int) -> float:
    """The rms error of the mean of 3, 6, 9 ... instants, from `means` [3, 2, H, W]: of all, of thirds, of the middle.

    Each in two independent halves: the product of their differences is a square that noise changes by nothing on
    average. The error falls as a power of the instants, 1/2 (thin ghosts apart) to 2 (steps below a pixel), which the
    middle one and the thirds show; of three instants 2 is taken. Other counts have no thirds: 0, not measured.
    """
    if count % 3:
        return 0.0
    thirds, middle = (float(np.mean(np.prod(few - means[0], axis=0))) for few in means[1:])
    if thirds <= 0:
        return 0.0
    power = 2.0 if count == 3 else math.log(max(middle, thirds) / thirds) / math.log(count / 3) / 2
    return math.sqrt(thirds) / 3 ** min(max(power, 0.5), 2.0)


def blur_error(travel: float, instants: int) -> float:
    """Largest error of the mean of K instants at a moving edge, as a share of its contrast.

    An edge that travels m px in the exposure steps by d = m / K. While d < 1 px, a pixel's coverage is piecewise linear
    in time and the midpoint rule errs by at most d^2 / (8 m) per kink; coarser steps leave separate ghosts of 1 / K.
    """
    step = travel / instants
    return step**2 / (8 * travel) if 0 < step <= 1 else 1 / instants if step > 1 else 0.0

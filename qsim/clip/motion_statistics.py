"""Measures the motion of a clip from its flow: per frame, and per frame of a bit-depth study.

A **plane** is one clip frame read with one bit; a frame of b bits is 2^b - 1 planes.
"""

from __future__ import annotations

import numpy as np
from numpy import ndarray as Array

MOVING = 0.1  # px per frame: a pixel that moves farther counts as moving
SLOWEST = 10_000.0  # clip frames per second: in slower clips, a plane is too long to count as an instant
CODE_BITS = 3  # motion is stated per frame of 3 bits, for all compared depths
CODE_PLANES = 2**CODE_BITS - 1
LOOKS = 4  # instants over which the motion of a clip is averaged


def looks(frames: int) -> list[int]:
    """Return the clip frames whose mean motion is that of a clip of so many frames."""
    return sorted({int(t) for t in np.linspace(0, frames - 1, min(LOOKS, frames)).round()})


def moving_pixels(length: Array, frames: int = 1) -> Array:
    """Return which pixels move more than `MOVING` in `frames` clip frames; those of unknown motion do not.

    `length` is that of the flow [px per clip frame], of any shape, NaN where unknown.
    """
    return np.isfinite(length) & (length * frames > MOVING)


def moving_mean(length: Array, frames: int = 1) -> float | None:
    """Return the mean motion [px in `frames` clip frames] of the `moving_pixels`; None if there are none."""
    moving = length[moving_pixels(length, frames)] * frames
    return float(moving.mean()) if moving.size else None

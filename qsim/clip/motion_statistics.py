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


def moving_mean(length: Array, frames: int = 1) -> float | None:
    """Return the mean motion [px] of pixels that move more than `MOVING` in `frames` clip frames; None if none does.

    `length` is that of the flow [px per clip frame], of any shape, NaN where unknown.
    """
    extent = length[np.isfinite(length)] * frames
    moving = extent[extent > MOVING]
    return float(moving.mean()) if moving.size else None

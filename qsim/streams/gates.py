"""Exposure schedules: every code of a stream collects light in its share of a full exposure, in turn.

    shares (1, 0.25)  ->  code t is exposed for shares[t mod 2] of its time, around its middle

A sensor sees share * light and share * dark counts, and the dead time of a short exposure. Where a code takes several
clip frames (slices), a gate takes those in its time, the outer two in part: short exposures blur motion less. Planes
that are summed have a gate each. Light levels and truth are those of a full exposure, so all codes share one scale.
"""

from __future__ import annotations

import numpy as np
from numpy import ndarray as Array


def words(shares: tuple[float, ...]) -> str:
    """Return a schedule in words: `exposures of 1, 0.25 of a code's time in turn`."""
    return f"exposures of {', '.join(f'{share:g}' for share in shares)} of a code's time in turn"


def share_of(shares: tuple[float, ...], t: int) -> float:
    """Return the share of code t."""
    return shares[t % len(shares)]


def weights(share: float, slices: int) -> Array:
    """Return how much of each of `slices` equal parts of a full exposure lies in a gate around its middle, [slices]."""
    return np.diff(np.clip(np.arange(slices + 1.0), slices * (1 - share) / 2, slices * (1 + share) / 2))

"""Passes smooth curves through values at given times: cubic Hermite curves with slopes from their neighbours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy import ndarray as Array


def interval(times: Sequence[float], t: float) -> tuple[int, float, float]:
    """Return the number of the interval of time t, the fraction 0..1 of it, and its length; others are clipped."""
    i = int(np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2))
    length = times[i + 1] - times[i]
    return i, float(np.clip((t - times[i]) / length, 0.0, 1.0)), length


def slopes(times: Sequence[float], values: Array) -> Array:
    """Return the slope at every time, [times, N]: the chord of its neighbours, one-sided at the ends."""
    along: Array = np.gradient(np.asarray(values, dtype=np.float64), axis=0, edge_order=1)
    return along / np.gradient(np.asarray(times, dtype=np.float64))[:, None]


def value_at(times: Sequence[float], values: Array, t: float) -> Array:
    """Return the values [N] at time t of curves through `values` [times, N]; they rest outside of the times."""
    i, s, length = interval(times, t)
    p = values
    m = slopes(times, values) * length
    # The cubic Hermite basis h00, h10, h01, h11 at the fraction s of the interval.
    value: Array = (
        (2 * s**3 - 3 * s**2 + 1) * p[i]
        + (s**3 - 2 * s**2 + s) * m[i]
        + (3 * s**2 - 2 * s**3) * p[i + 1]
        + (s**3 - s**2) * m[i + 1]
    )
    return value

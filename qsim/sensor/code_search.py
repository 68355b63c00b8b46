"""Finds the code of a uniform number among the steps F_k = P(code <= k), which are computed one by one.

A sensor's steps are rising functions of k. `search` goes from a guess on, so that a good one costs about three steps a
pixel, however many codes there are; `decide` also tells how near a number came to a step.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy import ndarray as Array


def decide(cdf: Callable[[Array, Array], Array], top: int, u: Array, mean: Array, guess: Array) -> tuple[Array, Array]:
    """Return the smallest codes k with u < F_k (`top` at most) and the distance of u to the nearest step.

    Both are [p], of uniform numbers, Poisson means and guesses [p].
    """
    near = np.full(len(u), np.inf)

    def passed(k: Array, left: Array) -> Array:
        distance = u[left] - cdf(k, mean[left])
        near[left] = np.minimum(near[left], np.abs(distance))
        return distance >= 0

    return search(passed, top, guess), near


def search(passed: Callable[[Array, Array], Array], top: int, guess: Array) -> Array:
    """Return the smallest codes [p] whose step is not passed, `top` at most.

    `passed`: codes [n] of the pixels int [n] -> bool [n]. The search goes from the guess on in growing strides, then by
    bisection; only undecided pixels are evaluated again.
    """
    # The step of `low` is passed, that of `high` is not; the code is found where they are neighbours
    low = np.full(len(guess), -1)
    high = np.full(len(guess), top)
    probe = np.clip(guess, 0, max(top - 1, 0)).astype(np.intp)
    left = np.flatnonzero(high - low > 1)
    stride = 1
    while left.size:
        k = probe[left]
        up = passed(k, left)
        low[left] = np.where(up, k, low[left])
        high[left] = np.where(up, high[left], k)
        below = low[left]
        above = high[left]
        probe[left] = np.where(
            up, np.minimum(k + stride, (below + above + 1) // 2), np.maximum(k - stride, (below + above) // 2)
        )
        left = left[above - below > 1]
        stride = 2 * stride
    return high

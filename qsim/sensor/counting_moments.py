"""Computes mean and variance of counters with dead time from the counts near the mean, or by renewal theory.

Without clipping a non-paralyzable counter is a renewal process: the transforms of E[N] and E[N (N + 1)] / 2 over the
exposure are lambda / (s D) and lambda (lambda + s) / (s D^2), D = s + lambda (1 - exp(-s tau)). The pole at s = 0 gives
both moments. The others fade with the exposure, unless the counts are so regular that few are possible. Those, and
counts that the top code clips, are summed one by one.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy import ndarray as Array

SIGMAS = 8.6  # beyond them, 1e-17 of a law is left out
LONGER = 16.0  # counts by which the upper tail of a dim law is longer
FADED = -37.0  # exponent of the poles that are left out
Tail = Callable[[Array, Array, Array], Array]
_PAIRS = 1 << 20  # of counts and levels of light at a time


def renewal(mean: Array, share: float) -> tuple[Array, Array]:
    """Return mean and variance of the count from the pole at 0: expected arrivals [p] -> [p] each.

    `share` is dead time / exposure. With D = s d (1 - b s + c s^2 - ...), d = 1 + lambda tau, the mean is lambda / d
    (1 + b); in the variance all terms that cancel are left out.
    """
    fill = mean * share
    d = 1 + fill
    first = mean / d * (1 + fill * share / (2 * d))
    # The residue at s = 0 to the second order in tau / T, collected so that equal terms of E[N^2] and E[N]^2 are gone.
    rest = fill * (4 - d) / (2 * d**2) + 5 * fill**3 / (4 * d**3) - 2 * fill**2 / (3 * d**2)
    return first, mean / d * (1 / d**2 + share * rest)


def faded(mean: Array, share: float) -> Array:
    """Return where the other poles, tau s = W_k(x exp(x)) - x with x = lambda tau, are negligible: bool [p]."""
    from scipy.special import lambertw

    if share == 0:
        return np.ones(len(mean), bool)
    fill = mean * share
    result = np.zeros(len(mean), bool)
    some = (fill > 0) & (fill < 300)  # beyond, counts are regular
    x = fill[some]
    # The slowest pole decides: its real part over the exposure is the exponent with which it fades.
    result[some] = (lambertw(x * np.exp(x), 1).real - x) / share + np.log1p(mean[some]) < FADED
    return result


def moments(mean: Array, share: float, top: int, tail: Tail) -> tuple[Array, Array]:
    """Return mean and variance of the count, clipped at `top`: expected arrivals [p] -> [p] each.

    `tail` returns P(N <= k) where `below`, else P(N > k): codes int [n], expected arrivals [n], below bool [n] -> [n].
    """
    first, second = renewal(mean, share)
    reach = SIGMAS * np.sqrt(np.maximum(second, 0)) + LONGER
    free = faded(mean, share) & (first + reach < top)
    if not free.all():
        some = ~free
        first[some], second[some] = summed(mean[some], first[some], reach[some], top, tail)
    return first, second


def summed(mean: Array, around: Array, reach: Array, top: int, tail: Tail) -> tuple[Array, Array]:
    """Return mean and variance from the tails of the counts within `reach` of `around`: [p] each.

    Small probabilities are summed on either side of the code in the middle.
    """
    anchor = np.clip(np.rint(around), 0, top).astype(np.int64)
    low = np.clip(np.floor(around - reach), 0, top).astype(np.int64)
    high = np.clip(np.ceil(around + reach), 0, top).astype(np.int64)
    first = np.empty(len(mean))
    second = np.empty(len(mean))
    order = np.argsort(high - low)
    start = 0
    while start < len(order):
        stop = start + 1
        while stop < len(order) and (stop + 1 - start) * (high - low)[order[stop]] <= _PAIRS:
            stop += 1
        some = order[start:stop]
        steps = np.arange(int((high - low)[some].max(initial=0)))
        codes = low[some, None] + steps
        inside = codes < high[some, None]
        below = codes < anchor[some, None]
        passed = np.zeros(codes.shape)
        light = np.broadcast_to(mean[some, None], codes.shape)
        passed[inside] = tail(codes[inside], light[inside], below[inside])
        # E (N - c) = sum of P(N > k) over k >= c - sum of P(N <= k) over k
        # < c; E (N - c)^2 weights them by |2 (k - c) + 1|.
        away = 2 * (codes - anchor[some, None]) + 1
        shift = np.where(below, -passed, passed).sum(axis=1)
        first[some] = anchor[some] + shift
        second[some] = (np.abs(away) * passed).sum(axis=1) - shift**2
        start = stop
    return first, np.maximum(second, 0.0)

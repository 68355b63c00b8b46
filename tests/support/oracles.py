"""Distributions by the textbook in arbitrary precision: what the sensors' laws are compared with."""

from __future__ import annotations

import mpmath as mp


def paralyzable_oracle(arrivals, share: float, most: int | None = None) -> list:
    """P(N = k) by the textbook: binomial moments B_j = E[C(N, j)] summed with alternating signs; see deadtime.py.

    The last moment may be `most` where so many counts hardly ever occur.
    """
    arrivals = mp.mpf(arrivals)
    a = mp.mpf(share)
    rate = arrivals * mp.e ** (-arrivals * a)
    most = most or int(mp.floor(1 / a)) + 1
    moments = [mp.mpf(1)]
    for j in range(1, most + 1):
        c = 1 - (j - 1) * a
        end = min(a, max(c, mp.mpf(0)))
        fade = mp.e ** (-arrivals * end)
        first = 1 - fade  # the first count comes within one dead time, and j - 1 follow
        for r in range(1, j):
            first = (c**r - fade * (c - end) ** r) / mp.factorial(r) - first / arrivals
        moments.append(rate ** (j - 1) * (first + rate * (c - end) ** j / mp.factorial(j)) if c > 0 else mp.mpf(0))
    return [
        mp.fsum((-1) ** (j - k) * mp.binomial(j, k) * moments[j] for j in range(k, most + 1)) for k in range(most + 1)
    ]

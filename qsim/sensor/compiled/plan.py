"""How a compiled kernel has the steps F_0 ... F_(top-1) of a sensor: as short sums, or as curves that it looks up.

A pixel's code is the number of steps F_k that its uniform number u has passed. With lambda expected arrivals:

    QIS            F_k = sum_n D[n, k] Pois(n; lambda)      D is 1 for few electrons, 0 for many, and in between only
                                                            where read noise blurs the threshold: a narrow band
    CountingSPAD   F_k = sum_(n <= k) Pois(n; lambda s_k)   s_k: share of the exposure that is live after k counts
    BinarySPAD     F_0 = exp(-lambda) in each of M planes   a code is the number of planes that fired

Where the sums are long, or there are none (paralyzable pixels), steps are curves over light: curves.py.

The Poisson weights are carried as (lambda / scale)^n with coefficients scale^n / n!, so that one multiplication and
one addition per term suffice. Short sums are compared as u exp(lambda) >= sum; longer ones have half of the exponential
on either side, u exp(lambda / 2) >= exp(-lambda / 2) sum. A weight that underflows is then below 1e-10 of the unit, at
any light: with one exponential of a fixed shift in all weights, dark pixels of long sums lost terms that count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import ceil, e, lgamma, log, log2, sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.sensor import paralyzable_steps
from qsim.sensor.compiled.curves import Curves, below, falling
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS, electron_table, table_length, thresholds
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD

_MOST_BITS = 8  # a code is a byte
_LIVE_BITS = 4  # of counters whose steps are added up
_MAX_WORK = 260  # terms of all sums of one kernel together; looking up curves is quicker than more
_TERMS = 75  # electrons up to which float32 has the range, halved: exp(165 / 2)
_LONGEST_TABLE = 2048  # electrons in a table that is looked through for short sums
_PARALYSED = 45.0  # arrivals per dead time, at least one of which then comes in each: the code is 1 to 1e-16
_BRIGHT = 1000.0  # arrivals up to which those of many dead times have curves
_EXPONENT = 85.0  # exp of more overflows
_NEGLIGIBLE = 1e-12  # a coefficient that small moves no step by more than float64's rounding of the reference


@dataclass(frozen=True)
class Electrons:
    """Sums over electrons: q_0 ... q_(n-1), and for each step how many come in full and which are weighted."""

    highest: float  # arrivals beyond which every step without a floor is 0; more light changes nothing
    halved: bool  # half of exp(highest) is what the float has room for
    scale: float
    full: Array  # [n] coefficient of a whole term, scale^n / n!
    prefix: tuple[int, ...]  # per step: terms 0 ... prefix - 1 in full
    band: tuple[Array, ...]  # per step: coefficients of terms prefix, prefix + 1, ...
    floor: Array  # per step: what every number of electrons contributes (full well), else 0


@dataclass(frozen=True)
class Live:
    """Sums over counts: step k has k + 1 terms and the live share s_k; steps without live time are never passed."""

    levels: int
    shares: tuple[float, ...]  # above 0


@dataclass(frozen=True, eq=False)  # compared as objects: `plan` makes each once
class Plan:
    """How a kernel draws the codes of one sensor at one exposure."""

    efficiency: float  # arrivals per photon, of one plane
    dark: float  # arrivals without light, of one plane
    planes: int  # summed into one code; 1 unless BinarySPAD
    steps: Electrons | Live | Curves  # of one plane
    margin: float  # nearer than this to a step, float arithmetic does not decide


@lru_cache(maxsize=32)
def plan(sensor: Sensor, exposure: float) -> Plan | None:
    """The plan of a sensor; None where no kernel serves and the reference has to draw."""
    efficiency, dark = sensor.efficiency, sensor.dark_rate * exposure
    if sensor.bits > _MOST_BITS:
        return None
    if isinstance(sensor, BinarySPAD):
        m = sensor.planes
        return Plan(efficiency / m, dark / m, m, Live(2, (1.0,)), _margin(1))
    if isinstance(sensor, CountingSPAD) and sensor.dead_time_law(exposure) is None and sensor.bits <= _LIVE_BITS:
        shares = 1 - np.arange(sensor.levels - 1) * (sensor.dead_time / exposure)
        live = tuple(float(s) for s in shares[shares > 0])
        return Plan(efficiency, dark, 1, Live(sensor.levels, live), _margin(len(live)))
    if isinstance(sensor, QIS) and (short := electrons(sensor)) is not None:
        return Plan(efficiency, dark, 1, short, _margin(len(short.full)))
    found = _curves(sensor, exposure)
    return None if found is None else Plan(efficiency, dark, 1, found, found.margin)


def _curves(sensor: Sensor, exposure: float) -> Curves | None:
    """Curves of a sensor whose steps can be computed one by one, or whose table is short at usual light."""
    count = sensor.levels - 1
    codes = np.arange(count)[:, None]

    def pairs(step: Callable[[Array, Array], Array]) -> Callable[[Array], Array]:
        return lambda mean: step(np.broadcast_to(codes, mean.shape).ravel(), mean.ravel()).reshape(mean.shape)

    if isinstance(sensor, QIS):
        steps = thresholds(sensor)
        return None if steps is None else falling(pairs(steps.cdf), pairs(steps.slope), count)
    if isinstance(sensor, CountingSPAD):
        paralyzable = sensor.dead_time_law(exposure)
        if paralyzable is None:
            cdf, slope = sensor.steps(exposure)
            return falling(pairs(cdf), pairs(slope), count)
        ratio = paralyzable.ratio
        if paralyzable.by_steps:
            return below(
                lambda mean: paralyzable_steps.steps(ratio, count, mean[0])[0],
                lambda mean: paralyzable_steps.steps(ratio, count, mean[0])[1],
                count,
                _BRIGHT,
            )
        return below(
            lambda mean: paralyzable.cdf(mean[0])[:, :-1].T,
            lambda mean: paralyzable.slope(mean[0])[:, :-1].T,
            count,
            _PARALYSED * max(ratio, 1.0),
            settled=True,
        )
    return None


def _margin(terms: int) -> float:
    """Several times the largest float32 error of a step: rounding of u, exp and lambda, and of each term."""
    return 4e-7 + 1.2e-7 * terms


def electrons(sensor: QIS) -> Electrons | None:
    """The sums of a QIS of at most 8 bits, or None if they are too long."""
    if table_length(sensor) > _LONGEST_TABLE:
        return None
    table = electron_table(sensor, 0, sensor.levels)
    floor = np.where(table.tail_cdf[:-1] > _NEGLIGIBLE, table.tail_cdf[:-1], 0.0)
    weights = np.concatenate([np.ones((table.first, sensor.levels - 1)), table.cdf[:, :-1]]) - floor
    terms = np.flatnonzero((weights > _NEGLIGIBLE).any(axis=1))[-1:] + 1
    if not terms.size:
        return None
    n = int(terms[0])
    if n > _TERMS:
        return None
    weights = weights[:n]
    prefix = [int(np.argmin(np.append(column > 1 - _NEGLIGIBLE, False))) for column in weights.T]
    ends = [int(np.flatnonzero(np.append(True, column > _NEGLIGIBLE))[-1]) for column in weights.T]
    if 2 * n + sum(max(end - start, 0) for start, end in zip(prefix, ends, strict=True)) > _MAX_WORK:
        return None
    # Above lambda = highest even the last step is certain to be passed
    highest = n + 7 * sqrt(n) + 30
    scale = 2.0 ** max(0, ceil(log2(max(n / e, 1))))
    numbers = np.arange(n)
    full = np.exp(numbers * log(scale) - np.array([lgamma(m + 1) for m in numbers]))
    band = [weights[a:b, k] * full[a:b] for k, (a, b) in enumerate(zip(prefix, ends, strict=True))]
    return Electrons(highest, highest > _EXPONENT, scale, full, tuple(prefix), tuple(band), floor)

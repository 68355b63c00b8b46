"""Plans how a compiled kernel evaluates the cdf steps F_0 ... F_(top-1) of a sensor: short sums, or curves.

A pixel's code is the number of steps F_k that its uniform number u has passed. With lambda expected arrivals:

    QIS            F_k = sum_n D[n, k] Pois(n; lambda)      D is 1 for few electrons, 0 for many, and in between only
                                                            where read noise blurs the threshold: a narrow band
    CountingSPAD   F_k = sum_(n <= k) Pois(n; lambda s_k)   s_k: share of the exposure that is live after k counts
    BinarySPAD     F_0 = exp(-lambda) in each of M planes   a code is the number of planes that fired

Where the sums are long, or there are none (paralyzable pixels), steps are curves over light: curves.py. Each model
states its plan by `Sensor.kernel_plan`.

The Poisson weights are carried as (lambda / scale)^n with coefficients scale^n / n!, so that one multiplication and
one addition per term suffice. Short sums are compared as u exp(lambda) >= sum. Longer ones have half of the exponential
on either side, u exp(lambda / 2) >= exp(-lambda / 2) sum. A weight that underflows is then below 1e-10 of the unit, at
any light. With one exponential of a fixed shift in all weights, dark pixels of long sums lost terms that count.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, e, lgamma, log, log2, sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.sensor.compiled.curves import Curves

MOST_BITS = 8  # of a code that a kernel draws: a byte
_MAX_WORK = 260  # terms of all sums of one kernel; beyond it, curves are quicker
_TERMS = 75  # electrons up to which the range of float32 suffices, halved: exp(165 / 2)
_EXPONENT = 85.0  # exp of more overflows
_NEGLIGIBLE = 1e-12  # a smaller coefficient moves a step by less than the reference's rounding


@dataclass(frozen=True)
class Electrons:
    """Sums over electrons: q_0 ... q_(n-1), and for each step how many come in full and which are weighted."""

    highest: float  # arrivals beyond which every step without a floor is 0; more light changes nothing
    halved: bool  # exp(highest) overflows, so both sides carry half of the exponent
    scale: float
    full: Array  # [n] coefficient of a full term, scale^n / n!
    prefix: tuple[int, ...]  # per step: terms 0 ... prefix - 1 in full
    band: tuple[Array, ...]  # per step: coefficients of terms prefix, prefix + 1, ...
    floor: Array  # per step: what every number of electrons contributes (full well), else 0

    @classmethod
    def of(cls, cdf: Array, tail: Array) -> Electrons | None:
        """Return the sums of P(code <= k | n electrons), cdf [n, K] and its value `tail` [K] for more electrons.

        None if the sums are too long.
        """
        floor = np.where(tail > _NEGLIGIBLE, tail, 0.0)
        weights = cdf - floor
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
        return cls(highest, highest > _EXPONENT, scale, full, tuple(prefix), tuple(band), floor)


@dataclass(frozen=True)
class Live:
    """Sums over counts: step k has k + 1 terms and the live share s_k; steps without live time are never passed."""

    levels: int
    shares: tuple[float, ...]  # above 0


@dataclass(frozen=True, eq=False)  # compared as objects: `sensor.plan_of` makes each once
class Plan:
    """How a kernel draws the codes of one sensor at one exposure."""

    efficiency: float  # arrivals per photon, of one plane
    dark: float  # arrivals without light, of one plane
    planes: int  # summed into one code; 1 unless BinarySPAD
    steps: Electrons | Live | Curves  # of one plane
    margin: float  # distance to a step below which float32 does not decide

    @classmethod
    def summed(cls, efficiency: float, dark: float, steps: Electrons | Live, planes: int = 1) -> Plan:
        """Return a plan whose steps are added up; `efficiency` and `dark` are those of one plane.

        The margin is several times the largest float32 error of a step: rounding of u, exp and lambda, and of each
        term.
        """
        terms = len(steps.full) if isinstance(steps, Electrons) else len(steps.shares)
        return cls(efficiency, dark, planes, steps, 4e-7 + 1.2e-7 * terms)

    @classmethod
    def looked_up(cls, efficiency: float, dark: float, steps: Curves | None) -> Plan | None:
        """Return a plan whose steps are looked up; None without curves."""
        return None if steps is None else cls(efficiency, dark, 1, steps, steps.margin)

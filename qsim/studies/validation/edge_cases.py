"""Checks the sensor models at extreme light, at ties, in tails and at exact fractions of the dead time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from qsim.sensor.counting import CountingSPAD
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor


@dataclass(frozen=True)
class Case:
    """A hard case, its result, and whether that is right."""

    name: str
    found: str
    ok: bool


def hard_cases(sensors: dict[str, Sensor], exposure: float) -> list[Case]:
    """Check light from 0 to 1e12 photons, ties, tails, exact fractions of dead time, all-dark and all-full counts."""
    cases = []
    light = np.array([0.0, 1e-12, 1e-6, 1.0, 1e3, 1e6, 1e12])
    for name, sensor in sensors.items():
        cdf = sensor.cdf(light, exposure)
        log_pmf = sensor.log_pmf(light, exposure)
        total = np.exp(log_pmf).sum(axis=-1)
        good = (
            bool(np.isfinite(cdf).all() and (np.diff(cdf, axis=-1) >= -1e-12).all())
            and bool((cdf >= 0).all() and (cdf[:, -1] == 1).all())
            and float(np.abs(total - 1).max()) < 1e-9
            and not bool(np.isnan(log_pmf).any())
        )
        cases.append(
            Case(f"{name}: light 0 ... 1e12", f"sum of probabilities 1 +- {np.abs(total - 1).max():.1g}", good)
        )
    for name, sensor in sensors.items():
        if np.isneginf(sensor.log_pmf(np.array(sensor.white(exposure)), exposure)[-1]):
            continue  # the dead time is so long that the counter never fills
        dark, bright = np.eye(sensor.levels)[[0, -1]] * 1000
        low = sensor.maximum_likelihood(dark[None], exposure)
        high = sensor.maximum_likelihood(bright[None], exposure)
        bounds = [float(low.photons[0]), float(low.upper[0]), float(high.photons[0]), float(high.lower[0])]
        good = bool(np.isfinite(bounds).all()) and bounds[0] <= bounds[1] < bounds[3] <= bounds[2]
        cases.append(
            Case(f"{name}: all dark, all full", f"at most {bounds[1]:.3g}, at least {bounds[3]:.3g} photons", good)
        )
    cases += [_tail_case(exposure), _tie_case(), *_dead_time_cases(exposure)]
    return cases


def _tail_case(exposure: float) -> Case:
    """Check P(code 7) at 0.01 photons, which is 4.8e-18; a difference of cdf values would give 0."""
    tail = float(QIS(0.8, 1.6, 0.2, 3).log_pmf(np.array(0.01), exposure)[7])
    plain = float(np.log(_tail_sum(exposure)))
    return Case("QIS: P(code 7) at 0.01 photons", f"{np.exp(tail):.3g}", abs(tail - plain) < 1e-8)


def _tail_sum(exposure: float) -> float:
    from scipy import stats

    n = np.arange(30)
    return float(stats.poisson.pmf(n, 0.8 * 0.01 + 1.6 * exposure) @ stats.norm.sf((6.5 - n) / 0.2))


def _tie_case() -> Case:
    """Check ties at gain 1/2 without read noise: 1 electron is code 0 (half to even), 3 electrons are code 2."""
    sensor = QIS(1.0, 0.0, 0.0, 3, gain=0.5)
    codes = [int(c) for c in sensor.codes_of(np.arange(6.0))]
    return Case("QIS: ties of rounding, electrons 0 ... 5", str(codes), codes == [0, 0, 1, 2, 2, 2])


def _dead_time_cases(exposure: float) -> list[Case]:
    """Check dead time T / n at endless light: n counts fit; n + 1 have probability 0."""
    cases = []
    for n in (1, 2, 4):
        pmf = np.exp(CountingSPAD(1.0, 0.0, exposure / n, 3).log_pmf(np.array(1e9), exposure))
        cases.append(
            Case(f"counting SPAD: tau = T/{n}, endless light", f"{pmf.argmax()} counts", bool(pmf[n] > 1 - 1e-6))
        )
    return cases

"""Errors of a sensor's law against probabilities of arbitrary precision."""

from __future__ import annotations

import mpmath as mp
import numpy as np

EXPOSURE = 1.0  # s; dead times of tests are shares of it
LIMITS = np.array([1e-10, 1e-8, 1e-8])  # of the cdf, of log P, relative of the slope


def errors(sensor, photons: float, pmf: list, slope: list) -> np.ndarray:
    """Error of the cdf, of log P where P > 1e-280, relative error of the slope above 1e-280; codes clip at the top."""
    top = sensor.levels - 1
    pmf = [*pmf, *[mp.mpf(0)] * sensor.levels]
    pmf = [*pmf[:top], mp.fsum(pmf[top:])]
    cdf, log_pmf, dcdf = (f(photons, EXPOSURE) for f in (sensor.cdf, sensor.log_pmf, sensor.dcdf))
    worst = np.zeros(3)
    total = mp.mpf(0)
    for k in range(sensor.levels):
        total += pmf[k]
        worst[0] = max(worst[0], abs(float(cdf[k] - total)))
        if pmf[k] > 1e-280:
            worst[1] = max(worst[1], abs(float(log_pmf[k] - mp.log(pmf[k]))))
        if k < min(top, len(slope)) and abs(slope[k]) > 1e-280:
            worst[2] = max(worst[2], abs(float(dcdf[k] / slope[k] - 1)))
    return worst

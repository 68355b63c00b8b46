"""Calibrates a QIS: dark and flat frames -> its parameters, each with a 95 % interval.

    stacks (frame_statistics.py) --histogram_fit.py: maximum likelihood with the sensor's exact cdf--> QIS
                                 --photon_transfer.py: mean and variance against light-----------> a second estimate

The reported PRNU comes from prnu.py, without hot pixels and without a gradient of the light.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, isfinite, sqrt

import numpy as np

from qsim.calibration.flat_fields import qis_flats
from qsim.calibration.frame_statistics import FrameStatistics, check_noise, check_stacks
from qsim.calibration.histogram_fit import HistogramFit, best_fit, goodness, sensor_at
from qsim.calibration.photon_transfer import photon_transfer, spread_of_means
from qsim.calibration.prnu import measure_pattern
from qsim.calibration.results import Calibration, Value, log_interval, normal_interval, odd_efficiency, root_interval

HIDDEN_PEAKS = 0.5  # e-; above this read noise the histogram has no separate electron peaks


def calibrate_qis(darks: Sequence[FrameStatistics], flats: Sequence[FrameStatistics], *, bits: int) -> Calibration:
    """Estimate gain, offset, read noise, dark current, PRNU and, if the flats' photons are known, QE of a QIS.

    Values named `..._transfer` come from means and variances, the others from the histograms. `ValueError` if there is
    no dark or no flat stack, or if a stack is constant or its frames are all alike.
    """
    check_stacks(darks, flats, bits)
    if bits < 2:
        raise ValueError(
            "calibrate: 1 bit per code cannot tell gain, offset and read noise apart; calibrate binary planes with "
            "--model spad (calibrate_spad)"
        )
    if not darks or not flats:
        missing = "dark" if not darks else "flat"
        raise ValueError(f"calibrate: no {missing} frames; at least one dark and one flat stack are needed")
    for i, stack in enumerate((*darks, *flats)):
        if np.count_nonzero(stack.histogram) < 2:
            where = f"dark {i}" if i < len(darks) else f"flat {i - len(darks)}"
            code = int(np.argmax(stack.histogram))
            raise ValueError(
                f"calibrate: every code of {where} is {code}; calibration needs codes that vary: change the light or "
                "the exposure"
            )
    check_noise(darks, flats)
    warnings = _advice(darks, flats)
    transfer = photon_transfer(darks, flats)
    if not (isfinite(transfer.gain) and transfer.gain > 1e-8):
        raise ValueError(
            "calibrate: the variance of the flats does not grow with their mean; are they saturated or equal?"
        )
    dark_mean = min(stack.mean for stack in darks)
    s = sqrt(max(spread_of_means(flats, dark_mean), 0.0))
    fit = best_fit(darks, flats, bits, transfer, s)
    gain, read_noise = exp(fit.parameters[0]), exp(fit.parameters[2])
    spread = np.diag(fit.covariance)
    method = "photon-counting histogram"
    values = {
        "gain": log_interval(gain, spread[0], "codes/e-", method),
        "offset": normal_interval(float(fit.parameters[1]), spread[1], "codes", method),
        "read_noise": log_interval(read_noise, spread[2], "e-", method),
        "dark_current": normal_interval(float(fit.parameters[3]), spread[3], "e-/s", method, floor=0.0),
        "gain_transfer": normal_interval(transfer.gain, transfer.gain_variance, "codes/e-", "mean-variance", floor=0.0),
        "read_noise_transfer": root_interval(
            transfer.read_variance, transfer.read_variance_variance, "e-", "mean-variance"
        ),
    }
    levels, hot = qis_flats(flats, darks, sensor_at(fit.parameters, bits))
    pattern = measure_pattern(levels, hot)
    if pattern is not None:
        values |= pattern.values()
    if len({stack.exposure for stack in darks}) > 1:
        values["dark_current_transfer"] = normal_interval(
            transfer.dark_current, transfer.dark_current_variance, "e-/s", "dark mean over exposure", floor=0.0
        )
    values |= _efficiency(flats, fit)
    if read_noise > HIDDEN_PEAKS:
        warnings.append(
            f"read noise {read_noise:.2f} e- hides the electron peaks: gain and read noise rest on the variance alone"
        )
    p_value, residuals = goodness([*darks, *flats], fit.fitted, fit.parameters.size)
    if p_value < 1e-3:
        warnings.append(f"the fitted histograms do not describe the data (p = {p_value:.1g}): the model is wrong here")
    if "quantum_efficiency" in values:
        warnings += odd_efficiency(values["quantum_efficiency"])
    return Calibration("QIS", bits, values, p_value, tuple(warnings), residuals)


def _efficiency(flats: Sequence[FrameStatistics], fit: HistogramFit) -> dict[str, Value]:
    """Return the electrons per photon, if a light standard gave the photons of the flats."""
    known = [i for i, flat in enumerate(flats) if flat.photons]
    if not known:
        return {}
    photons = np.array([flats[i].photons for i in known], float)
    rows = [4 + i for i in known]
    covariance = fit.covariance[np.ix_(rows, rows)] / np.outer(photons, photons)
    weights = np.linalg.solve(covariance, np.ones(len(known)))
    weights /= weights.sum()
    value = float(weights @ (fit.parameters[rows] / photons))
    variance = float(weights @ covariance @ weights)
    return {"quantum_efficiency": normal_interval(value, variance, "e-/photon", "light standard", floor=0.0)}


def _advice(darks: Sequence[FrameStatistics], flats: Sequence[FrameStatistics]) -> list[str]:
    """Return warnings about parameters that these data determine badly."""
    words = []
    if any(stack.frames < 2 for stack in (*darks, *flats)):
        raise ValueError(
            "calibrate: a stack of one frame cannot tell noise from the fixed pattern; take at least 2 frames"
        )
    if len({stack.exposure for stack in darks}) < 2:
        words.append("all darks have one exposure: dark current and offset are told apart by the histogram only")
    for i, flat in enumerate(flats):
        if flat.saturated > 1e-3:
            words.append(
                f"flat {i}: {flat.saturated:.1%} of the codes are saturated: the histogram allows for it, "
                "mean-variance does not"
            )
    return words

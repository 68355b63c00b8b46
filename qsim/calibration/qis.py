"""Dark and flat frames -> the parameters of a sensor, each with a 95 % interval.

    stacks (stacks.py) --photon-counting histogram: maximum likelihood with the sensor's exact cdf--> QIS
                       --mean and variance against light-------------------------------------------> a second opinion
                       --counts, Fano factor, neighbouring frames----------------------------------> calibrate_spad.py

Model of a flat field of one light level: pixel p expects lambda (1 + s x_p) electrons, x_p normal with variance 1 (the
PRNU s), plus dark electrons D t. All frames of a pixel share x_p, so codes of one pixel are not independent: the
covariance of the fit is the sandwich I^-1 J I^-1, whose J holds that term (White, Econometrica 50, 1982).
Left out of the fit: a spread of the dark current, of the offset and of the read noise between pixels; lag between
frames. The PRNU that is reported comes from calibrate_pattern.py: without hot pixels, without a gradient of the light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, inf, isfinite, log, sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.flat_fields import qis_flats
from qsim.calibration.frame_statistics import Stack
from qsim.calibration.prnu import measure_pattern
from qsim.calibration.results import Calibration, Value, log_interval, normal_interval, odd_efficiency, root_interval
from qsim.sensor.qis import QIS

HIDDEN_PEAKS = 0.5  # e-: above this read noise the histogram has no separate electron peaks


# Mean and variance (photon transfer)


@dataclass(frozen=True)
class Transfer:
    """Gain, read noise, dark current and offset from means and variances, and the variance of gain and read noise^2."""

    gain: float  # codes/e-
    offset: float  # codes
    dark_current: float  # e-/s
    read_variance: float  # e-^2; may be below 0 by noise
    gain_variance: float
    dark_current_variance: float
    read_variance_variance: float


def photon_transfer(darks: Sequence[Stack], flats: Sequence[Stack]) -> Transfer:
    """Weighted straight line of variance over mean: slope = gain, height at the darkest stack = read noise + ADC noise.

    Mean and variance of one stack are correlated through the third moment: the residual v - g m of a stack has the
    variance (mu4 - v^2 + g^2 v - 2 g mu3) / n. Means count from the darkest stack, whose own mean therefore enters all
    the others, while its residual is that of v alone: generalised least squares with these covariances. The ADC adds
    1/12 codes^2 (Janesick, Photon Transfer, SPIE 2007).
    """
    base = min(darks, key=lambda stack: stack.exposure)
    stacks = [base, *[s for s in darks if s is not base], *flats]
    mean = np.array([s.mean - base.mean for s in stacks])
    variance = np.array([s.variance for s in stacks])
    n = np.array([s.pixels * max(s.frames - 1, 1) for s in stacks], float)
    third = np.array([s.central_moment(3) for s in stacks])
    fourth = np.array([s.central_moment(4) for s in stacks])
    design = np.stack([np.ones_like(mean), mean], axis=1)
    gain = max(float((variance[-1] - variance[0]) / (mean[-1] or 1.0)), 1e-6)
    for _ in range(4):
        spread = np.diag(np.maximum(fourth - variance**2 + gain**2 * variance - 2 * gain * third, 1e-12) / n)
        spread[1:, 1:] += gain**2 * variance[0] / n[0]
        spread[0, 0] = max(fourth[0] - variance[0] ** 2, 1e-12) / n[0]
        spread[0, 1:] = spread[1:, 0] = gain * third[0] / n[0]
        weighted = np.linalg.solve(spread, design)
        covariance = np.linalg.inv(design.T @ weighted)
        height, slope = covariance @ (weighted.T @ variance)
        gain = max(float(slope), 1e-9)
    # The dark mean grows with exposure: offset + gain D t. Its noise is also in the residuals that gave the gain
    dark_slope, dark_offset, slope_variance, levers = _dark_line(stacks[: len(darks)])
    dark_current = dark_slope / gain
    shared = np.diag((third - gain * variance) / n)
    shared[1:, 0] = gain * variance[0] / n[0]
    shared[0, 0] = third[0] / n[0]
    slope_with_gain = float((covariance @ weighted.T)[1] @ shared[:, : len(darks)] @ levers)
    adc = 1 / 12
    dark_electrons = dark_current * base.exposure
    read_variance = (height - adc) / gain**2 - dark_electrons
    gradient = np.array([1 / gain**2, -2 * (height - adc) / gain**3])
    return Transfer(
        gain,
        dark_offset,
        dark_current,
        float(read_variance),
        float(covariance[1, 1]),
        (slope_variance + dark_current**2 * float(covariance[1, 1]) - 2 * dark_current * slope_with_gain) / gain**2,
        float(gradient @ covariance @ gradient) + base.exposure**2 * slope_variance / gain**2,
    )


def _dark_line(darks: Sequence[Stack]) -> tuple[float, float, float, Array]:
    """Dark mean over exposure: slope [codes/s], offset [codes], variance of the slope, weights of the means in it."""
    time = np.array([s.exposure for s in darks])
    mean = np.array([s.mean for s in darks])
    spread = np.array([s.central_moment(2) / (s.pixels * s.frames) for s in darks]) + 1e-18
    if len(set(time)) < 2:
        return 0.0, float(np.average(mean, weights=1 / spread)), 0.0, np.zeros_like(time)
    weight = 1 / spread
    centre = np.average(time, weights=weight)
    lever = float(np.sum(weight * (time - centre) ** 2))
    levers = weight * (time - centre) / lever
    slope = float(levers @ mean)
    return slope, float(np.average(mean, weights=weight) - slope * centre), 1 / lever, levers


def spread_of_means(flats: Sequence[Stack], dark_mean: float) -> float:
    """Relative variance between **all** pixels' means, shading and hot pixels included: what widens the histograms."""
    best = (0.0, inf)
    for flat in flats:
        signal = flat.mean - dark_mean
        if flat.frames < 2 or flat.pixels < 3 or signal <= 0:
            continue
        between = float((flat.total / flat.frames).var(ddof=1))
        if between / signal**2 < best[1]:
            best = ((between - flat.variance / flat.frames) / signal**2, between / signal**2)
    return best[0]


# The photon-counting histogram


NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(5)
WEIGHTS = WEIGHTS / WEIGHTS.sum()


LONGEST_STEP = np.array([0.3, 5.0, 1.5])  # of ln gain, offset and ln read noise in one iteration


@dataclass(frozen=True, eq=False)
class _Fit:
    """Parameters (ln gain, offset, ln read noise, dark current, light of every flat [e-]) and what is known of them."""

    parameters: Array
    information: Array  # [m, m], of the pooled histograms
    covariance: Array  # [m, m], with the pixels' common factor
    log_likelihood: float
    fitted: tuple[Array, ...]  # per stack, probabilities [levels]


def fit_histograms(darks: Sequence[Stack], flats: Sequence[Stack], bits: int, start: Array, prnu_value: float) -> _Fit:
    """Maximum likelihood of the pooled histograms of all stacks by Fisher scoring with step control."""
    stacks = [*darks, *flats]
    parameters = start.copy()
    shares, jacobians, overdispersion = _model(stacks, len(darks), bits, parameters, prnu_value)
    best = _log_likelihood(stacks, shares)
    for _ in range(60):
        information, score = _information(stacks, shares, jacobians)
        free = ~((parameters <= _lower_bounds(parameters.size)) & (score <= 0))
        step = np.zeros_like(parameters)
        step[free] = np.linalg.lstsq(information[np.ix_(free, free)], score[free], rcond=1e-12)[0]
        scale, gained = 1.0, 0.0
        while scale > 1e-4:
            move = scale * step
            move[:3] = np.clip(move[:3], -LONGEST_STEP, LONGEST_STEP)
            trial = np.maximum(parameters + move, _lower_bounds(parameters.size))
            new = _model(stacks, len(darks), bits, trial, prnu_value)
            value = _log_likelihood(stacks, new[0])
            if value >= best:
                gained, best, parameters = value - best, value, trial
                shares, jacobians, overdispersion = new
                break
            scale /= 4
        if scale <= 1e-4 or gained < 1e-7:
            break
    information, _ = _information(stacks, shares, jacobians)
    inverse = np.linalg.pinv(information, rcond=1e-13, hermitian=True)
    meat = information.copy()
    for stack, jacobian, extra in zip(stacks, jacobians, overdispersion, strict=True):
        push = jacobian @ extra  # how the common factor of a pixel moves the score
        meat += stack.pixels * stack.frames * (stack.frames - 1) * np.outer(push, push)
    return _Fit(parameters, information, inverse @ meat @ inverse, best, tuple(shares))


def _lower_bounds(size: int) -> Array:
    """ln gain and offset are free, read noise stays above 0.01 e-, dark current and light do not fall below 0."""
    return np.array([-inf, -inf, log(0.01), *[0.0] * (size - 3)])


def _sensor(parameters: Array, bits: int) -> QIS:
    return QIS(1.0, 0.0, exp(parameters[2]), bits, gain=exp(parameters[0]), offset=float(parameters[1]))


def _arrivals(stacks: Sequence[Stack], darks: int, parameters: Array, s: float) -> tuple[Array, Array, Array]:
    """Expected electrons at the nodes of the PRNU [stack, node], the nodes' weights, and what light adds per unit."""
    dark = np.array([parameters[3] * stack.exposure for stack in stacks])
    light = np.concatenate([np.zeros(darks), parameters[4:]])
    nodes, weights = (NODES, WEIGHTS) if s > 0 else (np.zeros(1), np.ones(1))
    return np.maximum(dark[:, None] + light[:, None] * (1 + s * nodes), 0.0), weights, 1 + s * nodes


def _mix(table: Array, weights: Array) -> Array:
    """[stack, node, levels] -> [stack, levels]."""
    return np.tensordot(table, weights, axes=([1], [0]))


def _shares(stacks: Sequence[Stack], darks: int, bits: int, parameters: Array, s: float) -> Array:
    """P(code) of every stack, [stack, levels]."""
    arrivals, weights, _ = _arrivals(stacks, darks, parameters, s)
    return _mix(np.exp(_sensor(parameters, bits).log_pmf(arrivals, 1.0)), weights)


def _model(
    stacks: Sequence[Stack], darks: int, bits: int, parameters: Array, s: float
) -> tuple[Array, list[Array], list[Array]]:
    """Per stack: P(code) [levels], d log P / d parameters [m, levels], and s lambda dP/dlambda [levels]."""
    shares = _shares(stacks, darks, bits, parameters, s)
    arrivals, weights, factors = _arrivals(stacks, darks, parameters, s)
    derivatives = np.zeros((parameters.size, *shares.shape))
    for i in range(3):  # gain, offset, read noise: central differences of the exact probabilities
        small = np.zeros_like(parameters)
        small[i] = 1e-5
        more, less = (_shares(stacks, darks, bits, parameters + sign * small, s) for sign in (1, -1))
        derivatives[i] = (more - less) / 2e-5
    slope = np.diff(_sensor(parameters, bits).dcdf(arrivals, 1.0), axis=-1, prepend=0.0)
    by_dark, by_light = _mix(slope, weights), _mix(slope, weights * factors)
    derivatives[3] = by_dark * np.array([[stack.exposure] for stack in stacks])
    for i in range(len(stacks) - darks):
        derivatives[4 + i, darks + i] = by_light[darks + i]
    jacobians = np.moveaxis(derivatives, 1, 0) / np.maximum(shares, 1e-300)[:, None, :]
    light = np.concatenate([np.zeros(darks), parameters[4:]])
    return shares, list(jacobians), list(s * light[:, None] * by_dark)


def _log_likelihood(stacks: Sequence[Stack], shares: Sequence[Array] | Array) -> float:
    return sum(
        float(np.sum(np.where(s.histogram > 0, s.histogram * np.log(np.maximum(p, 1e-300)), 0.0)))
        for s, p in zip(stacks, shares, strict=True)
    )


def _information(
    stacks: Sequence[Stack], shares: Sequence[Array] | Array, jacobians: Sequence[Array]
) -> tuple[Array, Array]:
    """Fisher information of the pooled histograms [m, m] and the score [m]."""
    size = jacobians[0].shape[0]
    information, score = np.zeros((size, size)), np.zeros(size)
    for stack, p, jacobian in zip(stacks, shares, jacobians, strict=True):
        n = stack.histogram.sum()
        information += n * (jacobian * p) @ jacobian.T
        score += jacobian @ (stack.histogram - n * p)
    return information, score


def goodness(stacks: Sequence[Stack], shares: Sequence[Array], fitted: int) -> tuple[float, tuple[Array, ...]]:
    """Chi-square p-value of histograms against fitted shares, bins expected below 5 pooled, and residuals per level.

    The common factor of a pixel moves the codes like a change of light, which is fitted, so the test keeps its level.
    """
    from scipy.stats import chi2

    total, freedom, residuals = 0.0, -fitted, []
    for stack, share in zip(stacks, shares, strict=True):
        expected = share * stack.histogram.sum()
        residuals.append((stack.histogram - expected) / np.sqrt(np.maximum(expected, 1.0)))
        observed_bins, expected_bins = _pooled(stack.histogram, expected)
        total += float(np.sum((observed_bins - expected_bins) ** 2 / expected_bins))
        freedom += len(expected_bins) - 1
    return (float(chi2.sf(total, freedom)) if freedom > 0 else float("nan")), tuple(residuals)


def _pooled(observed: Array, expected: Array, least: float = 5.0) -> tuple[Array, Array]:
    """Neighbouring bins joined until each expects at least `least`."""
    group = np.minimum(np.floor(np.cumsum(expected) / least), max(np.floor(expected.sum() / least) - 1, 0)).astype(int)
    _, group = np.unique(group, return_inverse=True)
    return np.bincount(group, observed), np.bincount(group, expected)


def calibrate_qis(darks: Sequence[Stack], flats: Sequence[Stack], *, bits: int) -> Calibration:
    """Gain, offset, read noise, dark current, PRNU and, where the flats' photons are known, QE of a QIS.

    Values named `..._transfer` come from means and variances, the others from the histograms. `ValueError` if there is
    no dark or no flat stack, or if nothing varies.
    """
    check_stacks(darks, flats)
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
            raise ValueError(f"calibrate: every code of {where} is {code}: nothing varies, nothing can be told")
    warnings = _advice(darks, flats)
    transfer = photon_transfer(darks, flats)
    if not (isfinite(transfer.gain) and transfer.gain > 1e-8):
        raise ValueError(
            "calibrate: the variance of the flats does not grow with their mean; are they saturated or equal?"
        )
    dark_mean = min(stack.mean for stack in darks)
    s = sqrt(max(spread_of_means(flats, dark_mean), 0.0))
    fit = _best_fit(darks, flats, bits, transfer, s)
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
    levels, hot = qis_flats(flats, darks, _sensor(fit.parameters, bits))
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


def _best_fit(darks: Sequence[Stack], flats: Sequence[Stack], bits: int, transfer: Transfer, s: float) -> _Fit:
    """The fit from the likeliest of a few starts: with resolved peaks a gain off by one peak is a local maximum."""
    reach = min(3 * sqrt(transfer.gain_variance) / transfer.gain, 0.3)
    read = sqrt(max(transfer.read_variance, 0.05**2))
    stacks = [*darks, *flats]
    starts = []
    for shift in np.linspace(-reach, reach, 9):
        gain = transfer.gain * (1 + shift)
        dark = max(transfer.dark_current, 1e-9)
        lights = [max((flat.mean - transfer.offset) / gain - dark * flat.exposure, 1e-3) for flat in flats]
        starts.append(np.array([log(gain), transfer.offset, log(read), dark, *lights]))
    likelihoods = [_log_likelihood(stacks, _shares(stacks, len(darks), bits, start, s)) for start in starts]
    return fit_histograms(darks, flats, bits, starts[int(np.argmax(likelihoods))], s)


def _efficiency(flats: Sequence[Stack], fit: _Fit) -> dict[str, Value]:
    """Electrons per photon, where a light standard gave the photons of the flats."""
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


def check_stacks(darks: Sequence[Stack], flats: Sequence[Stack]) -> None:
    """`ValueError` unless there are stacks, all of one size."""
    if not darks and not flats:
        raise ValueError("calibrate: no frames at all; give dark and flat frames")
    shapes = {stack.total.shape for stack in (*darks, *flats)}
    if len(shapes) > 1:
        raise ValueError(f"calibrate: stacks of different sizes {sorted(shapes)}; use the same part of the sensor")


def _advice(darks: Sequence[Stack], flats: Sequence[Stack]) -> list[str]:
    """What these data cannot tell."""
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

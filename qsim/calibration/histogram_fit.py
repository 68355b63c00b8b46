"""Fits the photon-counting histograms of a QIS by maximum likelihood, and tests the fit by chi-square.

Model of a flat field at one light level: pixel p expects lambda (1 + s x_p) electrons and D t dark electrons, where
x_p is normal with variance 1 and s is the PRNU. All frames of a pixel share x_p, so its codes are not independent. The
covariance of the fit is therefore the sandwich I^-1 J I^-1, whose J holds that term (White, Econometrica 50, 1982).
Left out of the fit: a spread of the dark current, of the offset and of the read noise between pixels; lag between
frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, inf, log, sqrt

import numpy as np
from numpy import ndarray as Array

from qsim.calibration.frame_statistics import FrameStatistics
from qsim.calibration.photon_transfer import Transfer
from qsim.calibration.prnu import normal_nodes
from qsim.sensor.qis import QIS

NODES, WEIGHTS = normal_nodes(5)  # of the PRNU
LONGEST_STEP = np.array([0.3, 5.0, 1.5])  # in one iteration, of ln gain, offset [codes] and ln read noise


@dataclass(frozen=True, eq=False)
class HistogramFit:
    """Fitted parameters [m], their covariance, and the fitted histograms.

    Parameters: ln gain [codes/e-], offset [codes], ln read noise [e-], dark current [e-/s], light of every flat [e-].
    """

    parameters: Array  # [m]
    information: Array  # [m, m], of the pooled histograms
    covariance: Array  # [m, m], with the pixels' common factor
    log_likelihood: float
    fitted: tuple[Array, ...]  # per stack, probabilities [levels]


def fit_histograms(
    darks: Sequence[FrameStatistics], flats: Sequence[FrameStatistics], bits: int, start: Array, prnu_value: float
) -> HistogramFit:
    """Maximise the likelihood of the pooled histograms of all stacks, by Fisher scoring with step control.

    `start` [m] holds the first parameters, `prnu_value` is s of the model.
    """
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
        push = jacobian @ extra  # derivative of the score by the common factor of a pixel
        meat += stack.pixels * stack.frames * (stack.frames - 1) * np.outer(push, push)
    return HistogramFit(parameters, information, inverse @ meat @ inverse, best, tuple(shares))


def _lower_bounds(size: int) -> Array:
    """Return the lower bounds: none for ln gain and offset, 0.01 e- of read noise, 0 for dark current and light."""
    return np.array([-inf, -inf, log(0.01), *[0.0] * (size - 3)])


def sensor_at(parameters: Array, bits: int) -> QIS:
    """Return the QIS with these parameters [m], without light and dark current."""
    return QIS(1.0, 0.0, exp(parameters[2]), bits, gain=exp(parameters[0]), offset=float(parameters[1]))


def _arrivals(stacks: Sequence[FrameStatistics], darks: int, parameters: Array, s: float) -> tuple[Array, Array, Array]:
    """Return expected electrons at the nodes of the PRNU [stack, node], the weights and the factors of the light."""
    dark = np.array([parameters[3] * stack.exposure for stack in stacks])
    light = np.concatenate([np.zeros(darks), parameters[4:]])
    nodes, weights = (NODES, WEIGHTS) if s > 0 else (np.zeros(1), np.ones(1))
    return np.maximum(dark[:, None] + light[:, None] * (1 + s * nodes), 0.0), weights, 1 + s * nodes


def _mix(table: Array, weights: Array) -> Array:
    """Return the weighted mean over nodes: [stack, node, levels] -> [stack, levels]."""
    return np.tensordot(table, weights, axes=([1], [0]))


def _shares(stacks: Sequence[FrameStatistics], darks: int, bits: int, parameters: Array, s: float) -> Array:
    """Return P(code) of every stack, [stack, levels]."""
    arrivals, weights, _ = _arrivals(stacks, darks, parameters, s)
    return _mix(np.exp(sensor_at(parameters, bits).log_pmf(arrivals, 1.0)), weights)


def _model(
    stacks: Sequence[FrameStatistics], darks: int, bits: int, parameters: Array, s: float
) -> tuple[Array, list[Array], list[Array]]:
    """Return per stack: P(code) [levels], d log P / d parameters [m, levels], and s lambda dP/dlambda [levels]."""
    shares = _shares(stacks, darks, bits, parameters, s)
    arrivals, weights, factors = _arrivals(stacks, darks, parameters, s)
    derivatives = np.zeros((parameters.size, *shares.shape))
    for i in range(3):  # gain, offset, read noise: central differences of the exact probabilities
        small = np.zeros_like(parameters)
        small[i] = 1e-5
        more, less = (_shares(stacks, darks, bits, parameters + sign * small, s) for sign in (1, -1))
        derivatives[i] = (more - less) / 2e-5
    slope = np.diff(sensor_at(parameters, bits).dcdf(arrivals, 1.0), axis=-1, prepend=0.0)
    by_dark, by_light = _mix(slope, weights), _mix(slope, weights * factors)
    derivatives[3] = by_dark * np.array([[stack.exposure] for stack in stacks])
    for i in range(len(stacks) - darks):
        derivatives[4 + i, darks + i] = by_light[darks + i]
    jacobians = np.moveaxis(derivatives, 1, 0) / np.maximum(shares, 1e-300)[:, None, :]
    light = np.concatenate([np.zeros(darks), parameters[4:]])
    return shares, list(jacobians), list(s * light[:, None] * by_dark)


def _log_likelihood(stacks: Sequence[FrameStatistics], shares: Sequence[Array] | Array) -> float:
    """Return the log-likelihood of the histograms of all stacks, given P(code)."""
    return sum(
        float(np.sum(np.where(s.histogram > 0, s.histogram * np.log(np.maximum(p, 1e-300)), 0.0)))
        for s, p in zip(stacks, shares, strict=True)
    )


def _information(
    stacks: Sequence[FrameStatistics], shares: Sequence[Array] | Array, jacobians: Sequence[Array]
) -> tuple[Array, Array]:
    """Return the Fisher information of the pooled histograms [m, m] and the score [m]."""
    size = jacobians[0].shape[0]
    information, score = np.zeros((size, size)), np.zeros(size)
    for stack, p, jacobian in zip(stacks, shares, jacobians, strict=True):
        n = stack.histogram.sum()
        information += n * (jacobian * p) @ jacobian.T
        score += jacobian @ (stack.histogram - n * p)
    return information, score


def goodness(
    stacks: Sequence[FrameStatistics], shares: Sequence[Array], fitted: int
) -> tuple[float, tuple[Array, ...]]:
    """Return the chi-square p-value of histograms against fitted shares, and residuals per level in sigmas.

    Bins with an expectation below 5 are pooled. The common factor of a pixel acts on the codes like a change of light,
    which is fitted; the test therefore keeps its level.
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
    """Join neighbouring bins until each expects at least `least`; return observed and expected counts."""
    last = max(observed.sum() // least - 1, 0)  # whole counts: rounding of the expected sum must not join two bins
    group = np.minimum(np.floor(np.cumsum(expected) / least), last).astype(int)
    _, group = np.unique(group, return_inverse=True)
    return np.bincount(group, observed), np.bincount(group, expected)


def best_fit(
    darks: Sequence[FrameStatistics], flats: Sequence[FrameStatistics], bits: int, transfer: Transfer, s: float
) -> HistogramFit:
    """Fit from the likeliest of a few starts: with resolved peaks, a gain off by one peak is a local maximum."""
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

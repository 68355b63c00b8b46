"""The only maker of statistical tolerances: every limit comes from n, sigma and a false-alarm rate.

A correct program exceeds a limit with the stated probability, shared by `checks` independent checks (Sidak).
"""

from __future__ import annotations

from math import expm1, log, log1p, sqrt
from statistics import NormalDist

import numpy as np
from scipy import stats as _scipy_stats

FALSE_ALARM = 1e-6  # of one assertion, unless it says otherwise


def per_check(false_alarm: float, checks: int) -> float:
    """The rate for one of `checks` independent checks that together alarm with `false_alarm` (Sidak)."""
    return -expm1(log1p(-false_alarm) / checks)


def critical_z(false_alarm: float = FALSE_ALARM, checks: int = 1) -> float:
    """|z| which a correct program exceeds in any of `checks` independent checks with this probability."""
    return NormalDist().inv_cdf(1 - per_check(false_alarm, checks) / 2)


def assert_mean(
    sample: np.ndarray, mean: float, variance: float, *, false_alarm: float = FALSE_ALARM, checks: int = 1
) -> None:
    """The sample mean is compatible with a known mean and a known variance of one draw."""
    sigma = sqrt(variance / sample.size)
    found = float(np.mean(sample, dtype=np.float64))
    limit = critical_z(false_alarm, checks)
    if sigma > 0:
        z = (found - mean) / sigma
    else:
        z = 0.0 if found == mean else np.inf
    assert abs(z) < limit, f"mean {found:.8g}, expected {mean:.8g} +- {sigma:.2g}: z = {z:.1f}, limit {limit:.1f}"


def assert_variance(
    sample: np.ndarray,
    variance: float,
    fourth_moment: float,
    *,
    false_alarm: float = FALSE_ALARM,
    checks: int = 1,
) -> None:
    """The sample variance is compatible with a known variance; var(s^2) = (mu4 - var^2 (n-3)/(n-1)) / n."""
    n = sample.size
    found = float(np.var(sample, ddof=1, dtype=np.float64))
    sigma = sqrt((fourth_moment - variance**2 * (n - 3) / (n - 1)) / n)
    z = (found - variance) / sigma
    limit = critical_z(false_alarm, checks)
    assert abs(z) < limit, (
        f"variance {found:.8g}, expected {variance:.8g} +- {sigma:.2g}: z = {z:.1f}, limit {limit:.1f}"
    )


def assert_same_rms(
    first: np.ndarray, second: np.ndarray, *, false_alarm: float = FALSE_ALARM, checks: int = 1
) -> None:
    """Two samples of independent errors have one rms; var(mean square) = (mu4 - mu2^2) / n, from the samples."""
    squares = [np.square(sample, dtype=np.float64).ravel() for sample in (first, second)]
    means = [float(square.mean()) for square in squares]
    assert min(means) > 0, "a sample without errors has no rms to compare"
    sigma = sqrt(sum(float(s.var()) / s.size / m**2 for s, m in zip(squares, means, strict=True))) / 2
    z = log(means[0] / means[1]) / 2 / sigma
    limit = critical_z(false_alarm, checks)
    found = f"rms {sqrt(means[0]):.4g} and {sqrt(means[1]):.4g}, their ratio known to {sigma:.2g}"
    assert abs(z) < limit, f"{found}: z = {z:.1f}, limit {limit:.1f}"


def assert_share(hits: int, n: int, share: float, *, false_alarm: float = FALSE_ALARM, checks: int = 1) -> None:
    """`hits` of `n` independent trials are compatible with the probability `share` (exact binomial test)."""
    p = _scipy_stats.binomtest(hits, n, share).pvalue
    assert p > per_check(false_alarm, checks), f"{hits} of {n} = {hits / n:.6g}, expected {share:.6g}: p = {p:.2g}"


def histogram_p_value(codes: np.ndarray, pmf: np.ndarray, fitted: int = 0) -> float:
    """Chi-square p-value of codes 0 ... K-1 against `pmf`; neighbouring bins expected below 5 are pooled.

    A code that cannot occur but does has the p-value 0: pooling must not hide it.
    """
    counts = np.bincount(np.ravel(codes), minlength=pmf.size).astype(float)
    if counts.size > pmf.size or counts[pmf == 0].any():
        return 0.0
    expected = pmf * codes.size
    observed_bins = []
    expected_bins = []
    o = 0.0
    e = 0.0
    for c, x in zip(counts, expected, strict=True):
        o = o + c
        e = e + x
        if e >= 5:
            observed_bins.append(o)
            expected_bins.append(e)
            o = e = 0.0
    if not expected_bins:
        raise ValueError(f"{codes.size} codes are too few for a chi-square test: no bin expects 5")
    observed_bins[-1] += o
    expected_bins[-1] += e
    if len(expected_bins) == 1:
        return 1.0 if abs(observed_bins[0] - expected_bins[0]) < 1e-6 * codes.size else 0.0
    chi2 = sum((a - b) ** 2 / b for a, b in zip(observed_bins, expected_bins, strict=True))
    return float(_scipy_stats.chi2.sf(chi2, len(expected_bins) - 1 - fitted))


def assert_histogram(
    codes: np.ndarray, pmf: np.ndarray, *, fitted: int = 0, false_alarm: float = FALSE_ALARM, checks: int = 1
) -> None:
    """Codes are compatible with a probability per code."""
    p = histogram_p_value(codes, pmf, fitted)
    assert p > per_check(false_alarm, checks), f"chi-square p = {p:.3g} is below {per_check(false_alarm, checks):.3g}"


def mixture_p_value(codes: np.ndarray, pmf: np.ndarray) -> float:
    """Chi-square of a histogram whose draws differ: code i has the probabilities pmf[i], [N] and [N, levels].

    The counts have the mean sum p and the covariance sum (diag(p) - p p'); codes expected less than five times are
    pooled with their neighbours, as for one distribution.
    """
    observed = np.bincount(codes.ravel(), minlength=pmf.shape[1]).astype(float)
    chances = pmf.reshape(-1, pmf.shape[-1])
    groups = []
    current = []
    for k, expected in enumerate(chances.sum(axis=0)):
        current.append((k, expected))
        if sum(e for _, e in current) >= 5:
            groups.append([k for k, _ in current])
            current = []
    if not groups:
        raise ValueError(f"{codes.size} codes are too few for a chi-square test: no bin expects 5")
    groups[-1] += [k for k, _ in current]
    pooled = np.stack([chances[:, g].sum(axis=1) for g in groups], axis=1)
    counts = np.array([observed[g].sum() for g in groups])
    if len(groups) == 1:
        return 1.0
    difference = (counts - pooled.sum(axis=0))[1:]  # the counts add up: one of them says nothing
    covariance = np.diag(pooled.sum(axis=0)) - pooled.T @ pooled
    chi2 = float(difference @ np.linalg.solve(covariance[1:, 1:], difference))
    return float(_scipy_stats.chi2.sf(chi2, len(groups) - 1))

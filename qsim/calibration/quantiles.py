"""Quantiles of the chi-square, Student's and binomial laws, without the slow import of scipy.stats."""

from __future__ import annotations


def chi2_quantile(share: float, freedom: float) -> float:
    """Return what a chi-square with so many degrees of freedom exceeds in 1 - `share` of all cases."""
    from scipy.special import gammaincinv

    return 2 * float(gammaincinv(freedom / 2, share))


def chi2_above(value: float, freedom: float) -> float:
    """Return the probability that a chi-square exceeds a value."""
    from scipy.special import gammaincc

    return float(gammaincc(freedom / 2, value / 2))


def student_quantile(share: float, freedom: float) -> float:
    """Return what Student's t exceeds in 1 - `share` of all cases."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, share))


def binomial_quantile(share: float, trials: int, chance: float) -> int:
    """Return the least number of successes that is not exceeded with a probability of at least `share`."""
    from scipy.special import bdtr, bdtrik

    found = max(int(-(-bdtrik(share, trials, chance) // 1)), 0)
    return found - 1 if found > 0 and bdtr(found - 1, trials, chance) >= share else found

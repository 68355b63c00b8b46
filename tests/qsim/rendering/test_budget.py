"""The record of a budget: grids, instants and blur, checked by brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest

from qsim.rendering.budget import Budget, blur_error, blur_left, grid_samples


def test_sample_counts_are_those_of_the_sampler(capfd):
    """Mitsuba prints a warning when it rounds a count that does not fit its grid."""
    for samples in range(1, 60):
        count = grid_samples(samples)
        assert samples <= count <= (math.sqrt(samples) + 2) ** 2
        assert grid_samples(count) == count
    from qsim.rendering import engine

    engine.select()
    import mitsuba as mi

    for samples in (1, 2, 3, 5, 7, 11, 13, 17, 23, 31, 32, 60, 127):
        mi.load_dict({"type": "multijitter", "sample_count": grid_samples(samples)})
    assert "rounded" not in capfd.readouterr().out


@pytest.mark.parametrize(("extent", "instants"), [(0.5, 1), (3.0, 5), (3.0, 9), (4.2, 7), (1.0, 1)])
def test_the_blur_error_bounds_the_midpoint_rule_at_an_edge(extent, instants):
    """Coverage of a pixel that an edge passes: fine integral against K instants, at many offsets."""
    offsets = np.linspace(-extent, 1 + extent, 801)
    fine = (np.arange(4000) + 0.5) / 4000
    coarse = (np.arange(instants) + 0.5) / instants

    def mean(times):
        return np.clip(offsets[:, None] + extent * (times - 0.5), 0, 1).mean(axis=1)

    worst = np.abs(mean(fine) - mean(coarse)).max()
    # Two kinks of the coverage may fall into the exposure: at most twice the error of one.
    assert worst <= 2 * blur_error(extent, instants) + 1e-6
    assert worst >= 0.3 * blur_error(extent, instants)


def area_below(x: np.ndarray) -> np.ndarray:
    """Integral of clip(x, 0, 1) from 0."""
    inside = np.clip(x, 0, 1)
    return inside**2 / 2 + np.maximum(x - 1, 0)


@pytest.mark.parametrize(("count", "edges"), [(9, 0.5), (9, 6.0), (33, 0.5), (33, 20.0), (3, 0.3)])
def test_every_third_instant_gives_the_error_of_all(count, edges):
    """An edge passes pixels at random places by `edges` px a step; the reference is the exact integral.

    The estimate is within a factor of three of the error, or of `blur_error` if steps are below a pixel and those of
    the thirds above.
    """
    places = np.random.default_rng(3).uniform(-0.5, 0.5, 40000)

    def mean(times):
        return np.mean([np.clip((t - places) * edges * count + 0.5, 0, 1) for t in times], axis=0)

    times = (np.arange(count) + 0.5) / count - 0.5
    means = np.array([mean(times), mean(times[1::3]), mean(times[count // 2 : count // 2 + 1])])
    length = edges * count  # px in the exposure; the integral of clip(x, 0, 1) is x^2 / 2 up to 1, then x - 1 / 2
    upper, lower = ((end - places) * length + 0.5 for end in (0.5, -0.5))
    exact = (area_below(upper) - area_below(lower)) / length
    real = np.sqrt(np.mean((means[0] - exact) ** 2))
    assert (
        real / 3 < blur_left(np.stack([means, means], axis=1), count) < 3 * max(real, blur_error(edges * count, count))
    )


def test_a_budget_without_samples_is_refused():
    with pytest.raises(ValueError, match=r"Budget.samples: at least 1, got 0"):
        Budget(samples=0)


def test_samples_are_shared_among_halves_and_instants():
    assert Budget(samples=72).grid(1) == 36
    assert Budget(samples=72).grid(9) == 4
    assert Budget(samples=1).grid(5) == 2


def test_a_quality_of_the_denoiser_that_does_not_exist_is_refused():
    with pytest.raises(ValueError, match=r"Budget\.quality: high, balanced, fast, optix; got 'best'"):
        Budget(quality="best")

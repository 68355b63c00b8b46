"""The rules that compare results of machines: what is within is passed, what is beyond is seen."""

import numpy as np
import pytest
from machines import (
    FIT,
    P_VALUE_ERROR,
    ErrorsOfLight,
    Fits,
    Rendered,
    Sums,
    difference,
    eps,
    rounding,
    standard_errors,
    walk,
)

LIGHT = np.linspace(0.5, 1.5, 1000)
STEP = np.eye(1, LIGHT.size)[0]  # of the first pixel


@pytest.mark.parametrize(("of", "size"), [("mean", 1.0), ("each", 0.5), (8.0, 8.0)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_sums_may_differ_by_n_eps_of_their_size(of, size, dtype):
    limit = 5 * eps(dtype) * size
    assert difference(Sums(LIGHT + 0.5 * limit * STEP, 5, dtype, of), LIGHT) is None
    assert "1 of 1000 differ, by up to" in (difference(Sums(LIGHT + 2 * limit * STEP, 5, dtype, of), LIGHT) or "")


def test_sums_in_another_order_are_within_the_rule():
    """In any order, n eps holds for every sum, and the random walk for a thousand of them; both can fail."""
    terms = np.random.default_rng(0).uniform(0, 1, (1000, 200)).astype(np.float32)
    forth = np.add.accumulate(terms, axis=1)[:, -1].astype(float)
    back = np.add.accumulate(terms[:, ::-1], axis=1)[:, -1].astype(float)
    apart = np.abs(forth / back - 1)
    assert 0 < apart.max() < rounding(200, np.float32)
    assert apart.max() < walk(200, np.float32)
    assert apart.max() > walk(2, np.float32)


def test_fits_may_differ_by_a_thousandth_of_their_own_standard_error():
    values = np.array([1.0, 2.0, 3.0])
    low = np.array([0.9, 1.8, -np.inf])
    high = np.array([1.1, np.inf, np.inf])
    errors = standard_errors(values, low, high)
    np.testing.assert_allclose(errors, [0.2 / 3.919928, 0.4 / 3.919928, 0.0], rtol=1e-6)
    for factor, same in ((0.5, True), (2.0, False)):
        moved = Fits(values + factor * FIT * errors, errors)
        assert (difference(moved, values, errors) is None) is same
        # The stored standard errors count, not those of the run: a fit that lost its interval must not pass.
        assert (difference(Fits(moved.values, 100 * errors), values, errors) is None) is same
    assert difference(Fits(values + np.array([0, 0, 1e-12]), errors), values, errors) is not None
    assert 0.28 < P_VALUE_ERROR < 0.29


def test_light_may_differ_in_few_pixels_by_one_sample():
    light = Rendered(LIGHT, 72, 2)
    few = light.few(LIGHT.size)
    assert 2 <= few <= 10
    half = eps(np.float16)
    for pixels, size, same in (
        (few, half / 3, True),
        (few + 1, half / 3, False),
        (1, 1.4 / 72, True),
        (1, 0.05, False),
    ):
        moved = LIGHT + size * (np.arange(LIGHT.size) < pixels)
        assert (difference(Rendered(moved, 72, 2), LIGHT) is None) is same
    assert Rendered(LIGHT, 72, 2, denoise=True).few(LIGHT.size) > few
    errors = np.array([0.01, 30.0])
    assert difference(ErrorsOfLight(errors * 1.0001, light), errors) is None
    assert difference(ErrorsOfLight(errors * 1.02, light), errors) is not None


def test_other_shapes_and_other_infinities_are_seen():
    assert "shape" in (difference(Sums(LIGHT[1:], 5), LIGHT) or "")
    values = np.array([1.0, np.inf, np.nan])
    assert difference(Sums(values, 5), values) is None
    for wrong in ([1.0, 2.0, np.nan], [1.0, np.inf, 3.0], [np.nan, np.inf, np.nan], [1.0, -np.inf, np.nan]):
        assert difference(Sums(np.array(wrong), 5), values) is not None

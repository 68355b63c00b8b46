"""Tests distortion against its polynomial and its inverse, over random lenses, and the light behind a lens."""

from __future__ import annotations

import math

import numpy as np
import pytest

from qsim.optics.lens import Lens


def random_lens(rng: np.random.Generator) -> Lens:
    """Return a lens of any distortion, weak to extreme, of either sign."""
    k1, k2 = (float(rng.choice([-1, 1]) * 10 ** rng.uniform(-4, 1)) for _ in range(2))
    return Lens(k1, k2 / 10 * float(rng.choice([0, 1])))


def widest(lens: Lens) -> float:
    """Return the largest slope seen, at most 3, of a picture that does not fold."""
    return min(3.0, 0.99999 * float(lens.seen(np.array([min(lens.fold, 10.0), 0.0]))[0]))


def slopes_within(rng: np.random.Generator, radius: float, count: int = 99) -> np.ndarray:
    """Return random slopes [count, 2], the first at the middle, the last at `radius`."""
    lengths = np.array([0.0, *rng.uniform(0, radius, count - 2), radius])
    angles = rng.uniform(0, 2 * np.pi, count)
    return lengths[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])


def test_the_ray_of_a_slope_is_seen_there_again():
    rng = np.random.default_rng(1)
    worst = 0.0
    for _ in range(300):
        lens = random_lens(rng)
        slopes = slopes_within(rng, widest(lens))
        worst = max(worst, float(np.abs(lens.seen(lens.traced(slopes)) - slopes).max()))
    assert worst < 1e-12


def test_slopes_are_seen_by_the_polynomial_of_brown_and_conrady():
    rng = np.random.default_rng(2)
    for _ in range(50):
        lens = random_lens(rng)
        x, y = slopes_within(rng, min(0.999 * lens.fold, 3.0)).T
        r2 = x**2 + y**2
        factor = 1 + lens.k1 * r2 + lens.k2 * r2**2
        np.testing.assert_allclose(lens.seen(np.stack([x, y], -1)), np.stack([x * factor, y * factor], -1), rtol=1e-12)


def test_steep_rays_are_not_seen_inside_again():
    """Beyond the slope where the polynomial falls, it would bring rays from far outside back into the picture."""
    lens = Lens(k1=-0.3)
    edge = lens.fold * (1 - 0.3 * lens.fold**2)
    far = lens.seen(np.array([[2 * lens.fold, 0.0], [0.0, -50.0]]))
    np.testing.assert_allclose(np.linalg.norm(far, axis=-1), edge)
    assert abs(2 * lens.fold * (1 - 0.3 * (2 * lens.fold) ** 2)) < 2.5 * edge  # the polynomial alone comes back
    assert math.isinf(Lens(k1=0.2).fold)


def test_the_light_of_a_pixel_is_that_of_its_solid_angle():
    """The cosine times the solid angle that a pixel sees, from differences of rays, over that on the axis."""
    rng = np.random.default_rng(3)
    step = 1e-5
    for _ in range(30):
        lens = random_lens(rng)
        at = slopes_within(rng, 0.9 * min(widest(lens), 1.5), 20)[1:]
        shifts = np.array([[step, 0], [-step, 0], [0, step], [0, -step]])
        right, left, down, up = lens.traced(at[None] + shifts[:, None])
        along, across = (right - left) / (2 * step), (down - up) / (2 * step)
        area = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
        cosine = 1 / np.sqrt(1 + np.sum(lens.traced(at) ** 2, axis=-1))
        np.testing.assert_allclose(lens.illumination(at, natural=True), cosine**4 * area, rtol=2e-5)


def test_falloff_is_a_polynomial_in_the_slope_of_the_ray():
    lens = Lens(0.1, 0.0, (-0.5, 0.2))
    seen = lens.seen(np.array([[0.3, 0.4]]))
    expected = 1 - 0.5 * 0.25 + 0.2 * 0.0625
    assert float(lens.illumination(seen, natural=False)[0]) == pytest.approx(expected, rel=1e-12)
    both, natural = (float(each.illumination(seen, natural=True)[0]) for each in (lens, Lens(0.1)))
    assert both == pytest.approx(natural * expected, rel=1e-12)


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        (Lens(k1=-0.5), "the picture folds at 0.5"),
        (Lens(k1=0.3, k2=-0.5), "with k1 = 0.3 and k2 = -0.5 the picture folds"),
        (Lens(k1=1e30), "are beyond any lens"),
        (Lens(k2=-101.0), "are beyond any lens"),
        (Lens(falloff=(-1.1,)), "leaves no light inside the picture"),
        (Lens(falloff=(-2.2, 1.2)), "must stay above 0"),  # falls below 0 and rises again
    ],
)
def test_a_picture_that_folds_or_turns_dark_is_refused(lens, message):
    lens.check(1e-16)
    with pytest.raises(ValueError, match=message):
        lens.check(1.0)


def test_numbers_of_a_lens_are_finite():
    for wrong in ({"k1": math.nan}, {"falloff": (math.inf,)}, {"shift": (0.0,)}, {"k2": "1"}):
        with pytest.raises(ValueError, match="finite numbers are expected"):
            Lens(**wrong)

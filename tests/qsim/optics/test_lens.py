"""Tests distortion against its formula and its inverse, over random lenses, and the light behind a lens."""

from __future__ import annotations

import math

import numpy as np
import pytest

from qsim.optics.lens import Lens
from qsim.scene.scene import describe


def random_lens(rng: np.random.Generator) -> Lens:
    """Return a lens of any distortion, weak to extreme, of either sign, with some of the terms."""
    k1, k2, k3, k4, p1, p2 = (float(rng.choice([-1, 1]) * 10 ** rng.uniform(-4, 1)) for _ in range(6))
    some = rng.integers(0, 2, 6).astype(float)
    terms = {"k3": k3 / 10 * some[1], "k4": k4 / 10 * some[2], "p1": p1 / 10 * some[3], "p2": p2 / 10 * some[3]}
    return Lens(k1, k2 / 10 * some[0], aspect=float(rng.uniform(0.6, 1.7)) if some[4] else 1.0, **terms)


def widest(lens: Lens) -> float:
    """Return the length of slopes seen, before the aspect, up to which `check` allows a picture, at most 3."""
    allowed = 0.0
    refused = 3.0
    for corner in (3.0, *np.repeat(np.nan, 24)):
        corner = corner if np.isfinite(corner) else (allowed + refused) / 2
        try:
            lens.check(corner)
            allowed = corner
        except ValueError:
            refused = corner
    return allowed


def slopes_within(rng: np.random.Generator, radius: float, count: int = 99) -> np.ndarray:
    """Return random slopes [count, 2], the first at the middle, the last at `radius`."""
    lengths = np.array([0.0, *rng.uniform(0, radius, count - 2), 0.99999 * radius])
    angles = rng.uniform(0, 2 * np.pi, count)
    return lengths[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])


def test_the_ray_of_a_slope_is_seen_there_again():
    rng = np.random.default_rng(1)
    worst = 0.0
    for _ in range(60):
        lens = random_lens(rng)
        slopes = slopes_within(rng, widest(lens)) * (lens.aspect, 1)
        worst = max(worst, float(np.abs(lens.seen(lens.traced(slopes)) - slopes).max()))
    assert worst < 1e-12


def projected(lens: Lens, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return slopes as `cv2.projectPoints` distorts them, term by term, with fl_x = aspect and fl_y = 1."""
    r2 = x * x + y * y
    radial = 1 + lens.k1 * r2 + lens.k2 * r2**2 + lens.k3 * r2**3 + lens.k4 * r2**4
    across = x * radial + 2 * lens.p1 * x * y + lens.p2 * (r2 + 2 * x * x)
    down = y * radial + lens.p1 * (r2 + 2 * y * y) + 2 * lens.p2 * x * y
    return np.stack([lens.aspect * across, down], axis=-1)


def test_slopes_are_seen_by_the_formula_of_brown_and_conrady():
    rng = np.random.default_rng(2)
    for _ in range(50):
        lens = random_lens(rng)
        slopes = slopes_within(rng, min(0.999 * lens.fold, 3.0))
        np.testing.assert_allclose(lens.seen(slopes), projected(lens, *slopes.T), rtol=1e-12, atol=1e-13)


def test_the_fold_is_where_the_slope_seen_stops_rising():
    """The least eigenvalue of the derivative, from differences of the formula, over the disk and a ring around it."""
    rng = np.random.default_rng(6)
    step = 1e-5
    finite = 0
    for _ in range(60):
        lens = random_lens(rng)
        reach = min(lens.fold, 3.0)
        angles = np.linspace(0, 2 * np.pi, 90)[:, None]
        radii = np.concatenate([np.linspace(0.02, 0.9999, 30) * reach, [1.02 * reach]])
        x = radii * np.cos(angles)
        y = radii * np.sin(angles)
        width = (1 / lens.aspect, 1.0)
        dx = (projected(lens, x + step, y) - projected(lens, x - step, y)) / (2 * step) * width
        dy = (projected(lens, x, y + step) - projected(lens, x, y - step)) / (2 * step) * width
        least = np.linalg.eigvalsh(np.stack([dx, dy], axis=-1))[..., 0]
        assert least[:, :-1].min() > 0.02 - 1e-5
        if lens.fold < 3.0:
            finite += 1
            assert least[:, -1].min() < 0.02
    assert finite > 20


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
        at = slopes_within(rng, 0.9 * min(widest(lens), 1.5), 20)[1:] * (lens.aspect, 1)
        shifts = np.array([[step, 0], [-step, 0], [0, step], [0, -step]])
        right, left, down, up = lens.traced(at[None] + shifts[:, None])
        along = (right - left) / (2 * step)
        across = (down - up) / (2 * step)
        area = (along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]) * lens.aspect
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
        (Lens(k4=101.0), "k4 = 101 are beyond any lens"),
        (Lens(k3=-0.2), "with k3 = -0.2 the picture folds at 0.8104"),
        (Lens(p1=0.12, p2=0.12), "with p1 = 0.12 and p2 = 0.12 the picture folds at 0.4908"),
        (Lens(falloff=(-1.1,)), "leaves no light inside the picture"),
        (Lens(falloff=(-2.2, 1.2)), "must stay above 0"),  # falls below 0 and rises again
    ],
)
def test_a_picture_that_folds_or_turns_dark_is_refused(lens, message):
    lens.check(1e-16)
    with pytest.raises(ValueError, match=message):
        lens.check(1.0)


def test_numbers_of_a_lens_are_finite():
    for wrong in ({"k1": math.nan}, {"falloff": (math.inf,)}, {"shift": (0.0,)}, {"k2": "1"}, {"p2": math.inf}):
        with pytest.raises(ValueError, match="finite numbers are expected"):
            Lens(**wrong)
    with pytest.raises(ValueError, match=r"Lens.aspect, fl_x over fl_y, must be in \[0.1, 10\], got 0"):
        Lens(aspect=0)


def test_terms_that_are_off_are_not_described():
    """Digests of data sets made before these terms existed stay as they are."""
    assert describe(Lens(0.1)).keys() == {"kind", "k1", "k2", "falloff", "shift"}
    assert describe(Lens(0.1, p1=0.2))["p1"] == 0.2

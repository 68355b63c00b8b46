"""Materials: numbers that no surface has are refused by class and field, before Mitsuba sees them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from qsim.scene import Conductor, Dielectric, NormalMap, RoughPlastic, Texture


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RoughPlastic(0.5, roughness=0.0), "RoughPlastic.roughness: a number above 0 is expected, got 0"),
        (lambda: RoughPlastic(0.5, roughness=-0.1), "RoughPlastic.roughness: a number from 0 to 1 is expected"),
        (lambda: RoughPlastic(0.5, ior=1.000277), "RoughPlastic.ior: a rough surface needs an index other than that"),
        (lambda: RoughPlastic(0.5, ior=math.inf), "RoughPlastic.ior: a finite number above 0 is expected, got inf"),
        (lambda: Conductor(roughness=math.nan), "Conductor.roughness: a number from 0 to 1 is expected, got nan"),
        (lambda: Conductor(roughness=1.1), "Conductor.roughness: a number from 0 to 1 is expected, got 1.1"),
        (lambda: Conductor(eta=-0.2), "Conductor.eta: a finite number from 0 up is expected, got -0.2"),
        (lambda: Conductor(k=(1.0, math.nan, 2.0)), r"Conductor.k: a finite number from 0 up is expected"),
        (lambda: Dielectric(ior=0.0), "Dielectric.ior: a finite number above 0 is expected, got 0.0"),
        (lambda: Dielectric(ior=1.000277, roughness=0.1), "Dielectric.ior: a rough surface needs an index"),
        (lambda: Dielectric(roughness=(0.1, 0.2, 0.3)), "Dielectric.roughness: a number from 0 to 1 is expected"),
        (lambda: NormalMap(np.full((4, 5, 3), 128, np.uint8)), "NormalMap.image: values from 0 to 1 .* by 255"),
        (lambda: NormalMap(np.full((4, 5, 3), np.nan)), "NormalMap.image: values from 0 to 1 are expected, found nan"),
        (lambda: NormalMap(np.zeros((4, 5))), r"NormalMap.image: a picture .* got shape \(4, 5\)"),
    ],
)
def test_numbers_that_no_surface_has_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_numbers_of_surfaces_are_taken():
    assert RoughPlastic(0.5, np.float32(1.0), 1.33).roughness == 1
    assert Conductor((0.2, 0.9, 1.1), (3.9, 2.4, 2.1), 0.0).roughness == 0
    assert Dielectric(1.000277).roughness == 0  # smooth
    assert RoughPlastic(0.5, ior=1.0).ior == 1
    assert NormalMap(np.full((1, 1, 3), 0.5)).repeat == (1.0, 1.0)


def test_a_scale_multiplies_all_values_of_a_texture():
    picture = np.random.default_rng(0).random((3, 4, 3)).astype(np.float32)
    np.testing.assert_array_equal(Texture(picture, scale=0.9).colours(), np.float32(0.9) * picture)
    np.testing.assert_array_equal(Texture(picture[..., 0], scale=0.5).pixels(), 0.5 * picture[..., 0])
    np.testing.assert_array_equal(Texture(picture[..., 0], scale=0.5).colours()[..., 2], 0.5 * picture[..., 0])
    with pytest.raises(ValueError, match=r"Texture\.image: nan"):
        Texture(picture, scale=np.nan).colours()

"""Tests units by worked numbers, laws and the EMVA 1288 formula."""

import dataclasses

import numpy as np
import pytest

from qsim.optics import radiometry
from qsim.optics.camera import Camera
from qsim.optics.radiometry import expected_photons, photon_energy, photons_per_lux, to_irradiance, to_photons

PAPER = Camera(
    focal_length=8e-3, f_number=2.8, pixel_pitch=1.1e-6, height=10, width=7, transmission=0.9, wavelength=555e-9
)
ON_AXIS = np.ones((1, 1))
EXPOSURE = 5e-4


def photons(camera: Camera, radiance: float = 1.0, exposure: float = EXPOSURE) -> float:
    return float(expected_photons(radiance * ON_AXIS, camera, exposure)[0, 0])


def test_photon_energy_at_555_nm():
    assert photon_energy(555e-9) == pytest.approx(3.579181725e-19, rel=1e-9)


def test_one_lux_is_the_count_worked_by_hand():
    """1 lx at 555 nm, 1.1 um, 0.5 ms: (1/683) W/m2 * 1.21e-12 m2 * 5e-4 s / 3.5792e-19 J."""
    np.testing.assert_allclose(to_photons(np.array(1 / 683), PAPER, EXPOSURE), 2.474861626, rtol=1e-9)
    assert photons_per_lux(PAPER, EXPOSURE) == pytest.approx(2.474861626, rel=1e-9)
    assert photons_per_lux(PAPER, EXPOSURE) / (EXPOSURE * 1.21) == pytest.approx(4090.680, rel=1e-6)


def test_radiance_one_through_the_lens():
    np.testing.assert_allclose(to_irradiance(np.array(1.0), PAPER), 0.0901605, rtol=1e-6)
    assert photons(PAPER) == pytest.approx(152.4010, rel=1e-6)
    assert photons(PAPER, radiance=0.02132531) == pytest.approx(3.25, rel=1e-6)


def test_a_wall_under_100_lux():
    """50 % Lambertian: 15.91549 cd/m2; f/2, T 0.9: 2.8125 lx on the faceplate, 6.960548 photons."""
    luminance = 0.5 * 100 / np.pi
    camera = dataclasses.replace(PAPER, f_number=2.0)
    assert luminance == pytest.approx(15.91549, rel=1e-6)
    assert photons(camera, radiance=luminance / 683) == pytest.approx(6.960548, rel=1e-6)


@pytest.mark.parametrize(("ppp", "lux"), [(3.25, 1.313), (9.75, 3.940), (19.5, 7.879), (26, 10.506)])
def test_lux_of_the_papers_light_levels(ppp: float, lux: float):
    assert ppp / photons_per_lux(PAPER, EXPOSURE) == pytest.approx(lux, rel=5e-4)


def test_emva_1288_hand_formula():
    """50.3412 * A [um2] * t [ms] * lambda [um] * E [uW/cm2], from the standard; its constants are not ours."""
    camera = dataclasses.replace(PAPER, pixel_pitch=5e-6, wavelength=625e-9)
    ours = float(to_photons(np.array(3.7e-2), camera, 2e-3))
    assert ours == pytest.approx(50.3412 * 25 * 2 * 0.625 * 3.7, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "ratio"),
    [
        ({"transmission": 0.45}, 0.5),
        ({"pixel_pitch": 2.2e-6}, 4.0),
        ({"fill_factor": 0.5}, 0.5),
        ({"f_number": 5.6}, 0.25),
        ({"wavelength": 277.5e-9}, 0.5),
    ],
)
def test_laws_of_lens_and_pixel(change: dict[str, float], ratio: float):
    camera = dataclasses.replace(PAPER, vignetting=False)
    assert photons(dataclasses.replace(camera, **change)) == pytest.approx(ratio * photons(camera), rel=1e-12)


def test_linear_in_radiance_and_exposure():
    assert photons(PAPER, radiance=7.0) == pytest.approx(7 * photons(PAPER), rel=1e-12)
    assert photons(PAPER, exposure=3 * EXPOSURE) == pytest.approx(3 * photons(PAPER), rel=1e-12)


def test_the_aperture_catches_what_arrives_on_the_image():
    """A Lambertian disk S at distance d sends pi L S sin^2 into the aperture; its image has the area S f^2 / d^2.

    For d >> f: power through the aperture = L S pi (f / 2N)^2 / d^2; irradiance = that / image area.
    """
    radiance = 2.0
    area = 1e-2
    distance = 1e3
    focal = 8e-3
    number = 2.8
    power = radiance * area * np.pi * (focal / (2 * number)) ** 2 / distance**2
    image = area * (focal / distance) ** 2
    camera = dataclasses.replace(PAPER, transmission=1.0, f_number=number)
    np.testing.assert_allclose(to_irradiance(np.array(radiance), camera), power / image, rtol=1e-12)


@pytest.mark.parametrize(("degrees", "share"), [(10, 0.941), (20, 0.780), (30, 0.5625)])
def test_cos4_vignetting(degrees: float, share: float):
    """One row whose last pixel's centre lies at the given angle."""
    width = 101
    focal = 50 / np.tan(np.radians(degrees)) * 1.1e-6
    camera = dataclasses.replace(PAPER, height=1, width=width, focal_length=focal)
    row = expected_photons(np.ones((1, width)), camera, EXPOSURE)[0]
    assert row[-1] / row[50] == pytest.approx(share, abs=5e-4)
    flat = expected_photons(np.ones((1, width)), dataclasses.replace(camera, vignetting=False), EXPOSURE)
    assert np.ptp(flat) == 0


def test_cosines_agree_with_the_camera():
    ours = radiometry.off_axis_cosines(10, 7, 5, 3.5, PAPER.focal_pixels)
    np.testing.assert_allclose(ours, PAPER.cosines(), rtol=1e-12)


def test_a_crop_at_its_origin_is_the_crop_of_the_photons():
    camera = dataclasses.replace(PAPER, focal_length=1e-5)  # 9 pixels: strong vignetting
    radiance = np.random.default_rng(0).random((10, 7))
    whole = expected_photons(radiance, camera, EXPOSURE)
    part = expected_photons(radiance[2:9, 1:4], camera, EXPOSURE, origin=(2, 1))
    np.testing.assert_array_equal(part, whole[2:9, 1:4])
    assert not np.allclose(expected_photons(radiance[2:9, 1:4], camera, EXPOSURE), part)


@pytest.mark.parametrize("exposure", [0.0, -1.0, float("nan")])
def test_an_impossible_exposure_is_named(exposure: float):
    with pytest.raises(ValueError, match="exposure: expected seconds above 0"):
        expected_photons(ON_AXIS, PAPER, exposure)


def test_black_has_no_factor():
    with pytest.raises(ValueError, match=r"fan_03: mean of photons is 0, no factor reaches 3\.25 PPP"):
        radiometry.ppp_factor(0.0, 3.25, "fan_03")
    with pytest.raises(ValueError, match="above 0, got -1"):
        radiometry.ppp_factor(2.0, -1)

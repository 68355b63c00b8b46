"""Tests the blur by the lens against sinusoids in closed form and against convolution with a fine Airy pattern."""

import dataclasses

import numpy as np
import pytest
from scipy import integrate, signal, special

from qsim.optics.camera import Camera
from qsim.optics.diffraction import airy_diameter, blurred, diffract, diffraction_line, mtf
from qsim.optics.lens import Lens

CAMERA = Camera(focal_length=8e-3, f_number=2.8, pixel_pitch=1.1e-6, height=10, width=7, wavelength=550e-9)
CLOSE = 0.01  # of the contrast, as the documents promise up to 0.45 cycles per pixel


def drawn_camera(rng: np.random.Generator) -> Camera:
    f_number, wavelength, pitch = np.exp(rng.uniform(np.log([1.4, 400e-9, 1e-6]), np.log([11, 700e-9, 10e-6])))
    return dataclasses.replace(CAMERA, f_number=f_number, wavelength=wavelength, pixel_pitch=pitch)


def overlap(frequency: float, camera: Camera) -> float:
    """The MTF as the area that two pupils of this distance share, by quadrature: no arccos of ours."""
    nu = min(frequency * camera.wavelength * camera.f_number / camera.pixel_pitch, 1.0)
    return integrate.quad(lambda x: 4 * np.sqrt(1 - x * x), nu, 1)[0] / np.pi


def contrast(image: np.ndarray, waves: np.ndarray, margin: int) -> float:
    """The amplitude of a wave in an image, away from its edges, by least squares; `waves` are its cosine and sine."""
    inner = (slice(margin, -margin),) * 2
    basis = np.stack([np.ones_like(image), *waves])[:, *inner].reshape(3, -1)
    found = np.linalg.lstsq(basis.T, image[inner].ravel())[0]
    return float(np.hypot(found[1], found[2]))


def waves(size: int, frequency: float, angle: float) -> np.ndarray:
    y, x = np.mgrid[:size, :size]
    phase = 2 * np.pi * frequency * (x * np.cos(angle) + y * np.sin(angle))
    return np.stack([np.cos(phase), np.sin(phase)])


def test_airy_disk_and_mtf():
    """f/2.8, 550 nm, 1.1 um: 3.4 pixels; contrast 1 at 0, 0 at and above the cut-off, 0.391 at half of it."""
    assert airy_diameter(CAMERA) == pytest.approx(3.415, abs=1e-3)
    cutoff = CAMERA.pixel_pitch / (CAMERA.wavelength * CAMERA.f_number)
    found = mtf(np.array([0, cutoff / 2, cutoff, 3 * cutoff]), CAMERA)
    np.testing.assert_allclose(found, [1, 2 / np.pi * (np.pi / 3 - np.sqrt(3) / 4), 0, 0], atol=1e-12)
    bands = diffraction_line(CAMERA, (610e-9, 540e-9, 460e-9))
    contrasts = "MTF 0.12, 0.20, 0.30 at Nyquist"
    assert bands == f"Airy disk 3.8, 3.4, 2.9 px wide, {contrasts} (f/2.8, 610, 540, 460 nm, 1.1 um)"


def test_waves_keep_the_contrast_of_lens_and_pixel():
    """Rendered waves (means over the pixels, in closed form) of any lens, pitch, colour and angle."""
    rng = np.random.default_rng(1)
    for _ in range(60):
        camera = drawn_camera(rng)
        angle = rng.uniform(0, np.pi)
        frequency = rng.uniform(0.05, 0.45)
        along = waves(128, frequency, angle)
        pixel = np.sinc(frequency * np.cos(angle)) * np.sinc(frequency * np.sin(angle))
        rendered = 1 + pixel * (np.array([0.6, 0.8]) @ along.reshape(2, -1)).reshape(128, 128)
        expected = overlap(frequency, camera) * pixel
        found = contrast(diffract(rendered, camera), along, 32)
        assert found == pytest.approx(expected, rel=CLOSE, abs=1e-3), (camera, angle, frequency)


@pytest.mark.parametrize(("f_number", "frequency", "angle"), [(1.4, 0.11, 0.2), (2.8, 0.297, 0.37), (5.6, 0.2, 1.1)])
def test_slanted_bars_keep_the_contrast_of_a_fine_airy_pattern(f_number, frequency, angle):
    """Bars drawn on a grid 11 times finer, convolved there with the Airy pattern, and averaged over pixels."""
    camera = dataclasses.replace(CAMERA, f_number=f_number)
    fine = 11
    size = 96
    y, x = (np.mgrid[: size * fine, : size * fine] + 0.5) / fine - 0.5
    bars = np.cos(2 * np.pi * frequency * (x * np.cos(angle) + y * np.sin(angle))) > 0
    reach = 20 * fine
    at = np.arange(-reach, reach + 1) / fine
    scale = camera.wavelength * f_number / camera.pixel_pitch  # px
    radius = np.pi * np.hypot(at[:, None], at) / scale + 1e-9
    airy = np.pi / 4 * (2 * special.j1(radius) / radius) ** 2 / (scale * fine) ** 2  # of light 1; its far tail is cut
    seen = signal.fftconvolve(bars.astype(float), airy, mode="same")

    def pixels(image: np.ndarray) -> np.ndarray:
        return image.reshape(size, fine, size, fine).mean(axis=(1, 3))

    along = waves(size, frequency, angle)
    found = contrast(diffract(pixels(bars.astype(float)), camera), along, 24)
    assert found == pytest.approx(contrast(pixels(seen), along, 24), rel=CLOSE)


def test_narrow_pixels_are_blurred_over_more_of_them():
    """Pixels half as wide see a wave of f cycles/px as square ones see one of 2 f across; down nothing changes."""
    narrow = dataclasses.replace(CAMERA, lens=Lens(aspect=2.0))
    x = np.arange(64) + 0.5
    across, down = (np.cos(2 * np.pi * f * x)[None] * np.ones((8, 1)) for f in (0.125, 0.25))
    scale = np.ptp(blurred(down, CAMERA)) / np.ptp(down)
    np.testing.assert_allclose(blurred(across, narrow), across * scale, atol=1e-12)
    np.testing.assert_allclose(blurred(down.T, narrow), blurred(down.T, CAMERA), atol=1e-12)


def test_light_is_kept_and_nowhere_below_zero():
    """Points, stars, strong textures, bars and flat fields of odd shapes; the dark stays dark."""
    rng = np.random.default_rng(2)
    for _ in range(40):
        camera = drawn_camera(rng)
        shape = tuple(rng.integers(1, 60, 2))
        stars = (rng.random(shape) < 0.02) * rng.lognormal(0, 3, shape)
        kinds = [stars, 1 + 1e6 * stars, rng.lognormal(0, 2, shape), np.full(shape, 3.0), np.zeros(shape)]
        for image in kinds:
            found = diffract(image, camera)
            assert found.min() >= 0
            assert found.sum() == pytest.approx(image.sum(), rel=1e-9)
            light = blurred(image, camera)
            if light.min() >= 0:
                np.testing.assert_array_equal(found, light)
    np.testing.assert_allclose(diffract(np.full((10, 7), 3.0), CAMERA), 3.0, rtol=1e-12)


def test_only_points_of_one_pixel_are_changed_and_by_as_much_as_stated():
    """The undershoot beside a point is 0.8 % of its light, below 7 % in all; slanted edges and lines have none."""
    point = np.zeros((101, 81))
    point[50, 40] = 1
    y, x = np.mgrid[:101, :81]
    worst = []
    for sharpness in np.linspace(0.05, 3, 60):  # wavelength x f-number / pitch
        camera = dataclasses.replace(CAMERA, pixel_pitch=CAMERA.wavelength * CAMERA.f_number / sharpness)
        light = blurred(point, camera)
        worst.append((-light.min(), -light[light < 0].sum()))
    undershoot, in_all = np.max(worst, axis=0)
    assert undershoot == pytest.approx(0.008, rel=0.02)
    assert 0.05 < in_all < 0.07  # 0.063 in larger pictures
    y, x = (np.mgrid[: 101 * 9, : 81 * 9] + 0.5) / 9
    for angle in np.linspace(0, np.pi / 2, 7):
        away = (x - 40.2) * np.cos(angle) + (y - 50.3) * np.sin(angle)
        for subject in (away > 0, np.abs(away) < 0.5):
            rendered = subject.reshape(101, 9, 81, 9).mean(axis=(1, 3))
            light = blurred(rendered, dataclasses.replace(CAMERA, f_number=2.4))
            assert light[10:-10, 10:-10].min() > -1e-3


def test_a_point_spreads_as_airy_says():
    """Behind f/11 at 1.1 um (13.4 pixels), 83.8 % of the light lies inside the first dark ring."""
    camera = dataclasses.replace(CAMERA, f_number=11.0)
    point = np.zeros((301, 301))
    point[150, 150] = 1
    y, x = np.mgrid[-150:151, -150:151]
    inside = diffract(point, camera)[np.hypot(x, y) <= airy_diameter(camera) / 2].sum()
    assert inside == pytest.approx(0.838, abs=0.01)  # pixels on the ring

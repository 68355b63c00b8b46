"""Tests the checks of a camera and its projection."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from qsim.optics import radiometry
from qsim.optics.camera import Camera
from qsim.optics.lens import Lens
from qsim.scene import Spin

CAMERA = Camera(focal_length=8e-3, f_number=2.8, pixel_pitch=1e-5, height=7, width=10)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixel_pitch": 1.1}, r"pixel_pitch is in metres, got 1.1; a 1.1 um pixel is 1.1e-6"),
        ({"focal_length": -1.0}, "focal_length is in metres"),
        ({"wavelength": 550.0}, "550 nm is 550e-9"),
        ({"f_number": 0.1}, "f_number"),
        ({"transmission": 1.5}, r"Camera\.transmission must be in \(0, 1\], got 1\.5"),
        ({"height": 0}, "Camera.height must be a positive whole number"),
        ({"target": (0.0, 9.0, 5.0)}, "give no orientation"),
    ],
)
def test_impossible_cameras_are_refused(changes, message):
    values = {"focal_length": 8e-3, "f_number": 2.8, "pixel_pitch": 1e-6, "height": 4, "width": 4}
    with pytest.raises(ValueError, match=message):
        Camera(**(values | changes))


def test_the_optical_axis_meets_the_middle_and_axes_point_right_and_down():
    pixels, depth = CAMERA.project(np.array([[0.0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]]))
    np.testing.assert_allclose(pixels[0], (5, 3.5), atol=1e-12)
    np.testing.assert_allclose(depth, 5)
    assert pixels[1, 0] > 5  # +x is to the right for a camera on +z
    assert pixels[2, 1] < 3.5  # +y is up, rows count down


def test_projecting_the_pixel_rays_gives_the_pixel_centres():
    camera = Camera(8e-3, 2.8, 1e-5, 7, 10, motion=Spin(axis=(0, 1, 0), rate=3.0), origin=(1, 2, 3), target=(0, 0.5, 0))
    t = 0.123
    pose = camera.pose(t)
    points = pose[:3, 3] + 2.5 * camera.directions() @ pose[:3, :3].T
    pixels, depth = camera.project(points, t)
    y, x = np.mgrid[:7, :10] + 0.5
    np.testing.assert_allclose(pixels, np.stack([x, y], -1), atol=1e-10)
    np.testing.assert_allclose(depth, 2.5)


def test_resizing_keeps_the_view_pitch_and_f_number():
    small = CAMERA.resized(14, 20)
    assert (small.pixel_pitch, small.f_number) == (CAMERA.pixel_pitch, CAMERA.f_number)
    here, there = (camera.project(np.array([0.003, 0.002, 0]))[0] for camera in (CAMERA, small))
    np.testing.assert_allclose(there, 2 * here)


def test_off_axis_cosines_of_a_wide_view():
    wide = Camera(focal_length=1e-4, f_number=2, pixel_pitch=1e-4, height=1, width=3)
    np.testing.assert_allclose(wide.cosines(), [[2**-0.5, 1, 2**-0.5]])


def test_a_distorting_lens_sees_its_pixel_rays_at_the_pixel_centres():
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:7, :10] + 0.5
    for _ in range(100):
        lens = Lens(*rng.uniform(-0.3, 0.5, 2), shift=tuple(rng.uniform(-0.4, 0.4, 2)))
        camera = dataclasses.replace(CAMERA, focal_length=1e-4 * rng.uniform(1, 4), lens=lens)
        points = camera.pose()[:3, 3] + rng.uniform(0.1, 9) * camera.directions() @ camera.pose()[:3, :3].T
        np.testing.assert_allclose(camera.project(points)[0], np.stack([x, y], -1), atol=1e-10)


def test_resizing_keeps_what_a_lens_shows():
    lens = Lens(-0.2, 0.05, (-0.3,), (0.1, -0.07))
    camera = dataclasses.replace(CAMERA, focal_length=1e-4, lens=lens)
    point = np.array([0.4, -0.3, 1.0])
    np.testing.assert_allclose(camera.resized(21, 30).project(point)[0], 3 * camera.project(point)[0], rtol=1e-12)


def test_an_ideal_lens_is_none():
    assert dataclasses.replace(CAMERA, lens=Lens()).lens is None
    with pytest.raises(ValueError, match="the picture folds"):
        dataclasses.replace(CAMERA, focal_length=5e-5, lens=Lens(k1=-0.4))


def thin(rng: np.random.Generator) -> Camera:
    """Return a random thin lens in focus."""
    focal = float(10 ** rng.uniform(-3, -1))
    focus = focal * float(1 + 10 ** rng.uniform(-1, 3))
    return Camera(
        focal, rng.uniform(0.5, 16), 1e-5, 7, 10, aperture_blur=True, focus_distance=focus, origin=(0, 0, 2 * focus)
    )


def test_a_thin_lens_obeys_its_laws():
    """1/f = 1/s + 1/v, the circle of confusion of a textbook, and its irradiance: pi L A^2 / (4 v^2)."""
    rng = np.random.default_rng(5)
    for _ in range(100):
        camera = thin(rng)
        f = camera.focal_length
        s = camera.focus
        v = camera.image_distance
        assert 1 / s + 1 / v == pytest.approx(1 / f, rel=1e-12)
        assert camera.focal_pixels == pytest.approx(v / 1e-5)
        depth = s * rng.uniform(0.3, 5)
        pupil = f / camera.f_number
        circle = pupil * f * abs(depth - s) / (depth * (s - f)) / 1e-5
        assert float(camera.circle_of_confusion(depth)) == pytest.approx(circle, rel=1e-9)
        irradiance = radiometry.to_irradiance(np.array(3.0), camera)
        assert float(irradiance) == pytest.approx(np.pi * 3.0 * pupil**2 / (4 * v**2), rel=1e-9)


def test_resizing_a_thin_lens_keeps_the_share_of_its_blur():
    rng = np.random.default_rng(6)
    for _ in range(20):
        camera = thin(rng)
        large = camera.resized(70, 110)
        depth = camera.focus * rng.uniform(0.3, 5)
        assert large.circle_of_confusion(depth) == pytest.approx(10 * camera.circle_of_confusion(depth), rel=1e-12)
        assert large.focal_pixels == pytest.approx(10 * camera.focal_pixels, rel=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"focus_distance": -1.0}, "focus_distance is in metres before the camera, got -1.0"),
        ({"focus_distance": float("nan")}, "before the camera"),
        ({"aperture_blur": True, "focus_distance": 7e-3}, "cannot focus on a distance of 0.007 m"),
        ({"f_number": -2.0}, "f_number must be at least 0.5"),
    ],
)
def test_impossible_lenses_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(CAMERA, **changes)

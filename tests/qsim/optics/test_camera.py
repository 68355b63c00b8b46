"""Tests the checks of a camera and its projection."""

from __future__ import annotations

import numpy as np
import pytest

from qsim.optics.camera import Camera
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

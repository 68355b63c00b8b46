"""Tests width, contrast and energy of the Airy pattern."""

import dataclasses

import numpy as np
import pytest

from qsim.optics.camera import Camera
from qsim.optics.diffraction import airy_diameter, airy_kernel, diffract, mtf

CAMERA = Camera(focal_length=8e-3, f_number=2.8, pixel_pitch=1.1e-6, height=10, width=7, wavelength=550e-9)


def test_airy_disk_and_mtf():
    """f/2.8, 550 nm, 1.1 um: 3.4 pixels; contrast 1 at 0, 0 at and above the cut-off, 0.391 at half of it."""
    camera = CAMERA
    assert airy_diameter(camera) == pytest.approx(3.415, abs=1e-3)
    cutoff = camera.pixel_pitch / (camera.wavelength * camera.f_number)
    contrast = mtf(np.array([0, cutoff / 2, cutoff, 3 * cutoff]), camera)
    np.testing.assert_allclose(contrast, [1, 2 / np.pi * (np.pi / 3 - np.sqrt(3) / 4), 0, 0], atol=1e-12)


def test_diffraction_keeps_a_constant_and_spreads_a_point_as_airy_says():
    """Behind f/11 at 1.1 um (13.4 pixels), 83.8 % of the light kept by the kernel lies inside the first dark ring."""
    camera = dataclasses.replace(CAMERA, f_number=11.0)
    np.testing.assert_allclose(diffract(np.full((10, 7), 3.0), camera), 3.0, rtol=1e-12)
    kernel = airy_kernel(camera)
    reach = kernel.shape[0] // 2
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    inside = kernel[np.hypot(x, y) <= airy_diameter(camera) / 2].sum()
    assert inside == pytest.approx(0.838, abs=0.03)  # pixels on the ring, and the 2 % outside the kernel
    assert kernel.min() > 0
    assert kernel.sum() == pytest.approx(1, rel=1e-12)


def test_the_kernel_has_the_contrast_of_the_closed_form():
    """Its transform is the MTF times the sinc of the pixel; the cut at six diameters changes it by about 2 %."""
    camera = dataclasses.replace(CAMERA, f_number=11.0)
    kernel = airy_kernel(camera)
    n = kernel.shape[0]
    frequency = np.arange(1, 15) / n
    contrast = np.abs(np.fft.fft(kernel.sum(axis=0)))[1:15]
    np.testing.assert_allclose(contrast, mtf(frequency, camera) * np.sinc(frequency), atol=0.02)


def test_a_pixel_much_larger_than_the_airy_disk_keeps_the_light():
    """At 22 um and f/2.8 the disk is 0.17 pixels wide; 1 - J0^2 - J1^2 puts 97.8 % into a circle in the pixel."""
    camera = dataclasses.replace(CAMERA, pixel_pitch=22e-6)
    kernel = airy_kernel(camera)
    reach = kernel.shape[0] // 2
    assert kernel[reach, reach] == pytest.approx(0.98, abs=0.01)

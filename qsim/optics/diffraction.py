"""Computes the Airy disk and the MTF of an ideal lens, and blurs images with the Airy pattern."""

from __future__ import annotations

import numpy as np
from numpy import ndarray as Array

from qsim.optics.camera import Camera


def airy_diameter(camera: Camera) -> float:
    """Return the diameter of the first dark ring, 2.44 lambda N, in pixels: 3.4 at f/2.8, 550 nm, 1.1 um."""
    return 2.439339 * camera.wavelength * camera.working_f_number / camera.pixel_pitch


def mtf(frequency: Array, camera: Camera) -> Array:
    """Return the contrast [...] of an ideal round aperture at `frequency` [...] [cycles per pixel].

    Source: Goodman, Fourier Optics, section 6.4.
    """
    nu = np.minimum(np.abs(frequency) * camera.wavelength * camera.working_f_number / camera.pixel_pitch, 1.0)
    contrast: Array = 2 / np.pi * (np.arccos(nu) - nu * np.sqrt(1 - nu * nu))
    return contrast


def diffraction_line(camera: Camera) -> str:
    """Return the resolution limit of the lens: `Airy disk 3.4 px wide, MTF 0.19 at Nyquist (f/2.8, 550 nm, 1.1 um)`."""
    nyquist = float(mtf(np.array([0.5]), camera)[0])
    where = f"f/{camera.f_number:g}, {1e9 * camera.wavelength:g} nm, {1e6 * camera.pixel_pitch:g} um"
    return f"Airy disk {airy_diameter(camera):.2g} px wide, MTF {nyquist:.2f} at Nyquist ({where})"


def airy_kernel(camera: Camera) -> Array:
    """Return the share of a point's light in the pixels around it, [n, n], n odd: the Airy pattern per pixel.

    The pattern is cut off at six Airy diameters (about 2 % of the light lies outside) and normalised to 1.
    """
    from scipy import special

    reach = max(1, int(np.ceil(6 * airy_diameter(camera))))
    points = int(np.clip(np.ceil(12 / airy_diameter(camera)), 6, 64))  # per pixel and axis
    nodes, weights = np.polynomial.legendre.leggauss(points)
    positions = (np.arange(-reach, reach + 1)[:, None] + nodes / 2).ravel()
    radius = np.hypot(positions[:, None], positions) * camera.pixel_pitch
    x = np.maximum(np.pi * radius / (camera.wavelength * camera.working_f_number), 1e-9)
    pattern = (2 * special.j1(x) / x) ** 2
    summed = np.einsum("yixj,i,j->yx", pattern.reshape(2 * reach + 1, points, -1, points), weights, weights)
    kernel: Array = summed / summed.sum()
    return kernel


def diffract(image: Array, camera: Camera) -> Array:
    """Return an image [H, W] convolved with `airy_kernel`, float64 [H, W] in its unit; mirrored at its edges."""
    from scipy import signal

    kernel = airy_kernel(camera)
    reach = kernel.shape[0] // 2
    padded = np.pad(np.asarray(image, np.float64), reach, mode="symmetric")
    return np.maximum(signal.fftconvolve(padded, kernel, mode="valid"), 0.0)

"""Computes the Airy disk and the MTF of an ideal lens, and blurs images by that MTF.

A rendered pixel is the mean over its area, so the pixel's own MTF is in the image already, and only the lens's is
applied: every spatial frequency up to 0.5 cycles per pixel in x and in y is multiplied by `mtf`. What the lens passes
beyond 0.5 cycles per pixel cannot be told apart on the pixel grid. The render has folded it to a frequency below, where
it is damped by the MTF of that frequency, which is larger than its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy import ndarray as Array

from qsim.arrays import plain
from qsim.optics.camera import Camera

NEAR = 31  # px: where a lone point takes pixels below 0, the light that lifts them to 0 comes from this square


def airy_diameter(camera: Camera) -> float:
    """Return the diameter of the first dark ring, 2.44 lambda N, in pixels: 3.4 at f/2.8, 550 nm, 1.1 um."""
    return 2.439339 * camera.wavelength * camera.working_f_number / camera.pixel_pitch


def mtf(frequency: Array, camera: Camera) -> Array:
    """Return the contrast [...] of an ideal round aperture at `frequency` [...] [cycles per height of a pixel].

    Source: Goodman, Fourier Optics, section 6.4.
    """
    nu = np.minimum(np.abs(frequency) * camera.wavelength * camera.working_f_number / camera.pixel_pitch, 1.0)
    contrast: Array = 2 / np.pi * (np.arccos(nu) - nu * np.sqrt(1 - nu * nu))
    return contrast


def diffraction_line(camera: Camera, bands: Sequence[float] | None = None) -> str:
    """Return the resolution limit of the lens, of each of the `bands` [m] of a colour clip.

    `Airy disk 3.4 px wide, MTF 0.19 at Nyquist (f/2.8, 550 nm, 1.1 um)`
    """
    cameras = [replace(camera, wavelength=wavelength) for wavelength in bands or (camera.wavelength,)]
    width = ", ".join(f"{airy_diameter(one):.2g}" for one in cameras)
    nyquist = ", ".join(f"{float(mtf(np.array(0.5), one)):.2f}" for one in cameras)
    light = ", ".join(f"{1e9 * one.wavelength:g}" for one in cameras)
    where = f"f/{camera.working_f_number:.3g}, {light} nm, {1e6 * camera.pixel_pitch:g} um"
    return f"Airy disk {width} px wide, MTF {nyquist} at Nyquist ({where})"


def blurred(image: Array, camera: Camera) -> Array:
    """Return an image [H, W] whose spatial frequencies are multiplied by `mtf`, float64 [H, W] in its unit.

    The image is mirrored at its edges, so that no light is lost there. Linear: beside points of one pixel the answer
    may lie below 0 (see `diffract`).
    """
    from scipy import fft

    # A cosine transform mirrors the image at its edges. Its k-th wave has k / 2 periods over the image.
    down, across = (np.arange(size) / (2 * size) for size in image.shape)  # cycles/px of a cosine transform
    contrast = mtf(np.hypot(down[:, None], across * camera.aspect), camera)
    spectrum = fft.dctn(plain(image, np.float64), norm="ortho")
    answer: Array = fft.idctn(spectrum * contrast, norm="ortho")
    return answer


def diffract(image: Array, camera: Camera) -> Array:
    """Return light [H, W] behind the lens, `blurred` and nowhere below 0, float64 [H, W] in its unit.

    The sum of the image is kept. Straight edges, lines and bars stay above 0 by themselves. Beside a point of one
    pixel, whose place within the pixel is unknown, a lens that passes light at Nyquist gives up to 0.8 % of the point's
    light less than nothing in a pixel; those pixels are set to 0, and the light is taken from their neighbourhood
    (`NEAR`), less than 7 % of the point's.
    """
    light = blurred(image, camera)
    lack = np.maximum(-light, 0.0)
    if not lack.any():
        return light
    from scipy import ndimage

    light = np.maximum(light, 0.0)
    # The lack of a pixel is shared out over its square in proportion to the light there. The
    # filter twice gives each pixel the sum of what all lacks around take from it.
    around = ndimage.uniform_filter(light, NEAR, mode="constant")
    share = np.divide(lack, around, out=np.zeros_like(lack), where=(lack > 0) & (around > 0))
    taken = ndimage.uniform_filter(share, NEAR, mode="constant")
    kept: Array = light * np.maximum(1 - taken, 0.0)
    return kept

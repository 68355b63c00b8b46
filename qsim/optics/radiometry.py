"""Converts radiance to expected photons: lens, pixel, exposure, light level.

    radiance [W m^-2 sr^-1] -> irradiance [W m^-2] -> photons [expected per pixel and exposure, before the sensor]

Nothing here is random. The lens obeys the sine condition, so irradiance = pi L T cos^4 / (4 N^2). Every factor enters
once: transmission, fill factor, vignetting and fall-off here, quantum efficiency in the sensor. A light level is one
factor for a clip (`LightLevel`), from a target in photons per pixel (PPP) or in faceplate lux; without a target it is
1. N is the working f-number where the camera focuses (`aperture_blur`). Left out: other aberrations, and stray light.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray as Array

from qsim.arrays import plain
from qsim.host import own_numbers
from qsim.kinds import LARGEST, SMALLEST, NotNegative, Positive
from qsim.lazy_array import Crop
from qsim.optics.camera import Camera
from qsim.optics.lens import Lens

PLANCK = 6.62607015e-34  # J s, exact (SI)
LIGHT_SPEED = 299792458.0  # m s^-1, exact (SI)
LUMINOUS_EFFICACY = 683.0  # lm W^-1 at 540 THz, exact (SI); K_m at 555 nm
LUX_WAVELENGTH = 555e-9  # m, where V(lambda) = 1: every lux of this module is light of this wavelength
V_LAMBDA = (
    0.00004,
    0.00012,
    0.0004,
    0.0012,
    0.0040,
    0.0116,
    0.023,
    0.038,
    0.060,
    0.09098,
    0.13902,
    0.20802,
    0.323,
    0.503,
    0.710,
    0.862,
    0.954,
    0.99495,
    0.995,
    0.952,
    0.870,
    0.757,
    0.631,
    0.503,
    0.381,
    0.265,
    0.175,
    0.107,
    0.061,
    0.032,
    0.017,
    0.00821,
    0.004102,
    0.002091,
    0.001047,
    0.00052,
    0.000249,
    0.00012,
    0.00006,
    0.00003,
    0.000015,
)  # of 380 to 780 nm in steps of 10 nm; CIE 1924
RGB = (610e-9, 540e-9, 460e-9)  # m, of the bands R, G and B of colour clips unless a scene states others
WHITE_PER_MEAN = 2.5  # white of a clip or stream over its mean light: the peak of scores and of requested errors


def check_crop(crop: Crop | None, height: int, width: int, where: str = "") -> Crop:
    """Return the crop (y, x, h, w) [px], None: the whole frame; `ValueError` for one that is not inside the frame."""
    if crop is None:
        return (0, 0, height, width)
    y, x, h, w = crop
    if y < 0 or x < 0 or h < 1 or w < 1 or y + h > height or x + w > width:
        place = f"{where}: " if where else ""
        raise ValueError(f"{place}crop (y, x, h, w) = {(y, x, h, w)} is not inside {height} x {width} pixels")
    return crop


def photon_energy(wavelength: float) -> float:
    """Return the energy of one photon [J]; `wavelength` in m."""
    return PLANCK * LIGHT_SPEED / wavelength


@own_numbers
def to_irradiance(radiance: Array, camera: Camera, cos_theta: float | Array = 1.0) -> Array:
    """Return the faceplate irradiance [W m^-2], float64 [...]: pi L T cos^4(theta) / (4 N^2) of a distant scene.

    `radiance` is [...] in W m^-2 sr^-1; `cos_theta` is a number or broadcasts with it.
    """
    # The camera equation: one cosine each for the tilted pupil and the tilted pixel, two for the longer way.
    scale = np.pi * camera.transmission / (4 * camera.working_f_number**2)
    return np.asarray(radiance, np.float64) * (scale * cos_theta**4)


@own_numbers
def to_photons(irradiance: Array, camera: Camera, exposure: float) -> Array:
    """Return expected photons per pixel in `exposure` [s], float64 [...], of irradiance [...] [W m^-2].

    All light has the camera's wavelength.
    """
    return np.asarray(irradiance, np.float64) * (camera.pixel_area * exposure / photon_energy(camera.wavelength))


@own_numbers
def expected_photons(
    radiance: Array, camera: Camera, exposure: float, *, origin: tuple[int, int] | None = None
) -> Array:
    """Return expected photons per pixel and exposure, float64 [..., H, W], before quantum efficiency.

    `radiance` is [..., H, W] in W m^-2 sr^-1, `exposure` in s. `origin` is the (y, x) of its first pixel in the
    camera's frame; without it the image is centred on the optical axis. `ValueError` if the exposure is not positive,
    and for a camera whose lens changes (`Camera.at`).
    """
    camera.resting()
    if not exposure > 0:
        raise ValueError(f"exposure: expected seconds above 0, got {exposure!r}; a full frame time at 2000 fps is 5e-4")
    radiance = plain(radiance, np.float64)
    cosines: float | Array = 1.0
    if (camera.vignetting or camera.lens is not None) and radiance.ndim >= 2:
        height, width = radiance.shape[-2:]
        y, x = origin or ((camera.height - height) / 2, (camera.width - width) / 2)
        # Fall-off belongs to the place in the camera's frame, not in the crop.
        axis = height, width, camera.axis[1] - y, camera.axis[0] - x, camera.focal_pixels
        if camera.lens is not None:
            radiance = radiance * illumination(*axis, camera.lens, camera.vignetting)
        else:
            cosines = off_axis_cosines(*axis)
    return to_photons(to_irradiance(radiance, camera, cosines), camera, exposure)


@own_numbers
def band_photons(
    radiance: Array, camera: Camera, exposure: float, bands: Sequence[float], *, origin: tuple[int, int] | None = None
) -> Array:
    """Return expected photons per pixel, exposure and band, float64 [..., 3, H, W]; arguments as of `expected_photons`.

    `radiance` [..., 3, H, W] holds the power of each band, whose light has one wavelength of `bands` [m].
    """
    cameras = [replace(camera, wavelength=wavelength) for wavelength in bands]
    # A band's power is counted in photons of its own energy: red light of the same power has more of them.
    each = [expected_photons(radiance[..., i, :, :], c, exposure, origin=origin) for i, c in enumerate(cameras)]
    return np.stack(each, axis=-3)


@functools.lru_cache(maxsize=16)
def off_axis_cosines(height: int, width: int, centre_y: float, centre_x: float, focal_pixels: float) -> Array:
    """Return the cosine of the off-axis angle at the pixel centres, [H, W], read-only; all lengths in pixels."""
    y = (np.arange(height) + 0.5 - centre_y)[:, None] / focal_pixels
    x = (np.arange(width) + 0.5 - centre_x)[None, :] / focal_pixels
    cosines: Array = 1 / np.sqrt(1 + x * x + y * y)
    cosines.setflags(write=False)
    return cosines


@functools.lru_cache(maxsize=16)
def illumination(
    height: int, width: int, centre_y: float, centre_x: float, focal_pixels: float, lens: Lens, natural: bool
) -> Array:
    """Return the share of the axis' light at the pixel centres behind a lens (`Lens.illumination`), [H, W], read-only.

    Arguments as of `off_axis_cosines`, whose fourth power it is for an ideal lens with `natural`.
    """
    y, x = (np.mgrid[:height, :width] + 0.5 - np.array([centre_y, centre_x])[:, None, None]) / focal_pixels
    share = lens.illumination(np.stack([x, y], axis=-1), natural=natural)
    share.setflags(write=False)
    return share


def photons_per_lux(camera: Camera, exposure: float) -> float:
    """Return photons per pixel in `exposure` [s] for one lux of 555 nm on the faceplate: 2.47 for 1.1 um and 0.5 ms."""
    return photons_per_lux_of(camera.pixel_area, exposure)


def photons_per_lux_of(area: float, exposure: float) -> float:
    """Return the same for a photosensitive area [m^2] without a camera."""
    return area * exposure / (LUMINOUS_EFFICACY * photon_energy(LUX_WAVELENGTH))


def photopic(bands: Sequence[float]) -> float:
    """Return the photopic lux of equally many photons in each of `bands` [m] over the lux of so many of 555 nm.

    1.51 of 610, 540 and 460 nm. V(lambda) is that of CIE 1924 every 10 nm, linear between.
    """
    visible = np.interp(np.asarray(bands) * 1e9, 380 + 10 * np.arange(len(V_LAMBDA)), V_LAMBDA, left=0, right=0)
    return float(np.sum(visible * LUX_WAVELENGTH / np.asarray(bands)))


def ppp_factor(mean_photons: float, target: float, name: str = "clip") -> float:
    """Return the factor that brings a clip's mean to `target` photons per pixel; `ValueError` for a black clip."""
    if not (target > 0 and np.isfinite(target)):
        raise ValueError(f"{name}: photons per pixel must be a number above 0, got {target!r}")
    if not mean_photons > 0:
        raise ValueError(
            f"{name}: mean of photons is {mean_photons:g}, no factor reaches {target:g} PPP; is the light on?"
        )
    factor = target / mean_photons
    if not SMALLEST <= factor <= LARGEST:
        allowed = f"{SMALLEST:g} to {LARGEST:g} times"
        raise ValueError(f"{name}: {target:g} PPP is {factor:.3g} times its own light; allowed are {allowed}")
    return factor


@dataclass(frozen=True)
class LightLevel:
    """The light level of a clip: photons at the sensor = factor * photons of the stored radiance, in every pixel.

    Of a clip frame, or of a code that collects several; descriptions of streams hold it.
    """

    factor: Positive  # 1 without a target
    ppp: NotNegative  # mean photons per pixel and exposure over the clip, after the factor
    before: NotNegative  # the same before the factor; mean radiance if the clip's unit is relative
    lux: NotNegative | None = None  # faceplate lux at 555 nm that give `ppp`; None without a camera

    def over(self, frames: int) -> LightLevel:
        """Return the light level of codes that collect the light of so many frames."""
        return replace(self, ppp=self.ppp * frames, before=self.before * frames)

"""Radiance to photons: the lens, the pixel, the exposure, the light level.

    radiance [W m^-2 sr^-1] -> irradiance [W m^-2] -> photons [expected per pixel and exposure, before the sensor]

Nothing here is random. The lens obeys the sine condition, so irradiance = pi L T cos^4 / (4 N^2). Every factor enters
once: transmission, fill factor and vignetting here, quantum efficiency in the sensor. A light level is one number for a
whole clip (`LightLevel`): a target in photons per pixel (PPP), in faceplate lux, or the light as it is. Left out:
aberrations, stray light, and the working f-number of close objects.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy import ndarray as Array

if TYPE_CHECKING:
    from qsim.clip.clip import Clip
    from qsim.optics.camera import Camera

PLANCK = 6.62607015e-34  # J s, exact (SI)
LIGHT_SPEED = 299792458.0  # m s^-1, exact (SI)
LUMINOUS_EFFICACY = 683.0  # lm W^-1 at 540 THz, exact (SI); K_m at 555 nm
LUX_WAVELENGTH = 555e-9  # m, where V(lambda) = 1: every lux of this module is light of this wavelength
WHITE_PER_MEAN = 2.5  # white of a clip or stream, in units of its mean light: the peak of scores and of asked errors

Crop = tuple[int, int, int, int]  # y, x, height, width


def photon_energy(wavelength: float) -> float:
    """Energy of one photon [J]; `wavelength` in m."""
    return PLANCK * LIGHT_SPEED / wavelength


def to_irradiance(radiance: Array, camera: Camera, cos_theta: float | Array = 1.0) -> Array:
    """Faceplate irradiance [W m^-2] of a distant scene: pi L T cos^4(theta) / (4 N^2)."""
    scale = np.pi * camera.transmission / (4 * camera.f_number**2)
    return np.asarray(radiance, np.float64) * (scale * cos_theta**4)


def to_photons(irradiance: Array, camera: Camera, exposure: float) -> Array:
    """Expected photons per pixel during `exposure` [s] of light at the camera's wavelength."""
    area = camera.fill_factor * camera.pixel_pitch**2
    return np.asarray(irradiance, np.float64) * (area * exposure / photon_energy(camera.wavelength))


def expected_photons(
    radiance: Array, camera: Camera, exposure: float, *, origin: tuple[int, int] | None = None
) -> Array:
    """Expected photons per pixel and exposure, float64, before quantum efficiency: the only way from radiance.

    `radiance` is [..., H, W] in W m^-2 sr^-1, `exposure` in s. `origin` is the (y, x) of its first pixel in the
    camera's frame; without it the image is centred on the optical axis. `ValueError` if the exposure is not positive.
    """
    if not exposure > 0:
        raise ValueError(f"exposure: expected seconds above 0, got {exposure!r}; a whole frame at 2000 fps is 5e-4")
    radiance = np.asarray(radiance, np.float64)
    cosines: float | Array = 1.0
    if camera.vignetting and radiance.ndim >= 2:
        height, width = radiance.shape[-2:]
        if origin is None:
            centre_y, centre_x = height / 2, width / 2
        else:
            centre_y, centre_x = camera.height / 2 - origin[0], camera.width / 2 - origin[1]
        cosines = off_axis_cosines(height, width, centre_y, centre_x, camera.focal_length / camera.pixel_pitch)
    return to_photons(to_irradiance(radiance, camera, cosines), camera, exposure)


@functools.lru_cache(maxsize=16)
def off_axis_cosines(height: int, width: int, centre_y: float, centre_x: float, focal_pixels: float) -> Array:
    """Cosine of the off-axis angle at the pixel centres, [H, W]; centre and focal length in pixels. Read-only."""
    y = (np.arange(height) + 0.5 - centre_y)[:, None] / focal_pixels
    x = (np.arange(width) + 0.5 - centre_x)[None, :] / focal_pixels
    cosines: Array = 1 / np.sqrt(1 + x * x + y * y)
    cosines.setflags(write=False)
    return cosines


def photons_per_lux(camera: Camera, exposure: float) -> float:
    """Photons per pixel and exposure for one lux of 555 nm light on the faceplate: 2.47 for 1.1 um and 0.5 ms."""
    area = camera.fill_factor * camera.pixel_pitch**2
    return area * exposure / (LUMINOUS_EFFICACY * photon_energy(LUX_WAVELENGTH))


def ppp_factor(mean_photons: float, target: float, name: str = "clip") -> float:
    """The one factor that brings a clip's mean to `target` photons per pixel; `ValueError` for a black clip."""
    if not (target > 0 and np.isfinite(target)):
        raise ValueError(f"{name}: photons per pixel must be a number above 0, got {target!r}")
    if not mean_photons > 0:
        raise ValueError(
            f"{name}: mean of photons is {mean_photons:g}, no factor reaches {target:g} PPP; is the light on?"
        )
    return target / mean_photons


@dataclass(frozen=True)
class LightLevel:
    """How bright a clip is for a sensor: photons = factor * (photons of the light as it is), everywhere in the clip."""

    factor: float  # 1 for light as it is
    ppp: float  # mean photons per pixel and exposure over the whole clip, after the factor
    mean_before: float  # the same before the factor; mean radiance where the clip's unit is relative
    lux: float | None  # faceplate lux at 555 nm that give `ppp`; None without a camera

    def line(self, clip: Clip, electrons_per_photon: float | None = None) -> str:
        """`fan_03: mean radiance 0.0254 W/m2/sr, 3.25 PPP (factor 0.84), then 1.31 lx at 555 nm, 2.60 e-/pixel`."""
        unit = " (relative)" if self.lux is None else " W/m2/sr"
        text = (
            f"{clip.name}: mean radiance {clip.mean_radiance:.4g}{unit}, {self.ppp:.4g} PPP (factor {self.factor:.4g})"
        )
        if self.lux is not None:
            text += f", then {self.lux:.4g} lx at 555 nm"
        if electrons_per_photon is not None:
            text += f", {self.ppp * electrons_per_photon:.3g} e-/pixel"
        return text


def light_level(clip: Clip, *, ppp: float | None = None, lux: float | None = None) -> LightLevel:
    """The light of a clip: scaled to `ppp` photons per pixel, to `lux` on the faceplate, or as it is (neither given).

    `ValueError` for a black clip, for both targets at once, and for a clip of relative radiance without `ppp`.
    """
    if ppp is not None and lux is not None:
        raise ValueError(f"{clip.name}: give the light level as ppp or as lux, not both")
    camera = clip.camera
    if camera is None:
        if ppp is None:
            what = "lux" if lux is not None else "absolute light"
            raise ValueError(
                f"{clip.name}: its radiance is relative (imported video) and has no {what}; "
                "give a target in photons per pixel, as in --ppp 3.25"
            )
        return LightLevel(ppp_factor(clip.mean_radiance, ppp, clip.name), ppp, clip.mean_radiance, None)
    per_lux = photons_per_lux(camera, clip.exposure)
    if lux is not None:
        ppp = lux * per_lux
    factor = 1.0 if ppp is None else ppp_factor(clip.mean_photons, ppp, clip.name)
    level = clip.mean_photons if ppp is None else ppp
    return LightLevel(factor, level, clip.mean_photons, level / per_lux)


def clip_photons(
    clip: Clip, t: int, factor: float = 1.0, crop: Crop | None = None, *, sharp: bool = False, diffraction: bool = False
) -> Array:
    """Expected photons [h, w] of frame t, or of its sharp instant, times a factor; crop = (y, x, height, width)."""
    if diffraction and crop is not None:
        whole = clip_photons(clip, t, factor, sharp=sharp, diffraction=True)
        y, x, height, width = crop
        return whole[y : y + height, x : x + width]
    radiance = clip.sharp(t, crop) if sharp else clip.radiance(t, crop)
    camera = clip.camera
    if camera is None:
        if diffraction:
            raise ValueError(f"{clip.name}: diffraction needs a camera, and this clip's radiance is relative")
        return radiance.astype(np.float64) * factor
    y, x = clip.origin
    if crop is not None:
        y, x = y + crop[0], x + crop[1]
    if diffraction:
        radiance = diffract(radiance, camera)
    return expected_photons(radiance, camera, clip.exposure, origin=(y, x)) * factor


def airy_diameter(camera: Camera) -> float:
    """Diameter of the Airy disk's first dark ring, 2.44 lambda N, in pixels: 3.4 at f/2.8, 550 nm, 1.1 um."""
    return 2.439339 * camera.wavelength * camera.f_number / camera.pixel_pitch


def mtf(frequency: Array, camera: Camera) -> Array:
    """Contrast of an ideal round aperture at `frequency` [cycles per pixel] (Goodman, Fourier Optics, section 6.4)."""
    nu = np.minimum(np.abs(frequency) * camera.wavelength * camera.f_number / camera.pixel_pitch, 1.0)
    contrast: Array = 2 / np.pi * (np.arccos(nu) - nu * np.sqrt(1 - nu * nu))
    return contrast


def diffraction_line(camera: Camera) -> str:
    """`Airy disk 3.4 px wide, MTF 0.19 at Nyquist (f/2.8, 550 nm, 1.1 um)`: what the lens could at best resolve."""
    nyquist = float(mtf(np.array([0.5]), camera)[0])
    where = f"f/{camera.f_number:g}, {1e9 * camera.wavelength:g} nm, {1e6 * camera.pixel_pitch:g} um"
    return f"Airy disk {airy_diameter(camera):.2g} px wide, MTF {nyquist:.2f} at Nyquist ({where})"


def airy_kernel(camera: Camera) -> Array:
    """Share of a point's light in the pixels around it, [n, n], n odd: the Airy pattern integrated over each pixel.

    Cut off at six Airy diameters (about 2 % of the light lies outside) and normalised to 1.
    """
    from scipy import special

    reach = max(1, int(np.ceil(6 * airy_diameter(camera))))
    points = int(np.clip(np.ceil(12 / airy_diameter(camera)), 6, 64))  # per pixel and axis
    nodes, weights = np.polynomial.legendre.leggauss(points)
    positions = (np.arange(-reach, reach + 1)[:, None] + nodes / 2).ravel()
    radius = np.hypot(positions[:, None], positions) * camera.pixel_pitch
    x = np.maximum(np.pi * radius / (camera.wavelength * camera.f_number), 1e-9)
    pattern = (2 * special.j1(x) / x) ** 2
    summed = np.einsum("yixj,i,j->yx", pattern.reshape(2 * reach + 1, points, -1, points), weights, weights)
    kernel: Array = summed / summed.sum()
    return kernel


def diffract(image: Array, camera: Camera) -> Array:
    """An image [H, W] seen through an ideal lens: convolved with `airy_kernel`, mirrored at its edges, float64."""
    from scipy import signal

    kernel = airy_kernel(camera)
    reach = kernel.shape[0] // 2
    padded = np.pad(np.asarray(image, np.float64), reach, mode="symmetric")
    return np.maximum(signal.fftconvolve(padded, kernel, mode="valid"), 0.0)

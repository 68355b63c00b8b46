"""Computes the expected photons of a clip's frames, and the light level of a clip for a sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy import ndarray as Array

from qsim.clip.clip_folder import ClipFolder
from qsim.host import own_numbers
from qsim.lazy_array import Crop
from qsim.optics.camera import checked_pitch
from qsim.optics.diffraction import diffract
from qsim.optics.radiometry import (
    LightLevel,
    band_photons,
    expected_photons,
    photons_per_lux,
    photons_per_lux_of,
    photopic,
    ppp_factor,
)
from qsim.sensor.colour_filter import ColourFilter

EXAMPLE_PITCH = 1.1e-6  # m, of a QIS: what the message about lux without a lens gives as an example
_MOST = 1e12  # photons per pixel and frame: the exact laws are tested up to it


@own_numbers
def light_level(
    clip: ClipFolder, *, ppp: float | None = None, lux: float | None = None, pixel_pitch: float | None = None
) -> LightLevel:
    """Return the light level of a clip: `ppp` photons per pixel, `lux` on the faceplate, or factor 1 without either.

    `pixel_pitch` [m] is that of a clip without a camera (relative radiance), whose pixels are square and photosensitive
    all over; it needs either target. `ValueError` for a black clip, for both targets at once, for such a clip without
    a target, or with `lux` and no pitch, for a pitch beside a camera, and above 1e12 photons.
    """
    if ppp is not None and lux is not None:
        raise ValueError(f"{clip.name}: give the light level as ppp or as lux, not both")
    camera = clip.camera
    if camera is None:
        return _relative_level(clip, ppp, lux, pixel_pitch)
    if pixel_pitch is not None:
        raise ValueError(
            f"{clip.name}: its camera has pixels of {1e6 * camera.pixel_pitch:g} um; leave pixel_pitch= out"
        )
    per_lux = photons_per_lux(camera, clip.exposure)
    if lux is not None:
        ppp = lux * per_lux
    factor = 1.0 if ppp is None else ppp_factor(clip.mean_photons, ppp, clip.name)
    level = _checked(clip, clip.mean_photons if ppp is None else ppp)
    return LightLevel(factor, level, clip.mean_photons, level / per_lux)


def _relative_level(clip: ClipFolder, ppp: float | None, lux: float | None, pixel_pitch: float | None) -> LightLevel:
    """Return the light level of a clip without a camera; see `light_level`."""
    if ppp is None and lux is None:
        raise ValueError(
            f"{clip.name}: its radiance is relative (imported video) and has no absolute light; "
            "give a target in photons per pixel, as in ppp=3.25"
        )
    if lux is not None and pixel_pitch is None:
        one = photons_per_lux_of(EXAMPLE_PITCH**2, clip.exposure)
        raise ValueError(
            f"{clip.name}: its radiance is relative (imported video) and has no pixel size, which lux need; give "
            f"pixel_pitch=, as in pixel_pitch={EXAMPLE_PITCH:g}, where 1 lx at 555 nm is {one:.3g} PPP in "
            f"{1e3 * clip.exposure:.4g} ms; or ppp="
        )
    per_lux = None
    if pixel_pitch is not None:
        per_lux = photons_per_lux_of(checked_pitch(pixel_pitch, f"{clip.name}: pixel_pitch=") ** 2, clip.exposure)
        if lux is not None:
            ppp = lux * per_lux
    assert ppp is not None
    factor = ppp_factor(clip.mean_radiance, ppp, clip.name)
    return LightLevel(factor, _checked(clip, ppp), clip.mean_radiance, None if per_lux is None else ppp / per_lux)


def _checked(clip: ClipFolder, ppp: float) -> float:
    """Return the mean photons per pixel; `ValueError` for more than the sensor models are made for."""
    if ppp > _MOST:
        raise ValueError(f"{clip.name}: {ppp:.3g} photons per pixel and frame are too many; give at most {_MOST:g}")
    return ppp


@own_numbers
def clip_photons(
    clip: ClipFolder,
    t: int,
    factor: float = 1.0,
    crop: Crop | None = None,
    *,
    sharp: bool = False,
    diffraction: bool = False,
) -> Array:
    """Return expected photons float64 [h, w] of frame t, or of its sharp instant, times a factor.

    Of a colour clip they are [3, h, w], the photons of each band. `crop` = (y, x, height, width) [px]; `diffraction`
    blurs by the lens's Airy pattern.
    """
    if diffraction and crop is not None:
        # Light from outside of a crop reaches into it, so the whole frame is blurred and cut afterwards.
        whole = clip_photons(clip, t, factor, sharp=sharp, diffraction=True)
        y, x, height, width = crop
        return whole[..., y : y + height, x : x + width]
    radiance = clip.sharp(t, crop) if sharp else clip.radiance(t, crop)
    camera = None if clip.camera is None else clip.camera.at(t / clip.frame_rate)
    if camera is None:
        if diffraction:
            raise ValueError(f"{clip.name}: diffraction needs a camera, and this clip's radiance is relative")
        return radiance.astype(np.float64) * factor
    y, x = clip.origin
    if crop is not None:
        y = y + crop[0]
        x = x + crop[1]
    if clip.bands is not None:
        if diffraction:
            # The Airy disk grows with the wavelength: each band has its own.
            cameras = [replace(camera, wavelength=wavelength) for wavelength in clip.bands]
            radiance = np.stack([diffract(*each) for each in zip(radiance, cameras, strict=True)])
        return band_photons(radiance, camera, clip.exposure, clip.bands, origin=(y, x)) * factor
    if diffraction:
        radiance = diffract(radiance, camera)
    return expected_photons(radiance, camera, clip.exposure, origin=(y, x)) * factor


def light_line(
    level: LightLevel,
    efficiency: float,
    filters: ColourFilter | None = None,
    bands: Sequence[float] | None = None,
) -> str:
    """Return a one-line summary of the light level of a sensor; behind filters the electrons of equal bands.

    `light scaled by 0.1228 to 3.25 photons/pixel (2.6 e-, equivalent to 1.313 lx at 555 nm)`; of a colour clip, whose
    level is the mean over `bands` [m], also the photons of all bands, and photopic lux if all have equally many.
    """
    lux = "" if level.lux is None else f", equivalent to {level.lux:.4g} lx at 555 nm"
    electrons = f"{level.ppp * efficiency:.3g} e-"
    unit = "photons/pixel"
    if filters is not None:
        electrons = f"about {level.ppp * filters.mean_efficiency(efficiency):.3g} e- with equal bands"
    if bands is not None:
        unit = f"photons/pixel and band, {len(bands) * level.ppp:.4g} of all bands"
        lux = "" if level.lux is None else f", photons of {level.lux:.4g} lx at 555 nm in each band"
        lux += "" if level.lux is None else f", together {level.lux * photopic(bands):.4g} photopic lx"
    return f"light scaled by {level.factor:.4g} to {level.ppp:.4g} {unit} ({electrons}{lux})"

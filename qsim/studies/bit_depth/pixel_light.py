"""Gives the light that the pixels of a study see: that of the clip, or of a colour clip that behind their filters.

A pixel sees one colour, so a mosaic [H, W] is studied as the light of one band is.
"""

from __future__ import annotations

from numpy import ndarray as Array

from qsim.sensor.colour_filter import MASKS, ColourFilter
from qsim.streams.clip import Clip
from qsim.streams.photons import clip_photons


def check_bands(clip: Clip, mask: str | None) -> None:
    """Raise `ValueError` for a colour clip without a mask, and for a mask over a clip of one band."""
    if clip.bands is not None and mask is None:
        raise ValueError(f"{clip.path}: holds three bands; say what its pixels see, as in colour=rggb")
    if clip.bands is None and mask is not None:
        raise ValueError(f"{clip.path}: has one band; leave colour={mask} out, or render it with bands=rgb")


def pixel_light(clip: Clip, t: int, factor: float, mask: str | None, *, sharp: bool = False) -> Array:
    """Return the expected photons [H, W] of clip frame t, times `factor`, each pixel behind its filter of the mask.

    Filters pass all light of their band. `mask` is a name of `MASKS`; None for a clip of one band.
    """
    photons = clip_photons(clip, t, factor, sharp=sharp)
    if mask is None:
        return photons
    return ColourFilter(MASKS[mask]).mosaic(photons, 1.0, clip.origin)

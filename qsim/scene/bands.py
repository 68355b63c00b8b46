"""Describes colour as three values, of the bands R, G and B, in the records of scenes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from qsim.optics.radiometry import RGB

Colour = tuple[float, float, float]  # values of the bands R, G and B
Bands = tuple[float, float, float]  # m, wavelengths of R, G and B

PER_BAND = frozenset(
    {"reflectance", "radiance", "emission", "intensity", "irradiance", "eta", "k", "sun_irradiance", "sky_irradiance"}
)


def numbers(value: Any) -> Iterator[float]:
    """Yield the values of a number or of a colour; nothing if it is neither."""
    given = value if isinstance(value, tuple) and len(value) == 3 else (value,)
    if all(isinstance(each, int | float | np.number) and np.isfinite(each) for each in given):
        yield from given


def three(value: float | Colour) -> Colour:
    """Return a number as a grey colour, and a colour as it is."""
    return value if isinstance(value, tuple) else (value, value, value)


def largest(value: float | Colour) -> float:
    """Return the largest value of a colour, and a number as it is."""
    return max(three(value))


def has_colour(record: Any) -> bool:
    """Return whether a material or a light states a quantity, or the picture of one, per band."""
    if any(has_colour(part) for part in getattr(record, "materials", ())):
        return True
    values = [getattr(value, "image", value) for name, value in vars(record).items() if name in PER_BAND]
    return any(isinstance(value, tuple) or (isinstance(value, np.ndarray) and value.ndim == 3) for value in values)


def check_bands(bands: Bands | None, where: str) -> None:
    """Raise `ValueError` for bands that are neither None nor three wavelengths [m]."""
    right = isinstance(bands, tuple) and len(bands) == 3 and all(1e-7 < wavelength < 1e-5 for wavelength in bands)
    if bands is not None and not right:
        raise ValueError(f"{where}: bands are three wavelengths in m, as in {RGB}, or None; got {bands!r}")

"""Converts radiance to expected photons: camera, lens, exposure, light level, diffraction. Nothing is random."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from qsim.optics.camera import Camera
    from qsim.optics.diffraction import diffract
    from qsim.optics.lens import Lens
    from qsim.optics.radiometry import RGB, WHITE_PER_MEAN, LightLevel, band_photons, expected_photons, photons_per_lux
    from qsim.optics.zoom import Zoom

__all__ = [
    "RGB",
    "WHITE_PER_MEAN",
    "Camera",
    "Lens",
    "LightLevel",
    "Zoom",
    "band_photons",
    "diffract",
    "expected_photons",
    "photons_per_lux",
]

__getattr__ = lazy_names(
    __name__,
    {
        "Camera": "camera",
        "Lens": "lens",
        "LightLevel": "radiometry",
        "RGB": "radiometry",
        "WHITE_PER_MEAN": "radiometry",
        "Zoom": "zoom",
        "band_photons": "radiometry",
        "diffract": "diffraction",
        "expected_photons": "radiometry",
        "photons_per_lux": "radiometry",
    },
)

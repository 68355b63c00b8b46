"""Converts radiance to expected photons: camera, lens, exposure, light level, diffraction. Nothing is random."""

from typing import TYPE_CHECKING

from qsim.files import lazy_names

if TYPE_CHECKING:
    from qsim.optics.camera import Camera
    from qsim.optics.diffraction import diffract
    from qsim.optics.radiometry import WHITE_PER_MEAN, LightLevel, expected_photons, photons_per_lux

__all__ = ["WHITE_PER_MEAN", "Camera", "LightLevel", "diffract", "expected_photons", "photons_per_lux"]

__getattr__ = lazy_names(
    __name__,
    {
        "Camera": "camera",
        "LightLevel": "radiometry",
        "WHITE_PER_MEAN": "radiometry",
        "diffract": "diffraction",
        "expected_photons": "radiometry",
        "photons_per_lux": "radiometry",
    },
)

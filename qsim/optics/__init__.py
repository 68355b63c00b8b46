"""Converts radiance to expected photons: camera, lens, exposure, light level, diffraction. Nothing is random."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

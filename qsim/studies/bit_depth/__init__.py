"""Finds the best bit depth for a motion and a light level."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

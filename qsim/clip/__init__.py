"""Reads and writes the folder of a clip: radiance, ground truth and their description."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

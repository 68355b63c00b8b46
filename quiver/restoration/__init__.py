"""Restores clips of any size with any method, in bounded memory."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

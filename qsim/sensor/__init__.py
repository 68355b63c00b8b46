"""Converts expected photons to codes: exact laws, keyed draws, pixel defects, named devices, bit packing."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

"""Reads recordings of other programs as clips and streams, and writes ours for them."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

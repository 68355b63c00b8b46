"""Describes scenes: bodies, materials, lights and motions as frozen records, without a renderer."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

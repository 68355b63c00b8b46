"""Defines the networks, pure functions of codes, and their weights files."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

"""Reads the command line of `qsim` and runs its commands."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

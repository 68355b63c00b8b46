"""Scores methods, measures their costs, and writes tables of both."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

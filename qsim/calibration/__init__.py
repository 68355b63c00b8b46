"""Measures sensor parameters, with confidence intervals, from recorded frames."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

"""Renders scenes to radiance of a stated error, with ground truth. Only this room renders with Mitsuba."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

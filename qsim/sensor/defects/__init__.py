"""Models deviations from an ideal pixel: fixed-pattern and correlated noise; simulates photons one by one."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

"""Makes data sets from recipes: jobs, workers, resuming, provenance, and a forecast of the cost."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

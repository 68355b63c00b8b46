"""Shows clips, streams and stored results as pages and previews."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

"""What a sensor sees of a clip: its light, the codes drawn from it, and the streams that hold them."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

"""qsim: moving scenes at 2000 fps into the few-bit streams of quanta image sensors.

A notebook needs the names of `__all__` only; each is imported on first use.

    clip = qsim.render("fan", frames=21)
    stream = clip.sense("quiver-physical", ppp=3.25, bits=3)
"""

from qsim.files import VERSION
from qsim.lazy_imports import attach

__version__ = VERSION

__getattr__, __dir__, __all__ = attach(__name__, __file__)

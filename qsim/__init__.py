"""qsim: moving scenes at 2000 fps into the few-bit streams of quanta image sensors."""

__version__ = "0.1.0"

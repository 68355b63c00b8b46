"""Publishes data sets for programs without qsim, and reads what was published: shards, a data card, metadata."""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

"""Restores video by classical methods, which need no training."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from quiver.baselines.methods import METHODS, Method

__all__ = ["METHODS", "Method"]

__getattr__ = lazy_names(
    __name__,
    {
        "METHODS": "methods",
        "Method": "methods",
    },
)

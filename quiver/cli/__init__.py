"""Reads the command line of `quiver` and runs its commands."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from quiver.cli.program import main

__all__ = ["main"]

__getattr__ = lazy_names(
    __name__,
    {
        "main": "program",
    },
)

"""Codes and training windows out of qsim's files."""

from typing import TYPE_CHECKING

from qsim.files import lazy_names

if TYPE_CHECKING:
    from quiver.data.codes import open_clips

__all__ = ["open_clips"]

__getattr__ = lazy_names(
    __name__,
    {
        "open_clips": "codes",
    },
)

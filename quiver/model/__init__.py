"""The networks: pure functions of codes, and their weights."""

from typing import TYPE_CHECKING

from qsim.files import lazy_names

if TYPE_CHECKING:
    from quiver.model.quiver import QUIVER

__all__ = ["QUIVER"]

__getattr__ = lazy_names(
    __name__,
    {
        "QUIVER": "quiver",
    },
)

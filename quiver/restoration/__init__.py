"""Restores clips of any size with any method, in bounded memory."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from quiver.restoration.api import restore
    from quiver.restoration.interface import RestoreOptions, Restorer
    from quiver.restoration.restored_file import restore_to_file
    from quiver.restoration.restorers import restorer

__all__ = ["RestoreOptions", "Restorer", "restore", "restore_to_file", "restorer"]

__getattr__ = lazy_names(
    __name__,
    {
        "RestoreOptions": "interface",
        "Restorer": "interface",
        "restore": "api",
        "restore_to_file": "restored_file",
        "restorer": "restorers",
    },
)

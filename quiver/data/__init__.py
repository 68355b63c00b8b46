"""Reads codes and training windows from qsim's files."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from quiver.data.clips import open_clips
    from quiver.data.codes import Codes, array_codes, sensed, stream_codes
    from quiver.data.illumination import Illumination
    from quiver.data.windows import Windows, WindowSettings

__all__ = [
    "Codes",
    "Illumination",
    "WindowSettings",
    "Windows",
    "array_codes",
    "open_clips",
    "sensed",
    "stream_codes",
]

__getattr__ = lazy_names(
    __name__,
    {
        "Codes": "codes",
        "Illumination": "illumination",
        "WindowSettings": "windows",
        "Windows": "windows",
        "array_codes": "codes",
        "open_clips": "clips",
        "sensed": "codes",
        "stream_codes": "codes",
    },
)

"""Reads recordings of other programs as clips and streams, and writes ours for them."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from qsim.formats.detection import detect
    from qsim.formats.exporting import export
    from qsim.formats.importing import read, to_clip, to_stream
    from qsim.formats.recording import Recording

__all__ = ["Recording", "detect", "export", "read", "to_clip", "to_stream"]

__getattr__ = lazy_names(
    __name__,
    {
        "Recording": "recording",
        "detect": "detection",
        "export": "exporting",
        "read": "importing",
        "to_clip": "importing",
        "to_stream": "importing",
    },
)

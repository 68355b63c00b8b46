"""Other programs' files into clips and streams, and back."""

from typing import TYPE_CHECKING

from qsim.files import lazy_names

if TYPE_CHECKING:
    from qsim.formats.exporting import export
    from qsim.formats.importing import detect, read, to_clip, to_stream

__all__ = ["detect", "export", "read", "to_clip", "to_stream"]

__getattr__ = lazy_names(
    __name__,
    {
        "detect": "importing",
        "export": "exporting",
        "read": "importing",
        "to_clip": "importing",
        "to_stream": "importing",
    },
)

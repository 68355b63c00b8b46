"""Reads and writes the folder of a clip: radiance, ground truth and their description."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from qsim.clip.clip_folder import ClipFolder
    from qsim.clip.clip_info import ClipInfo
    from qsim.clip.writer import ClipWriter

__all__ = ["ClipFolder", "ClipInfo", "ClipWriter"]

__getattr__ = lazy_names(__name__, {"ClipFolder": "clip_folder", "ClipInfo": "clip_info", "ClipWriter": "writer"})

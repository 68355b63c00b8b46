"""Reads and writes clips: radiance, ground truth and packed streams; simulates streams from radiance."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from qsim.clip.clip import Clip
    from qsim.clip.photons import clip_photons, light_level
    from qsim.clip.sensing import Sensing, replay, sense
    from qsim.clip.stream import Stream
    from qsim.clip.writer import ClipWriter

__all__ = ["Clip", "ClipWriter", "Sensing", "Stream", "clip_photons", "light_level", "replay", "sense"]

__getattr__ = lazy_names(
    __name__,
    {
        "Clip": "clip",
        "ClipWriter": "writer",
        "clip_photons": "photons",
        "light_level": "photons",
        "Sensing": "sensing",
        "Stream": "stream",
        "replay": "sensing",
        "sense": "sensing",
    },
)

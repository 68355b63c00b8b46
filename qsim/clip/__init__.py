"""The folder on disk: radiance, ground truth and packed streams, and how a stream is drawn from light."""

from typing import TYPE_CHECKING

from qsim.files import lazy_names

if TYPE_CHECKING:
    from qsim.clip.clip import Clip
    from qsim.clip.stream import Sensing, Stream, replay, sense
    from qsim.clip.writer import ClipWriter

__all__ = ["Clip", "ClipWriter", "Sensing", "Stream", "replay", "sense"]

__getattr__ = lazy_names(
    __name__,
    {
        "Clip": "clip",
        "ClipWriter": "writer",
        "Sensing": "stream",
        "Stream": "stream",
        "replay": "stream",
        "sense": "stream",
    },
)

"""What a sensor sees of a clip: its light, the codes drawn from it, and the streams that hold them."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from qsim.streams.clip import Clip
    from qsim.streams.photons import clip_photons, light_level
    from qsim.streams.sensing import Sensing, replay, sense
    from qsim.streams.stream import Stream

__all__ = ["Clip", "Sensing", "Stream", "clip_photons", "light_level", "replay", "sense"]

__getattr__ = lazy_names(
    __name__,
    {
        "Clip": "clip",
        "clip_photons": "photons",
        "light_level": "photons",
        "Sensing": "sensing",
        "Stream": "stream",
        "replay": "sensing",
        "sense": "sensing",
    },
)

from .clip import Clip as Clip
from .photons import clip_photons as clip_photons
from .photons import light_level as light_level
from .sensing import Sensing as Sensing
from .storing import replay as replay
from .storing import sense as sense
from .stream import Stream as Stream

from .clips import open_clips as open_clips
from .codes import Codes as Codes
from .codes import array_codes as array_codes
from .codes import sensed as sensed
from .codes import stream_codes as stream_codes
from .illumination import Illumination as Illumination
from .windows import Windows as Windows
from .windows import WindowSettings as WindowSettings

from .clip_folder import ClipFolder as ClipFolder
from .clip_info import ClipInfo as ClipInfo
from .writer import ClipWriter as ClipWriter

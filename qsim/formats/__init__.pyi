from .detection import detect as detect
from .exporting import export as export
from .importing import read as read
from .importing import to_clip as to_clip
from .importing import to_stream as to_stream
from .recording import Recording as Recording

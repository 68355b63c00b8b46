from .clip_study import Study as Study
from .clip_study import study as study
from .laws import Structure as Structure
from .laws import depths as depths
from .readout import Readout as Readout
from .readout import StudySettings as StudySettings
from .speed_sweep import Sweep as Sweep
from .speed_sweep import sweep as sweep

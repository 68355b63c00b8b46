"""Finds the best bit depth for a motion and a light level."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from qsim.studies.bit_depth.clip_study import Study, study
    from qsim.studies.bit_depth.laws import Structure, depths
    from qsim.studies.bit_depth.readout import Readout, StudySettings
    from qsim.studies.bit_depth.speed_sweep import Sweep, sweep

__all__ = ["Readout", "Structure", "Study", "StudySettings", "Sweep", "depths", "study", "sweep"]

__getattr__ = lazy_names(
    __name__,
    {
        "Readout": "readout",
        "Structure": "laws",
        "Study": "clip_study",
        "StudySettings": "readout",
        "Sweep": "speed_sweep",
        "depths": "laws",
        "study": "clip_study",
        "sweep": "speed_sweep",
    },
)

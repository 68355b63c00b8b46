"""Measures sensor parameters, with confidence intervals, from recorded frames."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from qsim.calibration.frame_statistics import FrameStatistics, measure, measure_sums
    from qsim.calibration.qis import calibrate_qis
    from qsim.calibration.results import Calibration
    from qsim.calibration.spad import calibrate_spad

__all__ = ["Calibration", "FrameStatistics", "calibrate_qis", "calibrate_spad", "measure", "measure_sums"]

__getattr__ = lazy_names(
    __name__,
    {
        "Calibration": "results",
        "FrameStatistics": "frame_statistics",
        "calibrate_qis": "qis",
        "calibrate_spad": "spad",
        "measure": "frame_statistics",
        "measure_sums": "frame_statistics",
    },
)

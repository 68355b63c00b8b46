from .frame_statistics import FrameStatistics as FrameStatistics
from .frame_statistics import measure as measure
from .frame_statistics import measure_sums as measure_sums
from .qis import calibrate_qis as calibrate_qis
from .results import Calibration as Calibration
from .spad import calibrate_spad as calibrate_spad

"""Converts expected photons to codes: exact laws, keyed draws, pixel defects, named devices, bit packing."""

from typing import TYPE_CHECKING

from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from qsim.sensor.counting import CountingSPAD
    from qsim.sensor.defects.pixel_array import PixelArray
    from qsim.sensor.devices import load
    from qsim.sensor.estimation import Response
    from qsim.sensor.packing import pack, unpack
    from qsim.sensor.qis import QIS
    from qsim.sensor.sensor import Sensor
    from qsim.sensor.spad import BinarySPAD
    from qsim.sensor.spike import SpikeCamera

__all__ = [
    "QIS",
    "BinarySPAD",
    "CountingSPAD",
    "PixelArray",
    "Response",
    "Sensor",
    "SpikeCamera",
    "load",
    "pack",
    "unpack",
]

__getattr__ = lazy_names(
    __name__,
    {
        "BinarySPAD": "spad",
        "CountingSPAD": "counting",
        "PixelArray": "defects.pixel_array",
        "QIS": "qis",
        "Response": "estimation",
        "Sensor": "sensor",
        "SpikeCamera": "spike",
        "load": "devices",
        "pack": "packing",
        "unpack": "packing",
    },
)

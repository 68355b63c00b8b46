"""qsim: moving scenes at 2000 fps into the few-bit streams of quanta image sensors.

The names of `__all__` are all that a notebook needs; each is imported when it is first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from qsim.clip.clip import Clip, ClipWriter
    from qsim.clip.stream import Sensing, Stream, sense
    from qsim.dataset.dataset import Dataset
    from qsim.keys import Key
    from qsim.optics.camera import Camera
    from qsim.rendering.mitsuba_xml import read_mitsuba
    from qsim.scene.scene import Scene
    from qsim.sensor.counting import CountingSPAD
    from qsim.sensor.qis import QIS
    from qsim.sensor.sensor import Sensor
    from qsim.sensor.spad import BinarySPAD

__version__ = "0.1.0"

_HOMES = {
    "BinarySPAD": "sensor.spad",
    "Camera": "optics.camera",
    "Clip": "clip.clip",
    "ClipWriter": "clip.writer",
    "CountingSPAD": "sensor.counting",
    "Dataset": "dataset.dataset",
    "Key": "keys",
    "QIS": "sensor.qis",
    "Scene": "scene.scene",
    "Sensing": "clip.stream",
    "Sensor": "sensor.sensor",
    "Stream": "clip.stream",
    "read_mitsuba": "rendering.mitsuba_xml",
    "sense": "clip.stream",
}

__all__ = [
    "QIS",
    "BinarySPAD",
    "Camera",
    "Clip",
    "ClipWriter",
    "CountingSPAD",
    "Dataset",
    "Key",
    "Scene",
    "Sensing",
    "Sensor",
    "Stream",
    "read_mitsuba",
    "sense",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'qsim' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"qsim.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

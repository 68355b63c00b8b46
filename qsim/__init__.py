"""qsim: moving scenes at 2000 fps into the few-bit streams of quanta image sensors.

The names of `__all__` are all that a notebook needs; each is imported when it is first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from qsim.clip import Clip, ClipWriter
    from qsim.dataset import Dataset
    from qsim.keys import Key
    from qsim.qis import QIS
    from qsim.scene import Camera, Scene
    from qsim.sensor import Sensor
    from qsim.spad import BinarySPAD, CountingSPAD
    from qsim.stream import Sensing, Stream, sense

__version__ = "0.1.0"

_HOMES = {
    "BinarySPAD": "spad",
    "Camera": "scene",
    "Clip": "clip",
    "ClipWriter": "clip",
    "CountingSPAD": "spad",
    "Dataset": "dataset",
    "Key": "keys",
    "QIS": "qis",
    "Scene": "scene",
    "Sensing": "stream",
    "Sensor": "sensor",
    "Stream": "stream",
    "sense": "stream",
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
    "sense",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'qsim' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"qsim.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

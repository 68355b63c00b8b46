"""qsim: moving scenes at 2000 fps into the few-bit streams of quanta image sensors.

A notebook needs the names of `__all__` only; each is imported on first use.

    clip = qsim.render("fan", frames=21)
    stream = clip.sense("quiver-physical", ppp=3.25, bits=3)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from qsim.files import VERSION
from qsim.lazy_imports import lazy_names

if TYPE_CHECKING:
    from qsim.calibration.qis import calibrate_qis
    from qsim.calibration.spad import calibrate_spad
    from qsim.clip.clip_info import ClipInfo
    from qsim.clip.writer import ClipWriter
    from qsim.dataset.dataset import Dataset
    from qsim.dataset.scene_rendering import render
    from qsim.keys import Key
    from qsim.optics.camera import Camera
    from qsim.optics.radiometry import expected_photons
    from qsim.rendering.budget import Budget
    from qsim.rendering.clip_rendering import render_clip
    from qsim.rendering.fidelity import choose_budget
    from qsim.rendering.mitsuba_xml import read_mitsuba
    from qsim.rendering.renderer import Renderer
    from qsim.scene import Scene
    from qsim.sensor.counting import CountingSPAD
    from qsim.sensor.devices import load as load_sensor
    from qsim.sensor.packing import pack, unpack
    from qsim.sensor.qis import QIS
    from qsim.sensor.sensor import Sensor
    from qsim.sensor.spad import BinarySPAD
    from qsim.sensor.spike import SpikeCamera
    from qsim.streams.clip import Clip
    from qsim.streams.sensing import Sensing, replay, sense
    from qsim.streams.stream import Stream

__version__ = VERSION

_HOMES = {
    "BinarySPAD": "sensor.spad",
    "Camera": "optics.camera",
    "Budget": "rendering.budget",
    "Clip": "streams.clip",
    "ClipInfo": "clip.clip_info",
    "ClipWriter": "clip.writer",
    "CountingSPAD": "sensor.counting",
    "Dataset": "dataset.dataset",
    "Key": "keys",
    "QIS": "sensor.qis",
    "Renderer": "rendering.renderer",
    "Scene": "scene.scene",
    "Sensing": "streams.sensing",
    "Sensor": "sensor.sensor",
    "SpikeCamera": "sensor.spike",
    "Stream": "streams.stream",
    "read_mitsuba": "rendering.mitsuba_xml",
    "calibrate_qis": "calibration.qis",
    "calibrate_spad": "calibration.spad",
    "choose_budget": "rendering.fidelity",
    "expected_photons": "optics.radiometry",
    "load_sensor": "sensor.devices:load",
    "pack": "sensor.packing",
    "render": "dataset.scene_rendering",
    "render_clip": "rendering.clip_rendering",
    "replay": "streams.sensing",
    "sense": "streams.sensing",
    "unpack": "sensor.packing",
}

__all__ = [
    "QIS",
    "BinarySPAD",
    "Budget",
    "Camera",
    "Clip",
    "ClipInfo",
    "ClipWriter",
    "CountingSPAD",
    "Dataset",
    "Key",
    "Renderer",
    "Scene",
    "Sensing",
    "Sensor",
    "SpikeCamera",
    "Stream",
    "calibrate_qis",
    "calibrate_spad",
    "choose_budget",
    "expected_photons",
    "load_sensor",
    "pack",
    "read_mitsuba",
    "render",
    "render_clip",
    "replay",
    "sense",
    "unpack",
]

__getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

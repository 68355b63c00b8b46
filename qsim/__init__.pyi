from .calibration.qis import calibrate_qis as calibrate_qis
from .calibration.spad import calibrate_spad as calibrate_spad
from .clip.clip_info import ClipInfo as ClipInfo
from .clip.writer import ClipWriter as ClipWriter
from .dataset.dataset import Dataset as Dataset
from .dataset.scene_rendering import render as render
from .formats.importing import from_video as from_video
from .keys import Key as Key
from .optics.camera import Camera as Camera
from .optics.radiometry import expected_photons as expected_photons
from .plane_sums import PlaneSums as PlaneSums
from .rendering.budget import Budget as Budget
from .rendering.clip_rendering import render_clip as render_clip
from .rendering.fidelity import choose_budget as choose_budget
from .rendering.mitsuba_xml import read_mitsuba as read_mitsuba
from .rendering.renderer import Renderer as Renderer
from .scene.scene import Scene as Scene
from .sensor.counting import CountingSPAD as CountingSPAD
from .sensor.devices import load as load_sensor  # noqa: F401  (public name)
from .sensor.drawn import DrawnSensor as DrawnSensor
from .sensor.event_camera import EventCamera as EventCamera
from .sensor.packing import pack as pack
from .sensor.packing import unpack as unpack
from .sensor.qis import QIS as QIS
from .sensor.sensor import Sensor as Sensor
from .sensor.spad import BinarySPAD as BinarySPAD
from .sensor.spike import SpikeCamera as SpikeCamera
from .streams.clip import Clip as Clip
from .streams.event_stream import EventStream as EventStream
from .streams.sensing import Sensing as Sensing
from .streams.storing import replay as replay
from .streams.storing import sense as sense
from .streams.stream import Stream as Stream

__version__: str

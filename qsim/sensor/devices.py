"""Names sensors, every number with its source, and reads sensors from a user's TOML file.

A number that its maker or authors did not publish is left out. A detection efficiency of 1 with the note "detected
photons" means that light is to be given as photons that this sensor detects. A fill factor belongs to the camera
(`optics.Camera.fill_factor`), never to the sensor, so that it enters once.

    load("quiver-physical", ppp=3.25)     load("spad-320x240", bits=3)     load("my_sensor.toml")

    # my_sensor.toml: the fields and units of the sensor classes, nothing else
    [sensor]
    model = "QIS"                # QIS, BinarySPAD, CountingSPAD or SpikeCamera
    quantum_efficiency = 0.8     # electrons per photon
    dark_current = 1.6           # e-/s
    read_noise = 0.2             # e- rms
    bits = 3
    # median, dark_doubling, qe_curve ...: the laws of file_laws.py
    # full_well = 10000          # e-; a QIS with iso = 400 in place of gain fills its code by a quarter of it
    [sources]                    # optional: one sentence per field
    read_noise = "photon transfer of 2026-05-03, 25 C"
    [defects]                    # optional: hot and dead pixels, PRNU, afterpulses, crosstalk ...: see defect_table.py
    prnu = 0.01
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import TypedDict

from qsim import files, plugins
from qsim.checks import ArgumentError, file_path, suggest
from qsim.host import own_numbers
from qsim.records import convert
from qsim.sensor import file_laws
from qsim.sensor.counting import CountingSPAD
from qsim.sensor.event_camera import CAMERAS, EventCamera
from qsim.sensor.file_laws import NOTHING, Conditions
from qsim.sensor.qis import QIS
from qsim.sensor.sensor import Sensor
from qsim.sensor.spad import BinarySPAD
from qsim.sensor.spike import SpikeCamera

MODELS: Mapping[str, type[Sensor]] = MappingProxyType(
    {"QIS": QIS, "BinarySPAD": BinarySPAD, "CountingSPAD": CountingSPAD, "SpikeCamera": SpikeCamera}
)

_QUIVER_QE = 0.8  # e- per photon; Chennuri et al., "Quanta Video Restoration", ECCV 2024, simulation settings
_QUIVER_READ_NOISE = 0.2  # e- rms; same
_QUIVER_DARK = 1.6  # e-/pixel/s in the text of the same paper, e-/pixel/FRAME in its authors' program


def quiver_paper(bits: int = 3) -> QIS:
    """Return the sensor of the QUIVER paper's text: gain 1, dark current per second.

    Two thirds of a flat field saturate at 9.75 PPP.
    """
    return QIS(_QUIVER_QE, _QUIVER_DARK, _QUIVER_READ_NOISE, bits)


def quiver_published(ppp: float, bits: int = 3, exposure: float = 5e-4) -> QIS:
    """Return the sensor of the QUIVER authors' program.

    It has 1.6 e- dark per frame of `exposure` [s] and the gain 0.5 (2^b - 1) / PPP.
    """
    if not exposure > 0:
        raise ValueError(f"quiver-published: the exposure is in seconds and above 0, got {exposure!r}")
    return QIS(_QUIVER_QE, _QUIVER_DARK / exposure, _QUIVER_READ_NOISE, bits, gain=_gain("quiver-published", ppp, bits))


def quiver_physical(ppp: float, bits: int = 3) -> QIS:
    """Return our default: dark current per second as in the paper's text, and the program's gain, but at most 1.

    The gain is min(0.5 (2^b - 1) / PPP, 1) codes per electron. A larger one leaves codes unused: at 0.5 PPP and 3 bits
    the program's rule makes 7 codes per electron, and frames hold little but 0 and 7.
    """
    gain = min(_gain("quiver-physical", ppp, bits), 1.0)
    return QIS(_QUIVER_QE, _QUIVER_DARK, _QUIVER_READ_NOISE, bits, gain=gain)


def _gain(name: str, ppp: float, bits: int) -> float:
    """Return the gain 0.5 (2^b - 1) / PPP [codes/e-]: the mean light level falls on half of the code range."""
    if not 0 < ppp < float("inf"):
        raise ValueError(f"{name}: the gain follows the light level; give the photons per pixel above 0, got {ppp!r}")
    return 0.5 * (2**bits - 1) / ppp


def _cmos(bits: int) -> QIS:
    """Return a conventional pixel of 5.1 e- read noise; `ValueError` for codes that end near its black."""
    if bits < 8:
        raise ValueError("cmos-5.1e: black is at code 32; give 8 bits or more")
    return QIS(_QUIVER_QE, _QUIVER_DARK, 5.1, bits, gain=1.0, offset=32.0)


@dataclass(frozen=True)
class Device:
    """One named sensor: the function that makes it, and the source of each number."""

    name: str
    what: str  # one line
    bits: int  # unless the caller gives others
    make: Callable[[float | None, int, float], Sensor]  # (ppp, bits, exposure [s]) -> Sensor
    sources: Mapping[str, str]  # field -> source, condition
    follows_light: bool = False  # the gain is set from the PPP
    median: bool = False  # its dark rate is that of the median pixel


_QUIVER_SOURCES = {
    "quantum_efficiency": "0.8; Chennuri et al., Quanta Video Restoration, ECCV 2024, simulation settings",
    "read_noise": "0.2 e- rms; same paper (also its figure 1)",
}
_RULE = "0.5 (2^bits - 1) / PPP; the rule behind the default of the authors' program, 1.0769 at 3.25 PPP and 3 bits"
_PHYSICAL_RULE = "min(0.5 (2^bits - 1) / PPP, 1); the same rule, with at most one code per electron; our choice"


def _need(name: str, ppp: float | None) -> float:
    if ppp is None:
        raise ValueError(f"{name}: the gain follows the light level; give the photons per pixel (ppp=)")
    return ppp


DEVICES: Mapping[str, Device] = MappingProxyType(
    {
        device.name: device
        for device in (
            Device(
                "quiver-physical",
                "QUIVER's sensor with the text's dark current and the program's gain, at most 1 (default)",
                3,
                lambda ppp, bits, exposure: quiver_physical(_need("quiver-physical", ppp), bits),
                {**_QUIVER_SOURCES, "dark_current": "1.6 e-/s; same paper, text", "gain": _PHYSICAL_RULE},
                follows_light=True,
            ),
            Device(
                "quiver-paper",
                "QUIVER's sensor as its paper's text has it: gain 1",
                3,
                lambda ppp, bits, exposure: quiver_paper(bits),
                {**_QUIVER_SOURCES, "dark_current": "1.6 e-/s; same paper, text", "gain": "1; the text names no gain"},
            ),
            Device(
                "quiver-published",
                "QUIVER's sensor as its authors' program has it: dark electrons per frame",
                3,
                lambda ppp, bits, exposure: quiver_published(_need("quiver-published", ppp), bits, exposure),
                {
                    **_QUIVER_SOURCES,
                    "dark_current": "1.6 e- per frame (so 1.6/exposure); the authors' published program",
                    "gain": _RULE,
                },
                follows_light=True,
            ),
            Device(
                "cmos-5.1e",
                "conventional CMOS pixel for comparison, 10 to 12 bits",
                10,
                lambda ppp, bits, exposure: _cmos(bits),
                {
                    "read_noise": "5.1 e- rms; QUIVER paper, figure 1",
                    "quantum_efficiency": "0.8; set equal to the QIS, so that a comparison shows the read noise alone",
                    "dark_current": "1.6 e-/s; set equal to the QIS",
                    "gain": "1 code per electron; our choice",
                    "offset": "32 codes, six sigma of the read noise, so that black is not clipped; our choice",
                },
            ),
            Device(
                "spad-320x240",
                "the QUIVER paper's real camera: 320 x 240 clocked SPADs, 10 000 planes/s; a b-bit code sums 2^b - 1",
                1,
                lambda ppp, bits, exposure: BinarySPAD(1.0, 0.0, bits),
                {
                    "pde": "1, not published: give light in detected photons (the paper's 4.9 PPP per 7 planes)",
                    "dark_count_rate": "0, not published: dark counts are part of the detected photons",
                },
            ),
            Device(
                "qis-ma2017",
                "1 Mpixel stacked BSI quanta image sensor, 1.1 um pixels, up to 1040 fps",
                1,
                lambda ppp, bits, exposure: QIS(1.0, 0.2, 0.21, bits),
                {
                    "read_noise": "0.21 e- rms, array average, room temperature; Ma et al., Optica 4, 1474 (2017)",
                    "dark_current": "0.2 e-/s, an upper bound ('less than'), room temperature; same paper, abstract",
                    "quantum_efficiency": "1, left out: give light in generated electrons",
                    "gain": "1 code per electron; thresholds at half electrons",
                },
            ),
            Device(
                "megax-a",
                "1 Mpixel clocked SPAD array, pixel type A (7 transistors), 9.4 um, 24 000 planes/s",
                1,
                lambda ppp, bits, exposure: BinarySPAD(0.105, 0.4, bits),
                {
                    "pde": "0.105, peak probability on the active area (fill factor 0.070 goes to the camera), 3.3 V "
                    "excess bias; Morimoto et al., Optica 7, 346 (2020), arXiv:1912.12910",
                    "dark_count_rate": "0.4 /s, median, 3.3 V excess bias; same paper",
                },
                median=True,
            ),
            Device(
                "megax-b",
                "the same array, pixel type B (5.75 transistors)",
                1,
                lambda ppp, bits, exposure: BinarySPAD(0.267, 2.0, bits),
                {
                    "pde": "0.267, peak probability on the active area (fill factor 0.134 goes to the camera), 3.3 V "
                    "excess bias; Morimoto et al., Optica 7, 346 (2020), arXiv:1912.12910",
                    "dark_count_rate": "2.0 /s, median, 3.3 V excess bias; same paper",
                },
                median=True,
            ),
            Device(
                "spad512s",
                "512 x 512 clocked SPAD camera, up to 100 000 planes/s; deeper codes are sums of planes",
                1,
                lambda ppp, bits, exposure: BinarySPAD(0.5, 25.0, bits),
                {
                    "pde": "0.5 at 520 nm, on the active area; maker's product page (Pi Imaging SPAD512S)",
                    "dark_count_rate": "25 /s, upper bound of the typical pixel; same page",
                },
            ),
            Device(
                "spcm20a",
                "single counting SPAD module, 20 um active diameter",
                8,
                lambda ppp, bits, exposure: CountingSPAD(0.35, 25.0, 35e-9, bits),
                {
                    "pde": "0.35 at 500 nm, typical; maker's product page (Thorlabs SPCM20A)",
                    "dark_count_rate": "25 /s typical, 60 /s at most; same page",
                    "dead_time": "35 ns, from the page's 'a photon every 35 ns' (28 MHz at most); active quenching",
                    "paralyzable": "False; actively quenched",
                },
            ),
        )
    }
)


TABLES = ("sensor", "sources", "defects", "colour")  # of a file; defect_table.py and colour_filter.py read the last two


@own_numbers
def load(
    name: str | Path | Sensor,
    *,
    ppp: float | None = None,
    bits: int | None = None,
    exposure: float = 5e-4,
    conditions: Conditions = NOTHING,
) -> Sensor:
    """Return the sensor of a name in `DEVICES` or of a TOML file; a `Sensor` is returned as given.

    `ppp` [photons/pixel] sets the gain where it follows the light. `bits` replaces the device's own depth (a TOML file
    and a `Sensor` state their own). `exposure` [s] matters for dark electrons given per frame, `conditions` for the
    laws of a file (file_laws.py). `ValueError` names what is wrong.
    """
    if conditions.temperature is not None and (isinstance(name, Sensor) or str(name) in DEVICES):
        shown = type(name).__name__ if isinstance(name, Sensor) else name
        raise ValueError(
            f"{shown}: has no law of temperature; use a sensor file with dark_doubling and dark_reference, or leave "
            "the temperature out"
        )
    if isinstance(name, Sensor):
        if bits is not None and bits != name.bits:
            raise ValueError(f"{type(name).__name__}: has bits = {name.bits}, the request {bits}; change one of them")
        return name
    if str(name) in DEVICES:
        device = DEVICES[str(name)]
        made = device.make(ppp, device.bits if bits is None else bits, exposure)
        return made.with_dark_rate(made.dark_rate * conditions.dark.mean) if device.median and conditions.dark else made
    if (plugin := plugins.load(str(name), plugins.SENSORS)) is not None:
        return _of_plugin(plugin, {"ppp": ppp, "bits": bits, "exposure": exposure})
    path = file_path(name)
    if str(name) in CAMERAS:
        raise ValueError(f"{name}: is an event camera, which has no codes; draw its events with `qsim events`")
    if path.suffix != ".toml":
        raise ValueError(f"unknown sensor {str(name)!r}{suggest(str(name), names())}; `qsim sensors` lists all")
    sensor = from_toml(path, bits, conditions)
    if bits is not None and bits != sensor.bits:
        cure = "change one of them"
        if sensor.at_depth(bits) is not None:
            cure = f"{cure}, or delete the line of bits: such a file serves every depth"
        raise ValueError(f"{path}: the file has bits = {sensor.bits}, the request {bits}; {cure}")
    return sensor


def names() -> list[str]:
    """Return the names of all sensors: those of this package, and of installed ones."""
    return [*DEVICES, *plugins.installed(plugins.SENSORS)]


def _of_plugin(plugin: plugins.Plugin, given: Mapping[str, float | None]) -> Sensor:
    """Return the sensor of others: a class, a function that makes one, or a sensor.

    A class or function gets those of ppp, bits and exposure [s] that it takes. `ValueError` where it needs others, or
    makes something else, or other bits.
    """
    made = plugin.made
    if callable(made) and not isinstance(made, Sensor):
        taken = inspect.signature(made).parameters
        named = {name: one for name, one in taken.items() if one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)}
        needed = [name for name, one in named.items() if one.default is one.empty and given.get(name) is None]
        if needed:
            raise ValueError(
                f"{plugin.name}: needs {', '.join(needed)}; give defaults, or name a function that makes the sensor"
            )
        made = made(**{name: value for name, value in given.items() if name in taken and value is not None})
    if not isinstance(made, Sensor):
        raise ValueError(f"{plugin.name}: is no sensor; name a class below qsim.Sensor, or a function that makes one")
    check_known(made)
    bits = given["bits"]
    if bits is not None and bits != made.bits:
        raise ValueError(f"{plugin.name}: has bits = {made.bits}, the request {bits}; change one of them")
    return made


def load_sum(
    name: str | Path | Sensor,
    planes: int,
    *,
    bits: int | None = None,
    ppp: float | None = None,
    exposure: float = 5e-4,
    argument: str = "planes",
) -> Sensor:
    """Return the sensor of codes that sum so many planes, each of `exposure` [s]; else as `load`.

    `bits` may be those of a plane or of the sum, and so may those of a file. `ValueError` for others, and with the
    `argument` that states the planes for a sensor that sums none.
    """
    loaded = load(name, ppp=ppp, bits=plane_bits(name, planes, bits), exposure=exposure)
    if planes == 1:
        return loaded.plane if loaded.sums_planes else loaded
    if not loaded.sums_planes:
        kind = type(loaded).__name__
        shown = kind if isinstance(name, Sensor) else name
        raise ArgumentError(
            argument,
            f"{shown}: only a clocked SPAD sums planes, this is a {kind}; give another sensor, as in spad-320x240",
        )
    return loaded.plane.of_planes(planes)


def plane_bits(name: str | Path | Sensor, planes: int, bits: int | None = None) -> int:
    """Return the bits with which a sensor is loaded whose planes are summed; `ArgumentError` for other depths.

    They are those that are given or that the sensor states: of a plane, or of a sum. Files of no bits serve both.
    """
    own = name.bits if isinstance(name, Sensor) else table_of(name).get("bits")
    stated = bits if bits is not None else own
    if not isinstance(stated, int):
        return 1
    if stated not in (1, planes.bit_length()):
        where = "" if bits is not None else f" in {name}"
        depths = "planes are 1-bit codes"
        if planes > 1:
            depths = f"a plane has 1 bit and a sum of {planes} has {planes.bit_length()}"
        raise ArgumentError("bits", f"{stated}{where}: {depths}; leave it out")
    return own if isinstance(own, int) else stated


def from_toml(path: str | Path, bits: int | None = None, conditions: Conditions = NOTHING) -> Sensor:
    """Return the sensor of a TOML file with a table [sensor] and, optionally, [sources] and [defects]; strict.

    `bits` is the depth of a code where the file states none: such a file serves every depth. Without a spread of dark
    rates in `conditions`, a median is that of the file's own [defects].
    """
    path = Path(path)
    tables = files.read_toml(path, "sensor file")
    for key in tables:
        if key not in TABLES:
            raise ValueError(f"{path}: unknown table [{key}]{suggest(key, TABLES)}")
    if not isinstance(tables.get("sensor"), dict):
        raise ValueError(f"{path}: a table [sensor] with model, bits and the model's fields is missing")
    if "bits" not in tables["sensor"] and not _has_one_depth(tables["sensor"].get("model")):
        if bits is None:
            raise ValueError(f"{path}: states no bits, so it serves every depth; say which one, as in bits=3")
        tables["sensor"]["bits"] = bits
    table = tables["sensor"]
    if "median" in table and conditions.dark is None and isinstance(tables.get("defects"), dict):
        from qsim.sensor.defects import defect_table

        own = defect_table.from_toml(path)
        conditions = replace(conditions, dark=None if own is None else own.pattern.dark)
    sensor = of_table(table, f"{path}: [sensor]", conditions)
    known = [field.name for field in fields(sensor)]  # type: ignore[arg-type]  # every model is a dataclass
    known += [key for key in ("iso", *file_laws.KEYS) if key in table]
    for key in tables.get("sources", {}):
        if key not in known:
            raise ValueError(f"{path}: unknown key {key!r} in [sources]{suggest(key, known)}")
    return sensor


def of_table(table: Mapping[str, object], where: str, conditions: Conditions = NOTHING) -> Sensor:
    """Return the sensor of a table [sensor] that states its bits, with its laws (file_laws.py); `ValueError`."""
    return from_dict(_with_gain(file_laws.resolved(table, where, conditions), where), where=where)


def _with_gain(settings: dict[str, object], where: str) -> dict[str, object]:
    """Return a table [sensor] whose `iso`, if it has one, becomes its gain: at ISO 100 the full well fills the code.

    gain = iso / 100 (2^bits - 1 - offset) / full_well, in codes per electron.
    """
    if "iso" not in settings:
        return settings
    numbers = {}
    for key in ("iso", "full_well", "bits", "offset"):
        value = settings.get(key, 0.0)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{where}: {key} is a number, got {value!r}")
        numbers[key] = float(value)
    if settings.get("model") != "QIS" or "gain" in settings:
        raise ValueError(
            f'{where}: iso states the gain of a QIS; leave one of iso and gain out, and give model = "QIS"'
        )
    room = 2 ** min(numbers["bits"], 64) - 1 - numbers["offset"]
    if not (0 < numbers["full_well"] < 1e30 and 0 < numbers["iso"] < 1e30 and room > 0):
        raise ValueError(
            f"{where}: iso needs a full_well above 0 and codes above the offset; at ISO 100 they are equal"
        )
    gain = numbers["iso"] / 100 * room / numbers["full_well"]
    return {key: value for key, value in settings.items() if key != "iso"} | {"gain": gain}


def table_of(name: str | Path | Sensor) -> Mapping[str, object]:
    """Return the table [sensor] of a TOML file as it is written; empty for other sensors."""
    if isinstance(name, Sensor) or Path(name).suffix != ".toml":
        return {}
    table: object = files.read_toml(Path(name), "sensor file").get("sensor")
    return table if isinstance(table, dict) else {}


def from_dict(settings: Mapping[str, object], where: str = "sensor") -> Sensor:
    """Return the sensor that `Sensor.to_dict` described: {"model": "QIS", field: value, ...}; strict, `ValueError`."""
    name = settings.get("model")
    if name == EventCamera.__name__:
        raise ValueError(f"{where}: is an event camera, which has no codes; draw its events with `qsim events`")
    if isinstance(name, str) and isinstance(settings.get("plugin"), Mapping):
        return _of_others(name, settings, where)
    if not isinstance(name, str) or name not in MODELS:
        raise ValueError(f"{where}: model is one of {', '.join(MODELS)}, got {name!r}{suggest(str(name), MODELS)}")
    values = {key: value for key, value in settings.items() if key != "model"}
    return convert(values, MODELS[name], where)


def _of_others(name: str, settings: Mapping[str, object], where: str) -> Sensor:
    """Return a stored sensor of others; a warning says where its module is another one than it was."""
    stored = settings["plugin"]
    assert isinstance(stored, Mapping)
    kind, source = plugins.stored_class(name, stored, where)
    if not issubclass(kind, Sensor):
        raise ValueError(f"{where}: {name} of {source.module} is no sensor any more; restore its earlier version")
    if source.sha256 != stored.get("sha256"):
        warnings.warn(
            f"{where}: was written with another {source.words()}; codes that are drawn again may differ", stacklevel=2
        )
    return convert({key: value for key, value in settings.items() if key not in ("model", "plugin")}, kind, where)


def _has_one_depth(model: object) -> bool:
    """Return whether a model's codes have one depth, which its files need not state: spikes are there or not."""
    return isinstance(model, str) and model in MODELS and MODELS[model].code_model == "spikes"


def is_known(sensor: Sensor) -> bool:
    """Return whether a file can name the model of a sensor: one of this package, of a named file, or of a package."""
    return MODELS.get(type(sensor).__name__) is type(sensor) or plugins.source_of(type(sensor)) is not None


def check_known(sensor: Sensor) -> None:
    """Raise `ValueError` unless a file can state this sensor: of a class of one's own no reader could make it again."""
    if not is_known(sensor):
        raise ValueError(
            f"{type(sensor).__name__}: is none of the models that a file can name ({', '.join(MODELS)}), so a stored "
            "stream of it could not be opened; name it by its file, as in mine.py:Sensor, or install it as an entry "
            "point of qsim.sensors"
        )


class ListedDevice(TypedDict):
    """A named sensor as `qsim doctor --devices` states it."""

    name: str
    what: str
    settings: dict[str, object]  # its record at 3.25 PPP
    settings_at: str  # the light to which they belong
    sources: dict[str, str]  # of its numbers


def listing() -> list[ListedDevice]:
    """Return all named sensors."""
    rows: list[ListedDevice] = []
    for device in DEVICES.values():
        settings = device.make(3.25, device.bits, 5e-4).to_dict()
        rows.append(
            {
                "name": device.name,
                "what": device.what,
                "settings": settings,
                "settings_at": "3.25 PPP, 0.5 ms" if device.follows_light else "any light level",
                "sources": dict(device.sources),
            }
        )
    return rows

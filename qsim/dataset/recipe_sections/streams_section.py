"""Reads a section [[streams]] of a recipe: how every clip is sensed, once per bits and light level."""

from __future__ import annotations

from typing import Any

from qsim import checks
from qsim.dataset.recipe_sections.toml_section import Section, file_name
from qsim.settings import settings_of
from qsim.streams.sensing import Sensing
from qsim.structure import Table

STREAMS: Table = {
    "sensor": checks.text,
    "bits, if any": checks.list_of(checks.bits),
    "ppp, if any": checks.list_of(checks.light),
    "lux, if any": checks.list_of(checks.light),
    "absolute, if any": checks.flag,
    "follow, if any": checks.flag,
    "seed, if any": checks.seed,
    "name, if any": file_name,
    "group, if any": checks.flag,
    "slices, if any": checks.whole,
    "diffraction, if any": checks.flag,
    "row_delay, if any": checks.positive,
    "row_order, if any": checks.row_order,
    "colour, if any": checks.text,
    "exposures, if any": checks.shares,
    "temperature, if any": checks.real,
}


def streams_of(section: Section, seed: int, taken: set[str]) -> list[Sensing]:
    """Return one stream per bits and light level, and add their names to `taken`; `ValueError` for a taken name."""
    given = section.values(STREAMS)
    levels = _light(section, given)
    bits = given.get("bits", [None])
    name = given.get("name")
    sensor = _sensor(
        section, given["sensor"], bits, given.get("group", False), given.get("slices", 1), given.get("temperature")
    )
    if name is not None and (count := len(bits) * len(levels)) > 1:
        cure = "give one bits and one light level, or leave the name out"
        raise ValueError(f"{section.where('name')}: one name for {count} streams; {cure}")
    given["sensor"] = sensor
    given["colour"] = _colour(section, given.get("colour"))
    given.setdefault("seed", seed)
    own = {setting.name: given[setting.name] for setting in settings_of(Sensing) if setting.name in given}
    with section.naming():
        found = [Sensing(**own | {"bits": b, "ppp": None, "lux": None} | light) for b in bits for light in levels]
    for sensing in found:
        with section.naming("sensor", "streams are named after the sensor: "):
            stream = sensing.stream_name
        if stream in taken:
            raise ValueError(f"{section.where()}: two [[streams]] are called '{stream}'; give one of them a name")
        taken.add(stream)
    return found


def _light(section: Section, given: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the fields of `Sensing` that state each light level; absolute light has none."""
    units = [key for key in ("ppp", "lux", "absolute") if key in given]
    if len(units) != 1:
        wanted = "give one light level, ppp = ..., lux = ... or absolute = true"
        raise ValueError(f"{section.where()}: {wanted}; {' and '.join(units) or 'none'} given")
    unit = units[0]
    if unit != "absolute":
        return [{unit: level} for level in given[unit]]
    if not given["absolute"]:
        raise ValueError(f"{section.where('absolute')}: absolute can only be true; or give a ppp")
    return [{}]


def _sensor(
    section: Section, sensor: str, bits: list[int | None], group: bool, slices: int, temperature: float | None
) -> str:
    """Return the sensor's name or absolute file; `ValueError` if it lacks these bits, or cannot be read as asked."""
    from qsim.sensor import devices
    from qsim.sensor.file_laws import Conditions

    if sensor.endswith(".toml"):
        sensor = str((section.text.path.parent / sensor).resolve())
    for depth in bits:
        with section.naming("sensor"):
            found = devices.load(sensor, ppp=3.25, bits=depth, exposure=5e-4, conditions=Conditions(temperature))
        known = depth is not None or sensor.endswith(".toml")
        if group and not (known and found.sums_planes):
            what = f"this is a {type(found).__name__}" if known else "the bits of a code are needed, as in bits = 3"
            raise ValueError(f"{section.where('group')}: group sums planes of a clocked SPAD; {what}")
        if slices > 1 and (group or not found.takes_slices):
            what = "group sums planes instead" if group else f"this is a {type(found).__name__}"
            raise ValueError(f"{section.where('slices')}: slices are of one exposure of a QIS or CountingSPAD; {what}")
    return sensor


def _colour(section: Section, colour: str | None) -> str | None:
    """Return the name or absolute file of colour filters; `ValueError` if they cannot be read."""
    from qsim.sensor import colour_filter

    if colour is not None:
        colour = str((section.text.path.parent / colour).resolve()) if colour.endswith(".toml") else colour
        with section.naming("colour"):
            colour_filter.load(colour)
    return colour

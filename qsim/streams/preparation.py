"""Prepares the draw of a clip from the settings of a stream, and refuses settings that do not fit the clip.

clip, Sensing --light level, sensor, filters, defects, timing--> Draw
"""

from __future__ import annotations

import dataclasses

from qsim import keys
from qsim.clip.clip_folder import ClipFolder
from qsim.sensor import devices, file_laws
from qsim.sensor.colour_filter import ColourFilter
from qsim.sensor.defects import defect_table
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.event_simulation import TOLERANCE, Effects
from qsim.sensor.defects.pixel_array import PixelArray, require_effect
from qsim.sensor.file_laws import Conditions
from qsim.sensor.sensor import Sensor
from qsim.streams.photons import light_level
from qsim.streams.sensing import Sensing, as_summed, filters_of, frames_needed, sensor_of
from qsim.streams.simulation import Draw


def prepare(clip: ClipFolder, sensing: Sensing) -> Draw:
    """Return the draw of a clip with these settings; `ValueError` if they do not fit the clip."""
    found = sensing.defects or (sensing.sensor_name if sensing.sensor_name.endswith(".toml") else None)
    if isinstance(found, str):
        found = defect_table.from_toml(found, needed=sensing.defects is not None)
    draw = assemble(clip, sensing, found)
    require_effect(found, draw.sensor)
    return draw


def _fitting_filters(clip: ClipFolder, sensing: Sensing, recorded: bool) -> ColourFilter | None:
    """Return the same from the clip's first pixel on; `ValueError` for a colour clip without filters, and reverse."""
    found = None if recorded and sensing.colour is None else filters_of(sensing)
    if (found is None) == (clip.bands is None):
        return None if found is None else found.shifted(*clip.origin)
    if found is None:
        cure = "give some, as in colour=rggb, or a table [colour] in the sensor's file"
        raise ValueError(f"{clip.name}: has three bands and {sensing.sensor_name} no colour filters; {cure}")
    raise ValueError(f"{clip.name}: has one band, and the sensor has colour filters; render it with bands=rgb")


def assemble(clip: ClipFolder, sensing: Sensing, found: Defects | None, own: Sensor | None = None) -> Draw:
    """Return the draw of a clip as `prepare`, with given defects. A given sensor `own` has no file and no filters."""
    filters = _fitting_filters(clip, sensing, own is not None)
    own = None if own is None else as_summed(own, sensing)
    planes = own.levels - 1 if own is not None and sensing.summed else sensing.frames
    if sensing.summed and sensing.depth is None:
        raise ValueError(f"{clip.name}: group= sums planes, and needs the bits of a code, as in bits=3")
    if not 1 <= planes <= len(clip):
        what = f"one code of {planes} planes" if sensing.summed else f"one exposure of {planes} slices"
        raise ValueError(f"{clip.name}: {len(clip)} frames are too few for {what}")
    if sensing.rows is not None:
        _check_rows(sensing, clip, 1 if sensing.summed else planes)
    ppp = None if sensing.ppp is None else sensing.ppp / planes
    level = light_level(clip, ppp=ppp, lux=sensing.lux, pixel_pitch=sensing.pixel_pitch)
    conditions = Conditions(sensing.temperature, _wavelength(clip), None if found is None else found.pattern.dark)
    sensor = own or sensor_of(sensing, ppp=level.ppp * planes, exposure=clip.exposure * planes, conditions=conditions)
    if filters is not None and own is None:
        filters = _by_curve(filters, clip, sensing)
    if found is not None and sensor.keeps_charge:
        raise ValueError(f"{sensing.sensor_name}: defects of spike cameras are not modelled; leave [defects] out")
    if found is not None:  # a measured dark map replaces the dark rate of the sensor
        sensor = PixelArray.of(found, sensor, *clip.shape[1:], clip.origin).sensor
    _check_planes(sensor, sensing, clip)
    key = keys.Key(seed=sensing.seed, clip=keys.hash_name(clip.name))
    if sensing.exposures is not None:
        _check_exposures(sensing, sensor, found)
    timing = sensing.timing(planes, sensing.summed)
    draw = Draw(sensor, level, key, timing, sensing.diffraction, found, colour=filters)
    return dataclasses.replace(draw, origin=clip.origin)


def _wavelength(clip: ClipFolder) -> float | None:
    """Return the wavelength [m] at which a curve of efficiency is read: that of the camera, of colours the second."""
    if clip.bands is not None:
        return clip.bands[1]
    return None if clip.camera is None else clip.camera.wavelength


def _by_curve(filters: ColourFilter, clip: ClipFolder, sensing: Sensing) -> ColourFilter:
    """Return filters that pass all light of their bands to the efficiency of the file's qe_curve, if it has one."""
    curve = devices.table_of(sensing.sensor).get("qe_curve")
    if curve is None or clip.bands is None:
        return filters
    if filters.efficiency is not None:
        raise ValueError(f"{sensing.sensor_name}: [colour] efficiency and qe_curve state the same; leave one out")
    red, green, blue = (file_laws.efficiency_at(curve, band, sensing.sensor_name) for band in clip.bands)
    passed = {"R": (red, 0.0, 0.0), "G": (0.0, green, 0.0), "B": (0.0, 0.0, blue), "W": (red, green, blue)}
    return dataclasses.replace(filters, efficiency={colour: passed[colour] for colour in "".join(filters.mask)})


def _check_exposures(sensing: Sensing, sensor: Sensor, found: Defects | None) -> None:
    """Raise `ValueError` if pixels remember the exposure before, so that all must be equal."""
    remembers = found is not None and (found.afterpulse or found.carry_dead_time)
    if sensor.keeps_charge:
        raise ValueError(f"exposures: {sensing.sensor_name} integrates without a pause; leave them out")
    if remembers or ((sensing.follow or sensing.slices > 1) and sensor.follows_photons):
        what = "followed photons of a counting pixel" if sensing.follow else "slices of a counting pixel"
        if remembers:
            what = "afterpulses and carried dead time"
        raise ValueError(f"exposures: {what} need codes of equal exposure; leave one of them out")


def _check_rows(sensing: Sensing, clip: ClipFolder, period: int) -> None:
    """Raise `ValueError` if rows cannot be read at their times: planes or codes of `period` clip frames."""
    rows = sensing.rows
    assert rows is not None
    _, height, width = clip.shape
    if clip.exposure < 0.999 / clip.frame_rate:
        raise ValueError(f"{clip.name}: rows at their own time need a clip whose shutter is open all the time")
    rows.check(height, width, clip.frame_rate, period, clip.name)
    needed = frames_needed(sensing, height, width, clip.frame_rate)
    if len(clip) < needed:
        raise ValueError(f"{clip.name}: {len(clip)} frames are too few for one code, whose last row needs {needed}")


def _check_planes(sensor: Sensor, sensing: Sensing, clip: ClipFolder) -> None:
    """Raise `ValueError` if sums of planes or slices of exposures do not fit the sensor or the clip."""
    kind = type(sensor).__name__
    if sensing.follow and not sensor.follows_photons:
        raise ValueError(f"{sensing.sensor_name}: follow= is for the photons of a CountingSPAD, this is a {kind}")
    if sensing.summed and not sensor.sums_planes:
        raise ValueError(f"{sensing.sensor_name}: group= is for a clocked SPAD (BinarySPAD), this is a {kind}")
    if sensing.slices > 1 and not sensor.takes_slices:
        raise ValueError(
            f"{sensing.sensor_name}: slices of an exposure are for a CountingSPAD or a QIS, this is a {kind}"
        )
    if sensing.slices > 1 and clip.exposure < 0.999 / clip.frame_rate:
        raise ValueError(f"{clip.name}: slices of one exposure need a clip whose shutter is open all the time")


def followed(clip: ClipFolder, sensing: Sensing, draw: Draw) -> tuple[Draw, Effects | None]:
    """Return the draw, photon by photon where needed or asked for, and the error of the closed form; None if exact."""
    missed = draw.missed(clip) or (Effects(0.0, 0.0, 0.0) if sensing.follow else None)
    if missed is None or not (sensing.follow or missed.largest > TOLERANCE):
        return draw, missed
    return dataclasses.replace(draw, followed=missed), missed

"""Senses clips: prepares the draw of a `Sensing`, stores its stream, and replays stored frames.

clip (radiance) --light level, optics--> photons --sensor, key--> codes --> streams/NAME.npy + streams/NAME.json
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from numpy import ndarray as Array

from qsim import files, keys, locks, records, scratch
from qsim.clip.clip_folder import ClipFolder
from qsim.files import Progress, check_name
from qsim.kinds import Bits, Frames, Light, Name, Number, Positive, RowOrder, Schedule, Seed, Text
from qsim.sensor import colour_filter, devices, file_laws, packing
from qsim.sensor.colour_filter import ColourFilter
from qsim.sensor.defects import defect_table
from qsim.sensor.defects.defect_table import Defects
from qsim.sensor.defects.event_simulation import TOLERANCE, Effects
from qsim.sensor.defects.pixel_array import PixelArray, require_effect
from qsim.sensor.file_laws import Conditions
from qsim.sensor.sensor import Sensor
from qsim.settings import setting
from qsim.streams.exposures import Timing
from qsim.streams.photons import light_level, light_line
from qsim.streams.rows import Rows
from qsim.streams.simulation import Draw, same_settings, stored
from qsim.streams.stream import Stream, write_packed, writing


@dataclass(frozen=True)
class Sensing:
    """The settings of a stream: sensor, light level, seed; independent of the clip.

    `ValueError` for values out of their bounds, and for settings that exclude each other.
    """

    sensor: Annotated[
        Text | Sensor, setting("a name of `qsim doctor --devices`, or a .toml file", known=devices.DEVICES.keys)
    ]
    bits: Annotated[Bits | None, setting("bits per code", unset="the sensor's own", varied=True)] = None
    ppp: Annotated[
        Light | None,
        setting("mean photons per pixel and code over the clip", unset="the clip's own light", varied=True),
    ] = None
    lux: Annotated[Light | None, setting("faceplate lux at 555 nm, instead of ppp", unit="lx", varied=True)] = None
    seed: Annotated[Seed, setting("seed of the noise")] = 0
    name: Annotated[Name | None, setting("name of the stream", unset="made from sensor, bits and light", short="o")] = (
        None
    )
    group: Annotated[bool, setting("sum 2^bits - 1 clip frames, as binary planes, to one code")] = False
    diffraction: Annotated[bool, setting("blur light with the lens's Airy pattern")] = False
    defects: Annotated[
        Text | Defects | None,
        setting(
            "table [defects]: hot and dead pixels, PRNU, offsets, measured maps, afterpulses, crosstalk, dead time "
            "that is carried over",
            unset="that of the sensor's own .toml file",
            shown="FILE.toml",
            recipe=False,
        ),
    ] = None
    slices: Annotated[
        Frames,
        setting("counting SPAD or QIS: clip frames per exposure, so that light may change within it (motion blur)"),
    ] = 1
    row_delay: Annotated[
        Positive | None, setting("seconds from one row, or column, to the next", unit="s", unset="all at once")
    ] = None
    row_order: Annotated[
        RowOrder | None, setting("direction of rows (down or up), or of columns (right or left)", unset="down")
    ] = None
    colour: Annotated[
        Text | ColourFilter | None,
        setting(
            "colour filters: rggb, quad, rgbw, red, green, blue, or a .toml with a table [colour]",
            unset="those of the sensor's own .toml file",
            shown="MASK",
        ),
    ] = None
    exposures: Annotated[
        Schedule | None,
        setting(
            "shares of a code's time with light, in turn, as in 1,0.25,0.0625; light levels are of full exposures",
            unset="all of it",
        ),
    ] = None
    follow: Annotated[bool, setting("counting SPAD: draw photon by photon, so that their times are known")] = False
    temperature: Annotated[
        Number | None,
        setting("degrees C of a sensor file with dark_doubling", unit="degrees C", unset="the file's own"),
    ] = None
    pixel_pitch: Annotated[
        Positive | None,
        setting(
            "metres, of a clip without a camera (imported video), so that its lux are known: 1.1e-6",
            unit="m",
            recipe=False,
        ),
    ] = None

    def __post_init__(self) -> None:
        for name in ("sensor", "defects", "colour"):
            value = getattr(self, name)
            if isinstance(value, os.PathLike):
                object.__setattr__(self, name, os.fspath(value))
        records.settle(self)
        if self.ppp is not None and self.lux is not None:
            raise ValueError("give the light level as ppp or as lux, not both")
        if self.group and self.slices != 1:
            raise ValueError("group sums planes, slices are of one exposure; give one of them")
        if self.row_order is not None and self.row_delay is None:
            raise ValueError(f"row_order {self.row_order}: orders rows that have their own time; give row_delay too")

    @property
    def rows(self) -> Rows | None:
        """The readout of rows or columns at their own time; None: all at once."""
        return None if self.row_delay is None else Rows(self.row_delay, self.row_order or "down")

    @property
    def stream_name(self) -> str:
        """The given name, or one made of the settings: `quiver-physical_3bit_3.25ppp`."""
        if self.name is not None:
            return check_name(self.name)
        light = (
            "asis" if self.ppp is self.lux is None else f"{self.ppp:g}ppp" if self.lux is None else f"{self.lux:g}lx"
        ).replace("e+", "e")  # a name holds no +
        bits = "" if self.depth is None else f"_{self.depth}bit"
        seed = f"_seed{self.seed}" if self.seed else ""
        sensor = Path(self.sensor_name).name.removesuffix(".toml")
        if isinstance(self.colour, str):
            sensor += f"-{Path(self.colour).name.removesuffix('.toml')}"
        elif self.colour is not None:
            sensor += f"-{files.sha256(files.to_json(self.colour.to_dict()))[:8]}"
        if isinstance(self.sensor, Sensor):
            sensor += f"-{files.sha256(files.to_json(self.sensor.to_dict()))[:8]}"
        return check_name(f"{sensor}{bits}_{light}{seed}")

    @property
    def sensor_name(self) -> str:
        """The sensor's name or file; of a record, its class."""
        return type(self.sensor).__name__ if isinstance(self.sensor, Sensor) else self.sensor

    @property
    def planes(self) -> int:
        """The clip frames in a code: planes that are summed, or slices of an exposure."""
        return 2 ** (self.depth or 1) - 1 if self.group else self.slices

    @property
    def depth(self) -> int | None:
        """The bits of a code, as requested, of a record, or of the file of a sum of planes; None: the device's own."""
        if self.bits is not None:
            return self.bits
        if isinstance(self.sensor, Sensor):
            return self.sensor.bits
        return devices.load(self.sensor, ppp=1.0).bits if self.group and self.sensor.endswith(".toml") else None


def prepare(clip: ClipFolder, sensing: Sensing) -> Draw:
    """Return the draw of a clip with these settings; `ValueError` if they do not fit the clip."""
    found = sensing.defects or (sensing.sensor_name if sensing.sensor_name.endswith(".toml") else None)
    if isinstance(found, str):
        found = defect_table.from_toml(found, needed=sensing.defects is not None)
    draw = assemble(clip, sensing, found)
    require_effect(found, draw.sensor)
    return draw


def filters_of(sensing: Sensing) -> ColourFilter | None:
    """Return the colour filter array that the settings or the sensor's file state; None without one."""
    if sensing.colour is not None:
        return colour_filter.load(sensing.colour) if isinstance(sensing.colour, str) else sensing.colour
    return colour_filter.from_toml(sensing.sensor_name) if sensing.sensor_name.endswith(".toml") else None


def _fitting_filters(clip: ClipFolder, sensing: Sensing, recorded: bool) -> ColourFilter | None:
    """Return the same from the clip's first pixel on; `ValueError` for a colour clip without filters, and reverse."""
    found = None if recorded and sensing.colour is None else filters_of(sensing)
    if (found is None) == (clip.bands is None):
        return None if found is None else found.shifted(*clip.origin)
    if found is None:
        cure = "give some, as in --colour rggb, or a table [colour] in the sensor's file"
        raise ValueError(f"{clip.name}: has three bands and {sensing.sensor_name} no colour filters; {cure}")
    raise ValueError(f"{clip.name}: has one band, and the sensor has colour filters; render it with --bands rgb")


def assemble(clip: ClipFolder, sensing: Sensing, found: Defects | None, own: Sensor | None = None) -> Draw:
    """Return the draw of a clip as `prepare`, with given defects. A given sensor `own` has no file and no filters."""
    filters = _fitting_filters(clip, sensing, own is not None)
    planes = sensing.planes
    if sensing.group and sensing.depth is None:
        raise ValueError(f"{clip.name}: summing planes needs the bits of a code, as in --bits 3")
    if not 1 <= planes <= len(clip):
        what = f"one code of {planes} planes" if sensing.group else f"one exposure of {planes} slices"
        raise ValueError(f"{clip.name}: {len(clip)} frames are too few for {what}")
    if sensing.rows is not None:
        _check_rows(sensing, clip, 1 if sensing.group else planes)
    ppp = None if sensing.ppp is None else sensing.ppp / planes
    level = light_level(clip, ppp=ppp, lux=sensing.lux, pixel_pitch=sensing.pixel_pitch)
    conditions = Conditions(sensing.temperature, _wavelength(clip), None if found is None else found.pattern.dark)
    sensor = own or devices.load(
        sensing.sensor,
        ppp=level.ppp * planes,
        bits=sensing.bits,
        exposure=clip.exposure * planes,
        conditions=conditions,
    )
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
    timing = Timing(planes, sensing.group, sensing.rows, sensing.exposures)
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
        what = (
            "afterpulses and carried dead time"
            if remembers
            else f"{'followed photons' if sensing.follow else 'slices'} of a counting pixel"
        )
        raise ValueError(f"exposures: {what} need codes of equal exposure; leave one of them out")


def frames_needed(sensing: Sensing, height: int, width: int, frame_rate: float) -> int:
    """Return the clip frames of the first code: its planes or slices, and those that its last row still needs."""
    rows = sensing.rows
    return sensing.planes + (0 if rows is None else rows.reach(height, width, frame_rate))


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
        raise ValueError(f"{sensing.sensor_name}: only the photons of a CountingSPAD are followed, this is a {kind}")
    if sensing.group and not sensor.sums_planes:
        raise ValueError(f"{sensing.sensor_name}: only a clocked SPAD (BinarySPAD) sums planes, this is a {kind}")
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


def describe(clip: ClipFolder, sensing: Sensing, draw: Draw) -> dict[str, Any]:
    """Return the json of the stream of a draw, without the fields of the written file (checksums, versions)."""
    _, height, width = clip.shape
    named = {} if isinstance(sensing.sensor, Sensor) else {"sensor_name": sensing.sensor}
    return (
        named
        | {
            "shape": [len(draw.exposures(clip)), height, width],
            "ppp_target": sensing.ppp,
            "lux_target": sensing.lux,
            "ppp": draw.level.ppp * draw.planes,
            "ppp_factor": draw.level.factor,
            "mean_photons_before": draw.level.mean_before * draw.planes,
            "equivalent_lux_555nm": draw.level.lux,
            "radiance_unit": clip.info.radiance_unit,
            "transfer": "linear",
            "diffraction": draw.diffraction,
            "seed": draw.key.seed,
            "clip_key": draw.key.clip,
            "clip": clip.name,
            "frame_rate": clip.frame_rate / draw.planes,
            "exposure": clip.exposure * draw.planes,
            "planes_per_code": draw.planes,
            "drawn_by": draw.law,
        }
        | ({} if draw.defects is None else {"defects": draw.defects.to_dict()})
        | ({} if draw.timing.rows is None else {"rows": draw.timing.rows.to_dict()})
        | ({} if draw.colour is None else {"colour": draw.colour.to_dict()})
        | ({} if draw.timing.shares is None else {"exposures": list(draw.timing.shares)})
        | ({} if draw.origin == (0, 0) else {"origin": list(draw.origin)})
        | _temperature(sensing)
        | ({} if sensing.pixel_pitch is None else {"pixel_pitch": sensing.pixel_pitch})
    )


def _temperature(sensing: Sensing) -> dict[str, float]:
    """Return the temperature [degrees C] at which a sensor file with such a law was read."""
    found = file_laws.temperature_of(devices.table_of(sensing.sensor), sensing.temperature)
    return {} if found is None else {"temperature": found}


def sense(
    clip: ClipFolder,
    sensing: Sensing,
    *,
    force: bool = False,
    progress: Progress | None = None,
    on_wait: Callable[[], None] | None = None,
) -> tuple[Stream, str]:
    """Draw and store a stream; return it and a one-line summary of its light level.

    A stream of this name is kept if its settings are the same; `FileExistsError` for other settings without `force`.
    While another process senses this clip, wait after a call of `on_wait`.
    """
    if isinstance(sensing.sensor, Sensor):
        devices.check_known(sensing.sensor)
    draw, missed = followed(clip, sensing, prepare(clip, sensing))
    meta = describe(clip, sensing, draw)
    efficiency = draw.sensor.efficiency
    whole = dataclasses.replace(draw.level, ppp=draw.level.ppp * draw.planes)  # of a code, not of a clip frame
    line = light_line(whole, efficiency, draw.colour, clip.bands)
    if draw.colour is not None:
        line += f"; {draw.colour.words(efficiency)}"
    line += draw.timing.words()
    line += draw.exposures(clip).about_flicker(clip.strengths)
    if draw.timing.rows is None and draw.planes % 2 == 0:
        line += "; its truth is half a clip frame late, which an odd number of slices avoids"
    if draw.defects is not None:
        effects = [key for key, value in draw.defects.to_dict().items() if value and key != "device_seed"]
        line += f"; defects: {', '.join(effects) or 'none'}"
    if missed is not None:
        meta["dead_time_effects"] = dataclasses.asdict(missed)
        line += f"; {missed}: {'photon by photon' if draw.followed else 'below ' + str(TOLERANCE) + ', closed form'}"
    kept = None if force else _kept(clip, sensing, draw, meta)
    if kept is not None:
        _tidy(clip)
        return kept, line
    with writing(clip.path / "streams", on_wait):
        kept = None if force else _kept(clip, sensing, draw, meta)  # another process may have made it
        if kept is not None:
            return kept, line
        blocks = draw.packed(clip, meta["shape"][0], progress)
        return _write(clip, sensing.stream_name, blocks, draw.sensor, meta), line


def _kept(clip: ClipFolder, sensing: Sensing, draw: Draw, meta: dict[str, Any]) -> Stream | None:
    """Return the stored stream if its settings are these, None if there is none; `FileExistsError` for others."""
    json_path = clip.path / "streams" / f"{sensing.stream_name}.json"
    try:
        old = Stream.open(json_path)
    except FileNotFoundError:
        return None
    if same_settings(old.meta, meta) and old.meta["sensor"] == draw.sensor.to_dict():
        return old
    raise FileExistsError(f"{json_path}: exists with other settings; name this stream with --name, or use --force")


def replay(clip: ClipFolder, stream: Stream, frame: int) -> tuple[Array, Array]:
    """Return one frame drawn again from the stream's json, and the stored frame: codes [H, W] each."""
    if not 0 <= frame < len(stream):
        raise ValueError(f"{stream.path}: frame {frame} does not exist; the stream has frames 0..{len(stream) - 1}")
    return stored(stream).frames(clip, frame, frame + 1)[0], stream.codes(frame, frame + 1)[0]


def write_stream(
    clip: ClipFolder, name: str, codes_iter: Iterable[Array], sensor: Sensor, meta: dict[str, Any]
) -> Stream:
    """Store codes ([H, W] frames or [t, H, W] blocks, in order) as a stream of `clip`; the json is written last.

    `meta` must hold shape (T, H, W), ppp_factor, exposure and frame_rate. `ValueError` if there are not T frames.
    """
    shape = tuple(meta["shape"][1:])

    def packed() -> Iterator[Array]:
        done = 0
        for block in codes_iter:
            block = block if block.ndim == 3 else block[None]
            if block.shape[1:] != shape:
                raise ValueError(f"{clip.path}, {name}: frame {done} is {block.shape[1:]}, expected {shape}")
            yield packing.pack(block, sensor.bits)
            done += len(block)

    with writing(clip.path / "streams"):
        return _write(clip, name, packed(), sensor, meta)


def _write(clip: ClipFolder, name: str, blocks: Iterable[Array], sensor: Sensor, meta: dict[str, Any]) -> Stream:
    """Store packed blocks as a stream of the clip; the caller holds the lock of its streams."""
    path = clip.path / "streams" / f"{check_name(name)}.npy"
    scratch.sweep(path.parent)
    return write_packed(path, blocks, sensor, {"orientation": clip.info.orientation} | meta)


def _tidy(clip: ClipFolder) -> None:
    """Delete what a writer left that was killed after its stream was written."""
    scratch.sweep(clip.path / "streams")
    lock = locks.Lock(clip.path / "streams" / "lock")
    with contextlib.suppress(OSError):  # a read-only folder
        if lock.path.exists() and lock.acquire():
            lock.delete()

"""Draws the events that an event camera reports of a clip, and stores them in the clip's folder.

clip (radiance) --light level, optics--> photons of each frame --efficiency, dark current--> photocurrent --pixels-->
events/NAME.npy + events/NAME.json

Light between two frames is taken as linear in its logarithm. So times of events mean something where light changes
evenly within a frame: nothing that flickers or passes a pixel within one is seen. Memory does not grow with the frames.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy import ndarray as Array

from qsim import files, keys, scratch
from qsim.clip.clip_folder import ClipFolder
from qsim.files import Progress, check_name
from qsim.host import own_numbers
from qsim.keys import Key
from qsim.kinds import Light, Name, Text
from qsim.optics.radiometry import WHITE_PER_MEAN, LightLevel
from qsim.sensor import event_camera as cameras
from qsim.sensor.event_camera import EventCamera
from qsim.sensor.event_pixels import EventPixels
from qsim.settings import given, setting, settle
from qsim.streams.event_stream import EVENT, FOLDER, EventInfo, EventStream, write
from qsim.streams.photons import clip_photons, light_level, light_line
from qsim.streams.sensing import AskedLux, AskedPitch, AskedSeed, light_name
from qsim.streams.stream import tidy, writing

_WIDEST = 1 << 16  # columns and rows that an event can name


@dataclass(frozen=True)
class EventSensing:
    """The settings of events: camera, light level, seed; independent of the clip.

    `ValueError` for values out of their bounds, and for settings that exclude each other.
    """

    camera: Annotated[
        Text | EventCamera,
        setting("dvs, dvs-ideal, or a .toml file", known=cameras.names, example="dvs"),
    ] = "dvs"
    ppp: Annotated[
        Light | None,
        setting("mean photons per pixel and clip frame", unset="the clip's own light", varied=True, example=[3.25]),
    ] = None
    lux: AskedLux = None
    seed: AskedSeed = 0
    name: Annotated[
        Name | None, setting("name of the events", unset="made from camera and light", short="o", example="dim")
    ] = None
    pixel_pitch: AskedPitch = None

    def __post_init__(self) -> None:
        if isinstance(self.camera, os.PathLike):
            object.__setattr__(self, "camera", os.fspath(self.camera))
        settle(self)
        if self.ppp is not None and self.lux is not None:
            raise ValueError("give the light level as ppp or as lux, not both")

    @property
    def camera_name(self) -> str:
        """The camera's name or file; empty for a record."""
        return self.camera if isinstance(self.camera, str) else ""

    @property
    def stream_name(self) -> str:
        """The given name, or one made of the settings: `dvs_3.25ppp`."""
        if self.name is not None:
            return check_name(self.name)
        light = light_name(self.ppp, self.lux)
        camera = Path(self.camera_name).name.removesuffix(".toml")
        if not isinstance(self.camera, str):
            camera = f"events-{files.sha256(files.to_json(self.camera.to_dict()))[:8]}"
        return check_name(f"{camera}_{light}" + (f"_seed{self.seed}" if self.seed else ""))


@dataclass(frozen=True)
class EventDraw:
    """An `EventSensing` applied to one clip: all parameters of its events."""

    camera: EventCamera
    level: LightLevel
    key: Key

    def current(self, clip: ClipFolder, t: int) -> Array:
        """Return the photocurrent of clip frame t, float64 [H, W] in e-/s, with the dark current."""
        photons = clip_photons(clip, t, self.level.factor)
        return photons * (self.camera.quantum_efficiency / clip.exposure) + self.camera.dark_current

    def blocks(self, clip: ClipFolder, progress: Progress | None = None) -> Iterator[tuple[Array, int]]:
        """Yield the events [n] between each two frames in the order of time, and how many follow one of their pixel."""
        frames = len(clip)
        pixels = EventPixels(self.camera, self.current(clip, 0), self.key, clip.origin)
        for t in range(1, frames):
            found = pixels.advance(self.current(clip, t), 1 / clip.frame_rate)
            # Microseconds are what event cameras and their file formats count.
            times = np.rint(((t - 1) / clip.frame_rate + found.times) * 1e6).astype(np.int64)
            yield _in_order(times, found.pixels, found.polarities, clip.shape[2])
            if progress is not None:
                progress(t + 1, frames)


def _in_order(times: Array, pixels: Array, polarities: Array, width: int) -> tuple[Array, int]:
    """Return events [n] in the order of time [us] and pixel, and how many follow one of their pixel."""
    order = np.lexsort((pixels, times))
    found = np.empty(len(order), EVENT)
    found["t"] = times[order]
    found["y"], found["x"] = np.divmod(pixels[order], width)
    found["p"] = polarities[order]
    return found, len(pixels) - len(np.unique(pixels))


def prepare(clip: ClipFolder, sensing: EventSensing) -> EventDraw:
    """Return the draw of a clip with these settings; `ValueError` if they do not fit the clip."""
    clip.require_one_band("an event camera")
    frames, height, width = clip.shape
    if frames < 2:
        raise ValueError(f"{clip.name}: has one frame, and events are changes between frames; give two or more")
    missing = () if clip.info.source is None else clip.info.source.missing_frames
    if missing:
        raise ValueError(
            f"{clip.name}: frame {missing[0]} was lost and is stored dark, which would be events; convert the "
            "recording without keep_gaps=True, or with frames between, as in rate=2000"
        )
    if max(height, width) > _WIDEST:
        raise ValueError(f"{clip.name}: {height} x {width} pixels; events name rows and columns below {_WIDEST}")
    level = light_level(clip, ppp=sensing.ppp, lux=sensing.lux, pixel_pitch=sensing.pixel_pitch)
    camera = cameras.load(sensing.camera)
    # Effects that depend on the light are stated relative to a bright current: that of the white of a clip.
    bright = WHITE_PER_MEAN * level.ppp * camera.quantum_efficiency / clip.exposure
    key = Key(seed=sensing.seed, clip=keys.hash_name(clip.name))
    return EventDraw(camera.with_bright(bright) if camera.needs_bright else camera, level, key)


def describe(clip: ClipFolder, sensing: EventSensing, draw: EventDraw) -> EventInfo:
    """Return the description of the events of a draw, without what their writer counts."""
    return EventInfo(
        shape=clip.shape,
        frame_rate=clip.frame_rate,
        camera=draw.camera.to_dict(),
        camera_name=sensing.camera_name,
        settings={name: value for name, value in given(sensing).items() if name not in ("camera", "name")},
        clip=clip.name,
        clip_key=draw.key.clip,
        origin=clip.origin,
        light=draw.level,
        orientation=clip.info.orientation,
    )


@own_numbers
def sense_events(
    clip: ClipFolder,
    sensing: EventSensing,
    *,
    force: bool = False,
    progress: Progress | None = None,
    on_wait: Callable[[], None] | None = None,
) -> tuple[EventStream, str]:
    """Draw and store the events of a clip; return them and a one-line summary of light and assumptions.

    Events of this name are kept if their settings are the same; `FileExistsError` for other settings without `force`.
    While another process draws events of this clip, wait after a call of `on_wait`.
    """
    draw = prepare(clip, sensing)
    info = describe(clip, sensing, draw)
    folder = clip.path / FOLDER
    kept = None if force else _kept(folder, sensing, info)
    if kept is not None:
        tidy(folder)
    else:
        with writing(folder, on_wait):
            kept = None if force else _kept(folder, sensing, info)  # another process may have made them
            if kept is None:
                scratch.sweep(folder)
                kept = write(folder / f"{sensing.stream_name}.npy", draw.blocks(clip, progress), info)
    return kept, _line(clip, draw, kept)


def _kept(folder: Path, sensing: EventSensing, info: EventInfo) -> EventStream | None:
    """Return the stored events if their settings are these, None if there are none; `FileExistsError` for others."""
    json_path = folder / f"{sensing.stream_name}.json"
    if not json_path.is_file():
        return None
    old = EventStream.open(json_path)
    if old.info.compared == info.compared:
        return old
    raise FileExistsError(f"{json_path}: exists with other settings; give a name=, or replace it with force=True")


def _line(clip: ClipFolder, draw: EventDraw, made: EventStream) -> str:
    """Return the light of the events, and what is assumed between frames with the share of events that rest on it."""
    line = light_line(draw.level, draw.camera.quantum_efficiency)
    share = 100 * made.info.following / max(len(made), 1)
    line += f"; log light is linear within the {1e6 / clip.frame_rate:.4g} us between frames, in which {share:.3g} % "
    line += "of events follow another of their pixel"
    if clip.strengths:
        line += "; lights flicker, and what they do within a frame is not seen"
    return line

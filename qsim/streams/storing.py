"""Stores streams: draws what a `Sensing` asks of a clip, keeps what is stored already, and replays stored frames.

clip (radiance) --light level, optics--> photons --sensor, key--> codes --> streams/NAME.npy + streams/NAME.json
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator

from numpy import ndarray as Array

from qsim import scratch
from qsim.clip.clip_folder import ClipFolder
from qsim.files import Progress, check_name
from qsim.host import own_numbers
from qsim.keys import Key
from qsim.notebook import reporting
from qsim.optics.radiometry import LightLevel
from qsim.sensor import devices, file_laws, packing
from qsim.sensor.defects.event_simulation import TOLERANCE
from qsim.sensor.sensor import Sensor
from qsim.streams.drawing import DRAWERS
from qsim.streams.photons import light_line
from qsim.streams.preparation import followed, prepare
from qsim.streams.sensing import Sensing
from qsim.streams.simulation import Draw
from qsim.streams.stream import Stream, tidy, write_packed, writing
from qsim.streams.stream_info import StreamInfo, stored_settings


def describe(clip: ClipFolder, sensing: Sensing, draw: Draw) -> StreamInfo:
    """Return the description of the stream of a draw, without what its writer adds."""
    _, height, width = clip.shape
    return StreamInfo.of(
        draw.sensor,
        sensor_name="" if isinstance(sensing.sensor, Sensor) else sensing.sensor,
        shape=(len(draw.exposures(clip)), height, width),
        frame_rate=clip.frame_rate / draw.planes,
        exposure=clip.exposure * draw.planes,
        planes_per_code=draw.planes,
        defects={} if draw.defects is None else draw.defects.to_dict(),
        colour=draw.colour,
        origin=draw.origin,
        temperature=file_laws.temperature_of(devices.table_of(sensing.sensor), sensing.temperature),
        settings=stored_settings(sensing),
        clip=clip.name,
        clip_key=draw.key.clip,
        light=draw.level.over(draw.planes),
        drawn_by=draw.law,
        orientation=clip.info.orientation,
    )


def stored(stream: Stream) -> Draw:
    """Return the draw of a stored stream, from its description; `ValueError` for one that qsim did not draw."""
    info = stream.info
    if info.light is None or info.clip_key is None or not info.drawn_by:
        raise ValueError(f"{stream.path}: was not drawn from a clip by qsim, so its description cannot draw it again")
    if info.drawn_by not in DRAWERS:
        known = ", ".join(DRAWERS)
        raise ValueError(f"{stream.path}: drawn by {info.drawn_by!r}, which is none of {known}; sense it again")
    timing = stream.timing
    # A description holds the light of a code, a draw that of a clip frame.
    level = LightLevel(info.light.factor, info.light.ppp / timing.frames, info.light.before / timing.frames, None)
    sensing = info.sensing
    return Draw(
        stream.sensor,
        level,
        Key(seed=sensing.seed, clip=info.clip_key),
        timing,
        sensing.diffraction,
        stream.defects,
        info.dead_time_effects if info.drawn_by == "events" else None,
        colour=info.colour,
        origin=info.origin,
    )


@own_numbers
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
    A notebook shows a bar where no `progress` is given. While another process senses this clip, wait after a call of
    `on_wait`.
    """
    draw, info = _described(clip, sensing)
    missed = info.dead_time_effects
    efficiency = draw.sensor.efficiency
    whole = dataclasses.replace(draw.level, ppp=draw.level.ppp * draw.planes)  # of a code, not of a clip frame
    line = light_line(whole, efficiency, draw.colour, clip.bands)
    if draw.colour is not None:
        line += f"; {draw.colour.words(efficiency)}"
    line += draw.timing.words()
    line += draw.exposures(clip).about_flicker(clip.strengths)
    if draw.timing.rows is None and draw.planes % 2 == 0:
        line += "; its truth is half a clip frame late, which an odd number of clip frames avoids"
    if draw.defects is not None:
        effects = [key for key, value in draw.defects.to_dict().items() if value and key != "device_seed"]
        line += f"; defects: {', '.join(effects) or 'none'}"
    if missed is not None:
        line += f"; {missed}: {'photon by photon' if draw.followed else 'below ' + str(TOLERANCE) + ', closed form'}"
    kept = None if force else _kept(clip, sensing, info)
    if kept is not None:
        tidy(clip.path / "streams")
        return kept, line
    with writing(clip.path / "streams", on_wait):
        kept = None if force else _kept(clip, sensing, info)  # another process may have made it
        if kept is not None:
            return kept, line
        with reporting(progress, sensing.stream_name) as heard:
            blocks = draw.packed(clip, info.shape[0], heard)
            return _write(clip, sensing.stream_name, blocks, info), line


@own_numbers
def drawn(clip: ClipFolder, sensing: Sensing) -> tuple[StreamInfo, Draw, Callable[[], Iterator[Array]]]:
    """Return the description of a stream, its draw, and what yields its packed codes; nothing is stored.

    They are those that `sense` stores: uint8 [t, H, ceil(W bits / 8)], some frames at a time.
    """
    draw, info = _described(clip, sensing)
    return info, draw, lambda: draw.packed(clip, info.shape[0])


def _described(clip: ClipFolder, sensing: Sensing) -> tuple[Draw, StreamInfo]:
    """Return the draw of a `Sensing` of a clip, and the description of its stream."""
    if isinstance(sensing.sensor, Sensor):
        devices.check_known(sensing.sensor)
    draw, missed = followed(clip, sensing, prepare(clip, sensing))
    return draw, dataclasses.replace(describe(clip, sensing, draw), dead_time_effects=missed)


def _kept(clip: ClipFolder, sensing: Sensing, info: StreamInfo) -> Stream | None:
    """Return the stored stream if its settings are these, None if there is none; `FileExistsError` for others."""
    json_path = clip.path / "streams" / f"{sensing.stream_name}.json"
    try:
        old = Stream.open(json_path)
    except FileNotFoundError:
        return None
    if old.info.compared == info.compared:
        return old
    raise FileExistsError(
        f"{json_path}: exists with other settings; give the stream a name=, or replace it with force=True"
    )


@own_numbers
def replay(clip: ClipFolder, stream: Stream, frame: int) -> tuple[Array, Array]:
    """Return one frame drawn again from the stream's json, and the stored frame: codes [H, W] each."""
    if not 0 <= frame < len(stream):
        raise ValueError(f"{stream.path}: frame {frame} does not exist; the stream has frames 0..{len(stream) - 1}")
    return stored(stream).frames(clip, frame, frame + 1)[0], stream.codes(frame, frame + 1)[0]


def write_stream(clip: ClipFolder, name: str, codes_iter: Iterable[Array], info: StreamInfo) -> Stream:
    """Store codes ([H, W] frames or [t, H, W] blocks, in order) as a stream of `clip`; the json is written last.

    `ValueError` if there are not as many frames as `info` states.
    """
    shape = info.shape[1:]

    def packed() -> Iterator[Array]:
        done = 0
        for block in codes_iter:
            block = block if block.ndim == 3 else block[None]
            if block.shape[1:] != shape:
                raise ValueError(f"{clip.path}, {name}: frame {done} is {block.shape[1:]}, expected {shape}")
            yield packing.pack(block, info.bits)
            done += len(block)

    with writing(clip.path / "streams"):
        return _write(clip, name, packed(), info)


def _write(clip: ClipFolder, name: str, blocks: Iterable[Array], info: StreamInfo) -> Stream:
    """Store packed blocks as a stream of the clip; the caller holds the lock of its streams."""
    path = clip.path / "streams" / f"{check_name(name)}.npy"
    scratch.sweep(path.parent)
    return write_packed(path, blocks, info)

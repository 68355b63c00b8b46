"""Prepares the clips of a bit-depth study: one clip at several speeds, rendered scenes, clips of grouped frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from qsim import keys
from qsim.clip.clip_info import ClipInfo, Grouped, Origin, SceneName
from qsim.clip.manifest import target_of
from qsim.clip.writer import ClipWriter
from qsim.files import Progress
from qsim.sensor.sensor import Sensor
from qsim.streams.clip import Clip
from qsim.streams.exposures import Timing
from qsim.streams.photons import light_level
from qsim.streams.sensing import Sensing
from qsim.streams.simulation import Draw
from qsim.streams.storing import describe, sense, write_stream
from qsim.studies.bit_depth.clip_study import check_clip
from qsim.studies.bit_depth.readout import StudySettings, at_depth, plane_sensor, readouts


@dataclass(frozen=True, eq=False)
class MovingClip:
    """A clip at one speed: rendered at that speed (step 1), or read at every `step`-th frame."""

    speed: float
    clip: Clip
    step: int = 1


@dataclass(frozen=True)
class ClipShape:
    """The size, rate and error of a clip that is rendered for a study."""

    frames: int
    height: int = 96
    width: int = 128
    frame_rate: float = 10_000.0
    psnr: float = 40.0  # wanted error of the radiance, dB
    seed: int = 0


def render(name: str, path: Path, shape: ClipShape, *, speed: float = 1.0, progress: Progress | None = None) -> Clip:
    """Render a scene to a clip, or return the clip at `path` if scene, its files, shape, rate and speed are the same.

    Raise `FileExistsError` if the clip there is another one.
    """
    from qsim.dataset import scene_files
    from qsim.rendering import fidelity
    from qsim.rendering.clip_rendering import render_clip

    loaded, read = scene_files.load(name, shape.seed, speed)
    scene = loaded.resized(shape.height, shape.width)
    if (path / "clip.json").is_file():
        clip = Clip.open(path)
        wanted = SceneName(family=scene.name, seed=scene.seed, speed=scene.speed)
        same = clip.shape == (shape.frames, shape.height, shape.width) and clip.frame_rate == shape.frame_rate
        if not same or clip.info.scene != wanted:
            raise FileExistsError(f"{path}: exists and is another clip; name another folder")
        if clip.info.reads != read:
            raise FileExistsError(
                f"{path}: exists and is not known to be of {name} and its files as they are now; name another folder"
            )
        return clip
    frames = shape.frames
    rate = shape.frame_rate
    chosen = fidelity.choose_budget(scene, frame_rate=rate, frames=frames, psnr=shape.psnr, seed=shape.seed)
    made_of = Origin(reads=read)
    return render_clip(
        scene, path, frames=frames, frame_rate=rate, seed=shape.seed, budget=chosen, progress=progress, made_of=made_of
    )


def clips_for(
    source: str, speeds: Sequence[float], shape: ClipShape, folder: Path | None, progress: Progress | None = None
) -> Iterator[MovingClip]:
    """Yield a clip at each speed: a clip folder (whole speeds from 1), or a scene rendered into FOLDER/clips.

    `progress` is called with the frames that are rendered and to be rendered, of all clips together.
    """
    if (Path(source) / "clip.json").is_file():
        clip = Clip.open(source)
        if any(v < 1 or not float(v).is_integer() for v in speeds):
            raise ValueError(
                f"{source}: a clip can be made faster by whole factors only; for other speeds name a scene"
            )
        yield from (MovingClip(v, clip, int(v)) for v in speeds)
        return
    from qsim import scenes

    if source not in scenes.FAMILIES and not source.endswith(".py"):
        raise FileNotFoundError(
            f"{source}: neither a clip folder nor a scene; the scenes are {', '.join(scenes.FAMILIES)}"
        )
    if folder is None:
        raise ValueError(f"{source} is a scene: give a folder for its clip")
    paths = {v: clip_path(folder, source, v) for v in speeds}
    missing = [v for v, path in paths.items() if not (path / "clip.json").is_file()]

    def of_all(v: float) -> Progress | None:
        if progress is None or v not in missing:
            return None
        before = missing.index(v) * shape.frames
        return lambda done, total: progress(before + done, len(missing) * shape.frames)

    for v, path in paths.items():
        yield MovingClip(v, render(source, path, shape, speed=v, progress=of_all(v)))


def clip_path(folder: Path, source: str, speed: float) -> Path:
    """Return the folder of the clip of a scene at a speed."""
    return folder / "clips" / f"{Path(source).stem}_x{speed:g}"


def to_render(source: str, speeds: Sequence[float], folder: Path | None) -> int:
    """Return how many clips `clips_for` renders."""
    if folder is None or (Path(source) / "clip.json").is_file():
        return 0
    return sum(not (clip_path(folder, source, v) / "clip.json").is_file() for v in speeds)


def check_sensors(settings: StudySettings, streams: bool) -> None:
    """Raise `ValueError` if a sensor cannot be read as the study needs it, or not stored as `streams`.

    Neither depends on light and exposure.
    """
    readouts(settings, 1.0, 1e-4)
    if streams:
        _summed_plane(settings, 1.0, 1e-4)


def _summed_plane(settings: StudySettings, ppp: float, exposure: float) -> Sensor:
    """Return the sensor of planes whose sums are stored; raise `ValueError` if it is no clocked SPAD."""
    plane = plane_sensor(settings, ppp, exposure)
    if not plane.sums_planes:
        raise ValueError("streams of summed planes need a clocked SPAD; leave out the plane sensor")
    return plane


def stream_clip(clip: Clip, folder: Path, bits: int, force: bool) -> Path:
    """Return the clip that `write_streams` writes for a depth; `FileExistsError` if it may not be replaced."""
    path = folder / f"{clip.name}_{bits}bit"
    target_of(path, force)
    return path


def write_streams(clip: Clip, folder: Path, settings: StudySettings, *, force: bool = False) -> list[Path]:
    """Write one clip per bit depth, FOLDER/NAME_3bit, with the streams `planes` and `multibit`; return their paths.

    Their frames are means of 2^b - 1 frames of `clip`, and their sharp frames are the middle ones. So
    `quiver evaluate FOLDER/NAME_3bit --stream planes` scores a restorer against the sharp instants.
    """
    check_clip(clip, settings)
    clip.require_one_band("a stream of summed light")
    level = light_level(clip, ppp=settings.ppp)
    plane = _summed_plane(settings, level.ppp, clip.exposure)
    made = []
    for bits in settings.bits:
        m = 2**bits - 1
        path = stream_clip(clip, folder, bits, force)
        read = Sensing(settings.sensor, bits, ppp=m * level.ppp, seed=settings.seed, name="multibit")
        if settings.sensor.endswith(".toml"):  # read at every depth, which the file does not state
            depth = at_depth(settings.sensor, bits, m * level.ppp, m * clip.exposure, settings.temperature)
            read = replace(read, sensor=depth)
        grouped = group(clip, path, m, force=force)
        sense(grouped, read)
        key = keys.Key(seed=settings.seed, clip=keys.hash_name(clip.name))
        summed = plane.at_depth(bits)
        assert summed is not None  # planes are summed at every depth
        draw = Draw(summed, level, key, Timing(m, summed=True), origin=clip.origin)
        # A code is one frame of `grouped`: its exposure is m times longer, which relative light does not know.
        of_code = level.over(m)
        if clip.camera is None:
            of_code = replace(of_code, factor=m * level.factor, before=level.before)
        info = describe(grouped, replace(read, sensor=draw.sensor), replace(draw, level=of_code, timing=Timing()))
        info = replace(info, planes_of=str(clip.path), drawn_by=draw.law, clip_key=None)  # `grouped` cannot draw it
        frames = (draw.frames(clip, t, t + 1) for t in range(len(grouped)))
        write_stream(grouped, "planes", frames, info)
        made.append(path)
    return made


def group(clip: Clip, path: Path, m: int, *, force: bool = False) -> Clip:
    """Write a clip whose frames are means of m frames (m odd) and whose sharp frames are the middle ones."""
    # The pose of a mean is that of its middle frame.
    kept = ("radiance_unit", "camera", "scene", "split", "origin", "seed", "render")
    frames, height, width = clip.shape
    info = ClipInfo(
        **{name: getattr(clip.info, name) for name in kept},
        shape=(frames // m, height, width),
        frame_rate=clip.frame_rate / m,
        exposure=clip.exposure * m,
        shutter=1.0,
        poses=clip.info.poses[m // 2 :: m][: frames // m],
        grouped=Grouped(clip=clip.name, frames=m),
    )
    with ClipWriter(path, info, force=force) as writer:
        for t in range(frames // m):
            mean = np.stack([clip.radiance(t * m + i) for i in range(m)]).mean(axis=0, dtype=np.float64)
            cut = None
            if clip.info.saturated_pixels:
                cut = np.any([clip.saturated(t * m + i) for i in range(m)], axis=0)
            middle = t * m + m // 2
            sharp = clip.sharp(middle) if m > 1 or clip.info.has("sharp", middle) else None
            writer.add(t, np.asarray(mean, np.float32), sharp, saturated=cut)
    return Clip.open(path)

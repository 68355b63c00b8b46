"""Writes clips, streams and events for others: cubes, mp4, PNG, EXR, zarr, .dat, camera paths, .h5; with a .json."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import files, scratch
from qsim.clip.manifest import check_outside
from qsim.colour import code_levels, peak
from qsim.formats import array_files, challenge, event_files, images, photon_times, raw_cameras, video
from qsim.formats.export_info import ExportInfo, beside, is_ours
from qsim.scene.camera_path import camera_path
from qsim.streams.clip import Clip
from qsim.streams.event_stream import EventStream
from qsim.streams.stream import Stream

BLOCK = 16  # frames read at a time
Source = Clip | Stream | EventStream


@dataclass(frozen=True)
class Export:
    """The format of an export."""

    kind: str  # cube, mp4, png, exr, zarr, challenge, spike, photons, nerfstudio, events
    transfer: str = "gamma 2.2"  # of pictures of light
    white: float | None = None  # light that becomes full scale; None: the 99.9th percentile
    lossless: bool = True  # of mp4
    playback: float = 30.0  # frames per second of an mp4; its .json has the capture rate
    planes: int = challenge.PLANES  # of a cube of the challenge


def export(source: Source, path: Path, wanted: Export, *, force: bool = False) -> Path:
    """Write a clip's light or a stream's codes for other programs, with PATH.json (or PATH/meta.json) beside it.

    `ValueError` if the kind cannot hold it: a photon cube holds one bit, an EXR holds light.
    """
    _export(source, path, wanted, force)
    return path


def _export(source: Source, path: Path, wanted: Export, force: bool) -> ExportInfo:
    if wanted.kind not in EXPORTS:
        raise ValueError(f"{path}: unknown kind {wanted.kind!r}; there are {', '.join(EXPORTS)}")
    check(source, wanted)
    if isinstance(source, EventStream):
        event_files.check(path, source)
    check_outside(path)
    if (path.exists() or path.is_symlink()) and not force:
        raise FileExistsError(f"{path}: exists; name another, or replace it with force=True")
    info = _info(source, wanted)
    path.parent.mkdir(parents=True, exist_ok=True)
    single = wanted.kind in ("cube", "mp4", "spike", "photons", "events")
    side = path.with_name(path.name + ".json")
    scratch.sweep(path.parent)
    for place in [path, *([side] if single else [])]:
        _check_ours(place, side if single else place / "meta.json", single)
    if single:
        with files.replacing_together(path, side) as (made, described):
            info = EXPORTS[wanted.kind](source, made, wanted, info)
            files.write_json(described, info.values)
        return info
    with files.naming(path), scratch.Scratch(path) as unfinished:
        part = unfinished.new()
        part.mkdir()
        info = EXPORTS[wanted.kind](source, part, wanted, info)
        files.write_json(part / "meta.json", info.values)
        files.sync_tree(part)
        if path.exists():  # or it appeared meanwhile
            if not force:
                raise FileExistsError(
                    f"{path}: appeared while it was written; move it away and run the same command again"
                )
            _check_ours(path, path / "meta.json", False)
            files.remove_folder(path)
        part.rename(path)
    files.sync_folder(path.parent)
    return info


def check(source: Source, wanted: Export) -> None:
    """Raise `ValueError` if events, the challenge or a camera path cannot hold this source; others check on writing."""
    if isinstance(source, EventStream) and wanted.kind != "events":
        raise ValueError(f"{source.path}: holds events, which are written with to=events")
    if wanted.kind == "events" and not isinstance(source, EventStream):
        raise ValueError(f"{source.path}: holds no events; draw some with `qsim events`, and name their .json")
    if wanted.kind == "challenge":
        if not isinstance(source, Clip):
            raise ValueError(f"{source.path}: is one stream, the challenge has three colours; name the clip's folder")
        challenge.bands_of(source, wanted.planes)
    if wanted.kind == "nerfstudio":
        if not isinstance(source, Clip):
            raise ValueError(f"{source.path}: is a stream, and poses belong to light; name the clip's folder")
        camera_file(source)


def described(source: Source, path: Path, wanted: Export, *, force: bool = False) -> tuple[Path, str]:
    """Export; return the path and one line: kind, frames, size, rates, white."""
    info = _export(source, path, wanted, force)
    if isinstance(source, EventStream):
        return path, source.said
    if info.cubes is not None:
        return path, f"challenge, {challenge.line(info.cubes, source.shape)}"
    frames, height, width = source.shape
    shown = f", played at {wanted.playback:g}" if wanted.kind == "mp4" else ""
    if isinstance(source, Stream):
        about = f"{source.bits}-bit codes" + (", stretched to 0..255" if info.stretched else "")
    elif info.white is not None:
        bits = _depth(source, wanted)
        about = f"light in {bits} bits by {info.transfer}, white {info.white:.4g} {source.info.radiance_unit}"
    else:
        about = f"linear light in {source.info.radiance_unit}"
    if isinstance(source, Clip):
        about += "; not written: codes, flow, depth (to=pairs writes codes, truth and flow)"
    rate = source.info.frame_rate
    return path, f"{wanted.kind}, {frames} frames of {height} x {width} pixels at {rate:g} per second{shown}, {about}"


_NAMES = (
    r"(meta|transforms)\.json|[0-9]{6,}\.(png|exr|npy)"
    r"|(frames/)?zarr\.json|frames/c/[0-9]+/[0-9]+/[0-9]+"
)


def _check_ours(place: Path, description: Path, single: bool) -> None:
    """Raise `FileExistsError` if `place` exists and is not an export with its description."""
    if not place.exists() and not place.is_symlink():
        return
    if place.is_symlink() or place.is_dir() == single or not is_ours(beside(description)):
        raise FileExistsError(f"{place}: was not written by `qsim convert`; move it, or name another output")
    if not single:
        files.check_ours(place, _NAMES)


def _cube(source: Clip | Stream, path: Path, _wanted: Export, info: ExportInfo) -> ExportInfo:
    if isinstance(source, Clip) or source.bits != 1:
        what = "a clip holds light" if isinstance(source, Clip) else f"this stream has {source.bits}"
        summed = isinstance(source, Stream) and source.sums is not None and source.sums.planes > 1
        cure = "sums of planes have none: export the single planes" if summed else "sense it with bits=1"
        raise ValueError(f"{source.path}: a photon cube holds one bit per pixel, {what}; {cure}")
    array_files.write_cube(path, _code_blocks(source), source.shape)
    return info


def _mp4(source: Clip | Stream, path: Path, wanted: Export, info: ExportInfo) -> ExportInfo:
    if isinstance(source, Stream) and source.bits > 8:
        raise ValueError(
            f"{source.path}: a video holds 8 bits per pixel, this stream has {source.bits}; use png or zarr"
        )
    if isinstance(source, Clip) and wanted.lossless:
        source.require_one_band("lossless mp4")
    video.write_video(path, _grey(source, wanted, info), wanted.playback, lossless=wanted.lossless)
    return info


def _png(source: Clip | Stream, path: Path, wanted: Export, info: ExportInfo) -> ExportInfo:
    if isinstance(source, Clip):
        images.write_png(path, _grey(source, wanted, info))
    else:
        codes = (image for block in _code_blocks(source) for image in block)
        images.write_png(path, (image.astype(bool) if source.bits == 1 else image for image in codes))
    return info


def _nerfstudio(source: Any, path: Path, wanted: Export, info: ExportInfo) -> ExportInfo:
    images.write_png(path, _grey(source, wanted, info))
    files.write_json(path / "transforms.json", camera_file(source))
    return info


def camera_file(clip: Clip) -> dict[str, object]:
    """Return the content of a transforms.json of a clip: its camera, and a pose per frame named 000000.png and so on.

    `ValueError` for a clip without a camera, and with less than two frames.
    """
    if clip.camera is None:
        raise ValueError(f"{clip.path}: has no camera (imported video); only rendered clips have poses")
    if len(clip) < 2:
        raise ValueError(f"{clip.path}: has one frame; a camera path needs two or more")
    poses = [np.array(pose) for pose in clip.info.poses] or [clip.camera.pose()] * len(clip)
    height, width = clip.shape[1:]
    names = [f"{t:06d}.png" for t in range(len(clip))]
    return camera_path(clip.camera, poses, names, clip.frame_rate, clip.origin) | {"w": width, "h": height}


def _exr(source: Clip | Stream, path: Path, _wanted: Export, info: ExportInfo) -> ExportInfo:
    if not isinstance(source, Clip):
        raise ValueError(f"{source.path}: EXR holds light, this is a stream of codes; use png, zarr or mp4")
    images.write_exr(path, (source.radiance(t) for t in range(len(source))))
    return info


def _zarr(source: Clip | Stream, path: Path, _wanted: Export, info: ExportInfo) -> ExportInfo:
    if isinstance(source, Clip):
        source.require_one_band("zarr")
    frames, height, width = source.shape
    rate = source.info.frame_rate
    # quanta-spad-sim calls the length of the whole recording T_exp.
    attributes = {"fps": rate, "T_exp": frames / rate, "T": frames, "H": height, "W": width, "shape": [*source.shape]}
    blocks = _light_blocks(source) if isinstance(source, Clip) else _code_blocks(source)
    array_files.write_zarr(path, blocks, source.shape, attributes | {"qsim": info.values})
    return info


def _challenge(source: Any, path: Path, wanted: Export, info: ExportInfo) -> ExportInfo:
    return info.but(cubes=challenge.write(source, path, wanted.planes))


def _spike(source: Clip | Stream, path: Path, _wanted: Export, info: ExportInfo) -> ExportInfo:
    if isinstance(source, Clip) or source.bits != 1:
        what = "this is light" if isinstance(source, Clip) else f"this stream has {source.bits}"
        raise ValueError(f"{source.path}: a spike file holds one bit per pixel, {what}; name a stream of one bit")
    raw_cameras.write_spike(path, _code_blocks(source), source.shape)
    return info.but(bit_order="lsb", orientation="upside down")


def _events(source: Any, path: Path, _wanted: Export, info: ExportInfo) -> ExportInfo:
    event_files.write(source, path)
    return info


def _photons(source: Clip | Stream, path: Path, _wanted: Export, info: ExportInfo) -> ExportInfo:
    if isinstance(source, Clip):
        raise ValueError(f"{source.path}: a clip has light, and no single photons; name one of its streams")
    return info.but(events=photon_times.write(source, path))


EXPORTS: dict[str, Callable[[Any, Path, Export, ExportInfo], ExportInfo]] = {
    "cube": _cube,
    "mp4": _mp4,
    "png": _png,
    "exr": _exr,
    "zarr": _zarr,
    "challenge": _challenge,
    "spike": _spike,
    "photons": _photons,
    "nerfstudio": _nerfstudio,
    "events": _events,
}


def _info(source: Source, wanted: Export) -> ExportInfo:
    """Return the description of an export before it is written: what is known of it by its source and its kind."""
    info = ExportInfo(source=source.info, orientation=source.info.orientation)
    if isinstance(source, EventStream):
        return info.but(time_unit="us", time_zero="middle of the exposure of frame 0")
    info = info.but(bit_order="msb", lossless=wanted.lossless if wanted.kind == "mp4" else None)
    if isinstance(source, Stream):
        return info.but(stretched=True) if wanted.kind == "mp4" else info
    stated = {"exr": "linear", "zarr": "linear", "challenge": "srgb"}
    info = info.but(transfer=stated.get(wanted.kind, wanted.transfer))
    if wanted.kind not in ("mp4", "png", "nerfstudio"):
        return info
    return info.but(white=wanted.white if wanted.white is not None else _white(source))


def _grey(source: Clip | Stream, wanted: Export, info: ExportInfo) -> Iterator[Array]:
    if isinstance(source, Clip):
        assert info.white is not None
        for block in _light_blocks(source):
            levels = images.grey(block, info.white, wanted.transfer, _depth(source, wanted))
            yield from levels if source.bands is None else np.ascontiguousarray(np.moveaxis(levels, -3, -1))
    else:
        for block in _code_blocks(source):
            yield from code_levels(block, 2**source.bits - 1)


def _depth(clip: Clip, wanted: Export) -> int:
    """Return the bits of a pixel and band: PNG holds 16 of grey, and 8 of each colour."""
    return 16 if wanted.kind == "png" and clip.bands is None else 8


def _white(clip: Clip) -> float:
    """Return the peak of up to 64 frames of a clip, of every second row and column, in its unit."""
    step = max(1, len(clip) // 32)
    samples = np.stack([clip.radiance(t)[..., ::2, ::2] for t in range(0, len(clip), step)])
    return peak(samples)


def _light_blocks(clip: Clip) -> Iterator[Array]:
    for start in range(0, len(clip), BLOCK):
        yield np.stack([clip.radiance(t) for t in range(start, min(start + BLOCK, len(clip)))])


def _code_blocks(stream: Stream) -> Iterator[Array]:
    for start in range(0, len(stream), BLOCK):
        yield stream.codes(start, min(start + BLOCK, len(stream)))

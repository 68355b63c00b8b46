"""Opens the test sets of the paper in their own layouts, as clips whose light is the grey value of each pixel.

    FOLDER/*.mp4, I2-2000FPS, and folders of pictures or videos at any depth, X4K1000FPS  ->  OUT/NAME, one clip each

As the published program does, colour becomes grey by the weights of OpenCV, 0.299 R + 0.587 G + 0.114 B in whole
numbers, and grey / 255 is taken as light, though it is gamma-coded. Sizes are those of the program's loader. A change
of size is bicubic (a = -0.75, no antialiasing), rounded to whole numbers.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim.clip import manifest
from qsim.clip.clip_info import ClipInfo
from qsim.clip.source import Source
from qsim.clip.writer import ClipWriter
from qsim.files import Progress, sha256, to_json
from qsim.formats.detection import recordings
from qsim.formats.images import read_pictures
from qsim.formats.video import read_frames
from qsim.streams.clip import Clip

WINDOW = 11  # frames of a published window; one is restored
WEIGHTS = (0.299, 0.587, 0.114)  # of red, green and blue in OpenCV's grey
OURS = rf"[^/]+/(?:{manifest.OURS}|begun\.json|journal\.jsonl|lock)"  # files of imported clips, finished or not


@dataclass(frozen=True)
class TestSet:
    """A test set of the paper: how its clips are read, and how many there are."""

    __test__ = False  # no test of pytest

    name: str  # of the protocol
    frame_rate: float  # Hz
    size: Callable[[int, int], tuple[int, int]]  # of the loader, for the height and width of a file
    clips: int
    windows: int  # one for every frame with five frames before and five after it


def _nearly_fours(height: int, width: int) -> tuple[int, int]:
    """Return the size of the published loader: a multiple of four for even sides."""
    return height + height % 4, width + width % 4


TEST_SETS = {
    "quiver-published": TestSet("quiver-published", 2000.0, _nearly_fours, 31, 6017),
    "x4k1000fps": TestSet("x4k1000fps", 1000.0, lambda height, width: (512, 1024), 15, 345),
}


def describe(folder: Path, which: TestSet) -> dict[Path, ClipInfo]:
    """Read a test set, and return what the clip of each recording states of itself.

    `FileNotFoundError` without the folder. `ValueError` if it holds no recordings, both kinds of them, two that would
    have one name, or one of fewer than eleven frames.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; name the folder of the test set")
    files = recordings(folder, None)
    if not files:
        raise ValueError(f"{folder}: holds no videos and no folders of pictures; name the folder of the test set")
    if files[0].is_file() and (pictures := recordings(folder, "png")):
        raise ValueError(f"{folder}: holds videos and folders of pictures ({pictures[0]}); name the folder of one kind")
    _check_names(folder, files)
    return {file: _described(file, which) for file in files}


def import_test_set(
    folder: Path,
    which: TestSet,
    out: Path,
    progress: Progress | None = None,
    described: Mapping[Path, ClipInfo] | None = None,
) -> list[Clip]:
    """Write the clips of a test set that OUT does not hold yet, and return all of them in the order of their names.

    `described` is the result of `describe`, where that was called before. Errors as there, and `ValueError` if OUT
    holds clips of other files. All are checked before the first is written.
    """
    described = describe(folder, which) if described is None else described
    targets = {file: out / _name(folder, file) for file in described}
    _check_others(folder, out, {target.name for target in targets.values()})
    for file, info in described.items():
        _check_target(targets[file], info)
    clips = []
    for done, (file, info) in enumerate(described.items()):
        if progress is not None:
            progress(done, len(described))
        clips.append(_imported(file, targets[file], info))
    if progress is not None:
        progress(len(described), len(described))
    return clips


def counted(clips: list[Clip], which: TestSet) -> str:
    """Return one line: how many windows the clips have, and how many the published set has."""
    windows = sum(len(clip) - WINDOW + 1 for clip in clips)
    found = f"{which.name}: {len(clips)} clips, {windows} windows"
    if (len(clips), windows) == (which.clips, which.windows):
        return f"{found}, as published"
    return f"{found}; the published set has {which.clips} clips and {which.windows} windows"


def _name(folder: Path, file: Path) -> str:
    place = file.relative_to(folder)
    return re.sub(r"[^A-Za-z0-9_.-]", "_", "_".join((*place.parts[:-1], place.stem if file.is_file() else place.name)))


def _check_names(folder: Path, files: list[Path]) -> None:
    """Raise `ValueError` if two recordings get the same name of a clip."""
    taken: dict[str, Path] = {}
    for file in files:
        other = taken.setdefault(_name(folder, file), file)
        if other != file:
            raise ValueError(f"{folder}: {other} and {file} would both be clip {_name(folder, file)}; rename one")


def _described(file: Path, which: TestSet) -> ClipInfo:
    """Return what a clip of a recording states of itself; `ValueError` for one of fewer than eleven frames."""
    frames = read_frames(file) if file.is_file() else read_pictures(file)
    first = next(frames, None)
    if first is None:
        raise ValueError(f"{file}: holds no frame")
    size = which.size(*first.shape[:2])
    count = sum(1 for _ in frames) + 1
    if count < WINDOW:
        raise ValueError(f"{file}: {count} frames; a published window has {WINDOW}")
    height, width = first.shape[:2]
    return ClipInfo(
        shape=(count, *size),
        frame_rate=which.frame_rate,
        exposure=1 / which.frame_rate,
        source=Source(file=str(file.resolve()), sha256=_digest(file), test_set=which.name, size=(height, width)),
        split="test",
    )


def _digest(file: Path) -> str:
    """Return the SHA-256 of a video, or of the names and digests of the pictures in a folder."""
    if file.is_file():
        return sha256(file)
    pictures = [item for item in file.iterdir() if item.suffix.lower() == ".png" and not item.name.startswith(".")]
    return sha256(to_json({picture.name: sha256(picture) for picture in pictures}))


def _check_others(folder: Path, out: Path, names: set[str]) -> None:
    """Raise `ValueError` if OUT holds anything but clips of these names, finished or not: it would be scored along."""
    for item in sorted(out.iterdir()) if out.is_dir() else []:
        if not item.name.startswith(".") and not {item.name, item.name.removesuffix(".part")} & names:
            raise ValueError(f"{item}: is no clip of {folder}; choose another")


def _check_target(target: Path, info: ClipInfo) -> None:
    """Raise `ValueError` if the folder of a clip holds another one."""
    if not target.exists():
        return
    clip = Clip.open(target)
    wanted = info.source or Source()
    found = clip.info.source or Source()
    same = clip.shape == info.shape
    if found == wanted and same:
        return
    if replace(found, sha256=wanted.sha256) == wanted and same:
        raise ValueError(f"{target}: {wanted.file} was changed since it became this clip; choose another")
    raise ValueError(
        f"{target}: is a clip of {found.file or 'another source'} with {len(clip)} frames, not of {wanted.file} with "
        f"{info.shape[0]}; choose another"
    )


def _imported(file: Path, target: Path, info: ClipInfo) -> Clip:
    """Return the clip of a recording, written now unless it is there."""
    if target.exists():
        return Clip.open(target)
    size = info.shape[1:]
    with ClipWriter(target, info) as writer:
        for t, frame in enumerate(read_frames(file) if file.is_file() else read_pictures(file)):
            if not writer.has(t):
                writer.add(t, resized(grey(frame), size).astype(np.float32) / np.float32(255))
    return Clip.open(target)


def grey(frame: Array) -> Array:
    """Return a frame of 8 bits, [H, W] or [H, W, 3] in red, green and blue, as grey of 8 bits [H, W]."""
    if frame.ndim == 2:
        return frame
    return np.rint(frame @ np.array(WEIGHTS)).astype(np.uint8)


def resized(frame: Array, size: tuple[int, int]) -> Array:
    """Return a grey frame of 8 bits [H, W] at another size, bicubic without antialiasing."""
    if frame.shape == size:
        return frame
    import torch
    import torch.nn.functional as functional

    image = torch.from_numpy(frame.astype(np.float32))[None, None]
    return functional.interpolate(image, size=size, mode="bicubic").round().clamp(0, 255)[0, 0].numpy().astype(np.uint8)

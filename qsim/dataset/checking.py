"""Compares data sets, clips, streams and restored video with their checksums.

A description holds the checksum of its keys, and the checksums of its frames or codes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy import ndarray as Array

from qsim import files, structure
from qsim.checks import check_video
from qsim.dataset.dataset import Dataset
from qsim.files import Progress, load_array
from qsim.streams.clip import Clip
from qsim.streams.stream import Stream


def lines(problems: list[str], names: str) -> list[str]:
    """Return one line per problem, or one that reports none."""
    return problems or [f"{names}: every file is what was written"]


def check(path: Path, progress: Progress | None = None) -> list[str]:
    """Compare every file below a data set, a clip, a stream or a restored video with its checksum; return problems.

    `FileNotFoundError` or `ValueError` if the path is none of them. `progress` is called with (done, total).
    """
    if (path / "dataset.json").is_file() or (path / "jobs").is_dir():
        dataset = Dataset.open(path)
        return dataset.verify(progress)
    if (path / "clip.json").is_file() or not path.with_suffix(".json").is_file():
        return _checked(lambda: Clip.open(path), path / "clip.json", progress)
    description = path.with_suffix(".json")
    found = files.read_json(description)
    if "ppp_factor" in found:
        return _checked(lambda: Stream.open(description), description, progress)
    if "seconds_per_frame" in found:
        return _checked(lambda: Restored.open(description), description, progress)
    raise ValueError(f"{path}: expected a data set, a clip, a stream or a restored video")


@dataclass(frozen=True)
class Restored:
    """Restored video: NAME.npy, float32 photons [T, H, W] or [T, 3, H, W], and NAME.json."""

    path: Path  # NAME.npy
    meta: dict[str, Any]  # NAME.json

    @staticmethod
    def open(description: Path) -> Restored:
        """Open a restored video by its description; `ValueError` if that is damaged."""
        cure = "restore the video again"
        meta = files.read_json(description)
        structure.description(description, meta, structure.RESTORED, cure)
        files.check_own(description, meta, cure)
        return Restored(description.with_suffix(".npy"), meta)

    def frames(self) -> Array:
        """Return the video, float32 photons, as a memory map; `ValueError` if it differs from its .json."""
        array = load_array(self.path)
        check_video(self.path, array.shape)
        if array.dtype.kind != "f" or self.meta.get("shape", list(array.shape)) != list(array.shape):
            raise ValueError(f"{self.path}: {array.dtype} {list(array.shape)} is not what its .json describes")
        return array

    def verify(self, progress: Progress | None = None) -> list[str]:
        """Return the problems of the video's file."""
        return files.differs(self.path, self.meta.get("sha256"))


def _checked(open_it: Any, description: Path, progress: Progress | None) -> list[str]:
    """Return the problems of one object; a damaged description is a problem, a missing one an error."""
    try:
        opened = open_it()
    except ValueError as error:
        if not description.is_file():
            raise
        return [str(error)]
    problems: list[str] = opened.verify(progress)
    return problems

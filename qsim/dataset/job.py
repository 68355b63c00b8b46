"""Defines one job of a data set: a clip with its streams, and the digest of all that decides its files."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from dataclasses import dataclass
from pathlib import Path

from qsim import files
from qsim.clip.sensing import Sensing
from qsim.files import to_json


@dataclass(frozen=True)
class Settings:
    """How a clip is rendered."""

    frames: int
    height: int  # pixels
    width: int  # pixels
    frame_rate: float  # Hz
    shutter: float = 0.0  # open share of a frame
    psnr: float = 40.0  # dB below white, wanted error of the radiance


@dataclass(frozen=True)
class Job:
    """One clip with its streams: a pure description; the same job gives the same files."""

    name: str
    family: str
    scene_seed: int
    speed: float
    split: str
    settings: Settings
    seed: int
    streams: tuple[Sensing, ...]

    @property
    def stem(self) -> str:
        """The family's name without folder and ending."""
        return Path(self.family).stem

    @property
    def scene(self) -> str:
        """What splits are made by: family and seed."""
        return f"{self.stem}:{self.scene_seed}"

    @property
    def digest(self) -> str:
        """SHA-256 of everything that decides the job's files."""
        return self.digest_with(psnr_unit="below white")

    def digest_with(self, **more: str) -> str:
        """The same with what else decides; without any, that of versions whose psnr was below the 99.9th percentile."""
        described = dataclasses.asdict(self) | {"family": Path(self.family).stem}
        described["streams"] = [stream | {"sensor": Path(stream["sensor"]).name} for stream in described["streams"]]
        for stream in described["streams"]:  # what is off stays out, so that data sets of earlier versions go on
            for key, off in (("defects", None), ("slices", 1)):
                if stream[key] == off:
                    del stream[key]
        own = [path for path in (self.family, *(stream.sensor for stream in self.streams)) if Path(path).is_absolute()]
        if own:  # by content: what a file says decides, not what it is called
            described["own"] = [_contents(path) for path in own]
        return hashlib.sha256(to_json(described | more)).hexdigest()


def _contents(path: str) -> str:
    """SHA-256 of a scene or sensor file, or of all files in a folder with their names."""
    root = Path(path)
    parts = sorted(part for part in root.rglob("*") if part.is_file()) if root.is_dir() else [root]
    # With the time of the last change of the inode, which nobody can set back.
    states = [(str(part.relative_to(root)), part.stat()) for part in parts]
    state = tuple((name, (of.st_mtime_ns, of.st_ctime_ns, of.st_ino, of.st_size)) for name, of in states)
    return _read_contents(path, state)


@functools.lru_cache(maxsize=64)
def _read_contents(path: str, state: tuple[tuple[str, tuple[int, ...]], ...]) -> str:
    """The same, read once as long as no file changes."""
    listed = [(name, files.sha256(Path(path) / name)) for name, _ in state]
    return files.sha256(to_json(listed))

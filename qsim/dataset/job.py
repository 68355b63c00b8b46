"""Describes one job of a data set: a clip, its streams, and a digest of everything that decides their files.

    digest of a job = SHA-256 of (digest of its series, seed of its scene, speed)

The digest of a series covers all that its clips share, so that a data set states the digests of a million clips by
those of its few series.
"""

from __future__ import annotations

import functools
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qsim import files, plugins
from qsim.files import to_json
from qsim.kinds import Split
from qsim.rendering.render_settings import RenderSettings
from qsim.sensor.defects import defect_table
from qsim.settings import given
from qsim.streams.sensing import Sensing


@dataclass(frozen=True)
class Job:
    """Description of one clip and its streams; the same job gives the same files."""

    family: str  # of the library, or the absolute path of a scene file or folder
    scene_seed: int
    speed: float  # factor on all motions
    split: Split
    settings: RenderSettings
    seed: int  # of the samples
    streams: tuple[Sensing, ...]
    block: str = ""  # folder of its files in a data set of more than a thousand clips, as "012" (series.py)

    @property
    def name(self) -> str:
        """Return the name of the clip, as `fan_0003_x2`."""
        return clip_name(self.stem, self.scene_seed, self.speed)

    @property
    def key(self) -> str:
        """Return the name with the folder that holds it, as `012/fan_0003`."""
        return f"{self.block}/{self.name}" if self.block else self.name

    @property
    def stem(self) -> str:
        """Return the family's name without folder and ending."""
        return Path(self.family).stem

    @property
    def scene(self) -> str:
        """Return FAMILY:SEED, the unit by which splits are made."""
        return f"{self.stem}:{self.scene_seed}"

    @property
    def digest(self) -> str:
        """Return the SHA-256 of everything that decides the job's files."""
        return job_digest(self.series_digest, self.scene_seed, self.speed)

    @property
    def series_digest(self) -> str:
        """Return the SHA-256 of everything that decides the files of a series, but seeds and speeds."""
        described: dict[str, Any] = {"family": self.stem, "split": self.split, "seed": self.seed}
        described["settings"] = given(self.settings)
        described["settings"].pop("camera_path", None)  # the content of the file decides, see below
        described["streams"] = [given(stream) for stream in self.streams]
        for stream in described["streams"]:
            for key in ("sensor", "colour"):
                if isinstance(stream.get(key), str):
                    stream[key] = Path(stream[key]).name
        named = (self.family, self.settings.camera_path or "", *(stream.sensor_name for stream in self.streams))
        own = [plugins.file_of(path) or path for path in named if Path(path).is_absolute()]
        own += [path for stream in self.streams for path in _read_by(stream)]
        if own:  # the content of a file decides, not its name
            described["own"] = [_contents(path) for path in own]
        return hashlib.sha256(to_json(described)).hexdigest()


def job_digest(series_digest: str, scene_seed: int, speed: float) -> str:
    """Return the digest of the job of a series with this seed and speed."""
    described = {"series": series_digest, "scene_seed": scene_seed, "speed": speed}
    return hashlib.sha256(to_json(described)).hexdigest()


def clip_name(stem: str, scene_seed: int, speed: float) -> str:
    """Return the name of the clip of a scene at a speed."""
    return f"{stem}_{scene_seed:04d}{speed_suffix(speed)}"


def speed_suffix(speed: float) -> str:
    """Return what a clip's name says of its speed: nothing at speed 1."""
    return "" if speed == 1 else f"_x{speed:g}"


State = tuple[tuple[str, tuple[int, ...]], ...]  # of files: name and what changes with the content


def _read_by(stream: Sensing) -> list[str]:
    """Return the files that a stream reads beside its sensor's: colour filters, and maps that the sensor's names."""
    filters = [stream.colour] if isinstance(stream.colour, str) and Path(stream.colour).is_absolute() else []
    sensor = stream.sensor_name
    return [
        *filters,
        *(_maps(sensor, _state(sensor)) if sensor.endswith(".toml") and Path(sensor).is_absolute() else ()),
    ]


@functools.lru_cache(maxsize=64)
def _maps(path: str, state: State) -> tuple[str, ...]:
    """Return the measured maps of a sensor file in its `state`."""
    found = defect_table.from_toml(path)
    return () if found is None else tuple(found.maps.values())


def _contents(path: str) -> str:
    """Return the SHA-256 of a file, or of all files in a folder with their names."""
    return _read_contents(path, _state(path))


def _state(path: str) -> State:
    """Return the state of a file, or of all files in a folder."""
    root = Path(path)
    parts = sorted(part for part in root.rglob("*") if part.is_file()) if root.is_dir() else [root]
    # The state includes the time of the inode's last change, which no program can set back.
    states = [(str(part.relative_to(root)), part.stat()) for part in parts]
    return tuple((name, (of.st_mtime_ns, of.st_ctime_ns, of.st_ino, of.st_size)) for name, of in states)


@functools.lru_cache(maxsize=64)
def _read_contents(path: str, state: State) -> str:
    """Return the same; the files are read again only after `state` has changed."""
    listed = [(name, files.sha256(Path(path) / name)) for name, _ in state]
    return files.sha256(to_json(listed))

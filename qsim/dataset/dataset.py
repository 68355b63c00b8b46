"""Reads and checks a data set: a folder of clips that generation.py makes from one recipe.

dataset.json   recipe, series of clips with their digests, its own checksum; written when a generation begins
clips/KEY      clip folders with their streams           (streams/clip.py)
jobs/KEY.json  records; a clip counts as finished when its record exists (job_record.py)

KEY is a clip's name, with the folder of its block where there are more than a thousand clips (series.py). What is
finished is found by listing the folders of the records, a thousand at a time.
"""

from __future__ import annotations

import functools
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from qsim import descriptions, files
from qsim.checks import SPLITS, file_path
from qsim.dataset.clip_list import ClipList, ClipsOfDataset
from qsim.dataset.job import Job
from qsim.dataset.job_record import failure, failure_notes, record_path, verify_job
from qsim.dataset.recipe_file import RecipeFile
from qsim.dataset.series import Listing, Series
from qsim.files import Progress
from qsim.host import own_numbers
from qsim.kinds import Name
from qsim.rendering.render_settings import RenderSettings
from qsim.streams.clip import Clip

Part = tuple[int, int]  # (i, n): the i-th of n parts, i = 1 ... n
NAMED = 1000  # unfinished clips that a check names one by one


class Damaged(ValueError):
    """dataset.json differs from what was written; repairing the data set writes it again."""


@dataclass(frozen=True, kw_only=True)
class DatasetInfo:
    """The description of a data set: dataset.json without its format version and its own checksum."""

    name: Name
    recipe: RecipeFile | None = None  # as it was written
    scenes: tuple[Series, ...] = ()
    software: dict[str, str] = field(default_factory=dict)


@own_numbers
@dataclass(frozen=True, eq=False)
class Dataset:
    """A data set folder; only clips that have a record are listed."""

    path: Path
    info: DatasetInfo  # dataset.json

    @staticmethod
    def open(path: str | os.PathLike[str]) -> Dataset:
        """Open a data set; `FileNotFoundError` or `ValueError` if the folder is not one of this version."""
        path = file_path(path)
        manifest = path / "dataset.json"
        remedy = f"`qsim generate` of {path} writes it again with repair=True"
        if not manifest.is_file():
            if (path / "jobs").is_dir():
                raise FileNotFoundError(f"{manifest}: missing; {remedy}")
            what = "not a data set folder (it has no dataset.json)" if path.exists() else "no such data set"
            raise FileNotFoundError(f"{path}: {what}")
        try:
            found = files.read_json(manifest)
        except ValueError as error:
            raise Damaged(f"{error}; {remedy}") from None
        descriptions.check_version(manifest, found)  # no repair writes the version of another program
        try:
            return Dataset(path, descriptions.of_values(manifest, found, DatasetInfo, remedy))
        except ValueError as error:
            raise Damaged(str(error)) from None

    def __repr__(self) -> str:
        done = self.finished()
        counts = {split: sum(int(done[part.start : part.stop].sum()) for part in self.parts(split)) for split in SPLITS}
        splits = ", ".join(f"{count} {split}" for split, count in counts.items())
        left = len(done) - int(done.sum())
        missing = f", {left} not made yet" if left else ""
        head = None if self.recipe is None else self.recipe.recipe
        if head is None:
            return f"<Dataset {self.name}: clips {splits}{missing}>"
        rate = head.frame_rate or RenderSettings.frame_rate
        size = f"{head.frames} x {head.height} x {head.width}"
        return f"<Dataset {self.name}: clips {splits}{missing}; {size} frames, rows, columns at {rate} fps>"

    @property
    def name(self) -> str:
        """Return the name that the recipe gives."""
        return self.info.name

    @property
    def recipe(self) -> RecipeFile | None:
        """Return the recipe as it was written."""
        return self.info.recipe

    @functools.cached_property
    def listing(self) -> Listing:
        """The clips of the recipe by their indices, finished or not."""
        return Listing(self.info.scenes)

    def parts(self, split: str | None = None) -> list[range]:
        """Return the indices of each series of one split, or of all. `ValueError` for an unknown split."""
        if split is not None and split not in SPLITS:
            raise ValueError(f"{self.path}: unknown split {split!r}; there are {', '.join(SPLITS)}")
        return [part for one, part in self.listing.splits if split in (None, one)]

    def finished(self) -> Array:
        """Return whether each clip has a record, bool [clips]; lists the folders of the records."""
        found = np.zeros(len(self.listing), bool)
        for block, indices in self.listing.blocks():
            try:
                there = set(os.listdir(self.path / "jobs" / block))
            except FileNotFoundError:
                continue
            if there:
                names = self.listing.names(indices.start, indices.stop)
                found[indices.start : indices.stop] = [f"{name}.json" in there for name in names]
        return found

    def indices(self, split: str | None = None) -> Array:
        """Return the indices of the finished clips of one split, or of all, int64."""
        parts = self.parts(split)
        done = self.finished()
        wanted = np.zeros_like(done)
        for part in parts:
            wanted[part.start : part.stop] = True
        return np.flatnonzero(done & wanted)

    def names(self, split: str | None = None) -> list[str]:
        """Return the names of the finished clips of one split, or of all. `ValueError` for an unknown split."""
        return [self.listing.name(index) for index in self.indices(split).tolist()]

    def keys(self, shard: Part | None = None) -> list[str]:
        """Return the names of the finished clips with the folders of their blocks, of all or the i-th of n parts."""
        return [self.listing.key(index) for index in shard_of(self.indices(), shard).tolist()]

    def holds(self, job: Job) -> bool:
        """Return whether the recipe of the data set has this job, with these settings."""
        index = self.listing.find(job.name)
        return index is not None and self.listing.digest(index) == job.digest

    def folder(self, index: int) -> Path:
        """Return the folder of a clip."""
        return self.path / "clips" / self.listing.key(index)

    def clips(self, split: str | None = None) -> ClipList:
        """Return the finished clips of one split, or of all; each is opened when it is asked for."""
        return ClipList((ClipsOfDataset(self, self.indices(split)),))

    @property
    def missing(self) -> list[str]:
        """Return the names of the recipe's unfinished clips."""
        return [self.listing.name(index) for index in np.flatnonzero(~self.finished()).tolist()]

    def failed(self) -> dict[str, str]:
        """Return why clips that are not finished failed, by their names; an unreadable note counts."""
        found = {}
        for key, path in failure_notes(self.path):
            index = self.listing.find(path.stem)
            if index is None or self.listing.key(index) != key or record_path(self.path, key).is_file():
                continue
            if (reason := failure(path, self.listing.digest(index))) is not None:
                found[path.stem] = reason
        return found

    def verify(self, progress: Progress | None = None, shard: Part | None = None) -> list[str]:
        """Return the problems of all files, one per file; clips not made yet are problems too.

        `shard` (i, n) takes the i-th of n parts of the clips. `progress(done, total)` is called after each clip.
        """
        done = self.finished()
        chosen = shard_of(np.arange(len(done)), shard)
        missing = chosen[~done[chosen]]
        problems = [
            f"{self.folder(index)}: not made yet; run `qsim generate` again" for index in missing[:NAMED].tolist()
        ]
        if len(missing) > NAMED:
            problems.append(f"{self.path}: {len(missing) - NAMED} more clips are not made yet")
        made = chosen[done[chosen]]
        for number, index in enumerate(made.tolist(), 1):
            series, _, _ = self.listing.scene(index)
            problems += verify_job(self.path, self.listing.key(index), self.listing.digest(index), series.split)
            if progress is not None:
                progress(number, len(made))
        return problems + self.shared_between_splits(shard)

    def shared_between_splits(self, shard: Part | None = None) -> list[str]:
        """Return one line per scene, mesh, texture and file of the test split that another split holds too.

        They are compared by content: a mesh by its vertices, a texture by its pixels or its file, a file by its bytes.
        `shard` (i, n) compares the i-th of n parts of the other splits with the whole test split.
        """
        tested = {index: _seen_in(self.folder(index)) for index in self.indices("test").tolist()}
        sought = set().union(*tested.values())
        elsewhere: dict[str, str] = {}
        for split in ("train", "val") if sought else ():
            for index in shard_of(self.indices(split), shard).tolist():
                name = self.listing.name(index)
                elsewhere |= {key: name for key in _seen_in(self.folder(index)) if key in sought}
        return [
            f"{self.folder(index)}: its {asset} is also in {elsewhere[key]}, which is not a test clip"
            for index, seen in tested.items()
            for key, asset in seen.items()
            if key in elsewhere
        ]


def shard_of(indices: Array, shard: Part | None) -> Array:
    """Return every n-th index from the i-th on, of a part (i, n); all without one."""
    if shard is None:
        return indices
    part, parts = checked_part(shard)
    return indices[part - 1 :: parts]


def checked_part(shard: Part) -> Part:
    """Return a part (i, n); `ValueError` unless 1 <= i <= n."""
    part, parts = shard
    if not 1 <= part <= parts:
        raise ValueError(f"shard {part}/{parts}: expected i/n with 1 <= i <= n, as in 7/100")
    return shard


def _seen_in(path: Path) -> dict[str, str]:
    """Return {what identifies it: its name} of scene, assets and read files of a clip; empty if it cannot be read."""
    from qsim.scenes.asset_folder import SUFFIXES

    try:
        info = Clip.open(path).info
    except (ValueError, OSError):
        return {}
    named = [] if info.scene is None else [f"scene {info.scene.family}:{info.scene.seed}"]  # an imported clip has none
    found = {asset.split(" ", 1)[-1]: asset for asset in [*named, *info.assets]}
    for name, digest in info.reads.items():
        if "*" not in name and Path(name).suffix.lower() in {*SUFFIXES, ".serialized"}:  # a pattern has no content
            found[digest] = f"file {name} (SHA-256 {digest})"
    return found

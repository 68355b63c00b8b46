"""Reads and checks a data set: a folder of clips that generation.py makes from one recipe.

dataset.json   recipe, splits by scene, state of every job, its own checksum; rewritten when a generation ends
clips/NAME     clip folders with their streams           (streams/clip.py)
jobs/NAME.json records; a clip counts as finished when its record exists (job_record.py)
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from qsim import descriptions, files
from qsim.checks import SPLITS, file_path
from qsim.dataset.job_record import JobInfo, record_path, verify_job
from qsim.dataset.recipe_file import RecipeFile
from qsim.files import Progress
from qsim.host import own_numbers
from qsim.kinds import Name
from qsim.rendering.render_settings import RenderSettings
from qsim.streams.clip import Clip


class Damaged(ValueError):
    """dataset.json differs from what was written; `qsim generate --repair` writes it again."""


@dataclass(frozen=True, kw_only=True)
class DatasetInfo:
    """The description of a data set: dataset.json without its format version and its own checksum."""

    name: Name
    recipe: RecipeFile | None = None  # as it was written
    jobs: dict[Name, JobInfo]
    software: dict[str, str] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Whether all clips are finished."""
        return all(job.state == "done" for job in self.jobs.values())


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
        splits = ", ".join(f"{len(self.names(split))} {split}" for split in SPLITS)
        missing = f", {len(self.missing)} not made yet" if self.missing else ""
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

    def names(self, split: str | None = None) -> list[str]:
        """Return the names of the finished clips of one split, or of all. `ValueError` for an unknown split."""
        if split is not None and split not in SPLITS:
            raise ValueError(f"{self.path}: unknown split {split!r}; there are {', '.join(SPLITS)}")
        chosen = [name for name, job in self.info.jobs.items() if split in (None, job.split)]
        return [name for name in chosen if record_path(self.path, name).is_file()]

    def clips(self, split: str | None = None) -> list[Clip]:
        """Return the finished clips of one split, or of all."""
        return [Clip.open(self.path / "clips" / name) for name in self.names(split)]

    @property
    def missing(self) -> list[str]:
        """Return the names of the recipe's unfinished clips."""
        return [name for name in self.info.jobs if not record_path(self.path, name).is_file()]

    def verify(self, progress: Progress | None = None) -> list[str]:
        """Return the problems of all files, one per file; clips not made yet are problems too.

        `progress(done, total)` is called after each clip.
        """
        problems = [f"{self.path / 'clips' / name}: not made yet; run `qsim generate` again" for name in self.missing]
        names = self.names()
        for done, name in enumerate(names, 1):
            problems += verify_job(self.path, name, self.info.jobs[name])
            if progress is not None:
                progress(done, len(names))
        return problems + self.shared_between_splits()

    def shared_between_splits(self) -> list[str]:
        """Return one line per scene, mesh, texture and file of the test split that another split holds too.

        They are compared by content: a mesh by its vertices, a texture by its pixels or its file, a file by its bytes.
        """
        elsewhere: dict[str, str] = {}
        for name in self.names("train") + self.names("val"):
            elsewhere |= dict.fromkeys(_seen_in(self.path / "clips" / name), name)
        return [
            f"{self.path / 'clips' / name}: its {asset} is also in {elsewhere[key]}, which is not a test clip"
            for name in self.names("test")
            for key, asset in _seen_in(self.path / "clips" / name).items()
            if key in elsewhere
        ]


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

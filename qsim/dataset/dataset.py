"""Reads and checks a data set: a folder of clips that generation.py makes from one recipe.

dataset.json   recipe, splits by scene, state of every job, its own checksum; rewritten when a generation ends
clips/NAME     clip folders with their streams           (streams/clip.py)
jobs/NAME.json records with checksums; a clip counts as finished when its record exists (job_runner.py)
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qsim import files, structure
from qsim.checks import file_path
from qsim.dataset.job import FRAME_RATE, Job
from qsim.dataset.job_runner import make_record, record_path
from qsim.dataset.recipe import SPLITS
from qsim.files import Progress
from qsim.streams.clip import Clip

FORMAT_VERSION = 1


class Damaged(ValueError):
    """dataset.json differs from what was written; `qsim generate --repair` writes it again."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """A data set folder; only clips that have a record are listed."""

    path: Path
    meta: dict[str, Any]  # dataset.json

    @staticmethod
    def open(path: str | os.PathLike[str]) -> Dataset:
        """Open a data set; `FileNotFoundError` or `ValueError` if the folder is not one of this version."""
        path = file_path(path)
        manifest = path / "dataset.json"
        remedy = f"`qsim generate RECIPE -o {path} --repair` writes it again"
        if not manifest.is_file():
            if (path / "jobs").is_dir():
                raise FileNotFoundError(f"{manifest}: missing; {remedy}")
            what = "not a data set folder (it has no dataset.json)" if path.exists() else "no such data set"
            raise FileNotFoundError(f"{path}: {what}")
        try:
            meta = files.read_json(manifest)
        except ValueError as error:
            raise Damaged(f"{error}; {remedy}") from None
        files.check_version(manifest, meta.get("format_version"), FORMAT_VERSION)
        try:
            structure.description(manifest, meta, structure.DATASET, remedy)
            if odd := [name for name in meta["jobs"] if not structure.is_name(name)]:
                raise ValueError(f"{manifest}: jobs holds {odd[0]!r:.60}, which is not the name of a clip; {remedy}")
            structure.description(manifest, meta, {"jobs": dict.fromkeys(meta["jobs"], structure.JOB)}, remedy)
            files.check_own(manifest, meta, remedy)
        except ValueError as error:
            raise Damaged(str(error)) from None
        return Dataset(path, meta)

    def __repr__(self) -> str:
        splits = ", ".join(f"{len(self.names(split))} {split}" for split in SPLITS)
        table = self.recipe.get("recipe")
        recipe = table if isinstance(table, dict) else {}
        size = " x ".join(str(recipe.get(key, "?")) for key in ("frames", "height", "width"))
        rate = recipe.get("frame_rate", FRAME_RATE)
        missing = f", {len(self.missing)} not made yet" if self.missing else ""
        return f"<Dataset {self.name}: clips {splits}{missing}; {size} frames, rows, columns at {rate} fps>"

    @property
    def name(self) -> str:
        """Return the name that the recipe gives."""
        return str(self.meta["name"])

    @property
    def recipe(self) -> dict[str, Any]:
        """Return the recipe as it was written."""
        return dict(self.meta["recipe"])

    def names(self, split: str | None = None) -> list[str]:
        """Return the names of the finished clips of one split, or of all. `ValueError` for an unknown split."""
        if split is not None and split not in SPLITS:
            raise ValueError(f"{self.path}: unknown split {split!r}; there are {', '.join(SPLITS)}")
        chosen = [name for name, job in self.meta["jobs"].items() if split in (None, job["split"])]
        return [name for name in chosen if record_path(self.path, name).is_file()]

    def clips(self, split: str | None = None) -> list[Clip]:
        """Return the finished clips of one split, or of all."""
        return [Clip.open(self.path / "clips" / name) for name in self.names(split)]

    @property
    def missing(self) -> list[str]:
        """Return the names of the recipe's unfinished clips."""
        return [name for name in self.meta["jobs"] if not record_path(self.path, name).is_file()]

    def verify(self, progress: Progress | None = None) -> list[str]:
        """Return the problems of all files, one per file; clips not made yet are problems too.

        `progress(done, total)` is called after each clip.
        """
        problems = [f"{self.path / 'clips' / name}: not made yet; run `qsim generate` again" for name in self.missing]
        names = self.names()
        for done, name in enumerate(names, 1):
            problems += verify_job(self.path, name, self.meta["jobs"][name])
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


def _read_record(path: Path) -> dict[str, Any]:
    """Read a record; `ValueError` if it is damaged."""
    record = files.read_json(path)
    cure = "`qsim generate RECIPE -o FOLDER --repair` makes it again"
    structure.description(path, record, structure.RECORD, cure)
    return record


def verify_job(folder: Path, name: str, expected: dict[str, Any]) -> list[str]:
    """Return the problems of one finished job's files; `expected` is its entry in the manifest.

    Each file holds the checksums of the next: manifest, record, clip.json and the streams' json, frames and codes.
    """
    path = record_path(folder, name)
    problems = files.differs(path, expected["record"]) if "record" in expected else []
    about = folder / "clips" / name / "clip.json"
    if not about.is_file():
        return [*problems, f"{about}: missing"]
    try:
        record = {} if problems else _read_record(path)
        clip = Clip.open(about.parent)
    except (ValueError, OSError) as error:
        return [*problems, files.wording(error)]
    if not problems and any(record.get(key) != expected[key] for key in ("digest", "split")):
        problems = [f"{path}: is the record of another job"]
    if problems:  # nothing that a damaged record holds is used
        return problems + clip.verify()
    problems = clip.verify() + files.differs(about, record.get("clip"))
    for stream, digest in record.get("streams", {}).items():
        problems += files.differs(clip.path / "streams" / f"{stream}.json", digest)
    return list(dict.fromkeys(problems))


def unproven(folder: Path, job: Job) -> str | None:
    """Return why a job that a worker reports as done is not done, or None.

    The record must be that of this job, with the checksums of clip.json and of each stream's json. Every file that
    they name must exist, and the codes must have the size in their json. `verify_job` checks the contents.
    """
    path = record_path(folder, job.name)
    place = folder / "clips" / job.name
    try:
        clip = Clip.open(place)
        if files.read_json(path) != make_record(job, place) or clip.info.job != job.digest:
            return f"{path}: is not the record of this job and its clip"
        for name in clip.info.checksums:
            if not (place / name).is_file() or (place / name).stat().st_size == 0:
                return f"{place / name}: missing or empty"
        for sensing in job.streams:
            _ = clip.stream(sensing.stream_name).packed
    except (ValueError, OSError) as error:
        return files.wording(error)
    return None

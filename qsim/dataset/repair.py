"""Removes the damaged files and records of finished jobs, so that these jobs are done again."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qsim import files
from qsim.clip import manifest
from qsim.dataset.dataset import Dataset, verify_job
from qsim.dataset.job import Job
from qsim.dataset.job_runner import make_record, record_path


def repair_jobs(folder: Path, jobs: list[Job]) -> tuple[str, ...]:
    """Check the finished jobs, remove what is damaged, and return the problems.

    The next run draws a damaged stream again and writes a damaged record again; every other damage costs a rendering.
    Streams that `qsim sense` added to a removed clip are lost, and each is named.
    `FileExistsError` for a clip to remove that holds other files than ours.
    """
    entries = Dataset.open(folder).meta["jobs"]
    checked = [_damage(folder, job, entries[job.name]) for job in jobs if record_path(folder, job.name).is_file()]
    taken = [damage for damage in checked if damage.problems]
    for damage in taken:  # refused before anything is deleted
        clip = folder / "clips" / damage.job.name
        if clip.is_symlink() and not damage.light:
            raise ValueError(
                f"{damage.problems[0]}; {clip} is a symbolic link to {os.readlink(clip)}, and --repair replaces no "
                "links: move the folder back, or delete the link to have the clip made here"
            )
        if clip.is_dir() and not damage.light:
            files.check_ours(clip, manifest.OURS)
    return tuple(line for damage in taken for line in _take_back(folder, damage))


@dataclass(frozen=True)
class _Damage:
    """The damage of a finished job."""

    job: Job
    problems: list[str]
    paths: set[Path]  # the damaged files
    light: bool  # repaired without rendering: only streams, or only the record


def _damage(folder: Path, job: Job, entry: dict[str, Any]) -> _Damage:
    """Check the files of a finished job; `entry` is its entry in the manifest."""
    expected = entry | {"digest": job.digest, "split": job.split}
    problems = verify_job(folder, job.name, expected)
    record = record_path(folder, job.name)
    clip = folder / "clips" / job.name
    damaged = {Path(problem.split(": ")[0]) for problem in problems}
    if record in damaged:
        light = damaged == {record} and _vouched_for(job, clip, expected.get("record"))
    else:
        light = all(path.parent == clip / "streams" for path in damaged)
    return _Damage(job, problems, damaged, light)


def _take_back(folder: Path, damage: _Damage) -> list[str]:
    """Delete the record and what is damaged; return the problems and the added streams that are lost."""
    record = record_path(folder, damage.job.name)
    clip = folder / "clips" / damage.job.name
    streams = clip / "streams"
    wanted = {sensing.stream_name for sensing in damage.job.streams}
    record.unlink()
    lost = damage.paths if damage.light else set(streams.glob("*.json"))
    added = sorted({path.stem for path in lost if path.parent == streams} - wanted)
    if damage.light:
        for path in damage.paths - {record}:
            path.with_suffix(".json").unlink(missing_ok=True)
            path.with_suffix(".npy").unlink(missing_ok=True)
    elif clip.exists():
        files.remove_folder(clip)
    gone = [f"{streams / name}.npy: was added by `qsim sense` and is gone; sense it again" for name in added]
    return damage.problems + gone


def _vouched_for(job: Job, clip: Path, digest: str | None) -> bool:
    """Return whether the record of a clip would have the checksum in the manifest."""
    try:
        return files.sha256(files.to_json(make_record(job, clip))) == digest
    except FileNotFoundError:
        return False

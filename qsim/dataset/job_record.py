"""The record of a finished job, jobs/KEY.json: written last, so that a clip counts as finished when its record exists.
KEY is the clip's name with the folder of its block (series.py).

Each file has one checksum: clip.json holds those of the frames, the description of a stream that of its codes, and
every description (record and manifest included) that of its own keys.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from qsim import descriptions, files
from qsim.dataset.job import Job
from qsim.kinds import Digest, Name, Split, Text
from qsim.streams.clip import Clip

CURE = "`qsim generate` makes it again with repair=True"


@dataclass(frozen=True, kw_only=True)
class JobRecord:
    """What a finished job made."""

    name: Name
    digest: Digest
    split: Split
    streams: tuple[Name, ...] = ()

    @classmethod
    def of(cls, job: Job) -> JobRecord:
        """Return the record of a job when all its files are written."""
        return cls(
            name=job.name,
            digest=job.digest,
            split=job.split,
            streams=tuple(sensing.stream_name for sensing in job.streams),
        )


@dataclass(frozen=True, kw_only=True)
class Failure:
    """The note of a job that failed, failed/KEY.json."""

    name: Name
    digest: Digest
    error: Text


def record_path(folder: Path, key: str) -> Path:
    """Return the path of the record; the job is done when it exists."""
    return folder / "jobs" / f"{key}.json"


def failure_path(folder: Path, key: str) -> Path:
    """Return the path of the file that holds the reason of a failure."""
    return folder / "failed" / f"{key}.json"


def failure_notes(folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield key and note of every job that failed, in the order of their keys."""
    root = folder / "failed"
    for path in sorted(root.rglob("*.json")):
        yield path.relative_to(root).with_suffix("").as_posix(), path


def failure(path: Path, digest: str) -> str | None:
    """Return the reason in a note; an unreadable note counts, one of other settings does not: None."""
    try:
        note = descriptions.read(path, Failure, "add retry=True")
    except ValueError as error:
        return files.wording(error)
    return note.error if note.digest == digest else None


def read_record(path: Path) -> JobRecord:
    """Return the record in a file; `ValueError` if it is damaged."""
    return descriptions.read(path, JobRecord, CURE)


def verify_job(folder: Path, key: str, digest: str, split: str) -> list[str]:
    """Return the problems of one finished job's files; digest and split are those of the job."""
    path = record_path(folder, key)
    place = folder / "clips" / key
    problems: list[str] = []
    streams: tuple[str, ...] = ()
    try:
        record = read_record(path)
        if (record.name, record.digest, record.split) == (place.name, digest, split):
            streams = record.streams
        else:
            problems.append(f"{path}: is the record of another job")
    except (ValueError, OSError) as error:
        problems.append(files.wording(error))
    if not (place / "clip.json").is_file():
        return [*problems, f"{place / 'clip.json'}: missing"]
    try:
        clip = Clip.open(place)
    except (ValueError, OSError) as error:
        return [*problems, files.wording(error)]
    if clip.info.job != digest:
        problems.append(f"{place / 'clip.json'}: is the clip of another job")
    problems += clip.verify()
    absent = [place / "streams" / f"{stream}.json" for stream in streams if stream not in clip.streams]
    return problems + [f"{description}: missing" for description in absent]


def unproven(folder: Path, job: Job) -> str | None:
    """Return why a job that a worker reports as done is not done, or None.

    Record and clip must be those of this job. Every file that they name must exist, and the codes must have the size
    in their description. `verify_job` checks the contents.
    """
    path = record_path(folder, job.key)
    place = folder / "clips" / job.key
    try:
        clip = Clip.open(place)
        if read_record(path) != JobRecord.of(job) or clip.info.job != job.digest:
            return f"{path}: is not the record of this job and its clip"
        for name in clip.info.checksums:
            if not (place / name).is_file() or (place / name).stat().st_size == 0:
                return f"{place / name}: missing or empty"
        for sensing in job.streams:
            _ = clip.stream(sensing.stream_name).packed
    except (ValueError, OSError) as error:
        return files.wording(error)
    return None

"""Checks data sets, clips, streams and restored video; draws codes again, and repairs what is damaged.

    check     compares every file with its checksum: a description holds that of its keys, its frames or its codes
    redraw    draws stored streams again with the reference engine, from description and clip alone: a checksum shows
              that codes are those that were written, a second draw whether they are right
    repair    removes the damaged files and records of finished jobs, so that these jobs are done again

A folder that was moved and linked is read through its link; a repair replaces no links.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qsim import files
from qsim.checks import ArgumentError
from qsim.clip import manifest
from qsim.dataset.dataset import Dataset, Part
from qsim.dataset.job import Job
from qsim.dataset.job_record import read_record, record_path, verify_job
from qsim.files import Progress
from qsim.restored_video import Restored, describes_restored
from qsim.streams.clip import Clip
from qsim.streams.event_stream import EventInfo, EventStream
from qsim.streams.storing import stored
from qsim.streams.stream import Stream, is_stream

PROMISED = 5e-6  # share of codes in which the compiled engine may differ from the reference
_BLOCK_PIXELS = 1 << 20


def lines(problems: list[str], names: str) -> list[str]:
    """Return one line per problem, or one that reports none."""
    return problems or [f"{names}: every file is what was written"]


def check(path: Path, progress: Progress | None = None, shard: Part | None = None) -> list[str]:
    """Compare every file below a data set, a clip, a stream or a restored video with its checksum; return problems.

    `shard` (i, n) takes the i-th of n parts of a data set. `FileNotFoundError` or `ValueError` if the path is none of
    them. `progress` is called with (done, total).
    """
    if (path / "dataset.json").is_file() or (path / "jobs").is_dir():
        dataset = Dataset.open(path)
        return dataset.verify(progress, shard)
    _refuse_shard(path, shard)
    if (path / "clip.json").is_file() or not path.with_suffix(".json").is_file():
        return _checked(lambda: Clip.open(path), path / "clip.json", progress)
    description = path.with_suffix(".json")
    found = files.read_json(description)
    if "code_model" in found:
        return _checked(lambda: Stream.open(description), description, progress)
    if found.get("format") == EventInfo.FORMAT:
        return _checked(lambda: EventStream.open(description), description, progress)
    if describes_restored(found):
        return _checked(lambda: Restored.open(description), description, progress)
    raise ValueError(f"{path}: expected a data set, a clip, a stream, events or a restored video")


def _refuse_shard(path: Path, shard: Part | None) -> None:
    """Raise `ValueError` for a part of something that is no data set."""
    if shard is not None:
        raise ArgumentError("shard", f"is a part of a data set, and {path} is none; leave it out")


def _checked(open_it: Callable[[], Any], description: Path, progress: Progress | None) -> list[str]:
    """Return the problems of one object; a damaged description is a problem, a missing one an error."""
    try:
        opened = open_it()
    except ValueError as error:
        if not description.is_file():
            raise
        return [str(error)]
    problems: list[str] = opened.verify(progress)
    return problems


@dataclass(frozen=True)
class Redrawn:
    """Result of drawing one stream again."""

    path: Path  # streams/NAME.npy
    codes: int  # compared
    differ: int = 0  # codes
    first: int | None = None  # frame with a difference
    why: str | None = None  # the stream could not be drawn again
    cure: str = ""

    @property
    def wrong(self) -> bool:
        """Return whether more codes differ than the compiled engine may."""
        return self.differ > PROMISED * self.codes

    def line(self) -> str | None:
        """Return the line about this stream; None where every code equals the reference's."""
        if self.why is not None:
            return f"{self.path}: not drawn again: {self.why}"
        if not self.differ:
            return None
        found = f"{self.path}: {self.differ} of {self.codes} codes differ from the reference's"
        if not self.wrong:
            return f"{found}, as many as the compiled engine may"
        return f"{found}, first in frame {self.first}; {self.cure}"


def redraw(path: Path, progress: Progress | None = None, shard: Part | None = None) -> list[Redrawn]:
    """Draw one stream again, or every stream of a clip or a data set; `check` names the damaged ones.

    `shard` (i, n) takes the i-th of n parts of a data set. `progress(done, total)` is called after each stream.
    `FileNotFoundError` or `ValueError` if there is none. Restored video has none, and its result is empty.
    """
    found = list(_streams(path, shard))
    if not found and path.is_dir() and shard is None:
        raise ValueError(f"{path}: holds no stream to draw again")
    results = []
    for done, (clip, json_path, again) in enumerate(found, 1):
        results.append(_redrawn(clip, json_path, again))
        if progress is not None:
            progress(done, len(found))
    return results


def _redrawn(place: Path, json_path: Path, dataset: Path | None) -> Redrawn:
    """Draw one stream of the clip at `place` again; `dataset` is the data set whose recipe made it, if any."""
    path = json_path.with_suffix(".npy")
    try:
        stream = Stream.open(json_path)
        draw = dataclasses.replace(stored(stream), engine="reference")
        clip = Clip.open(place)
        frames, height, width = stream.shape
        found = Redrawn(path, frames * height * width, cure=_cure(dataset))
        step = max(1, _BLOCK_PIXELS // (height * width * draw.planes))
        start = 0
        for block in draw.blocks(clip, 0, frames, step):
            wrong = block != stream.codes(start, start + len(block))
            if wrong.any():
                first = start + int(wrong.any(axis=(1, 2)).argmax()) if found.first is None else found.first
                found = dataclasses.replace(found, differ=found.differ + int(wrong.sum()), first=first)
            start += len(block)
    except (ValueError, OSError) as error:
        return Redrawn(path, 0, why=str(error).removeprefix(f"{path}: "))
    return found


def _cure(dataset: Path | None) -> str:
    """Return what to do about wrong codes, so that `check` passes afterwards."""
    if dataset is None:
        return "sense it again and replace it"
    return f"delete the file, and `qsim generate` of {dataset} makes it again with repair=True"


def _streams(path: Path, shard: Part | None) -> list[tuple[Path, Path, Path | None]]:
    """Return clip, description and, where its recipe made it, data set of every stream below a path."""
    if (path / "dataset.json").is_file():
        keys = Dataset.open(path).keys(shard)
        return [each for key in keys for each in _of_clip(path / "clips" / key, record_path(path, key), path)]
    _refuse_shard(path, shard)
    if (path / "clip.json").is_file() or not path.with_suffix(".json").is_file():
        if not (path / "clip.json").is_file():
            Clip.open(path)  # raises the error that names what is missing
        return _of_clip(path)
    described = path.with_suffix(".json")
    if not is_stream(described):  # restored video
        return []
    return [(described.absolute().parents[1], described, None)]


def _of_clip(
    path: Path, record: Path | None = None, dataset: Path | None = None
) -> list[tuple[Path, Path, Path | None]]:
    made = set() if record is None else _made_by_recipe(record)
    return [
        (path, json_path, dataset if json_path.stem in made else None)
        for json_path in sorted((path / "streams").glob("*.json"))
    ]


def _made_by_recipe(record: Path) -> set[str]:
    """Return the names of the streams in a record."""
    try:
        return set(read_record(record).streams)
    except (ValueError, OSError):  # `check` names it
        return set()


def redrawn_lines(found: list[Redrawn]) -> list[str]:
    """Return a line per stream that differs or could not be drawn, and one with the totals."""
    found_lines = [line for one in found if (line := one.line()) is not None]
    drawn = [one for one in found if one.why is None]
    wrong = sum(one.wrong for one in drawn)
    total = sum(one.codes for one in drawn)
    right = "all hold the reference's codes" if drawn else "so nothing is known of them"
    verdict = f"{wrong} hold wrong codes" if wrong else right
    return [*found_lines, f"drawn again: {len(drawn)} of {len(found)} streams, {total} codes; {verdict}"]


def repair_jobs(folder: Path, jobs: Sequence[Job]) -> tuple[str, ...]:
    """Check the finished jobs, remove what is damaged, and return the problems.

    The next run draws a damaged stream again and writes a damaged record again; every other damage costs a rendering.
    Streams that `qsim sense` added to a removed clip are lost, and each is named.
    `FileExistsError` for a clip to remove that holds other files than ours.
    """
    checked = (_damage(folder, job) for job in jobs if record_path(folder, job.key).is_file())
    taken = [damage for damage in checked if damage.problems]
    for damage in taken:  # refused before anything is deleted
        clip = folder / "clips" / damage.job.key
        if clip.is_symlink() and not damage.light:
            raise ValueError(
                f"{damage.problems[0]}; {clip} is a symbolic link to {os.readlink(clip)}, and repair=True replaces no "
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


def _damage(folder: Path, job: Job) -> _Damage:
    """Check the files of a finished job."""
    problems = verify_job(folder, job.key, job.digest, job.split)
    record = record_path(folder, job.key)
    clip = folder / "clips" / job.key
    damaged = {Path(problem.split(": ")[0]) for problem in problems}
    if record in damaged:
        light = damaged == {record}
    else:
        # Streams are drawn from the clip in seconds; anything else means that the clip is rendered again.
        light = all(path.parent == clip / "streams" for path in damaged)
    return _Damage(job, problems, damaged, light)


def _take_back(folder: Path, damage: _Damage) -> list[str]:
    """Delete the record and what is damaged; return the problems and the added streams that are lost."""
    record = record_path(folder, damage.job.key)
    clip = folder / "clips" / damage.job.key
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

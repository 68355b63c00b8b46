"""Generates a data set: runs the unfinished jobs of a recipe; an interrupted run resumes.

On machines of one kind the finished folder (dataset.py) always has the same bytes, apart from logs/: after a kill, in
shards, on a cluster.
"""

from __future__ import annotations

import contextlib
import errno
import os
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from qsim import descriptions, files, opening, scratch
from qsim.clip.manifest import read_info
from qsim.dataset.checking import repair_jobs
from qsim.dataset.dataset import Damaged, Dataset, DatasetInfo, Part, checked_part
from qsim.dataset.job import Job
from qsim.dataset.job_record import failure, failure_notes, failure_path, read_record, record_path, unproven
from qsim.dataset.job_runner import FOLDERS, RenderJob, Result, mark_failed, render_job
from qsim.dataset.jobs import Jobs
from qsim.dataset.recipe import Recipe
from qsim.dataset.worker_pool import Limits, run_here, run_local
from qsim.files import VERSION, Progress
from qsim.locks import Lock
from qsim.scratch import sweep

Executor = Callable[[Iterable[Job], Path, RenderJob], Generator[Result]]


READ = 1000  # clips of a section whose files of the user are compared before the first clip is made
_REPORTED = "a worker reports that it is done, but "
_ELSEWHERE = f"{_REPORTED}its record is missing; does every worker have this folder at this path?"


@dataclass(frozen=True)
class Options:
    """Options of a generation; none changes a byte of the result."""

    workers: int = 1  # processes; 0: run the jobs in this process
    shard: Part | None = None  # (i, n): the i-th of n shards, i = 1 ... n
    retry: bool = False  # try failed jobs again
    repair: bool = False  # check all files first and make damaged ones again
    wait: bool = False  # wait for another generator on the folder instead of refusing
    limits: Limits = field(default_factory=Limits)


@dataclass(frozen=True)
class Summary:
    """Results of a generation."""

    jobs: int  # of this shard
    done: int  # finished now or before
    made: int  # finished now
    failed: dict[str, str]  # name -> reason, now or before
    repaired: tuple[str, ...]  # problems that led to jobs done again
    shared: tuple[str, ...] = ()  # assets of the test split that other splits hold too; not looked for by a shard


def generate(
    recipe: Recipe,
    path: str | os.PathLike[str],
    options: Options | None = None,
    *,
    make: RenderJob = render_job,
    run: Executor | None = None,
    order: Callable[[Jobs], Iterable[Job]] = iter,
    on_result: Callable[[Result], None] | None = None,
) -> Summary:
    """Make the missing clips of a recipe's data set in folder `path`, in the order in which `order` gives its jobs.

    `run` executes the jobs (default: local processes; dask_cluster.py has another executor), `make` renders one clip.
    `ValueError` if the folder belongs to another recipe or another generator uses it, `OSError` if the disk is full.
    """
    options = options or Options()
    folder = Path(path).resolve()
    jobs = shard(recipe.jobs, options.shard)
    try:
        with _locked(folder, options):
            repaired = _begin(recipe, folder, jobs, options.repair)
            repaired += repair_jobs(folder, jobs) if options.repair else ()
            todo = _Todo(folder, order(jobs), retry=options.retry)
            with contextlib.closing((run or _runner(options))(todo, folder, make)) as results:
                for result in results:
                    if result.state == "full":
                        raise OSError(errno.ENOSPC, result.message)
                    if result.state == "gone":
                        raise FileNotFoundError(result.message)
                    todo.answer(result)
                    if on_result is not None:
                        on_result(result)
            todo.end()
            shared = () if options.shard else tuple(Dataset.open(folder).shared_between_splits())
    except OSError as error:
        if error.errno not in files.FULL:
            raise
        message = f"{folder}: {error.strerror}; nothing is lost: make space and run the same command again"
        raise OSError(message) from None
    return Summary(len(jobs), todo.before + todo.made, todo.made, todo.failed, repaired, shared)


class _Todo:
    """The unfinished jobs, each looked for when it is asked for, and what became of them.

    It is iterated once. A job that a worker reports as done counts when its files are there; else its record is
    deleted, and it has failed.
    """

    def __init__(self, folder: Path, jobs: Iterable[Job], *, retry: bool) -> None:
        self.folder = folder
        self.before = 0  # finished before
        self.made = 0
        self.failed: dict[str, str] = {}
        self._noted = dict(failure_notes(folder))
        self._retry = retry
        self._given: dict[str, Job] = {}
        self._left: Iterator[Job] = iter(jobs)

    def __iter__(self) -> Iterator[Job]:
        return self

    def __next__(self) -> Job:
        for job in self._left:
            if record_path(self.folder, job.key).is_file():
                self.before += 1
                self._forget(job)
            elif (reason := self._reason(job)) is not None:
                self.failed[job.name] = reason
            else:
                self._given[job.name] = job
                return job
        raise StopIteration

    def _reason(self, job: Job) -> str | None:
        """Return why a job failed before; None if it did not, or is tried again."""
        note = None if self._retry else self._noted.get(job.key)
        return None if note is None else failure(note, job.digest)

    def _forget(self, job: Job) -> None:
        """Delete the note of a job that is finished."""
        if job.key in self._noted:
            failure_path(self.folder, job.key).unlink(missing_ok=True)

    def answer(self, result: Result) -> None:
        """Note what a worker reports; it may crash after it has written the record."""
        job = self._given.pop(result.name, None)
        if job is None:
            if result.state == "done":
                self.failed[result.name] = f"{_REPORTED}no worker was given it"
            return
        there = record_path(self.folder, job.key).is_file()
        if result.state != "done" and not there:
            self.failed[job.name] = result.message
        elif not there:
            self.failed[job.name] = _ELSEWHERE
        # A worker may be killed between its files and its word, or report what it never wrote: files decide.
        elif problem := unproven(self.folder, job):
            record_path(self.folder, job.key).unlink()
            self.failed[job.name] = f"{_REPORTED}{problem}"
            mark_failed(self.folder, job, self.failed[job.name])
        else:
            failure_path(self.folder, job.key).unlink(missing_ok=True)
            self.made += 1

    def end(self) -> None:
        """Count the jobs after those that were asked for, and those of which nobody reported."""
        for _ in self:
            pass
        self.before += sum(record_path(self.folder, job.key).is_file() for job in self._given.values())


def shard(jobs: Jobs, part: Part | None) -> Jobs:
    """Return every n-th job from the i-th on, so that expensive families spread over the shards."""
    if part is None:
        return jobs
    first, step = checked_part(part)
    return jobs[first - 1 :: step]


class FramesDone:
    """Counts the rendered frames of jobs, by any process: of finished clips and in the journals of others.

    Each look is at some thousand unfinished clips, and the next one at those after them.
    """

    LOOK = 2000  # clips

    def __init__(self, folder: Path, jobs: Sequence[Job]) -> None:
        self.folder = folder
        self.jobs = jobs
        self._finished = bytearray(len(jobs))
        self._frames = 0  # of finished clips
        self._begun: dict[int, int] = {}  # frames of unfinished ones
        self._next = 0

    def look(self) -> int:
        """Return the number of frames that are known now."""
        looked = 0
        for _ in range(len(self.jobs)):
            number = self._next
            self._next = (number + 1) % len(self.jobs)
            if self._finished[number]:
                continue
            self._look_at(number)
            looked += 1
            if looked == self.LOOK:
                break
        return self._frames + sum(self._begun.values())

    def _look_at(self, number: int) -> None:
        job = self.jobs[number]
        if (self.folder / "clips" / job.key).is_dir():
            self._finished[number] = 1
            self._frames += job.settings.frames
            self._begun.pop(number, None)
            return
        with contextlib.suppress(OSError, ValueError):
            journal = self.folder / "work" / f"{job.key}.part" / "journal.jsonl"
            self._begun[number] = opening.content(journal).count(b"\n")


def write_manifest(recipe: Recipe, folder: Path) -> None:
    """Write dataset.json from the recipe."""
    lock = Lock(folder / "locks" / "manifest")
    lock.acquire(wait=True)
    with lock:
        scratch.sweep(folder)
        series = recipe.jobs.listing.series
        info = DatasetInfo(name=recipe.name, recipe=recipe.source, scenes=series, software={"qsim": VERSION})
        descriptions.write(folder / "dataset.json", info)


def _begin(recipe: Recipe, folder: Path, jobs: Jobs, repair: bool) -> tuple[str, ...]:
    """Make folders and manifest; return the repairs of the manifest. `ValueError` if it is another recipe's."""
    for name in FOLDERS:
        (folder / name).mkdir(exist_ok=True)
        sweep(folder / name)
    # The manifest is written last of all that begins a data set; without it, records decide whose folder this is.
    if not (folder / "dataset.json").is_file():
        _check_records(recipe, folder, repair)
        _check_reads(folder, jobs)
        write_manifest(recipe, folder)
        return ()
    try:
        old = Dataset.open(folder)
    except Damaged as error:
        if not repair:
            raise
        _check_records(recipe, folder, repair)
        write_manifest(recipe, folder)
        return (str(error),)
    _check_reads(folder, jobs)
    if old.info.scenes != recipe.jobs.listing.series:
        _check_same(recipe, old)
        write_manifest(recipe, folder)
    return ()


def _check_same(recipe: Recipe, old: Dataset) -> None:
    """`ValueError` unless a recipe has the clips of a data set, and made those that are made.

    A recipe may be edited before its clips are made. The order of more than a thousand clips decides their folders.
    """
    now = recipe.jobs.listing
    for index in range(len(now)):
        name = now.name(index)
        was = old.listing.find(name)
        if was is None:
            raise ValueError(f"{old.path}: was made from another recipe, without the clip {name}; use another folder")
        if now.digest(index) != old.listing.digest(was) and _is_made(old.path, old.listing.key(was)):
            raise ValueError(f"{old.path}: its clip {name} was made with other settings; use another folder")
        if now.key(index) != old.listing.key(was) and len(now) == len(old.listing):
            raise ValueError(f"{old.path}: lists its clips in another order, from {name} on; use another folder")
    for index in range(len(old.listing)):
        name = old.listing.name(index)
        if now.find(name) is None:
            raise ValueError(f"{old.path}: holds the clip {name}, which is not in this recipe; use another folder")


def _is_made(folder: Path, key: str) -> bool:
    """Return whether a job's clip exists, recorded or not."""
    return record_path(folder, key).is_file() or any((folder / at / key).exists() for at in ("clips", "work"))


def _check_reads(folder: Path, jobs: Jobs) -> None:
    """`ValueError` if a file that a scene of the user reads has changed since a clip was rendered.

    Of each section the first `READ` clips of this shard are looked at.
    """
    for part in jobs.by_section():
        if Path(part[0].family).is_absolute():
            _check_reads_of(folder, part[:READ])


def _check_reads_of(folder: Path, jobs: Jobs) -> None:
    """Check the files that the clips of one section read."""
    from qsim.dataset import scene_files

    seen: set[tuple[str, str, str]] = set()
    for job in jobs:
        for about in (folder / "clips" / job.key / "clip.json", folder / "work" / job.key / "clip.json"):
            reads: dict[str, str] = {}
            with contextlib.suppress(OSError, ValueError):  # missing or damaged: a check finds it
                reads = read_info(about).reads
            for name, digest in sorted(reads.items(), key=lambda entry: "*" in entry[0]):  # single files first
                key = (job.family, name, digest)
                problem = None if key in seen else scene_files.change(*key)
                seen.add(key)
                if problem:
                    raise ValueError(
                        f"{folder}: {problem} since its clip {job.name} was made, and the scene reads it; restore it, "
                        "or use another folder"
                    )


def _check_records(recipe: Recipe, folder: Path, repair: bool) -> None:
    """`ValueError` if a folder without manifest has a record of a clip with other settings.

    With `repair` such a clip is made again, and only a folder without any record of this recipe is refused.
    """
    digests = {}
    root = folder / "jobs"
    for path in root.rglob("*.json"):
        with contextlib.suppress(ValueError):
            digests[path.relative_to(root).with_suffix("").as_posix()] = read_record(path).digest
    listing = recipe.jobs.listing
    found = {key: listing.find(Path(key).name) for key in digests}
    asked = {key: index for key, index in found.items() if index is not None and listing.key(index) == key}
    if digests and not any(digests[key] == listing.digest(index) for key, index in asked.items()):
        raise ValueError(f"{folder}: none of its {len(digests)} finished clips is of this recipe; use another folder")
    other = [listing.name(index) for key, index in asked.items() if digests[key] != listing.digest(index)]
    if other and not repair:
        raise ValueError(
            f"{folder}: its clip {min(other)} was made with other settings; use another folder, or make it "
            "again with repair=True"
        )


@contextlib.contextmanager
def _locked(folder: Path, options: Options) -> Iterator[None]:
    """Lock the folder: one generator, or any number of different shards."""
    if folder.exists() and not _is_data_set(folder):
        raise ValueError(f"{folder}: is not empty and not a data set; use another folder")
    (folder / "locks").mkdir(parents=True, exist_ok=True)
    sweep(folder)
    sweep(folder / "locks")
    # Shards share one lock, which a generator of the whole takes alone.
    held = [Lock(folder / "locks" / "generate", shared=options.shard is not None)]
    if options.shard is not None:
        held.append(Lock(folder / "locks" / "shard-{}-of-{}".format(*options.shard)))
    try:
        for lock in held:
            if not lock.acquire(wait=options.wait):
                raise ValueError(f"{folder}: another generator is at work here; let it finish, or wait with wait=True")
        yield
    finally:
        for lock in held[1:]:  # of this shard
            lock.delete()
        held[0].release()


def _is_data_set(folder: Path) -> bool:
    """Return whether a folder is a data set, the rest of one, or empty."""
    if (folder / "locks").is_dir() or (folder / "dataset.json").is_file():
        return True
    return all(item.name in FOLDERS and item.is_dir() for item in folder.iterdir())


def _runner(options: Options) -> Executor:
    """Return the executor for the processes of this machine."""
    if options.workers == 0:
        return run_here

    def run(jobs: Iterable[Job], folder: Path, make: RenderJob) -> Generator[Result]:
        return run_local(jobs, folder, make, options.workers, options.limits)

    return run


@contextlib.contextmanager
def watching(folder: Path, jobs: Jobs, report: Progress, every: float = 0.5) -> Iterator[None]:
    """Call `report(frames done, frames in all)` while the block runs, for all processes and machines."""
    total = jobs.frames()
    seen = FramesDone(folder, jobs)
    stop = threading.Event()

    def watch() -> None:
        while not stop.wait(every):
            report(seen.look(), total)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()

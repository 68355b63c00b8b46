"""Generates a data set: runs the unfinished jobs of a recipe; an interrupted run resumes.

On machines of one kind the finished folder (dataset.py) always has the same bytes, apart from logs/: after a kill, in
shards, on a cluster.
"""

from __future__ import annotations

import contextlib
import errno
import os
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from qsim import descriptions, files, scratch
from qsim.clip.manifest import read_info
from qsim.dataset.checking import repair_jobs
from qsim.dataset.dataset import Damaged, Dataset, DatasetInfo
from qsim.dataset.job import Job
from qsim.dataset.job_record import Failure, JobInfo, failure_path, read_record, record_path, unproven
from qsim.dataset.job_runner import FOLDERS, RenderJob, Result, mark_failed, render_job
from qsim.dataset.recipe import Recipe
from qsim.dataset.worker_pool import Limits, run_here, run_local
from qsim.files import VERSION, Progress
from qsim.locks import Lock
from qsim.scratch import sweep

Executor = Callable[[list[Job], Path, RenderJob], Generator[Result]]


_REPORTED = "a worker reports that it is done, but "
_ELSEWHERE = f"{_REPORTED}its record is missing; does every worker have this folder at this path?"


@dataclass(frozen=True)
class Options:
    """Options of a generation; none changes a byte of the result."""

    workers: int = 1  # processes; 0: run the jobs in this process
    shard: tuple[int, int] | None = None  # (i, n): the i-th of n shards, i = 1 ... n
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
    shared: tuple[str, ...] = ()  # assets of the test split that other splits hold too


def generate(
    recipe: Recipe,
    path: str | os.PathLike[str],
    options: Options | None = None,
    *,
    make: RenderJob = render_job,
    run: Executor | None = None,
    on_result: Callable[[Result], None] | None = None,
) -> Summary:
    """Make the missing clips of a recipe's data set in folder `path`.

    `run` executes the jobs (default: local processes; dask_cluster.py has another executor), `make` renders one clip.
    `ValueError` if the folder belongs to another recipe or another generator uses it, `OSError` if the disk is full.
    """
    options = options or Options()
    folder = Path(path).resolve()
    jobs = shard(recipe.jobs, options.shard)
    try:
        with _locked(folder, options):
            repaired = _begin(recipe, folder, options.repair)
            repaired += repair_jobs(folder, jobs) if options.repair else ()
            failed = {} if options.retry else _failures(folder, jobs)
            todo = [job for job in jobs if not record_path(folder, job.name).is_file() and job.name not in failed]
            made: list[str] = []
            with contextlib.closing((run or _runner(options))(todo, folder, make)) as results:
                for result in results:
                    if result.state == "full":
                        raise OSError(errno.ENOSPC, result.message)
                    if result.state == "gone":
                        raise FileNotFoundError(result.message)
                    # A worker may crash after it has written the record.
                    if result.state == "done" or record_path(folder, result.name).is_file():
                        made.append(result.name)
                    else:
                        failed[result.name] = result.message
                    if on_result is not None:
                        on_result(result)
            failed |= _unproven(folder, todo, made)
            write_manifest(recipe, folder)
            done = sum(record_path(folder, job.name).is_file() for job in jobs)
            shared = tuple(Dataset.open(folder).shared_between_splits())
    except OSError as error:
        if error.errno not in files.FULL:
            raise
        message = f"{folder}: {error.strerror}; nothing is lost: make space and run the same command again"
        raise OSError(message) from None
    made = [name for name in made if name not in failed]
    return Summary(len(jobs), done, len(made), failed, repaired, shared)


def _unproven(folder: Path, jobs: list[Job], made: list[str]) -> dict[str, str]:
    """Return the jobs that a worker reports as done and that are not, with the reason; delete their records."""
    by_name = {job.name: job for job in jobs}
    failed = {}
    for name in made:
        if name not in by_name:
            failed[name] = f"{_REPORTED}no worker was given it"
        elif not record_path(folder, name).is_file():
            failed[name] = _ELSEWHERE
        elif problem := unproven(folder, by_name[name]):
            failed[name] = f"{_REPORTED}{problem}"
            record_path(folder, name).unlink()
            mark_failed(folder, by_name[name], failed[name])
    return failed


def shard(jobs: tuple[Job, ...], part: tuple[int, int] | None) -> list[Job]:
    """Return every n-th job from the i-th on, so that expensive families spread over the shards."""
    if part is None:
        return list(jobs)
    i, n = part
    if not 1 <= i <= n:
        raise ValueError(f"shard {i}/{n}: expected i/n with 1 <= i <= n, as in 7/100")
    return list(jobs[i - 1 :: n])


def frames_done(folder: Path, jobs: list[Job]) -> int:
    """Return the number of rendered frames, by any process: of finished clips and in the journals of others."""
    total = 0
    for job in jobs:
        if (folder / "clips" / job.name).is_dir():
            total += job.settings.frames
        else:
            with contextlib.suppress(OSError):
                total += (folder / "work" / f"{job.name}.part" / "journal.jsonl").read_bytes().count(b"\n")
    return total


def write_manifest(recipe: Recipe, folder: Path) -> None:
    """Write dataset.json from the recipe and the existing records."""
    lock = Lock(folder / "locks" / "manifest")
    lock.acquire(wait=True)
    with lock:
        scratch.sweep(folder)
        jobs = {}
        failures = _failures(folder, recipe.jobs)
        for job in recipe.jobs:
            listed = JobInfo(split=job.split, scene=job.scene, digest=job.digest)
            if record_path(folder, job.name).is_file():
                listed = replace(listed, state="done")
            elif job.name in failures:
                listed = replace(listed, state="failed", error=failures[job.name])
            jobs[job.name] = listed
        info = DatasetInfo(name=recipe.name, recipe=recipe.source, jobs=jobs, software={"qsim": VERSION})
        descriptions.write(folder / "dataset.json", info)


def _begin(recipe: Recipe, folder: Path, repair: bool) -> tuple[str, ...]:
    """Make folders and manifest; return the repairs of the manifest. `ValueError` if it is another recipe's."""
    for name in FOLDERS:
        (folder / name).mkdir(exist_ok=True)
        sweep(folder / name)
    if not (folder / "dataset.json").is_file():
        _check_records(recipe, folder, repair)
        _check_reads(recipe, folder)
        write_manifest(recipe, folder)
        return ()
    try:
        old = Dataset.open(folder).info.jobs
    except Damaged as error:
        if not repair:
            raise
        _check_records(recipe, folder, repair)
        write_manifest(recipe, folder)
        return (str(error),)
    _check_reads(recipe, folder)
    for job in recipe.jobs:
        if job.name not in old:
            raise ValueError(f"{folder}: was made from another recipe, without the clip {job.name}; use another folder")
        if old[job.name].digest != job.digest and _is_made(folder, job):
            raise ValueError(f"{folder}: its clip {job.name} was made with other settings; use another folder")
    extra = sorted(set(old) - {job.name for job in recipe.jobs})
    if extra:
        raise ValueError(f"{folder}: holds the clip {extra[0]}, which is not in this recipe; use another folder")
    if any(old[job.name].digest != job.digest for job in recipe.jobs):  # edited before their clips were made
        write_manifest(recipe, folder)
    return ()


def _is_made(folder: Path, job: Job) -> bool:
    """Return whether a job's clip exists, recorded or not."""
    return record_path(folder, job.name).is_file() or any((folder / at / job.name).exists() for at in ("clips", "work"))


def _check_reads(recipe: Recipe, folder: Path) -> None:
    """`ValueError` if a file that a scene of the user reads has changed since a clip was rendered."""
    from qsim.dataset import scene_files

    seen: set[tuple[str, str, str]] = set()
    for job in recipe.jobs:
        if not Path(job.family).is_absolute():
            continue
        for about in (folder / "clips" / job.name / "clip.json", folder / "work" / job.name / "clip.json"):
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
    for path in (folder / "jobs").glob("*.json"):
        with contextlib.suppress(ValueError):
            digests[path.stem] = read_record(path).digest
    asked = [job for job in recipe.jobs if job.name in digests]
    if digests and not any(digests[job.name] == job.digest for job in asked):
        raise ValueError(f"{folder}: none of its {len(digests)} finished clips is of this recipe; use another folder")
    other = [job.name for job in asked if digests[job.name] != job.digest]
    if other and not repair:
        raise ValueError(
            f"{folder}: its clip {other[0]} was made with other settings; use another folder, or make it "
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
    held = [Lock(folder / "locks" / "generate", shared=options.shard is not None)]
    if options.shard is not None:
        held.append(Lock(folder / "locks" / "shard-{}-of-{}".format(*options.shard)))
    try:
        for lock in held:
            if not lock.acquire(wait=options.wait):
                raise ValueError(f"{folder}: another generator is at work here; let it finish, or wait with wait=True")
        yield
    finally:
        for lock in held:
            lock.release()


def _is_data_set(folder: Path) -> bool:
    """Return whether a folder is a data set, the rest of one, or empty."""
    if (folder / "locks").is_dir() or (folder / "dataset.json").is_file():
        return True
    return all(item.name in FOLDERS and item.is_dir() for item in folder.iterdir())


def _failures(folder: Path, jobs: Sequence[Job]) -> dict[str, str]:
    """Return why unfinished jobs failed before; an unreadable note counts, one of other settings does not.

    Notes of finished jobs are deleted.
    """
    found = {}
    for job in jobs:
        path = failure_path(folder, job.name)
        if record_path(folder, job.name).is_file():
            path.unlink(missing_ok=True)
        elif path.is_file():
            try:
                note = descriptions.read(path, Failure, "add retry=True")
                if note.digest == job.digest:
                    found[job.name] = note.error
            except ValueError as error:
                found[job.name] = files.wording(error)
    return found


def _runner(options: Options) -> Executor:
    """Return the executor for the processes of this machine."""
    if options.workers == 0:
        return run_here

    def run(jobs: list[Job], folder: Path, make: RenderJob) -> Generator[Result]:
        return run_local(jobs, folder, make, options.workers, options.limits)

    return run


@contextlib.contextmanager
def watching(folder: Path, jobs: list[Job], report: Progress, every: float = 0.5) -> Iterator[None]:
    """Call `report(frames done, frames in all)` while the block runs, for all processes and machines."""
    total = sum(job.settings.frames for job in jobs)
    stop = threading.Event()

    def watch() -> None:
        while not stop.wait(every):
            report(frames_done(folder, jobs), total)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()

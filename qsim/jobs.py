"""One job of a data set: render a clip, sense its streams, write its record. And the processes that run many of them.

    work/NAME[.part]   the clip while it is rendered          (resumable, never read)
    clips/NAME         the finished clip with its streams
    jobs/NAME.json     the record: checksums of clip.json and of every stream's json; written last
    failed/NAME.json   why the job failed; gone when it succeeds
    logs/NAME.log      when, where, how long, how much memory; the only files that differ between two runs

A job is done when its record is there. Everything before can be killed at any moment and done again.
"""

from __future__ import annotations

import collections
import contextlib
import datetime
import errno
import multiprocessing
import multiprocessing.connection
import os
import platform
import resource
import signal
import threading
import time
import traceback
from collections.abc import Callable, Generator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from qsim import files, stream
from qsim.clip import Clip
from qsim.recipe import Job

Make = Callable[[Job, Path], object]  # renders a job's clip to a path; tests hand in a quick one

FULL = (errno.ENOSPC, errno.EDQUOT)
_ASSETS = {  # record of scene.py -> its array or file, and what it is
    "Texture": ("image", "texture"),
    "NormalMap": ("image", "texture"),
    "EnvironmentImage": ("image", "texture"),
    "Mesh": ("vertices", "mesh"),
}
MAX_DEATHS = 2  # of the worker process, before a job counts as failed
MEMORY_EXIT, ORPHAN_EXIT = 70, 71  # exit codes of worker processes


@dataclass(frozen=True)
class Result:
    """What became of one job."""

    name: str
    state: str  # "done", "failed", "full" (no space left) or "died" (the worker process did not survive it)
    message: str = ""
    clip_seconds: float = 0.0  # wall time of rendering
    stream_seconds: float = 0.0  # wall time of sensing
    peak_memory: int = 0  # bytes, of the worker process so far


@dataclass(frozen=True)
class Limits:
    """What a worker process may use."""

    memory: float = 4.0  # GiB of resident memory, then the process gives up its job
    jobs: int = 8  # per process: a fresh one replaces it, because renderers grow


def provenance(job: Job) -> dict[str, Any]:
    """What a job's clip.json says beside what the renderer knows: which job it is, its scene and split."""
    scene = {"family": Path(job.family).stem, "seed": job.scene_seed, "speed": job.speed}
    return {"name": job.name, "job": job.digest, "split": job.split, "scene": scene}


def render_job(job: Job, path: Path) -> object:
    """Render a job's clip with the budget that its wanted error asks for."""
    import scenes
    from qsim import budget, keys, render

    settings = job.settings
    scene = scenes.load(job.family, seed=job.scene_seed, speed=job.speed).resized(settings.height, settings.width)
    return render.render_clip(
        scene,
        path,
        frames=settings.frames,
        frame_rate=settings.frame_rate,
        shutter=settings.shutter,
        seed=(keys.hash_name(job.name) ^ job.seed) & 0x7FFFFFFF,  # no two clips share their samples
        budget=budget.Budget(),
        extra=provenance(job) | {"assets": assets(scene.to_dict())},
    )


def assets(described: Any) -> list[str]:
    """The pictures and meshes in a scene's description, as `texture SHA-256`, `texture FILE` or `mesh SHA-256`."""
    found: set[str] = set()
    waiting = [described]
    while waiting:
        item = waiting.pop()
        if isinstance(item, list):
            waiting += item
        elif isinstance(item, dict):
            waiting += item.values()
            key, kind = _ASSETS.get(str(item.get("kind")), ("", ""))
            value = item.get(key)
            if isinstance(value, dict):
                found.add(f"{kind} {value['sha256']}")
            elif isinstance(value, str):
                found.add(f"{kind} {value}")
    return sorted(found)


def record_path(folder: Path, name: str) -> Path:
    """The record whose presence means that the job is done."""
    return folder / "jobs" / f"{name}.json"


def run_job(job: Job, folder: Path, make: Make = render_job) -> Result:
    """Do whatever of a job is not done yet. Failures are written to failed/ and returned, not raised."""
    lock = files.Lock(folder / "locks" / job.name)
    lock.acquire(wait=True)  # another process may still be dying over this job
    started = time.monotonic()
    try:
        if record_path(folder, job.name).is_file():
            return Result(job.name, "done")
        clip = _clip(job, folder, make)
        rendered = time.monotonic()
        digests = {}
        for sensing in job.streams:
            drawn, line = stream.sense(clip, sensing)
            _log(folder, job.name, line)
            digests[drawn.name] = files.sha256(drawn.path.with_suffix(".json"))
        record = {"name": job.name, "digest": job.digest, "split": job.split, "streams": digests}
        record["clip"] = files.sha256(clip.path / "clip.json")
        files.write_json(record_path(folder, job.name), record)
        (folder / "failed" / f"{job.name}.json").unlink(missing_ok=True)
    except Exception as error:
        if isinstance(error, OSError) and error.errno in FULL:
            return Result(job.name, "full", f"{error.strerror}: {error.filename or folder}")
        _log(folder, job.name, traceback.format_exc())
        message = " ".join(str(error).split()) or type(error).__name__
        if not isinstance(error, ValueError | OSError):
            message = f"{type(error).__name__}: {message}"
        mark_failed(folder, job, message)
        return Result(job.name, "failed", message)
    finally:
        lock.release()
    seconds = (rendered - started, time.monotonic() - rendered)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    where = f"{platform.node()} process {os.getpid()}"
    _log(
        folder, job.name, f"done on {where}: clip {seconds[0]:.2f} s, streams {seconds[1]:.2f} s, peak {peak >> 20} MiB"
    )
    return Result(job.name, "done", "", seconds[0], seconds[1], peak)


def mark_failed(folder: Path, job: Job, message: str) -> None:
    """Remember a failure; `generate` lists it until it is retried."""
    files.write_json(folder / "failed" / f"{job.name}.json", {"name": job.name, "digest": job.digest, "error": message})


def run_here(jobs: list[Job], folder: Path, make: Make) -> Generator[Result]:
    """The jobs one after the other in this process."""
    for job in jobs:
        yield run_job(job, folder, make)


def run_local(jobs: list[Job], folder: Path, make: Make, workers: int, limits: Limits) -> Generator[Result]:
    """The jobs in `workers` fresh processes, each with its own renderer; one that dies takes down only its job."""
    queue = collections.deque(jobs)
    deaths: collections.Counter[str] = collections.Counter()
    crew: list[_Worker] = []
    try:
        while queue or any(worker.job for worker in crew):
            while queue and len([w for w in crew if w.job]) < workers:
                worker = next((w for w in crew if w.job is None), None)
                if worker is None:
                    worker = _Worker(folder, make, limits.memory)
                    crew.append(worker)
                worker.give(queue.popleft())
            for connection in multiprocessing.connection.wait([w.pipe for w in crew if w.job]):
                worker = next(w for w in crew if w.pipe is connection)
                job, result = worker.take()
                if result is None:  # the process died
                    crew.remove(worker)
                    deaths[job.name] += 1
                    if deaths[job.name] < MAX_DEATHS:
                        queue.append(job)
                        continue
                    result = Result(
                        job.name, "died", f"its worker process died {MAX_DEATHS} times ({worker.last_words})"
                    )
                    mark_failed(folder, job, result.message)
                elif worker.jobs >= limits.jobs:
                    crew.remove(worker)
                    worker.dismiss()
                yield result
    finally:
        for worker in crew:
            worker.dismiss(at_once=worker.job is not None)


class _Worker:
    """A process of its own that does one job after the other; it ends when the parent does."""

    def __init__(self, folder: Path, make: Make, memory: float) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, folder, make, memory, os.getpid()), daemon=True)
        self.process.start()
        theirs.close()
        self.job: Job | None = None
        self.jobs = 0

    def give(self, job: Job) -> None:
        self.job = job
        self.jobs += 1
        with contextlib.suppress(BrokenPipeError):  # it died idle: `take` will see it
            self.pipe.send(job)

    def take(self) -> tuple[Job, Result | None]:
        """The job and its result; None if the process died over it."""
        assert self.job is not None
        job, self.job = self.job, None
        try:
            return job, self.pipe.recv()
        except (EOFError, ConnectionResetError):
            self.process.join()
            return job, None

    @property
    def last_words(self) -> str:
        """Why the process is gone, in words."""
        code = self.process.exitcode
        if code == MEMORY_EXIT:
            return "it needed more memory than --memory allows"
        if code is not None and code < 0:
            return f"signal {signal.Signals(-code).name}; SIGKILL is often a lack of memory"
        return f"exit code {code}"

    def dismiss(self, at_once: bool = False) -> None:
        if at_once:
            self.process.terminate()
        self.pipe.close()
        self.process.join()


def _work(pipe: Connection, folder: Path, make: Make, memory: float, parent: int) -> None:
    """A worker process: jobs in, results out, until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's business
    threading.Thread(target=_watch, args=(parent, memory), daemon=True).start()
    with contextlib.suppress(EOFError):
        while True:
            pipe.send(run_job(pipe.recv(), folder, make))


def _clip(job: Job, folder: Path, make: Make) -> Clip:
    """The job's finished clip, rendered if it is not there."""
    path, work = folder / "clips" / job.name, folder / "work" / job.name
    if not path.is_dir():
        if not work.is_dir():
            _log(folder, job.name, f"rendering on {platform.node()}, process {os.getpid()}")
            make(job, work)
        os.replace(work, path)
        files.sync_folder(path.parent)
    clip = Clip.open(path)
    if clip.meta.get("job") != job.digest:
        raise ValueError(f"{path}: was made by another recipe; use another folder")
    return clip


def _log(folder: Path, name: str, text: str) -> None:
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    with open(folder / "logs" / f"{name}.log", "a", encoding="utf-8") as log:
        log.write(f"{now} {text}\n")


def _watch(parent: int, memory: float) -> None:
    """End this process when its parent is gone, or when it has grown beyond `memory` GiB."""
    while os.getppid() == parent:
        if resident_memory() > memory * 2**30:
            os._exit(MEMORY_EXIT)
        time.sleep(0.5)
    os._exit(ORPHAN_EXIT)


def resident_memory() -> int:
    """Bytes of memory that this process holds now (its peak, where the system does not say)."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

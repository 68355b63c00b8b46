"""Runs jobs in worker processes, each with its own renderer, a memory limit, and an end with its parent."""

from __future__ import annotations

import collections
import contextlib
import itertools
import multiprocessing
import multiprocessing.connection
import multiprocessing.resource_tracker
import os
import signal
import threading
import time
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from qsim.dataset.job import Job
from qsim.dataset.job_runner import RenderJob, Result, mark_failed, run_job
from qsim.process import resident_memory

MAX_CRASHES = 2  # of worker processes, before a job counts as failed
# exit codes of worker processes
MEMORY_EXIT = 70
ORPHAN_EXIT = 71


@dataclass(frozen=True)
class Limits:
    """Limits of a worker process."""

    memory: float = 4.0  # GiB of resident memory; above it the process ends and its job counts as crashed
    jobs: int = 8  # per process, which is then replaced, because the memory of a renderer grows


def run_here(jobs: Iterable[Job], folder: Path, make: RenderJob) -> Generator[Result]:
    """Run the jobs one after the other in this process."""
    for job in jobs:
        yield run_job(job, folder, make)


def run_local(jobs: Iterable[Job], folder: Path, make: RenderJob, workers: int, limits: Limits) -> Generator[Result]:
    """Run the jobs in `workers` new processes; a process that crashes loses only its job."""
    queue = _Queue(jobs)
    crashes: collections.Counter[str] = collections.Counter()
    pool: list[_Worker] = []
    try:
        while queue or any(worker.job for worker in pool):
            # A process is started only when there is a job for it: each one loads the renderer.
            while queue and len([w for w in pool if w.job]) < workers:
                worker = next((w for w in pool if w.job is None), None)
                if worker is None:
                    worker = _Worker(folder, make, limits.memory)
                    pool.append(worker)
                worker.give(queue.next())
            for connection in multiprocessing.connection.wait([w.pipe for w in pool if w.job]):
                worker = next(w for w in pool if w.pipe is connection)
                job, result = worker.take()
                if result is None:  # the process crashed
                    pool.remove(worker)
                    crashes[job.name] += 1
                    if crashes[job.name] < MAX_CRASHES:
                        queue.again(job)
                        continue
                    result = Result(
                        job.name, "crashed", f"its worker process crashed {MAX_CRASHES} times ({worker.exit_reason})"
                    )
                    mark_failed(folder, job, result.message)
                # The memory of a renderer grows from job to job; a new process begins anew.
                elif worker.jobs >= limits.jobs:
                    pool.remove(worker)
                    worker.close()
                yield result
    finally:
        for worker in pool:
            worker.close(terminate=worker.job is not None)


class _Queue:
    """Jobs that are taken one by one; it is true while there is one, and holds at most one beside those to repeat."""

    def __init__(self, jobs: Iterable[Job]) -> None:
        self._jobs: Iterator[Job] = iter(jobs)
        self._waiting: collections.deque[Job] = collections.deque()

    def __bool__(self) -> bool:
        if not self._waiting:
            self._waiting.extend(itertools.islice(self._jobs, 1))
        return bool(self._waiting)

    def next(self) -> Job:
        return self._waiting.popleft()

    def again(self, job: Job) -> None:
        self._waiting.append(job)


class _Worker:
    """A process that runs one job after the other and ends with its parent."""

    def __init__(self, folder: Path, make: RenderJob, memory: float) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, folder, make, memory, os.getpid()), daemon=True)
        # Ctrl-C in a terminal reaches all processes, and only the parent handles it: the child inherits this mask.
        # The first start of a child also starts the tracker, which unblocks SIGINT again: start the tracker before.
        multiprocessing.resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self.process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()
        self.job: Job | None = None
        self.jobs = 0

    def give(self, job: Job) -> None:
        """Send a job to the process."""
        self.job = job
        self.jobs += 1
        with contextlib.suppress(BrokenPipeError):  # the idle process has crashed: `take` returns None
            self.pipe.send(job)

    def take(self) -> tuple[Job, Result | None]:
        """Wait for the result and return it with the job; None in its place if the process crashed."""
        assert self.job is not None
        job = self.job
        self.job = None
        try:
            return job, self.pipe.recv()
        except (EOFError, ConnectionResetError):
            self.process.join()
            return job, None

    @property
    def exit_reason(self) -> str:
        """Return why the process ended."""
        code = self.process.exitcode
        if code == MEMORY_EXIT:
            return "it needed more memory than is allowed"
        if code is not None and code < 0:
            return f"signal {signal.Signals(-code).name}; SIGKILL is often a lack of memory"
        return f"exit code {code}"

    def close(self, terminate: bool = False) -> None:
        """End the process: after its job, or at once."""
        if terminate:
            self.process.terminate()
        self.pipe.close()
        self.process.join()


def _work(pipe: Connection, folder: Path, make: RenderJob, memory: float, parent: int) -> None:
    """Run in a worker process the jobs that arrive, and send their results, until the pipe closes."""
    threading.Thread(target=_watch, args=(parent, memory), daemon=True).start()
    with contextlib.suppress(EOFError):
        while True:
            pipe.send(run_job(pipe.recv(), folder, make))


def _watch(parent: int, memory: float) -> None:
    """End this process when its parent has ended, or when it holds more than `memory` GiB."""
    while os.getppid() == parent:
        if resident_memory() > memory * 2**30:
            os._exit(MEMORY_EXIT)
        time.sleep(0.5)
    os._exit(ORPHAN_EXIT)

"""Runs the jobs of a data set on a Dask cluster whose workers share the data set's folder.

    dask scheduler                                      # prints tcp://HOST:8786
    dask worker tcp://HOST:8786 --nthreads 1 LIMITS     # on every machine; LIMITS as below
    dask worker tcp://HOST:8786 --nthreads 1 LIMITS --resources GPU=1
    qsim generate scenes/i2_2000fps.toml -o /shared/i2 --cluster tcp://HOST:8786

On SLURM, dask-jobqueue starts the workers and gives the address of the scheduler:

    from dask_jobqueue import SLURMCluster
    cluster = SLURMCluster(cores=1, memory="4GB", walltime="04:00:00"); cluster.scale(40)
    print(cluster.scheduler_address)                    # for --cluster

The folder must have the same path on all machines, and so must a scene file or a sensor file. When a worker crashes,
another one resumes its job after the last complete frame. The files are those of a local run.

The memory of a renderer grows, and `worker_pool.Limits` holds for local processes only. A worker therefore gets its
LIMITS where it is started: `--memory-limit 4GiB --lifetime 1h --lifetime-stagger 10m --lifetime-restart`
(docs/cluster.md explains them).
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
from collections.abc import Generator, Iterable, Iterator
from pathlib import Path
from typing import Any

from qsim import files
from qsim.dataset.job import Job
from qsim.dataset.job_runner import RenderJob, Result, mark_failed, run_job

IN_FLIGHT = 5000  # jobs at the scheduler, which holds some kB for each
RETRIES = 3  # of a job that raised; the scheduler counts the workers that crashed (its allowed-failures)


class Cluster:
    """Executor on a running scheduler: `generate(..., run=Cluster("tcp://..."))`.

    Each job takes `gpus` of the resource GPU, if above 0. `ValueError` if no scheduler answers at the address.
    """

    def __init__(self, address: str, *, gpus: float = 0, timeout: float = 10.0) -> None:
        self.address = address
        self.gpus = gpus
        self.timeout = timeout

    def __call__(self, jobs: Iterable[Job], folder: Path, make: RenderJob) -> Generator[Result]:
        distributed = _distributed()
        resources = {"GPU": self.gpus} if self.gpus > 0 else None
        try:
            client = distributed.Client(self.address, timeout=self.timeout)
        except (OSError, TimeoutError, ValueError) as error:
            raise ValueError(f"{self.address}: no Dask scheduler answers there ({_short(error)})") from None
        with _quiet(), client:
            waiting = iter(jobs)
            futures = {}

            def submit(count: int) -> list[Any]:
                """Submit the next jobs; pure=False: the result of a job is its files, not the value returned."""
                given = {
                    client.submit(
                        run_job,
                        job,
                        folder,
                        make,
                        key=task_key(folder, job),
                        pure=False,
                        retries=RETRIES,
                        resources=resources,
                    ): job
                    for job in itertools.islice(waiting, count)
                }
                futures.update(given)
                return list(given)

            try:
                running = distributed.as_completed(submit(IN_FLIGHT))
                for future in running:
                    job = futures.pop(future)
                    if future.cancelled():  # by nobody here: the client does so when it loses the scheduler
                        raise ConnectionError(
                            f"{self.address}: its Dask scheduler is gone; nothing is lost: start one and run the same "
                            "command again"
                        )
                    running.update(submit(1))
                    yield _result(future, job, folder)
                    future.release()
            finally:
                client.cancel(list(futures))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask's own reports of a lost scheduler, with tracebacks, out of the messages of a command."""
    logger = logging.getLogger("distributed.client")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)


def task_key(folder: Path, job: Job) -> str:
    """Return the name of a job at the scheduler: `FOLDER-JOB-HASH`.

    Dask returns the stored result of a known key to every client, also to one with another folder. The hash therefore
    covers the resolved path and the job's digest.
    """
    hashed = os.fsencode(folder.resolve()) + b"\0" + job.digest.encode()
    return f"{folder.name}-{job.name}-{files.sha256(hashed)[:32]}"


def _result(future: Any, job: Job, folder: Path) -> Result:
    """Return the result of a finished future; an error of the worker is written to failed/."""
    try:
        found = future.result()
    except Exception as error:  # any error of the worker counts as a failure of this job
        message = f"on the cluster: {type(error).__name__}: {_short(error)}"
        mark_failed(folder, job, message)
        return Result(job.name, "crashed", message)
    assert isinstance(found, Result)
    return found


def _distributed() -> Any:
    try:
        import distributed
    except ImportError:
        raise ValueError("a cluster needs the package 'distributed': pip install distributed") from None
    return distributed


def _short(error: BaseException) -> str:
    return files.wording(error)[:200]

"""The same jobs on a Dask cluster: a scheduler somewhere, workers that see the data set's folder.

    dask scheduler                                      # prints tcp://HOST:8786
    dask worker tcp://HOST:8786 --nthreads 1            # on every machine, as many as it has room for
    dask worker tcp://HOST:8786 --nthreads 1 --resources GPU=1
    qsim generate scenes/i2_2000fps.toml -o /shared/i2 --cluster tcp://HOST:8786

On SLURM let dask-jobqueue start the workers and hand its address over:

    from dask_jobqueue import SLURMCluster
    cluster = SLURMCluster(cores=1, memory="4GB", walltime="04:00:00"); cluster.scale(40)
    print(cluster.scheduler_address)                    # for --cluster

The folder must have the same path on all machines; a scene file or a sensor file likewise. A worker that dies gives its
job back to the others, who go on with the frames it had finished. The files are those of a local run.
"""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from typing import Any

from qsim.jobs import Make, Result, mark_failed, run_job
from qsim.recipe import Job

RETRIES = 3  # deaths of workers, before a job counts as failed


class Cluster:
    """A running scheduler, as something that runs jobs: `generate(..., run=Cluster("tcp://..."))`.

    `gpus` of the resource GPU are asked for per job, if above 0. `ValueError` if nobody answers at the address.
    """

    def __init__(self, address: str, *, gpus: float = 0, timeout: float = 10.0) -> None:
        self.address, self.gpus, self.timeout = address, gpus, timeout

    def __call__(self, jobs: list[Job], folder: Path, make: Make) -> Generator[Result]:
        distributed = _distributed()
        resources = {"GPU": self.gpus} if self.gpus > 0 else None
        try:
            client = distributed.Client(self.address, timeout=self.timeout)
        except (OSError, TimeoutError, ValueError) as error:
            raise ValueError(f"{self.address}: no Dask scheduler answers there ({_short(error)})") from None
        with client:
            # One future per job; pure=False because a job's result is files, not its return value.
            futures = {
                client.submit(run_job, job, folder, make, key=f"{folder.name}-{job.name}", pure=False,
                              retries=RETRIES, resources=resources): job
                for job in jobs
            }  # fmt: skip
            try:
                for future in distributed.as_completed(list(futures)):
                    yield _result(future, futures[future], folder)
                    future.release()
            finally:
                client.cancel(list(futures))


def _result(future: Any, job: Job, folder: Path) -> Result:
    try:
        found = future.result()
    except Exception as error:  # the worker's: whatever it may be, it belongs to this job
        message = f"on the cluster: {type(error).__name__}: {_short(error)}"
        mark_failed(folder, job, message)
        return Result(job.name, "died", message)
    assert isinstance(found, Result)
    return found


def _distributed() -> Any:
    try:
        import distributed
    except ImportError:
        raise ValueError("a cluster needs the package 'distributed': pip install 'qsim[cluster]'") from None
    return distributed


def _short(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__

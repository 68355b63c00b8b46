"""Does the work of the host on one frame in a thread of its own, while the engine renders the next one."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType


class Behind:
    """Does one job at a time, in order. At most one is under way, so that no more than two frames are in memory."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "finishing frames")
        self._job: Future[None] | None = None

    def __enter__(self) -> Behind:
        return self

    def start(self, job: Callable[[], None]) -> None:
        """Start a job; `wait` comes before the next one."""
        self._job = self._pool.submit(job)

    def wait(self) -> bool:
        """Wait for the job under way and raise its error; return whether there was one."""
        job = self._job
        self._job = None
        if job is None:
            return False
        job.result()
        return True

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self.wait()
        finally:
            self._pool.shutdown()

"""Runs command lines in forks of a process that has begun no threads, kills them at a file operation, and limits them.

    with KillServer() as server:
        code, events, told = server.run(folder, "qsim sense clip", step=7)
        code, events, told = server.run(folder, "qsim check clip", memory=1 << 30, seconds=10)

A command is killed (SIGKILL) before its so-many-th operation that makes, renames, removes or opens a file to write, or
meets another `event` of service.py there; `condition` is one of that module, too.
With `memory` it gets so many bytes of addresses beyond those of the server, with `seconds` so much processor time and
twice that on the clock. With `trace` it leaves the steps of power_loss.py in that file.
"""

from __future__ import annotations

import atexit
import functools
import importlib
import json
import os
import pickle
import resource
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from power_loss import Recorder
from service import CONDITIONS, EVENTS

ROOT = Path(__file__).parents[2]
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT
ALREADY = (  # what commands import, and what begins no threads
    "av",
    "h5py",
    "jinja2",
    "matplotlib.figure",
    "PIL.Image",
    "scipy.optimize",
    "scipy.stats",
    "torch",
    "torch.utils.tensorboard",
    "quiver.evaluation.comparison",
    "quiver.restoration.restorers",
    "quiver.training.loop",
)
CHANGES = ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.truncate")


class KillServer:
    """The process that forks; it imports the programs once."""

    @staticmethod
    @functools.cache
    def shared() -> KillServer:
        """Return one for all tests of this process; it ends with it."""
        found = KillServer().__enter__()
        atexit.register(found.__exit__, None, None, None)
        return found

    def __enter__(self) -> Self:
        path = os.pathsep.join([str(ROOT), str(ROOT / "tests/support"), os.environ.get("PYTHONPATH", "")])
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        self.process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **threads, "PYTHONPATH": path},
            text=True,
        )
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.process.communicate()

    def run(
        self,
        folder: Path,
        line: str,
        step: int | None = None,
        *,
        memory: int = 0,
        seconds: int = 0,
        trace: Path | None = None,
        event: str = "killed",
        condition: str = "",
    ) -> tuple[int, int, str]:
        """(exit code, -9 if killed; events; what it told on stderr) of a command line in a folder."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(
            json.dumps([str(folder), line, step, memory, seconds, str(trace or ""), event, condition]) + "\n"
        )
        self.process.stdin.flush()
        code, events, told = json.loads(self.process.stdout.readline())
        return code, events, told


# ---- In the process that forks


def serve() -> None:
    """Answer every line on stdin."""
    import qsim.cli.program
    import quiver.cli.program

    for name in ALREADY:
        importlib.import_module(name)
    programs = {"qsim": qsim.cli.program.main, "quiver": quiver.cli.program.main}
    for text in sys.stdin:
        folder, line, step, memory, seconds, trace, event, condition = json.loads(text)
        program, *words = shlex.split(line)
        reading, writing = os.pipe()
        told = Path(folder).parent / "told"
        child = os.fork()
        if child == 0:
            os.close(reading)
            _limit(memory, seconds)
            _work(programs[program], words, folder, step, told, writing, trace, event, condition)
        os.close(writing)
        events = 0
        while found := os.read(reading, 4096):
            events += len(found)
        os.close(reading)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(json.dumps([code, events, told.read_text(errors="replace")]), flush=True)


def _limit(memory: int, seconds: int) -> None:
    """Limit the addresses and the time of this fork."""
    if memory:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + memory
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    if seconds:
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        signal.alarm(2 * seconds)


def _work(
    main: Any,
    words: list[str],
    folder: str,
    step: int | None,
    told: Path,
    counter: int,
    trace: str,
    event: str,
    condition: str,
) -> None:
    """Run a command in this fork, and end it."""
    os.chdir(folder)
    for number, name in ((1, "/dev/null"), (2, str(told))):
        os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    seen = 0
    recorder = Recorder(folder) if trace else None

    def watch(name: str, arguments: tuple[Any, ...]) -> None:
        nonlocal seen
        changes = name in CHANGES or (name == "open" and bool(arguments[2] & WRITING))
        if not changes or not os.path.abspath(str(arguments[0])).startswith(folder):  # caches of libraries
            return
        seen += 1
        if recorder is not None:
            recorder.tree()
        if seen == step:
            EVENTS[event]()
        os.write(counter, b".")

    if condition:
        CONDITIONS[condition]()
    sys.addaudithook(watch)
    if recorder is not None:
        recorder.start()
    code = 1
    try:
        code = main(words)
    finally:
        if recorder is not None:
            recorder.tree()
            Path(trace).write_bytes(pickle.dumps(recorder.steps))
        os._exit(code)


if __name__ == "__main__":
    serve()

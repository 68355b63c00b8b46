"""Runs command lines in forks of a process that has begun no threads, and kills them at a file operation.

    with KillServer() as server:
        code, events = server.run(folder, "qsim sense clip", step=7)

A command is killed (SIGKILL) before its so-many-th operation that makes, renames, removes or opens a file to write.
"""

from __future__ import annotations

import importlib
import json
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Any, Self

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

    def run(self, folder: Path, line: str, step: int | None = None) -> tuple[int, int, str]:
        """(exit code, -9 if killed; events; what it told on stderr) of a command line in a folder."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps([str(folder), line, step]) + "\n")
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
        folder, line, step = json.loads(text)
        program, *words = shlex.split(line)
        reading, writing = os.pipe()
        told = Path(folder).parent / "told"
        child = os.fork()
        if child == 0:
            os.close(reading)
            _work(programs[program], words, folder, step, told, writing)
        os.close(writing)
        events = 0
        while found := os.read(reading, 4096):
            events += len(found)
        os.close(reading)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(json.dumps([code, events, told.read_text(errors="replace")]), flush=True)


def _work(main: Any, words: list[str], folder: str, step: int | None, told: Path, counter: int) -> None:
    """Run a command in this fork, and end it."""
    os.chdir(folder)
    for number, name in ((1, "/dev/null"), (2, str(told))):
        os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    seen = 0

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal seen
        changes = event in CHANGES or (event == "open" and bool(arguments[2] & WRITING))
        if not changes or not os.path.abspath(str(arguments[0])).startswith(folder):  # caches of libraries
            return
        seen += 1
        if seen == step:
            os.kill(os.getpid(), signal.SIGKILL)
        os.write(counter, b".")

    sys.addaudithook(watch)
    code = 1
    try:
        code = main(words)
    finally:
        os._exit(code)


if __name__ == "__main__":
    serve()

"""Actions in a fork of this process, which a test may kill, or whose crash it wants to see."""

import contextlib
import gc
import itertools
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any


def forked(action: Callable[[], Any]) -> int:
    """Run `action` in a fork, whose number is returned; it exits with 0 if the action came to its end, else with 1."""
    gc.freeze()  # the child must not collect what threads of ours stand behind, as behind an open video: it has none
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # fork in a process with threads, from Python 3.12 on
        child = os.fork()
    if child == 0:
        code = 1
        with contextlib.suppress(BaseException):
            action()
            code = 0
        os._exit(code)
    gc.unfreeze()
    return child


def in_child(action: Callable[[], Any], seconds: float) -> bool:
    """Run `action` in a fork and kill it after so many seconds; True if it came to its end before."""
    child = forked(action)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            assert os.waitstatus_to_exitcode(status) == 0
            return True
        time.sleep(0.001)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


def killed_at(step: int, place: Path, action: Callable[[], Any]) -> bool:
    """Run `action` in a fork that SIGKILL ends before its so-many-th event of the file system; False if it had fewer.

    Events: what is opened below `place`, and whatever is made, removed or renamed.
    """
    events = itertools.count(1)

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        ours = event in ("os.mkdir", "os.rename", "os.remove", "os.rmdir") or (
            event == "open" and str(place) in str(arguments[0])
        )
        if ours and next(events) == step:
            os.kill(os.getpid(), signal.SIGKILL)

    def watched() -> None:
        sys.addaudithook(watch)
        action()

    code = os.waitstatus_to_exitcode(os.waitpid(forked(watched), 0)[1])
    assert code in (0, -signal.SIGKILL)
    return code != 0

"""Actions in a fork of this process, which a test may kill, or whose crash it wants to see."""

import contextlib
import gc
import os
import warnings
from collections.abc import Callable
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

"""Workers: Ctrl-C does not reach them, and an error of one is its own sentence."""

from __future__ import annotations

import os
import signal

import pytest
from torch._utils import ExceptionWrapper

from quiver.training.processes import begin_worker, plain_errors


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_workers_ignore_ctrl_c_and_termination(number):
    before = {known: signal.getsignal(known) for known in (signal.SIGINT, signal.SIGTERM)}
    try:
        begin_worker(0)
        os.kill(os.getpid(), number)
    finally:
        for known, handler in before.items():
            signal.signal(known, handler)


def wrapped(error: Exception) -> ExceptionWrapper:
    """Return what a worker of torch sends of an error."""
    try:
        raise error
    except type(error):
        return ExceptionWrapper(where="in DataLoader worker process 0")


@pytest.mark.parametrize(
    "error",
    [
        ValueError("clip fan_0003: window from frame 2: photons are nan"),
        FileNotFoundError("x/000003.exr: no such file; the clip is damaged"),
        MemoryError("Unable to allocate 3 GiB"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_the_error_of_a_worker_is_its_own_sentence(error):
    with pytest.raises(type(error)) as caught, plain_errors():
        wrapped(error).reraise()
    assert str(caught.value) == str(error)
    assert "Traceback" in str(caught.value.__cause__), "shown by --verbose"


def test_other_errors_stay_as_they_are():
    with pytest.raises(ValueError, match="first: second") as caught, plain_errors():
        raise ValueError("first: second")
    assert caught.value.__cause__ is None

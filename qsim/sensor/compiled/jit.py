"""Which Dr.Jit runs here, and small pieces that every kernel of codes is made of."""

from __future__ import annotations

import os
import sys
import warnings
from functools import cache
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import backend as engine

_PACKET = 16  # numbers that a kernel works on at a time, at most
_INFINITY = 0x7F800000  # float32; larger bit patterns are NaN or negative


def available() -> bool:
    """Whether Dr.Jit can run here: CUDA or a usable LLVM, and not in a child forked from a process that used it."""
    return not _in_broken_child and backend() is not None


@cache
def backend() -> Any:
    """`drjit.cuda` or `drjit.llvm`; None where neither works here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Sensor.sample says that the reference draws
        chosen = engine.choose()
    if chosen.backend == "scalar":
        return None
    if chosen.llvm_path:
        os.environ["DRJIT_LIBLLVM_PATH"] = chosen.llvm_path
    import drjit as dr

    engine.limit_threads()
    return getattr(dr, chosen.backend)


_in_broken_child: list[int] = []  # the process id, in a child of a process that had loaded Dr.Jit


def _after_fork() -> None:
    """Dr.Jit's threads do not survive a fork: such a child draws with the reference."""
    if "drjit" in sys.modules:
        _in_broken_child[:] = [os.getpid()]


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def whole_packets(numbers: Array) -> Array:
    """The same numbers [n] in memory that a kernel may read to the end of its last packet.

    Dr.Jit takes over the memory of NumPy's arrays. A packet that reached beyond them, and beyond the last page, ended
    the process.
    """
    missing = -numbers.size % _PACKET
    return np.append(numbers, np.zeros(missing, numbers.dtype))[: numbers.size] if missing else numbers


# ---- Pieces of kernels


def no_light(photons: list[Any]) -> Any:
    """Whether one is negative, infinite or NaN, by its bits: the reference says what is wrong."""
    import drjit as dr

    jit = backend()
    doubt: Any = jit.Bool(False)
    for theta in photons:
        pattern: Any = dr.reinterpret_array(jit.UInt32, theta)
        doubt |= pattern >= _INFINITY
    return doubt


def uniform32(word: Any) -> Any:
    import drjit as dr

    return dr.fma(backend().Float(word), 2.0**-32, 2.0**-33)


def smaller(a: Any, b: Any) -> Any:
    """The smaller one, in one instruction: `drjit.minimum` minds NaN and signed zeros, which do not come here."""
    import drjit as dr

    return dr.select(a < b, a, b)

"""Finds the Dr.Jit that works on this machine, and defines the small pieces that every kernel of codes shares."""

from __future__ import annotations

import os
import sys
from functools import cache
from math import log, prod
from typing import Any

import numpy as np
from numpy import ndarray as Array

from qsim import backend as engine
from qsim import llvm
from qsim.device_lock import one_thread_at_a_time
from qsim.keys import KEY_STEPS, MULTIPLIERS, ROUNDS
from qsim.thread_warnings import warnings_here

ALIGNED = 64  # bytes
_PACKET = 16  # numbers that a kernel works on at a time, at most
_INFINITY = 0x7F800000  # float32; larger bit patterns are NaN or negative


def available() -> bool:
    """Return whether Dr.Jit can run: CUDA or a usable LLVM works, and this is not a forked child.

    A child forked from a process that used Dr.Jit lacks its threads.
    """
    return not _in_broken_child and backend() is not None


@cache
@one_thread_at_a_time
def backend() -> Any:
    """Return `drjit.cuda` or `drjit.llvm`; None where neither works on this machine."""
    with warnings_here("ignore"):  # Sensor.sample warns that the reference draws
        chosen = engine.choose()
    if chosen.backend == "scalar":
        return None
    if chosen.llvm_path:
        llvm.prepare(chosen.llvm_path)
    import drjit as dr

    engine.limit_threads()
    return getattr(dr, chosen.backend)


_in_broken_child: list[int] = []  # the process id, in a child of a process that had loaded Dr.Jit


def _after_fork() -> None:
    """Note that Dr.Jit's threads do not survive a fork: such a child draws with the reference."""
    if "drjit" in sys.modules:
        _in_broken_child[:] = [os.getpid()]


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def whole_packets(numbers: Array) -> Array:
    """Return the same numbers [n] in memory that a kernel may read to the end of its last packet.

    Dr.Jit takes over the memory of NumPy's arrays. A packet that reached beyond them, and beyond the last page, ended
    the process.
    """
    missing = -numbers.size % _PACKET
    return np.append(numbers, np.zeros(missing, numbers.dtype))[: numbers.size] if missing else numbers


def aligned(shape: tuple[int, ...], kind: Any) -> Array:
    """Return an empty array [...] of a shape, whose memory begins where Dr.Jit's own would.

    Kernels for other memory are other kernels: without this one would be compiled again by chance.
    """
    size = prod(shape) * np.dtype(kind).itemsize
    memory = np.empty(size + ALIGNED, np.uint8)
    first = -memory.ctypes.data % ALIGNED
    return memory[first : first + size].view(kind).reshape(shape)


def is_aligned(numbers: Any) -> bool:
    """Return whether an array's memory begins as that of `aligned`; of arrays that tell no address it is not known."""
    if isinstance(numbers, np.ndarray):
        return numbers.ctypes.data % ALIGNED == 0
    address = getattr(numbers, "data_ptr", None)  # torch
    return address is not None and address() % ALIGNED == 0


def in_aligned(numbers: Array) -> Array:
    """Return the same numbers [...] in memory as of `aligned`; without a copy where they are there."""
    if is_aligned(numbers) and numbers.flags.c_contiguous:
        return numbers
    found = aligned(numbers.shape, numbers.dtype)
    found[...] = numbers
    return found


# ---- Pieces of kernels


def no_light(photons: list[Any]) -> Any:
    """Return whether one is negative, infinite or NaN, by its bits; the reference names the wrong value."""
    import drjit as dr

    jit = backend()
    wrong: Any = jit.Bool(False)
    for theta in photons:
        pattern: Any = dr.reinterpret_array(jit.UInt32, theta)
        wrong |= pattern >= _INFINITY
    return wrong


def uniform32(word: Any) -> Any:
    import drjit as dr

    return dr.fma(backend().Float(word), 2.0**-32, 2.0**-33)


def smaller(a: Any, b: Any) -> Any:
    """Return the smaller of two numbers in one instruction.

    `drjit.minimum` also handles NaN and signed zeros, which do not occur here.
    """
    import drjit as dr

    return dr.select(a < b, a, b)


def philox(x: Any, y: Any, frame: Any, high: Any, low: Any, redraw: int = 0) -> list[Any]:
    """Return the four words of one block; the compiled equivalent of keys.philox4x32."""
    import drjit as dr

    u32 = type(x)
    c0 = x
    c1 = y
    c2 = frame
    c3 = u32(redraw)
    for _ in range(ROUNDS):
        a = u32(MULTIPLIERS[0])
        b = u32(MULTIPLIERS[1])
        # One round of Philox 4x32 (Salmon et al., SC 2011): two products of 64 bits, whose high halves are mixed.
        high_a = dr.mul_hi(a, c0)
        low_a = a * c0
        high_b = dr.mul_hi(b, c2)
        low_b = b * c2
        c0 = high_b ^ c1 ^ high
        c1 = low_b
        c2 = high_a ^ c3 ^ low
        c3 = low_a
        high = high + KEY_STEPS[0]
        low = low + KEY_STEPS[1]
    return [c0, c1, c2, c3]


def exp_below_zero(x: Any) -> Any:
    """Return exp(x) of float32 -87 <= x <= 0 within 1.2e-7 of its value; `drjit.exp` also handles all other x.

    2^n exp(r) with |r| <= log(2)/2. Adding 1.5 2^23 rounds n to its last bits, from where it enters the exponent. The
    polynomial is that of Cephes (Moshier, expf).
    """
    import drjit as dr

    real = backend().Float
    bits = backend().UInt32
    magic = real(1.5 * 2.0**23)
    shifted = dr.fma(x, real(1 / log(2)), magic)
    n = shifted - magic
    r = dr.fma(n, real(-0.693359375), x)  # log(2) in two parts, the first one short
    r = dr.fma(n, real(2.12194440e-4), r)
    series = real(1.9875691500e-4)
    for c in (1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1):
        series = dr.fma(series, r, real(c))
    value: Any = dr.reinterpret_array(bits, dr.fma(series, r * r, r) + 1)
    exponent: Any = dr.reinterpret_array(bits, shifted)
    return dr.reinterpret_array(real, value + (exponent << 23))

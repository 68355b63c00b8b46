"""Activates the Mitsuba variant chosen by `qsim.backend`; times kernels and makes Dr.Jit values opaque."""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

from qsim import llvm
from qsim.backend import INSTALL_HINT, RenderEngine, choose, limit_threads
from qsim.device_lock import one_thread_at_a_time


class OfVariant(Protocol):
    """What was loaded with a Mitsuba variant."""

    @property
    def variant(self) -> str: ...


P = ParamSpec("P")
S = TypeVar("S", bound=OfVariant)
T = TypeVar("T")


def in_own_variant(method: Callable[Concatenate[S, P], T]) -> Callable[Concatenate[S, P], T]:
    """Return a method under the lock of the renderer, with the variant of its object.

    Between two calls another thread may have activated another variant.
    """

    @functools.wraps(method)
    def alone(self: S, /, *arguments: P.args, **options: P.kwargs) -> T:
        _set_variant(self.variant)
        return method(self, *arguments, **options)

    return one_thread_at_a_time(alone)


@one_thread_at_a_time
def select(prefer: str | None = None) -> RenderEngine:
    """Choose (once per process) and activate an engine; `prefer` or QSIM_ENGINE requires "cuda", "llvm" or "scalar".

    `ValueError` if the required engine does not work on this machine, with the reason and what to install.
    """
    engine = choose(prefer)
    activate(engine)
    return engine


def in_colour(engine: RenderEngine) -> RenderEngine:
    """Return the same engine with Mitsuba's variant of three bands; `ValueError` for the scalar engine."""
    if engine.backend == "scalar":
        raise ValueError(f"the scalar engine renders one band only ({engine.reason}); {INSTALL_HINT}")
    return replace(engine, variant=engine.variant.replace("_mono", "_rgb"))


@one_thread_at_a_time
def activate(engine: RenderEngine) -> None:
    """Make this engine's variant the current one; cheap if it is already active."""
    if engine.llvm_path:
        llvm.prepare(engine.llvm_path)
    _set_variant(engine.variant)
    limit_threads()


def _set_variant(variant: str) -> None:
    import mitsuba as mi

    if mi.variant() != variant:
        mi.set_variant(variant)


@contextmanager
def kernels_timed() -> Iterator[list[float]]:
    """Yield a list that receives the run time [s] of every kernel launched in the block, at the end of the block.

    It stays empty for the scalar engine, which launches none.
    """
    import drjit as dr

    seconds: list[float] = []
    before = dr.flag(dr.JitFlag.KernelHistory)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    dr.kernel_history_clear()
    try:
        yield seconds
    finally:
        seconds += [launch["execution_time"] / 1e3 for launch in dr.kernel_history()]
        dr.set_flag(dr.JitFlag.KernelHistory, before)


@contextmanager
def errors_only(mi: Any) -> Iterator[None]:
    """Suppress warnings of Mitsuba inside the block; the caller states in a comment which ones and why."""
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(level)


@one_thread_at_a_time
def free_memory(engine: RenderEngine) -> None:
    """Give the memory of unused arrays back to the system; Dr.Jit keeps it for new arrays of equal size."""
    if engine.backend == "scalar":
        return
    import drjit as dr

    gc.collect()
    dr.flush_malloc_cache()


def opaque(value: Any) -> Any:
    """Return a Dr.Jit value as data; as a literal, each change of it would compile the kernels again."""
    import drjit as dr

    dr.make_opaque(value)
    return value

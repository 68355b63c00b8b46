"""Sets the Mitsuba variant that `qsim.backend` chose, and keeps the few calls of Dr.Jit that all of rendering needs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from qsim.backend import Engine, choose, limit_threads


def select(prefer: str | None = None) -> Engine:
    """Choose (once per process) and activate an engine; `prefer` or QSIM_ENGINE insists on "cuda", "llvm" or "scalar".

    Raises ValueError when the wanted engine does not work here, with the reason and what to install.
    """
    engine = choose(prefer)
    activate(engine)
    return engine


def activate(engine: Engine) -> None:
    """Make this engine's variant the current one; cheap when it already is."""
    if engine.llvm_path:
        os.environ["DRJIT_LIBLLVM_PATH"] = engine.llvm_path
    import mitsuba as mi

    if mi.variant() != engine.variant:
        mi.set_variant(engine.variant)
    limit_threads()


@contextmanager
def kernels_timed() -> Iterator[list[float]]:
    """How long compiled kernels run inside the block, one number [s] for each; the list is filled at its end.

    Empty for the scalar engine, which launches none.
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
    """Mitsuba's log inside the block without warnings that say nothing here; the caller says which."""
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(level)


def opaque(value: Any) -> Any:
    """A Dr.Jit value as data: were it code, every kernel would be compiled anew whenever it changes."""
    import drjit as dr

    dr.make_opaque(value)
    return value

"""Keeps what the host program has set in torch and NumPy out of the numbers of this one, and leaves it as it is.

    @own_numbers        inside, float32 is what has no other type, autocast is off, and NumPy's errors are its
                        defaults, in this thread alone

A default type is of the whole process: to set it and give it back would change it for the host's other threads. So the
functions that would ask for it are told float32 instead. This costs nothing where the host has set nothing.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, ParamSpec, TypeVar

import numpy as np

from qsim import host
from quiver.device import DEVICES

Given = ParamSpec("Given")
Found = TypeVar("Found")


def own_numbers(function: Callable[Given, Found]) -> Callable[Given, Found]:
    """Let a function compute as in a program that has set nothing in torch and NumPy."""

    @functools.wraps(function)
    def computed(*args: Given.args, **kwargs: Given.kwargs) -> Found:
        with numbers():
            return function(*args, **kwargs)

    return computed


@contextmanager
def numbers() -> Iterator[None]:
    """Compute in the block as in a program that has set nothing in torch and NumPy."""
    import torch

    with ExitStack() as stack:
        stack.enter_context(host.numbers())
        for device in DEVICES[1:]:
            if torch.is_autocast_enabled(device):
                stack.enter_context(torch.autocast(device, enabled=False))
        if torch.get_default_dtype() is not torch.float32:
            stack.enter_context(_mode()())
        yield


@contextmanager
def flushed_denormals() -> Iterator[None]:
    """Make denormal numbers zero in this thread in the block, and give back what the host had."""
    import torch

    before = _is_flushed()
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)


def _is_flushed() -> bool:
    """Return whether the processor makes denormal numbers zero in this thread."""
    return bool(np.float64(5e-324) * np.float64(1.0) == 0.0)


@functools.cache
def _mode() -> Callable[[], Any]:
    """Return the mode in which functions take float32 for the default type."""
    import torch
    from torch.overrides import TorchFunctionMode

    always = {torch.zeros, torch.ones, torch.empty, torch.rand, torch.randn, torch.linspace, torch.eye}
    by_numbers = {torch.full, torch.arange, torch.tensor, torch.as_tensor}
    chosen = {torch.where, torch.Tensor.where}

    class Float32(TorchFunctionMode):
        """Tells functions that make tensors float32, and turns what others made of whole numbers into it."""

        def __torch_function__(
            self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
        ) -> Any:
            kwargs = dict(kwargs or {})
            if kwargs.get("dtype") is not None:
                return func(*args, **kwargs)
            if func in always or (func in by_numbers and _has_float([*args, *kwargs.values()])):
                return func(*args, **kwargs | {"dtype": torch.float32})
            if func in chosen:  # its condition is no number: only the numbers to choose from get a type
                return func(*map(_typed, args), **{name: _typed(value) for name, value in kwargs.items()})
            made = func(*args, **kwargs)
            default = torch.get_default_dtype()
            if not isinstance(made, torch.Tensor) or made.dtype is not default or not _of_whole_numbers(args, kwargs):
                return made
            floats = {name: _as_float(value) for name, value in kwargs.items()}
            return func(*map(_as_float, args), **floats)

    def _of_whole_numbers(args: tuple[Any, ...], kwargs: dict[str, Any]) -> bool:
        """Return whether tensors are among the arguments, and all hold whole numbers."""
        tensors = [value for value in (*args, *kwargs.values()) if isinstance(value, torch.Tensor)]
        return bool(tensors) and not any(one.is_floating_point() or one.is_complex() for one in tensors)

    def _as_float(value: Any) -> Any:
        return value.to(torch.float32) if isinstance(value, torch.Tensor) else value

    def _typed(value: Any) -> Any:
        """Return a Python float as a tensor of no dimensions, which gives way to the type of any tensor beside it."""
        return torch.tensor(value, dtype=torch.float32) if isinstance(value, float) else value

    return Float32


def _has_float(values: Any) -> bool:
    """Return whether a Python float is among numbers, in lists at any depth."""
    return any(isinstance(one, float) or (isinstance(one, list | tuple) and _has_float(one)) for one in values)

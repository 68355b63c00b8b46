"""Compiles a network for its training steps with `torch.compile`.

    kernels  neighbouring operations become one kernel
    graphs   launches are recorded once and replayed: CUDA graphs, for networks of many small kernels

Weights are shared with the network as it is, by which validations and files go.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import nn

BACKENDS = {"kernels": "inductor", "graphs": "cudagraphs"}  # of torch.compile


class Compiled:
    """A network that torch compiles when it is called; its other methods run as they are."""

    def __init__(self, network: nn.Module, kind: str) -> None:
        """`kind` is a key of BACKENDS."""
        self.network = network
        self.kind = kind
        self.form: Callable[..., Any] = torch.compile(network, backend=BACKENDS[kind])
        self.called = False

    def __call__(self, *given: Any, **named: Any) -> Any:
        """Return what the network returns."""
        self.called = True
        if self.kind == "graphs":
            torch.compiler.cudagraph_mark_step_begin()  # the outputs of the step before are no longer used
        return self.form(*given, **named)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the network."""
        return getattr(self.network, name)


def why_not(error: Exception | None) -> str:
    """Return the line that says that a network is not compiled, and why; None: its loss calls parts of it."""
    if error is None:
        return "the loss of this network calls its parts one by one, so it is not compiled"
    reason = next(iter(str(error).strip().splitlines()), "") or type(error).__name__
    return f"torch.compile does not work here, so the network is not compiled: {reason[:200]}"

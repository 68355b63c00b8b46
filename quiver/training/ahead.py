"""Lets a host run ahead of its GPU: the numbers of a step are read later, and its state can be brought back.

    step s: weights, optimiser, random states -> Copy; loss, norm -> host      step s + n: read; not finite: the copy

A host that asked for a loss at every step would wait until the GPU is idle, and the GPU then for its next kernels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from quiver.device import Reading, random_states, set_random_states
from quiver.training.optimiser import Optimiser
from quiver.training.schedule import State


class Copy:
    """The state of a run before a step; its memory serves for one step after another."""

    def __init__(self) -> None:
        self.memory: list[Tensor] = []
        self.content: dict[str, Any] = {}
        self.random: tuple[Tensor, list[Tensor]] = torch.get_rng_state(), []

    @torch.no_grad()
    def take(self, model: nn.Module, optimiser: Optimiser) -> Copy:
        """Copy all that the next step changes, on the device, and return this copy."""
        content = {"model": model.state_dict(), "optimiser": optimiser.state_dict()}
        tensors = list(_tensors(content))
        if [tensor.shape for tensor in tensors] != [tensor.shape for tensor in self.memory]:  # before the first step
            self.memory = [torch.empty_like(tensor) for tensor in tensors]
        # Tensors of one device are copied by a few launches; Adam counts its steps on the host.
        for device in {tensor.device for tensor in tensors}:
            pairs = [pair for pair in zip(self.memory, tensors, strict=True) if pair[1].device == device]
            torch._foreach_copy_([memory for memory, _ in pairs], [tensor for _, tensor in pairs])
        self.content = _with(content, iter(self.memory))
        self.random = torch.get_rng_state(), random_states()
        return self

    def restore(self, model: nn.Module, optimiser: Optimiser) -> None:
        """Bring the copied state back."""
        model.load_state_dict(self.content["model"])
        optimiser.load_state_dict(self.content["optimiser"])
        torch.set_rng_state(self.random[0])
        set_random_states(self.random[1])
        self.memory = []  # the optimiser may have taken it over


@dataclass
class Pending:
    """A step whose numbers were not read yet."""

    state: State  # before it
    rate: float
    samples: list[int]
    keys: list[str]
    numbers: Reading  # its loss and the norm of its gradient
    before: Copy | None  # None: nothing was changed since


def _tensors(tree: Any) -> Iterator[Tensor]:
    """Yield the tensors in nested dictionaries and lists."""
    if isinstance(tree, Tensor):
        yield tree
    elif isinstance(tree, dict | list):
        for value in tree.values() if isinstance(tree, dict) else tree:
            yield from _tensors(value)


def _with(tree: Any, tensors: Iterator[Tensor]) -> Any:
    """Return nested dictionaries and lists with other tensors, in the order of `_tensors`."""
    if isinstance(tree, Tensor):
        return next(tensors)
    if isinstance(tree, dict):
        return {name: _with(value, tensors) for name, value in tree.items()}
    return [_with(value, tensors) for value in tree] if isinstance(tree, list) else tree

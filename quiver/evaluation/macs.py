"""Counts the multiply-accumulates of networks, per pixel and frame: the measure of cost in tables at equal cost.

Counted are convolutions, linear layers and matrix products, as torch counts them; sampling and arithmetic on single
pixels are not. The count of a design is that of one more frame of a long clip. What restoring a stream in parts adds,
the frames around each part, depends on the program (quiver/restoration/pieces.py); `quiver bench` counts it.
"""

from functools import cache
from typing import Any

import torch
from torch import nn
from torch._ops import OpOverload
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from quiver.model.mergenet import MergeNet
from quiver.model.presets import made
from quiver.model.rivals.bit2bit import Bit2BitConfig

FRAMES = (12, 22)  # of two clips; networks repeat themselves after 10 frames at most
LONG = (32, 64)  # of bit2bit, which restores pieces of 32 frames
SIDE = 128  # px, of the clips; twice that for a network that would extend them


class MacCounter(TorchDispatchMode):
    """Counts what is run inside by torch's own rules, as torch's `FlopCounterMode` does, but of no single module.

    That follows every module, and asks of each operation again what it is made of: it takes twice the time.
    """

    def __init__(self) -> None:
        super().__init__()
        self.total = 0  # multiply-accumulates

    def __torch_dispatch__(self, func: OpOverload, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run an operation, or what it is made of, and count it."""
        named = kwargs or {}
        rule = flop_registry.get(func.overloadpacket)
        if rule is None and _composed(func):
            with self:
                return func.decompose(*args, **named)
        result = func(*args, **named)
        if rule is not None:
            self.total += rule(*args, **named, out_val=result) // 2
        return result


@cache
def _composed(func: OpOverload) -> bool:
    """Whether torch runs an operation as several others; those that ask for a device are unknown to it."""
    name = func.name()
    if not torch._C._dispatch_has_kernel(name):
        return False
    return torch._C._dispatch_has_kernel_for_dispatch_key(name, "CompositeImplicitAutograd")


def design_macs(config: Any) -> float:
    """Return those of the network of a configuration, per pixel of one more frame of a long clip of SIDE x SIDE px.

    Nothing is computed: tensors have a shape and no values.
    """
    with FakeTensorMode():
        return macs_per_pixel(made(config).eval(), LONG if isinstance(config, Bit2BitConfig) else FRAMES)


def macs(network: nn.Module, frames: int, height: int, width: int) -> int:
    """Return the multiply-accumulates with which a network restores a black clip [1, frames, 1, height, width].

    MergeNet gets as many merged frames.
    """
    merged = (frames, network.config.inputs, height, width) if isinstance(network, MergeNet) else None
    with torch.no_grad(), MacCounter() as counter:
        network(torch.zeros(merged or (1, frames, 1, height, width)))
    return counter.total


def macs_per_pixel(network: nn.Module, frames: tuple[int, int] = FRAMES, side: int = SIDE) -> float:
    """Return the multiply-accumulates per pixel of one more frame of a clip of side x side px.

    The difference of two clips, of so many `frames`, leaves out what the ends of a clip cost. For a network that
    extends such frames to its least size, the side is doubled until it does not.
    """
    while getattr(network, "least", 1) > side:
        side *= 2
    short, long = (macs(network, count, side, side) for count in frames)
    return (long - short) / ((frames[1] - frames[0]) * side**2)

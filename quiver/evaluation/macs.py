"""Counts the multiply-accumulates of networks, per pixel and frame: the measure of cost in tables at equal cost.

Counted are convolutions, linear layers and matrix products, as torch counts them; sampling and arithmetic on single
pixels are not. The count of a design is that of one more frame of a long clip. What restoring a stream in parts adds,
the frames around each part, depends on the program (quiver/restoration/parts.py); `quiver bench` counts it.
"""

from typing import Any

import torch
from torch import nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils.flop_counter import FlopCounterMode

from quiver.model.mergenet import MergeNet
from quiver.model.presets import made
from quiver.model.rivals.bit2bit import Bit2BitConfig

FRAMES = (12, 22)  # of two clips; networks repeat themselves after 10 frames at most
LONG = (32, 64)  # of bit2bit, which restores pieces of 32 frames
SIDE = 128  # px, of the clips; twice that for a network that would extend them


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
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        network(torch.zeros(merged or (1, frames, 1, height, width)))
    return int(counter.get_total_flops()) // 2


def macs_per_pixel(network: nn.Module, frames: tuple[int, int] = FRAMES, side: int = SIDE) -> float:
    """Return the multiply-accumulates per pixel of one more frame of a clip of side x side px.

    The difference of two clips, of so many `frames`, leaves out what the ends of a clip cost. For a network that
    extends such frames to its least size, the side is doubled until it does not.
    """
    while getattr(network, "least", 1) > side:
        side *= 2
    short, long = (macs(network, count, side, side) for count in frames)
    return (long - short) / ((frames[1] - frames[0]) * side**2)

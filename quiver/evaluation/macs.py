"""Counts the multiply-accumulates of networks, per pixel and frame: the measure of cost in tables at equal cost.

Counted are convolutions, linear layers and matrix products, as torch counts them; sampling and arithmetic on single
pixels are not.
"""

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

FRAMES = (32, 64)  # of two clips; bit2bit restores pieces of 32 frames, others repeat themselves after 10 at most
SIDE = 64  # px


def macs(network: nn.Module, frames: int, height: int, width: int) -> int:
    """Return the multiply-accumulates with which a network restores a black clip [1, frames, 1, height, width]."""
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        network(torch.zeros(1, frames, 1, height, width))
    return int(counter.get_total_flops()) // 2


def macs_per_pixel(network: nn.Module, frames: tuple[int, int] = FRAMES, side: int = SIDE) -> float:
    """Return the multiply-accumulates per pixel of one more frame of a clip of side x side px.

    The difference of two clips, of so many `frames`, leaves out what the ends of a clip cost.
    """
    short, long = (macs(network, count, side, side) for count in frames)
    return (long - short) / ((frames[1] - frames[0]) * side**2)

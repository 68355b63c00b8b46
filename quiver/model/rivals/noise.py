"""Computes noise maps: the variance or deviation of codes at their mean, from the table of their sensor.

A table holds the variance of codes/(2^b - 1) at equal steps of their mean from 0 to 1. Training and restoration make it
from the exact law of the sensor (quiver/data/noise_table.py) and give one to each clip.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from qsim.checks import shown
from quiver.model.config import real_number

# For a network called without a table: a QIS of three bits with quantum efficiency 0.8, read noise 0.2 e- and gain
# 1.077, to 0.9 % of the largest. White hardly fluctuates, as it is clipped.
VARIANCE = (
    0.0002,
    0.0107,
    0.0217,
    0.033,
    0.0443,
    0.0549,
    0.064,
    0.0707,
    0.0742,
    0.0737,
    0.0687,
    0.0588,
    0.0437,
    0.0235,
    0.0,
)
LEAST_VARIANCE = 1e-12  # keeps the slope of the deviation finite; a code of 16 bits rounds with 2e-11
BOX = 5  # px, side of the square whose mean stands for the mean of a pixel


def numbers(name: str, values: object, least: int, most: int) -> tuple[float, ...]:
    """Return `least` to `most` numbers from 0 to 1000 as a tuple; ValueError for anything else."""
    if not isinstance(values, list | tuple) or not least <= len(values) <= most:
        raise ValueError(f"{name} must be {least} to {most} numbers, got {shown(values)}")
    for value in values:
        real_number(name, value, 0, 1e3)
    return tuple(values)


def table_of(variance: Tensor | None, frames: Tensor) -> Tensor:
    """Return the table of each clip [B, n] for frames [B, ...]: `variance` [n] or [B, n], or VARIANCE for None.

    ValueError for a tensor of another shape.
    """
    table = torch.tensor(VARIANCE) if variance is None else variance
    if table.ndim not in (1, 2) or table.shape[-1] < 2 or (table.ndim == 2 and len(table) not in (1, len(frames))):
        raise ValueError(
            f"variance must be a table [n] or one for each of {len(frames)} clips [{len(frames)}, n], n >= 2, got "
            f"{tuple(table.shape)}; make it by noise_table"
        )
    return table.to(frames.device, torch.promote_types(frames.dtype, torch.float32)).expand(len(frames), -1)


def variance_at(mean: Tensor, table: Tensor) -> Tensor:
    """Return the variance at means [B, ...], clipped to 0 ... 1, from tables [B, n]; at the precision of the tables."""
    place = mean.to(table.dtype).clamp(0, 1) * (table.shape[1] - 1)
    below = place.detach().long().clamp(max=table.shape[1] - 2)
    low, high = (table.gather(1, (below + step).flatten(1)).view_as(below) for step in (0, 1))
    return torch.lerp(low, high, place - below)


def deviation_map(frames: Tensor, table: Tensor) -> Tensor:
    """Return the deviation of each pixel of codes/(2^b - 1), [B, T, 1, H, W] with tables [B, n] -> the same shape.

    The mean of 5 x 5 pixels stands for that of the pixel; beyond the edges there are no pixels.
    """
    mean = F.avg_pool2d(frames.flatten(0, 1), BOX, 1, BOX // 2, count_include_pad=False).view_as(frames)
    return variance_at(mean, table).clamp(min=LEAST_VARIANCE).sqrt().to(frames.dtype)

"""Computes noise maps: the variance or deviation of codes at their mean, from a table of the sensor."""

import torch
import torch.nn.functional as F
from torch import Tensor

from qsim.checks import shown
from quiver.model.config import real_number

# Variance of codes/7 at mean codes/7 of 0, 1/14 ... 1: a QIS of three bits with quantum efficiency 0.8, read noise
# 0.2 e- and gain 1.077, exact to 0.9 % of the largest. White hardly fluctuates, as it is clipped.
VARIANCE = (0.0002, 0.0107, 0.0217, 0.033, 0.0443, 0.0549, 0.064, 0.0707, 0.0742, 0.0737, 0.0687, 0.0588, 0.0437,
            0.0235, 0.0)  # fmt: skip
LEAST_VARIANCE = 1e-6  # keeps the slope of the deviation finite
BOX = 5  # px, side of the square whose mean stands for the mean of a pixel


def numbers(name: str, values: object, least: int, most: int) -> tuple[float, ...]:
    """Return `least` to `most` numbers from 0 to 1000 as a tuple; ValueError for anything else."""
    if not isinstance(values, list | tuple) or not least <= len(values) <= most:
        raise ValueError(f"{name} must be {least} to {most} numbers, got {shown(values)}")
    for value in values:
        real_number(name, value, 0, 1e3)
    return tuple(values)


def variance_table(name: str, values: object) -> tuple[float, ...]:
    """Return a table of variances, at equal steps of the mean from 0 to 1; ValueError unless it is one."""
    return numbers(name, values, 2, 4096)


def variance_at(mean: Tensor, table: Tensor) -> Tensor:
    """Return the variance at means [...], clipped to 0 ... 1, from its values [n] at equal steps of the mean."""
    place = mean.clamp(0, 1) * (len(table) - 1)
    below = place.detach().long().clamp(max=len(table) - 2)
    return torch.lerp(table[below], table[below + 1], place - below)


def deviation_map(frames: Tensor, table: Tensor) -> Tensor:
    """Return the deviation of each pixel of codes/(2^b - 1), [B, T, 1, H, W] -> the same shape.

    The mean of 5 x 5 pixels stands for that of the pixel; beyond the edges there are no pixels.
    """
    mean = F.avg_pool2d(frames.flatten(0, 1), BOX, 1, BOX // 2, count_include_pad=False).view_as(frames)
    return variance_at(mean, table.to(mean.dtype)).clamp(min=LEAST_VARIANCE).sqrt()

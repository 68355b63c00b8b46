"""Tells light that changes from things that move: the factor of a frame is the median over squares of the picture.

    codes [T, H, W] -> the change of light within the frames of a restorer's window, over its mean

Light that changes brightens all squares alike. Things that move brighten some and darken others, so that the median
stays; the mean of the picture does not: it changes by up to 23 % within eleven frames of scenes in constant light.
"""

from __future__ import annotations

import numpy as np
from numpy import ndarray as Array

from quiver.data.codes import Codes

FRAMES = 11  # in the middle of the stream
SIDE = 16  # px of a square, less where the picture is small
FEWEST = 9  # squares, below which the answer is 0
CERTAIN = 6.0  # standard errors that a change exceeds: motion makes neighbouring squares alike
MEDIAN = 1.2533  # standard error of a median over that of a mean, of normal numbers
DEVIATION = 1.4826  # standard deviation over the median distance from the median, of normal numbers


def light_change(codes: Codes) -> float:
    """Return the least change of light, largest minus smallest over the mean, that noise and motion do not explain.

    0 for constant light, and where the codes do not tell: few squares, darkness, saturation, different exposures.
    """
    length, height, width = codes.shape
    side = max(4, min(SIDE, height // 6, width // 6))
    rows, columns = height // side, width // side
    if rows * columns < 2 * FEWEST or length < 2 or codes.shares is not None:
        return 0.0
    first = max(0, (length - FRAMES) // 2)
    frames = codes.read(first, min(length, first + FRAMES))[:, : rows * side, : columns * side]
    means = frames.reshape(len(frames), rows, side, columns, side).mean(axis=(2, 4)).reshape(len(frames), -1)
    try:
        light = codes.sensor.response(codes.exposure).invert(means, side * side)
    except ValueError:
        return 0.0
    return _change(np.asarray(light, float))


def _change(light: Array) -> float:
    """Return the change of the light [T, squares], from the brighter half of the squares."""
    mean = light.mean(axis=0)
    bright = light[:, (mean >= np.median(mean)) & (mean > 0)]
    if bright.shape[1] < FEWEST:
        return 0.0
    ratios = bright / bright.mean(axis=0)
    factors = np.median(ratios, axis=1)
    spread = DEVIATION * np.median(np.abs(ratios - factors[:, None]), axis=1)
    errors = MEDIAN * spread / np.sqrt(bright.shape[1])
    low, high = int(factors.argmin()), int(factors.argmax())
    return float(max(0.0, factors[high] - factors[low] - CERTAIN * np.hypot(errors[low], errors[high])))

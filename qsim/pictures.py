"""Numbers -> pictures for people: one tone curve; flow, depth and bodies as colour. Nothing computes on these.

All take stacks or single frames [..., H, W] and return uint8 [..., H, W] or [..., H, W, 3].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

GAMMA = 2.2  # the one tone curve of every picture


def tone(linear: NDArray[np.floating], peak: float) -> NDArray[np.uint8]:
    """Linear light -> 8-bit grey: 255 (v / peak)^(1/2.2), clipped to 0 ... peak and rounded; NaN is shown black."""
    if not peak > 0:
        raise ValueError(f"tone: the peak must be positive, got {peak!r}")
    scaled = np.clip(np.nan_to_num(np.asarray(linear, np.float64)) / peak, 0.0, 1.0)
    return np.rint(255.0 * scaled ** (1 / GAMMA)).astype(np.uint8)


def code_levels(codes: NDArray[np.integer], bits: int) -> NDArray[np.uint8]:
    """Codes 0 ... 2^bits - 1 as grey levels 0 ... 255, without any curve."""
    return np.rint(255.0 * codes / (2**bits - 1)).astype(np.uint8)


def flow_colours(flow: NDArray[np.floating], largest: float) -> NDArray[np.uint8]:
    """Flow [..., 2, H, W] in pixels as colour: hue is the direction (right red, down green), depth of colour the speed.

    White is no motion; `largest` [px] and above is the full colour; NaN (no flow known) is grey.
    """
    if not largest > 0:
        raise ValueError(f"flow_colours: the largest flow must be positive, got {largest!r} px")
    u, v = flow[..., 0, :, :], flow[..., 1, :, :]
    unknown = ~(np.isfinite(u) & np.isfinite(v))
    u, v = np.where(unknown, 0.0, u), np.where(unknown, 0.0, v)
    speed = np.minimum(np.hypot(u, v) / largest, 1.0)
    rgb = hue(np.arctan2(v, u) / (2 * np.pi))
    rgb = 1.0 - speed[..., None] * (1.0 - rgb)
    rgb[unknown] = 0.5
    return np.rint(255.0 * rgb).astype(np.uint8)


def hue(turns: NDArray[np.floating]) -> NDArray[np.float64]:
    """Fully saturated colours around the circle, one turn from red over green and blue to red: [...] -> [..., 3]."""
    position = np.mod(turns, 1.0)[..., None] * 6.0 + np.array([0.0, 4.0, 2.0])
    return np.clip(np.abs(np.mod(position, 6.0) - 3.0) - 1.0, 0.0, 1.0)


def flow_legend(size: int = 96) -> NDArray[np.uint8]:
    """The colour wheel of `flow_colours` [size, size, 3]: the rim is the largest flow."""
    y, x = np.mgrid[0:size, 0:size] * (2.0 / (size - 1)) - 1.0
    inside = np.hypot(x, y) <= 1.0
    wheel = flow_colours(np.stack([x, y]), 1.0)
    wheel[~inside] = 255
    return wheel


def depth_levels(depth: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Depth as grey: near is bright; 1/depth between its 1st and 99th percentile; nothing hit is black."""
    with np.errstate(divide="ignore"):
        nearness = np.where(np.isfinite(depth) & (depth > 0), 1.0 / depth, np.nan)
    if not np.isfinite(nearness).any():
        return np.zeros(depth.shape, np.uint8)
    low, high = np.nanpercentile(nearness, [1, 99])
    grey = 40 + 215 * (nearness - low) / max(high - low, 1e-12)
    return np.where(np.isfinite(nearness), np.clip(np.nan_to_num(grey), 0, 255), 0).astype(np.uint8)

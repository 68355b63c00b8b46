"""Computes transfer curves, luminance, peak and PSNR, and pictures of arrays: one tone curve, false colours.

Pictures are made of frames [..., H, W] and are uint8 [..., H, W] or [..., H, W, 3].
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qsim.arrays import plain

TRANSFERS = ("linear", "srgb", "gamma 2.2")
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear red, green and blue: ITU-R BT.709
GAMMA = 2.2  # of the tone curve of every picture
AVERAGE = 11  # frames of a naive mean, the window of QUIVER


def to_linear(values: NDArray[Any], transfer: str, top: float) -> NDArray[Any]:
    """Return linear light, float32 in 0..1, of coded values 0 ... top (IEC 61966-2-1 for srgb)."""
    coded = plain(values, np.float32) / np.float32(top)
    if transfer == "linear":
        return coded
    if transfer == "gamma 2.2":
        return coded**2.2
    if transfer == "srgb":
        return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4).astype(np.float32)
    raise ValueError(f"transfer {transfer!r}: known are {', '.join(TRANSFERS)}")


def from_linear(light: NDArray[Any], transfer: str, top: int) -> NDArray[Any]:
    """Return coded values 0 ... top, rounded, of linear light in 0..1 (clipped): the inverse of `to_linear`."""
    light = np.clip(plain(light, np.float64), 0, 1)
    if transfer == "linear":
        coded = light
    elif transfer == "gamma 2.2":
        coded = light ** (1 / 2.2)
    elif transfer == "srgb":
        coded = np.where(light <= 0.04045 / 12.92, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
    else:
        raise ValueError(f"transfer {transfer!r}: known are {', '.join(TRANSFERS)}")
    return np.rint(coded * top).astype(np.uint8 if top < 256 else np.uint16)


def luminance(rgb: NDArray[Any]) -> NDArray[Any]:
    """Return the Rec. 709 luminance [...] of linear colours [..., 3], in the precision of the input."""
    return rgb @ LUMINANCE.astype(rgb.dtype if rgb.dtype.kind == "f" else np.float64)


def peak(image: NDArray[np.floating]) -> float:
    """Return the peak of an array of any shape: the 99.9th percentile of its finite values; 1 if that is 0.

    The caller's docstring states of what: a frame, some frames of a clip, a reference.
    """
    value = bright_end(image)
    return value if value > 0 else 1.0


def bright_end(image: NDArray[np.floating]) -> float:
    """Return the 99.9th percentile of the finite values of an array of any shape, in their unit; 0 if none is."""
    finite = image[np.isfinite(image)]
    return float(np.percentile(finite, 99.9)) if finite.size else 0.0


def psnr(peak: float, rms: float) -> float:
    """Return the PSNR [dB] of an rms error below a peak of the same unit: inf for no error, -inf for no peak."""
    if rms <= 0:
        return math.inf
    return 20 * math.log10(peak / rms) if peak > 0 else -math.inf


def tone(linear: NDArray[np.floating], peak: float) -> NDArray[np.uint8]:
    """Return linear light as 8-bit grey: 255 (v / peak)^(1/2.2), clipped to 0 ... peak and rounded; NaN is black."""
    if not peak > 0:
        raise ValueError(f"tone: the peak must be positive, got {peak!r}")
    scaled = np.clip(np.nan_to_num(plain(linear, np.float64)) / peak, 0.0, 1.0)
    return np.rint(255.0 * scaled ** (1 / GAMMA)).astype(np.uint8)


def tone_picture(linear: NDArray[np.floating], peak: float, *, colours: bool) -> NDArray[np.uint8]:
    """Return `tone` of grey light [..., H, W], or of bands [..., 3, H, W] as red, green and blue [..., H, W, 3]."""
    levels = tone(linear, peak)
    return np.moveaxis(levels, -3, -1) if colours else levels


def code_levels(codes: NDArray[np.integer], top: int) -> NDArray[np.uint8]:
    """Return codes 0 ... `top` as grey levels 0 ... 255, linearly."""
    return np.rint(255.0 * codes / top).astype(np.uint8)


def flow_colours(flow: NDArray[np.floating], largest: float) -> NDArray[np.uint8]:
    """Return flow [..., 2, H, W] [px] as colour: the hue is the direction (right red, down green).

    The saturation is the speed: white is no motion, `largest` [px] and above is the full colour. NaN is grey.
    """
    if not largest > 0:
        raise ValueError(f"flow_colours: the largest flow must be positive, got {largest!r} px")
    u = flow[..., 0, :, :]
    v = flow[..., 1, :, :]
    unknown = ~(np.isfinite(u) & np.isfinite(v))
    u = np.where(unknown, 0.0, u)
    v = np.where(unknown, 0.0, v)
    speed = np.minimum(np.hypot(u, v) / largest, 1.0)
    rgb = hue_from_turns(np.arctan2(v, u) / (2 * np.pi))
    rgb = 1.0 - speed[..., None] * (1.0 - rgb)
    rgb[unknown] = 0.5
    return np.rint(255.0 * rgb).astype(np.uint8)


def hue_from_turns(turns: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return saturated colours [..., 3] of turns [...]; one turn goes from red over green and blue to red."""
    position = np.mod(turns, 1.0)[..., None] * 6.0 + np.array([0.0, 4.0, 2.0])
    return np.clip(np.abs(np.mod(position, 6.0) - 3.0) - 1.0, 0.0, 1.0)


def error_colours(error: NDArray[np.floating], full: float) -> NDArray[np.uint8]:
    """Return errors [..., H, W] as colour [..., H, W, 3]: white is none, red above, blue below.

    Errors of `full` and above, in the same unit, have the full colour; NaN is grey.
    """
    if not full > 0:
        raise ValueError(f"error_colours: the error of the full colour must be positive, got {full!r}")
    share = np.clip(np.nan_to_num(error) / full, -1.0, 1.0)
    above = np.maximum(share, 0.0)
    below = np.maximum(-share, 0.0)
    rgb = 1.0 - np.stack([below, np.abs(share), above], axis=-1) * np.array([0.85, 0.8, 0.85])
    rgb[np.isnan(error)] = 0.5
    return np.rint(255.0 * rgb).astype(np.uint8)


def flow_legend(size: int = 96) -> NDArray[np.uint8]:
    """Return the colour wheel of `flow_colours` [size, size, 3]; the rim is the largest flow."""
    y, x = np.mgrid[0:size, 0:size] * (2.0 / (size - 1)) - 1.0
    inside = np.hypot(x, y) <= 1.0
    wheel = flow_colours(np.stack([x, y]), 1.0)
    wheel[~inside] = 255
    return wheel


# Far to near, of rising lightness so that the order survives in grey: (share, red, green, blue).
_DEPTH_RAMP = np.array(
    [(0.0, 24, 22, 66), (0.25, 74, 40, 130), (0.5, 182, 54, 121), (0.75, 246, 122, 88), (1.0, 252, 246, 190)]
)


def depth_range(depth: NDArray[np.floating]) -> tuple[float, float]:
    """Return (near, far) [m]: the 1st and 99th percentile of finite depths; (1, 1) if there are none."""
    hit = depth[np.isfinite(depth) & (depth > 0)]
    if hit.size == 0:
        return 1.0, 1.0
    near, far = np.percentile(hit, [1, 99])
    return float(near), float(far)


def depth_colours(depth: NDArray[np.floating], near: float, far: float) -> NDArray[np.uint8]:
    """Return depth [..., H, W] [m] as colour [..., H, W, 3], linear in 1/depth: near is yellow, far is dark blue.

    Pixels without a hit (infinite, zero, NaN) are black.
    """
    if not 0 < near <= far < np.inf:
        raise ValueError(f"depth_colours: expected 0 < near <= far in metres, got {near!r} and {far!r}")
    hit = np.isfinite(depth) & (depth > 0)
    nearness = 1.0 / np.where(hit, depth, far)
    low = 1.0 / far
    high = 1.0 / near
    share = np.clip((nearness - low) / (high - low) if high > low else np.ones_like(nearness), 0.0, 1.0)
    rgb = np.stack([np.interp(share, _DEPTH_RAMP[:, 0], _DEPTH_RAMP[:, i]) for i in (1, 2, 3)], axis=-1)
    rgb[~hit] = 0
    return np.rint(rgb).astype(np.uint8)


def depth_legend(height: int = 12, width: int = 96) -> NDArray[np.uint8]:
    """Return the bar of `depth_colours` [height, width, 3], linear in 1/depth; near is left, far is right."""
    nearness = np.linspace(1.0, 0.5, width)
    return np.tile(depth_colours(1.0 / nearness, 1.0, 2.0), (height, 1, 1))

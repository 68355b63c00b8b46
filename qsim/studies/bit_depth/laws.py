"""Computes the laws of bit depth against motion for a sensor that reads M = 2^b - 1 planes as one b-bit frame.

    planes at `base_fps` -> frames of b bits at base_fps / (2^b - 1), all with the same exposure per second

More bits per frame mean fewer reads (less read noise, fewer bytes) and longer exposures (more motion blur).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy import ndarray as Array


@dataclass(frozen=True)
class Depth:
    """One bit depth at equal exposure."""

    bits: int
    fps: float  # frames of 2^bits - 1 planes per second
    motion_px_per_frame: float  # image speed / fps
    read_noise_per_second: float  # e-/s: read noise times fps, the linear sum that the QUIVER paper prints
    read_noise_quadrature: float  # e- after one second: independent reads add in squares, read noise times sqrt(fps)
    data_rate_megabytes_per_second: float  # 10^6 bytes, height x width x bits x fps / 8

    @property
    def planes(self) -> int:
        """The number of binary planes in one frame."""
        return 2**self.bits - 1


def depths(
    *, height: int, width: int, base_fps: float, read_noise: float, bits: Sequence[int], speed: float
) -> list[Depth]:
    """Return the table of the QUIVER paper (ECCV 2024, Table 1) for any sensor.

    `speed` is that of the image [px/s], `read_noise` in e- per read. The paper rounds its frame rates to 1428, 323, 78
    and 20 before it computes the other columns. Here they are exact (1428.57, 322.58, 78.74, 19.57).
    """
    for name, value in {"height": height, "width": width, "base_fps": base_fps}.items():
        if not value > 0:
            raise ValueError(f"tradeoff: {name} must be positive, got {value!r}")
    for name, value in {"read_noise": read_noise, "speed": speed}.items():
        if not value >= 0:
            raise ValueError(f"tradeoff: {name} must not be negative, got {value!r}")
    for b in bits:
        if not 1 <= b <= 16:
            raise ValueError(f"tradeoff: bits must be 1 ... 16, got {b!r}")
    rows = []
    for b in bits:
        fps = base_fps / (2**b - 1)
        rate = height * width * b * fps / 8e6
        rows.append(Depth(b, fps, speed / fps, read_noise * fps, read_noise * sqrt(fps), rate))
    return rows


@dataclass(frozen=True, eq=False)
class Structure:
    """The structure function of the light: D(k) = mean of (light(t + k) - light(t))^2, k = 0, 1, ... planes.

    If the statistics of the scene do not change with time, the blur follows exactly. For M planes of weight 1/M around
    an instant (M odd)

        mean (exposed - sharp)^2 = 1/M sum_s D(|s|) - 1/M^2 sum_(k < M) (M - k) D(k),   s = -(M-1)/2 ... (M-1)/2

    (expand both squares in the covariance C and set C = C(0) - D/2). A scene moving v times as fast has D(v k).
    Noise of the rendering is the same on both sides.
    """

    values: Array  # [K], photons^2, values[0] = 0

    def at(self, lags: Array) -> Array:
        """Return D at lags of any shape [planes]: interpolated over squared lags, constant after the last."""
        known = np.arange(len(self.values), dtype=float)
        # D(k) grows as k^2 at short lags, where motion is linear: straight over k^2.
        return np.interp(np.asarray(lags, float) ** 2, known**2, self.values)

    def blur(self, planes: int, speed: float = 1.0) -> float:
        """Return the mean square error [photons^2] of a frame against its sharp middle, at `speed` times the motion."""
        k = np.arange(1, planes)
        s = np.arange(planes) - planes // 2
        # The formula of the class; lags within the frame, each k seen M - k times.
        within = float(np.sum((planes - k) * self.at(speed * k))) / planes**2
        return max(float(np.mean(self.at(speed * np.abs(s)))) - within, 0.0)

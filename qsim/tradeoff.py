"""Bit depth against motion: what a sensor that may read M = 2^b - 1 planes as one b-bit frame gains and pays.

    planes at `base_fps` -> frames of b bits at base_fps / (2^b - 1), all with the same exposure per second

More bits per frame mean fewer reads (less read noise, fewer bytes) and longer exposures (more motion blur).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt


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
        """Binary planes that fit into one frame."""
        return 2**self.bits - 1


def depths(
    *, height: int, width: int, base_fps: float, read_noise: float, bits: Sequence[int], speed: float
) -> list[Depth]:
    """The table of the QUIVER paper (ECCV 2024, Table 1) for any sensor.

    `speed` is that of the image in px/s, `read_noise` in e- per read. The paper rounds its frame rates to
    1428, 323, 78 and 20 before it forms the other columns; here they stay exact (1428.57, 322.58, 78.74, 19.57).
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

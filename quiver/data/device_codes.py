"""Draws codes on the device and gives them to torch without a copy through the host (DLPack)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from qsim.keys import Key
from qsim.sensor.sensor import Sensor
from quiver.device import wait


def codes_on_device(
    sensor: Sensor, photons: Any, exposure: float, *, key: Key, origin: tuple[int, int] = (0, 0)
) -> Tensor:
    """Return codes uint8 [T, H, W] where Dr.Jit draws: on the GPU that renders, or on the CPU with LLVM.

    They equal `sensor.sample` of the same float32 photons [T, H, W], a tensor or a NumPy array; a tensor on the GPU
    stays there. `exposure` is in seconds. `ValueError` as `Sensor.sample_on_device`.
    """
    if isinstance(photons, Tensor):
        photons = photons.detach().contiguous()
        wait(photons.device)  # Dr.Jit has another stream
    return torch.from_dlpack(sensor.sample_on_device(photons, exposure, key=key, origin=origin))

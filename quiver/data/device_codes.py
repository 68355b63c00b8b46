"""Draws codes on the device and gives them to torch without a copy through the host (DLPack)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from qsim.keys import Key
from qsim.sensor.row import Row
from qsim.sensor.rows import draw_rows
from qsim.sensor.sensor import Sensor
from quiver.device import follow, wait

_ALIGNED = 64  # bytes


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


def codes_of_rows(light: Tensor, rows: Sequence[Row], packed: bool = False) -> Tensor:
    """Return the codes uint8 [B, T, H, W] of a batch of windows, drawn in one launch where Dr.Jit draws.

    With `packed` those of binary sensors, packed by rows as `qsim.sensor.packing` packs them: [B, T, H, ceil(W / 8)].

    `light` [B, T, H, W] is float16, float32 or float64, on that device or on the host; `rows[b].scale` times it are the
    expected photons. The codes equal `rows[b].sensor.sample` of these photons, or `code_table.draw_codes` with
    `at_once`. The host does not wait, and nothing is compiled for other keys, exposures, light levels or sizes.
    Light is finite and not negative: nobody looks at it. `ValueError` as `draw_rows`.
    """
    if light.ndim != 4:
        raise ValueError(f"light has the shape [B, T, H, W], got {list(light.shape)}")
    shape = tuple(light.shape)
    given = light.detach().contiguous().reshape(-1)
    if given.data_ptr() % _ALIGNED:  # other memory needs another kernel
        given = given.clone()
    follow(given.device)
    drawn = torch.from_dlpack(draw_rows(given, (shape[0], shape[1], shape[2], shape[3]), rows, packed))
    codes = drawn.view(torch.uint8).reshape(*shape[:3], -1)
    return codes if packed or shape[3] == codes.shape[3] else codes[..., : shape[3]]

"""Finds the most likely light of every pixel on levels of light, on any device.

    codes [K, pixels] -> sum over codes of log P(code | level) [pixels, levels] -> largest -> parabola through three

It is within 1e-3 of the light of quiver/baselines/likelihood.py, which solves every outcome to its end. The levels and
the parabola are those of quiver/baselines/exposures.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as functional
from torch import Tensor

from qsim.sensor.sensor import Sensor
from quiver.baselines import exposures, few_codes
from quiver.baselines.batched.tables import Table, table

PIXEL_BYTES = 64  # that a pixel takes beside its likelihoods


@dataclass(frozen=True, eq=False)
class _Levels:
    """Logarithms of probabilities of one sensor, and the corrections of windows of so many codes."""

    light: Tensor  # float64 [G]
    log_pmf: Tensor  # float64 [levels, G]
    coarse: Tensor  # float32 [levels, G]
    of_sums: Tensor  # float64, photons of each sum of the codes, which dark windows have; the last is the most
    bias: Table | None  # of the most likely photons, over them; None where it is not taken off

    @property
    def pixel_bytes(self) -> int:
        """Bytes that a pixel takes."""
        return PIXEL_BYTES + 8 * len(self.light)


@lru_cache(maxsize=16)
def _levels(sensor: Sensor, exposure: float, count: int, device: torch.device) -> _Levels:
    """Return the tables for windows of `count` codes; `ValueError` where probabilities take too much memory."""
    whole = (1.0,)
    size = exposures.table_bytes(whole, sensor, exposure)
    if size > exposures.TABLE_BYTES:
        raise ValueError(
            f"likelihood: codes of {sensor.bits} bit need a table of {size / 1e6:.0f} MB on a GPU, and at most "
            f"{exposures.TABLE_BYTES / 1e6:.0f} MB are taken; use device=cpu, or the method moment"
        )
    times = ((1.0, count),)
    log_pmf = torch.from_numpy(np.ascontiguousarray(exposures.log_pmf(whole, sensor, exposure).T))
    bias = None if sensor.keeps_charge else table(*few_codes.second_order(sensor, exposure, times), device)
    return _Levels(
        torch.from_numpy(few_codes.levels(whole, sensor, exposure)).to(device),
        log_pmf.to(device),
        log_pmf.to(torch.float32).to(device),
        torch.tensor(few_codes.of_sums(sensor, exposure, times)).to(device),
        bias,
    )


def light_of_windows(codes: Tensor, sensor: Sensor, exposure: float, memory: float) -> Tensor:
    """Return photons [B, H, W], float32, of windows of codes [B, K, H, W], whole numbers.

    Pixels are computed together as far as about `memory` bytes hold them. `ValueError` as of `_levels`.
    """
    batch, count, height, width = codes.shape
    known = _levels(sensor, exposure, count, codes.device)
    flat = codes.movedim(1, -1).reshape(-1, count).to(torch.int32)
    step = max(1, int(min(memory, 1e15) // known.pixel_bytes))
    found = [_light(flat[start : start + step], known) for start in range(0, len(flat), step)]
    return torch.cat(found).view(batch, height, width)


def _light(codes: Tensor, known: _Levels) -> Tensor:
    """Return photons [N] of windows of codes [N, K]."""
    likelihood = functional.embedding_bag(codes, known.coarse, mode="sum")
    best = likelihood.argmax(1)
    inner = best.clamp(1, len(known.light) - 2)
    # Sums of many logarithms, whose differences bend the parabola: in float64.
    places = inner[:, None] + torch.arange(-1, 2, device=codes.device)
    flat = codes.long()[:, :, None] * len(known.light) + places[:, None]
    before, middle, after = known.log_pmf.flatten()[flat].sum(1).unbind(1)
    bend = before - 2 * middle + after
    shift = torch.where(bend < 0, (before - after) / (2 * torch.where(bend < 0, bend, -1.0)), 0.0)
    shift = torch.where(best == inner, shift.clamp(-1, 1), 0.0)
    light = known.light[best] * (known.light[1] / known.light[0]) ** shift
    sums = codes.sum(1)
    most = known.of_sums[-1]
    if known.bias is None:
        return torch.minimum(torch.where(best == 0, 0.0, light), most).to(torch.float32)
    found = torch.where(best == 0, known.of_sums[sums], light - known.bias(light).to(torch.float64))
    return torch.where(sums == len(known.of_sums) - 1, most, torch.minimum(found, most)).to(torch.float32)

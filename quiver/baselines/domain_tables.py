"""Holds the tables of the scale phi (information_domain.py) on a device, for the sensors of a batch of windows.

    mean codes [B, ...] -> phi, deviation, variance;    phi [B, ...] -> photons, slope          (curves.py)

Pooled codes are whole numbers of 1 / scale^2: their phi is looked up by that number and is exact, so that the search
for paths, which compares sums, chooses as it does by NumPy's tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from quiver.baselines import curves
from quiver.baselines.curves import Curves, Place
from quiver.baselines.information_domain import FLOOR, InformationDomain
from quiver.baselines.paths.moved_frames import SCALES
from quiver.device import is_gpu

CODE_BITS = 9  # places per octave of mean codes: 2^bits
LIGHT_BITS = 10  # of phi, towards whose end light rises fast
POOLED = 1 << 17  # values of pooled codes that a table of them may have
PHI, DEVIATION, VARIANCE = range(3)  # functions of the mean code
PHOTONS, SLOPE = range(2)  # functions of phi


@dataclass(frozen=True, eq=False)
class DomainTables:
    """Tables for B windows, or for any number of windows of one sensor if B is 1."""

    code: Curves
    light: Curves
    first: Tensor  # float32 [B, 1, 1], mean code of a dark pixel
    last: Tensor  # float32 [B, 1, 1], mean code where it stops rising
    dark_slope: Tensor  # float32 [B, 1, 1], of phi below `first`
    pooled: dict[int, Tensor]  # phi float32 [B, numbers] of whole numbers of 1 / scale^2; empty for many bits

    def phi(self, mean_code: Tensor, place: Place | None = None) -> Tensor:
        """Return phi, float32 [B, H, W], of mean codes [B, H, W]; negative below that of a dark pixel."""
        place = place or self.code.place(mean_code)
        below = (mean_code - self.first).clamp_(max=0).mul_(self.dark_slope)
        return self.code.value(place, PHI).add_(below)

    def phi_of_pooled(self, mean_code: Tensor, scale: int) -> Tensor:
        """Return phi, float32 [B, H, W], of codes that are pooled over `scale` x `scale` pixels, [B, H, W]."""
        table = self.pooled.get(scale)
        if table is None:
            return self.phi(mean_code)
        number = (mean_code * scale**2).int()
        if len(table) > 1:
            number += _starts(table)
        return table.flatten().index_select(0, number.flatten()).view(mean_code.shape)

    def stabilised(self, mean_code: Tensor, count: Tensor | float) -> tuple[Tensor, Tensor]:
        """Return phi and its deviation, float32 [B, H, W], of the mean of `count` codes; half a count below saturation
        at most.
        """
        # At saturation a mean code tells no light; half a count below, the estimate is that of the moment inverse.
        most = torch.maximum(self.last - 0.5 / count, self.first)
        mean_code = torch.minimum(mean_code, most)
        place = self.code.place(mean_code)
        root = count.sqrt() if isinstance(count, Tensor) else count**0.5
        return self.phi(mean_code, place), self.code.value(place, DEVIATION).div_(root)

    def variance(self, mean_code: Tensor) -> Tensor:
        """Return the variance of a code [B, H, W] at mean codes [B, H, W], FLOOR at least."""
        return self.code.value(self.code.place(mean_code), VARIANCE).clamp_(min=FLOOR)

    def light_and_slope(self, phi: Tensor) -> tuple[Tensor, Tensor]:
        """Return photons and photons per unit of phi, float32 [B, H, W], of phi [B, H, W]."""
        place = self.light.place(phi)
        return self.light.value(place, PHOTONS), self.light.value(place, SLOPE)

    def photons(self, phi: Tensor) -> Tensor:
        """Return photons, float32 [B, H, W], of phi [B, H, W]; from 0 to the brightest light of the table."""
        return self.light.value(self.light.place(phi), PHOTONS)


def _starts(table: Tensor) -> Tensor:
    """Return the number of the first value of each window in a table [B, n], int32 [B, 1, 1]."""
    return torch.arange(len(table), dtype=torch.int32, device=table.device)[:, None, None] * table.shape[1]


def domain_tables(domain: InformationDomain, device: torch.device) -> DomainTables:
    """Return the tables of one sensor on a device, some 2 MB; those that were used last are kept there."""
    return (_on_gpu if is_gpu(device) else _on_cpu)(domain, device)


def _made(domain: InformationDomain, device: torch.device) -> DomainTables:
    """Return the tables of one sensor on a device."""
    pooled = {}
    for scale in SCALES:
        numbers = scale**2 * domain.top + 1
        if numbers <= POOLED:
            pooled[scale] = torch.from_numpy(domain.forward(np.arange(numbers) / scale**2))[None].to(device)
    ends = torch.tensor([domain.mean_code[0], domain.mean_code[-1], domain.dark_slope], dtype=torch.float32)
    first, last, slope = ends.to(device)[:, None, None, None]
    return DomainTables(
        curves.curves(domain.mean_code, (domain.phi, domain.deviation, domain.variance), CODE_BITS, device),
        curves.curves(domain.phi, (domain.photons, domain.slope), LIGHT_BITS, device),
        first,
        last,
        slope,
        pooled,
    )


_on_cpu = lru_cache(maxsize=64)(_made)
_on_gpu = lru_cache(maxsize=512)(_made)  # a training on many sensors and levels of light needs all of them in turn


def tables_of_batch(domains: Sequence[InformationDomain], device: torch.device) -> DomainTables:
    """Return the tables of a batch of windows, one sensor each."""
    parts = [domain_tables(domain, device) for domain in domains]
    if all(part is parts[0] for part in parts):
        return parts[0]
    pooled = {}
    for scale in SCALES:
        tables = [part.pooled.get(scale) for part in parts]
        known = [table for table in tables if table is not None]
        if len(known) == len(tables):
            longest = max(table.shape[1] for table in known)
            pooled[scale] = torch.cat([_longer(table, longest) for table in known])
    return DomainTables(
        curves.joined([part.code for part in parts]),
        curves.joined([part.light for part in parts]),
        torch.cat([part.first for part in parts]),
        torch.cat([part.last for part in parts]),
        torch.cat([part.dark_slope for part in parts]),
        pooled,
    )


def _longer(table: Tensor, length: int) -> Tensor:
    return torch.nn.functional.pad(table, (0, length - table.shape[1]))

"""States how MergeNet is trained: inputs made where windows are drawn, and a loss that counts every light in decibels.

    codes -> merged frame -> channels, phi, deviation, table phi -> light;  loss = mean over windows of log(MSE)

Some windows lack frames on one side or both, as those at the ends of a stream do.

The error is that of a score: light over the peak, clamped. Its logarithm gives a dim window the same weight as a bright
one; otherwise the dimmest would own the gradient. Above the peak the clamp keeps a small slope.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor, nn

from quiver.data.codes import Codes
from quiver.data.sensor_of_window import SeenBy
from quiver.model.blocks import WINDOW
from quiver.restoration.merge_inputs import InformationDomain, batch_inputs, middle_inputs
from quiver.training.settings import Protocol, Settings
from quiver.training.system import Batch

ENDS = 0.3  # share of the windows that lack frames
SIDE = WINDOW // 2  # frames before and after the one that is restored
KEPT = 256  # sensors whose tables stay on a device
NODES = 1024  # of the table from phi to light, evenly spaced in phi
FLOOR = 2e-6  # added to a mean squared error: 57 dB
ABOVE = 0.05  # slope of light above the peak

PROTOCOLS: Mapping[str, Protocol] = {
    "quick": {
        "sensor": ("quiver-physical", "spad-320x240"),  # of a SPAD, 2^bits - 1 planes are summed
        "ppp": tuple(float(f"{level:.3g}") for level in np.geomspace(0.3, 100, 16)),
        "bits": (1, 2, 3, 4, 5, 6, 7),
        "optimiser": "muon",
        "learning_rate": 3e-3,
        "crop": 96,
        "batch": 6,
        "clip_norm": 1.0,
        "loss": "own",
    }
}


def check(network: nn.Module, settings: Settings) -> None:
    """Raise `ValueError` unless windows have the frames that a restored frame is merged from."""
    if settings.frames != WINDOW:
        raise ValueError(f"frames={settings.frames}: mergenet restores from {WINDOW} frames; leave frames= out")


def kept_frames(sample: int) -> tuple[int, int]:
    """Return how many frames before and after the middle one the window of a number keeps."""
    rng = np.random.default_rng([sample, 20261129])
    if rng.random() >= ENDS:
        return SIDE, SIDE
    return int(rng.integers(SIDE + 1)), int(rng.integers(SIDE + 1))


def prepare(codes: Codes, sample: int) -> dict[str, Tensor]:
    """Return the inputs of the middle frame of a window, and the table from phi to light over white."""
    inputs, domain = middle_inputs(codes, kept_frames(sample))
    top, table = light_table(domain, codes.white, torch.device("cpu"))
    return {
        "channels": inputs.channels[0],
        "phi": inputs.phi[0],
        "deviation": inputs.deviation[0],
        "top": top,
        "table": table,
    }


@torch.no_grad()
def prepare_batch(codes: Tensor, sensors: Sequence[SeenBy]) -> dict[str, Tensor]:
    """Return what `prepare` does for windows of codes [B, T, h, w] at once, on their device."""
    kept = [kept_frames(seen.sample) for seen in sensors]
    inputs, domains = batch_inputs(codes, [(seen.sensor, seen.exposure) for seen in sensors], kept)
    ends = [_light_table(domain, seen.white, codes.device) for domain, seen in zip(domains, sensors, strict=True)]
    return {
        "channels": inputs.channels,
        "phi": inputs.phi,
        "deviation": inputs.deviation,
        "top": torch.stack([top for top, _ in ends]),
        "table": torch.stack([table for _, table in ends]),
    }


def light_table(domain: InformationDomain, white: float, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the largest phi of a sensor, a scalar, and its light over white [NODES] over phi from 0 to there."""
    top = float(domain.phi[-1])
    table = np.interp(np.linspace(0, top, NODES), domain.phi, domain.photons) / white
    return torch.tensor(top, dtype=torch.float32).to(device), torch.from_numpy(table.astype(np.float32)).to(device)


_light_table = lru_cache(maxsize=KEPT)(light_table)  # of the sensors of a training


def light_of(phi: Tensor, top: Tensor, table: Tensor) -> Tensor:
    """Return light over white [B, h, w] of phi [B, h, w], from tables [B, NODES] over phi from 0 to `top` [B]."""
    last = table.shape[1] - 1
    place = (phi / top[:, None, None]).clamp(0, 1) * last
    left = place.detach().floor().long().clamp(0, last - 1)
    low, high = (table.gather(1, (left + step).flatten(1)).view_as(phi) for step in (0, 1))
    return low + (high - low) * (place - left)


def restored(network: nn.Module, batch: Batch) -> tuple[Tensor, int]:
    """Return the middle frame of a window [B, 1, 1, h, w] in units of white, and its place."""
    correction = network(batch["channels"])[:, 0].float()
    light = light_of(batch["phi"] + batch["deviation"] * correction, batch["top"], batch["table"])
    return light[:, None, None], batch["codes"].shape[1] // 2


def loss(network: nn.Module, batch: Batch, settings: Settings, share: float) -> Tensor:
    """Return the mean over windows of log(mean squared error of light over the peak, clamped)."""
    light, middle = restored(network, batch)
    unit = (batch["white"] / batch["peak"]).to(light.dtype)[:, None, None]
    return log_error(light[:, 0, 0] * unit, batch["target"][:, middle, 0] * unit).mean()


def log_error(light: Tensor, target: Tensor) -> Tensor:
    """Return log(mean squared error) of windows [B] of light over the peak [B, h, w], clamped."""
    return ((_shown(light) - _shown(target)).square().mean((1, 2)) + FLOOR).log()


def _shown(light: Tensor) -> Tensor:
    return torch.where(light > 1, 1 + ABOVE * (light - 1), light)

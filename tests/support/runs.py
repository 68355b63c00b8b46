"""Makes settings and networks for small training runs."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import nn

from quiver.model.unet import UNet, UNetConfig
from quiver.training.settings import Settings


def settings(data: Path, out: Path, **changes: object) -> Settings:
    defaults = {"steps": 6, "crop": 16, "batch": 2, "validate_every": 4, "warmup": 2, "validation_windows": 2}
    return Settings(str(data), str(out), **defaults | changes)


def small_network(seed: int = 0) -> UNet:
    torch.manual_seed(seed)
    return UNet(UNetConfig(4))


def same_weights(a: nn.Module, b: nn.Module) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a.state_dict().values(), b.state_dict().values(), strict=True))

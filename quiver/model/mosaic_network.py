"""Defines MosaicNet: a network of one band that restores each place of a mosaic, and a learned end that joins colours.

    codes of a place of the tile [N, T, 1, h, w] --core--> light of the place     (the same weights for all places)
    light [N, H, W], linear estimate of R, G and B [N, 3, H, W] --bands--> R, G, B [N, 3, H, W]

The linear estimate (qsim/sensor/demosaicing.py) knows no edges, and treats the error of all places alike. Residual
convolutions at the scale of the tile add what it misses, as of joint demosaicing and denoising (Gharbi et al. 2016).
They see light over the mean of the frame, and how many photons that mean is, so one network serves all light levels. An
untrained end returns the linear estimate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from qsim.checks import shown
from quiver.model.blocks import conv
from quiver.model.config import NetworkConfig, whole_number

DARK = 0.02  # of the mean light: the floor of the unit of a correction
LONGEST_SIDE = 16  # px, of a tile


@dataclass(frozen=True)
class MosaicNetConfig(NetworkConfig):
    """Configuration: the network of one band, the mask that the end has learned, and the end's size."""

    core: str  # the class of a network
    settings: Mapping[str, Any] = field(default_factory=dict)  # of its configuration
    mask: tuple[str, ...] = ("RG", "GB")
    width: int = 48
    layers: int = 6

    def __post_init__(self) -> None:
        whole_number("MosaicNetConfig.width", self.width, 1, 512)
        whole_number("MosaicNetConfig.layers", self.layers, 1, 32)
        lengths = {len(row) for row in self.mask}
        if len(lengths) != 1 or not 1 <= min(lengths) <= LONGEST_SIDE or len(self.mask) > LONGEST_SIDE:
            raise ValueError(f"MosaicNetConfig.mask is no tile of at most {LONGEST_SIDE} px: {shown(self.mask)}")

    @property
    def tile(self) -> tuple[int, int]:
        """Rows and columns of the tile."""
        return len(self.mask), len(self.mask[0])


class MosaicNet(nn.Module):
    """A network of one band with a learned end for one mask."""

    def __init__(self, config: MosaicNetConfig, core: nn.Module) -> None:
        super().__init__()
        self.config = config
        self.core = core
        rows, columns = config.tile
        places = rows * columns
        width = config.width
        self.enter = conv(4 * places + 1, width, 3)
        self.inner = nn.ModuleList(conv(width, width, 3) for _ in range(config.layers))
        self.leave = conv(width, 3 * places, 3)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)  # type: ignore[arg-type]

    @property
    def reach(self) -> int:
        """Tiles beyond which a pixel depends on no light, but for the mean."""
        return self.config.layers + 2

    def bands(self, light: Tensor, linear: Tensor, mean: Tensor, photons: Tensor) -> Tensor:
        """Return R, G and B [N, 3, H, W] in the unit of the light [N, H, W] behind the mask; whole tiles fill frames.

        `linear` [N, 3, H, W] is the linear estimate, `mean` [N] the mean light of the frame, and `photons` [N] that
        mean in photons.
        """
        tile = self.config.tile
        scale = mean.clamp_min(1e-12)[:, None, None, None]
        seen = self.split(light[:, None] / scale, tile)
        guess = self.split(linear / scale, tile)
        unit = (seen.mean(dim=1, keepdim=True).clamp_min(0) + DARK).sqrt()
        known = torch.log10(photons.clamp_min(1e-3))[:, None, None, None].expand_as(unit) / 2
        features = self.enter(torch.cat([_root(seen), _root(guess), known], dim=1))
        for layer in self.inner:
            features = features + layer(torch.relu(features))
        return linear + scale * self.join(unit * self.leave(torch.relu(features)), tile)

    @staticmethod
    def split(frames: Tensor, tile: tuple[int, int]) -> Tensor:
        """Return [N, C, H, W] as [N, C rows columns, H/rows, W/columns]: every place of the tile is a channel."""
        count, channels, height, width = frames.shape
        rows, columns = tile
        apart = frames.reshape(count, channels, height // rows, rows, width // columns, columns)
        return apart.permute(0, 1, 3, 5, 2, 4).reshape(count, -1, height // rows, width // columns)

    @staticmethod
    def join(places: Tensor, tile: tuple[int, int]) -> Tensor:
        """Return the inverse of `split`."""
        rows, columns = tile
        count, channels, height, width = places.shape
        apart = places.reshape(count, channels // (rows * columns), rows, columns, height, width)
        return apart.permute(0, 1, 4, 2, 5, 3).reshape(count, -1, height * rows, width * columns)


def _root(light: Tensor) -> Tensor:
    """Return the square root of light, continued below 0 as an odd function: there noise of photons is alike."""
    return light.sign() * ((light.abs() + DARK).sqrt() - DARK**0.5)

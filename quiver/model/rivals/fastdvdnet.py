"""Defines FastDVDnet (Tassano et al., CVPR 2020): a cascade of two small U-Nets over five frames; a control.

    frames t-1, t, t+1 with their noise maps -> first U-Net -> frame t, denoised once
    results t-1, t, t+1 of the first U-Net with the noise maps -> second U-Net -> restored frame t

Written from a description of the article. Look-ahead: 2 frames. Beyond the ends of a clip, time runs backwards. The
first U-Net runs once per frame of a clip, though three restored frames use its result.

Our reading: the article's noise map is one number. Here it is the sensor's deviation at the mean of 5 x 5 pixels, from
its exact table; the second U-Net gets the maps of the frames whose results it takes. Where the article has 30 channels
for each frame, we have 15/16 of the width. In training, batch normalisation sees one time step at a time.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from quiver.model.config import NetworkConfig, flag, whole_number
from quiver.model.rivals.edges import restored_range
from quiver.model.rivals.noise import deviation_map, table_of

TRIPLE = 3  # frames of a U-Net


@dataclass(frozen=True)
class FastDVDnetConfig(NetworkConfig):
    """Configuration of FastDVDnet; the defaults are the published sizes, with noise maps of the sensor."""

    width: int = 32  # channels at full size; twice and four times as many at half and at a quarter
    noise_map: bool = True  # False: the network sees the frames alone
    batch_norm: bool = True  # False: no normalisation

    def __post_init__(self) -> None:
        """Raise `ValueError` for a value out of range."""
        whole_number("FastDVDnetConfig.width", self.width, 2, 1024)
        for name in ("noise_map", "batch_norm"):
            flag(f"FastDVDnetConfig.{name}", getattr(self, name))


class FastDVDnet(nn.Module):
    """FastDVDnet for grey frames."""

    look_ahead: ClassVar[int] = 2  # frames
    frames_in: ClassVar[int] = 5  # of a window; the middle one is restored
    multiple: ClassVar[int] = 4  # px that divide height and width inside

    def __init__(self, config: FastDVDnetConfig | None = None) -> None:
        """Make the network of a configuration; the published sizes by default."""
        super().__init__()
        self.config = config = config or FastDVDnetConfig()
        self.first = Block(config)
        self.second = Block(config)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
        self.takes_variance = config.noise_map

    def forward(self, frames: Tensor, variance: Tensor | None = None) -> Tensor:
        """[B, T, 1, H, W] of codes/(2^b - 1) -> restored [B, T, 1, H, W]; ValueError for another shape.

        `variance` is the sensor's table, [n] or one per clip [B, n]; None: that of noise.VARIANCE.
        """
        known = {} if variance is None else {"variance": variance}
        return restored_range(self, frames, 0, frames.shape[1], **known)

    def windows(self, frames: Tensor, variance: Tensor | None = None) -> Tensor:
        """[B, T, 1, H, W], T >= 5, H and W multiples of 4 -> restored frames 2 ... T-3 [B, T-4, 1, H, W]."""
        maps = deviation_map(frames, table_of(variance, frames)).unbind(1) if self.config.noise_map else None
        images = frames.unbind(1)
        restored = []
        denoised: deque[Tensor] = deque(maxlen=TRIPLE)
        for t in range(1, len(images) - 1):
            denoised.append(self.first(images[t - 1 : t + 2], None if maps is None else maps[t - 1 : t + 2]))
            if len(denoised) == TRIPLE:
                restored.append(self.second(denoised, None if maps is None else maps[t - 2 : t + 1]))
        return torch.stack(restored, dim=1)


class Block(nn.Module):
    """A U-Net at three scales, whose levels are added; it finds the noise of the middle one of three frames."""

    def __init__(self, config: FastDVDnetConfig) -> None:
        """Make the layers."""
        super().__init__()
        # channels; of a frame, before the frames meet
        w = config.width
        each = 15 * config.width // 16
        normed = config.batch_norm
        self.enter = nn.Sequential(
            *_layer(TRIPLE * (1 + config.noise_map), TRIPLE * each, normed, groups=TRIPLE),
            *_layer(TRIPLE * each, w, normed),
        )
        self.down = nn.Sequential(*_layer(w, 2 * w, normed, stride=2), *_layers(2 * w, normed))
        self.bottom = nn.Sequential(
            *(*_layer(2 * w, 4 * w, normed, stride=2), *_layers(4 * w, normed), *_layers(4 * w, normed)),
            *(_conv(4 * w, 8 * w), nn.PixelShuffle(2)),
        )
        self.rise = nn.Sequential(*_layers(2 * w, normed), _conv(2 * w, 4 * w), nn.PixelShuffle(2))
        self.leave = nn.Sequential(*_layer(w, w, normed), _conv(w, 1))

    def forward(self, images: Sequence[Tensor], maps: Sequence[Tensor] | None) -> Tensor:
        """Three images and noise maps [N, 1, H, W] -> the middle image without its noise [N, 1, H, W]."""
        pairs = [images] if maps is None else [images, maps]
        full = self.enter(torch.cat([part for of_frame in zip(*pairs, strict=True) for part in of_frame], dim=1))
        half = self.down(full)
        half = self.bottom(half) + half
        return images[TRIPLE // 2] - self.leave(self.rise(half) + full)


def _conv(inputs: int, outputs: int, stride: int = 1, groups: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, stride, padding=1, groups=groups)


def _layer(inputs: int, outputs: int, normed: bool, stride: int = 1, groups: int = 1) -> list[nn.Module]:
    norm = [nn.BatchNorm2d(outputs)] if normed else []
    return [_conv(inputs, outputs, stride, groups), *norm, nn.ReLU(inplace=True)]


def _layers(width: int, normed: bool) -> list[nn.Module]:
    return [*_layer(width, width, normed), *_layer(width, width, normed)]

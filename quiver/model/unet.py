"""Defines a U-Net over the stacked frames of a window: the control for every learned method.

The eleven frames are channels of one image. The network has no part for motion, time or noise. Its outside is that of
the compared networks (quiver/model/rivals/). Look-ahead: 5 frames; beyond the ends of a clip, time runs backwards.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from quiver.model.blocks import RADIUS, WINDOW, check_input, conv, join
from quiver.model.config import NetworkConfig, whole_number
from quiver.model.rivals.edges import restored_range


@dataclass(frozen=True)
class UNetConfig(NetworkConfig):
    """Configuration of a U-Net: three scales with widths w, 2w, 4w; w = 32 gives 0.91 million parameters."""

    width: int = 32

    def __post_init__(self) -> None:
        whole_number("UNetConfig.width", self.width, 1, 1024)


class SmallUNet(nn.Module):
    """Convolutions at full, half and quarter scale, each joined to the next finer one (Ronneberger et al. 2015)."""

    REACH = 36  # px: an output pixel depends on no input farther away
    MULTIPLE = 4  # of height and width

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        w = width
        self.down1 = nn.Sequential(*_relu_chain((inputs, w, w)))
        self.down2 = nn.Sequential(*_relu_chain((w, 2 * w, 2 * w)))
        self.bottom = nn.Sequential(*_relu_chain((2 * w, *[4 * w] * 5)))
        self.up2 = nn.ConvTranspose2d(4 * w, 2 * w, 2, stride=2)
        self.merge2 = nn.Sequential(*_relu_chain((4 * w, 2 * w, 2 * w)))
        self.up1 = nn.ConvTranspose2d(2 * w, w, 2, stride=2)
        self.merge1 = nn.Sequential(*_relu_chain((2 * w, w, w)))
        self.leave = conv(w, 1, 3)

    def forward(self, x: Tensor) -> Tensor:
        """[N, inputs, H, W] -> [N, 1, H, W], H and W multiples of 4."""
        full = self.down1(x)
        half = self.down2(F.max_pool2d(full, 2))
        quarter = self.bottom(F.max_pool2d(half, 2))
        half = self.merge2(join(self.up2(quarter), half))
        return self.leave(self.merge1(join(self.up1(half), full)))


class UNet(nn.Module):
    """The control for grey frames."""

    look_ahead: ClassVar[int] = RADIUS  # frames
    frames_in: ClassVar[int] = WINDOW  # of a window; the middle one is restored
    multiple: ClassVar[int] = SmallUNet.MULTIPLE  # px that divide height and width inside
    reach: ClassVar[int] = SmallUNet.REACH  # px: a pixel depends on no input farther away

    def __init__(self, config: UNetConfig | None = None) -> None:
        super().__init__()
        self.config = config or UNetConfig()
        self.body = SmallUNet(WINDOW, self.config.width)

    def forward(self, frames: Tensor) -> Tensor:
        """[B, T, 1, H, W] of codes/(2^b - 1) -> restored [B, T, 1, H, W]; ValueError for another shape."""
        return restored_range(self, frames, 0, frames.shape[1])

    def windows(self, frames: Tensor) -> Tensor:
        """[B, T, 1, H, W], T >= 11, H and W multiples of 4 -> restored frames 5 ... T-6 [B, T-10, 1, H, W].

        ValueError for fewer frames or other sides.
        """
        check_input(frames, self.multiple)
        starts = range(frames.shape[1] - WINDOW + 1)
        return torch.stack([self.body(frames[:, t : t + WINDOW, 0]) for t in starts], dim=1)


def _relu_chain(widths: Sequence[int]) -> list[nn.Module]:
    """Return the layers conv3, ReLU, ..., conv3, ReLU of the given widths."""
    return [layer for inputs, outputs in pairwise(widths) for layer in (conv(inputs, outputs, 3), nn.ReLU())]

"""Defines MergeNet, our restorer of one frame from merged frames: one set of weights for every light, depth and sensor.

    channels [N, 17, H, W] in units of the noise -> U-Net, widths 40, 80, 160 -> correction [N, 1, H, W], the same unit

The frame restored is merged phi + deviation x correction. On the scale phi all sensors look alike: the noise of n codes
has the deviation 1 / sqrt(n), and the signal is between one and a hundred of them. So one network sees every bit
depth and light level. Alignment and merging need no training (quiver/baselines/path_merge.py).

Average pooling and bilinear enlargement instead of maxima and strided kernels: a shift of the input by a pixel then
hardly changes the answer. Joins add instead of concatenating, which saves a third of the multiplications.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from quiver.model.blocks import conv
from quiver.model.config import NetworkConfig, whole_number

INPUTS = 17  # channels, of quiver/restoration/merge_inputs.py


@dataclass(frozen=True)
class MergeNetConfig(NetworkConfig):
    """Configuration: three scales with widths w, 2w, 4w; w = 40 gives 0.91 million parameters."""

    width: int = 40
    inputs: int = INPUTS

    def __post_init__(self) -> None:
        whole_number("MergeNetConfig.width", self.width, 1, 256)
        if self.inputs != INPUTS:
            raise ValueError(
                f"MergeNetConfig.inputs is {self.inputs!r}, this version prepares {INPUTS}; train such weights again"
            )


class MergeNet(nn.Module):
    """Convolutions at full, half and quarter scale, each added to the next finer one (Ronneberger et al. 2015)."""

    multiple = 8  # of height and width: 4 would do here, and merging has cells of 8 px
    REACH = 36  # px: a pixel depends on no channel farther away; paths reach farther
    frames_in = 11  # frames of a training window; a restored frame takes fewer at the ends of a stream

    def __init__(self, config: MergeNetConfig | None = None) -> None:
        super().__init__()
        self.config = config or MergeNetConfig()
        w = self.config.width
        self.fine = _chain(self.config.inputs, w, w)
        self.middle = _chain(w, 2 * w, 2 * w)
        self.coarse = _chain(2 * w, 4 * w, 4 * w, 4 * w, 2 * w)
        self.middle_again = _chain(2 * w, 2 * w, w)
        self.fine_again = _chain(w, w, w)
        self.leave = conv(w, 1, 3)
        nn.init.zeros_(self.leave.weight)  # an untrained network returns the merged frame
        nn.init.zeros_(self.leave.bias)  # type: ignore[arg-type]

    def forward(self, channels: Tensor) -> Tensor:
        """[N, inputs, H, W] -> [N, 1, H, W], in deviations of the noise; H and W are multiples of 4."""
        fine = self.fine(channels.contiguous(memory_format=torch.channels_last))  # 1.2 to 1.4 times as fast on a CPU
        middle = self.middle(functional.avg_pool2d(fine, 2))
        coarse = self.coarse(functional.avg_pool2d(middle, 2))
        middle = self.middle_again(_twice(coarse).add_(middle))
        joined = _twice(middle).add_(fine)  # in place, and without the sum's parts: frames are large
        del fine, middle
        restored: Tensor = self.leave(self.fine_again(joined))
        return restored


def _chain(*widths: int) -> nn.Sequential:
    """Return conv3, ReLU, ..., conv3, ReLU of these widths."""
    layers: Sequence[nn.Module] = [x for a, b in pairwise(widths) for x in (conv(a, b, 3), nn.ReLU(inplace=True))]
    return nn.Sequential(*layers)


def _twice(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)

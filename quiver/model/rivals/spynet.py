"""Defines SpyNet, a small pyramid network for optical flow (Ranjan and Black, CVPR 2017).

From the coarsest level to the finest it adds a correction to the upsampled flow, from the two images at that level.
The layers have their published names.
"""

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from quiver.model.deformable import warp

MULTIPLE = 32  # px; images are resized to multiples of it inside
# of three channels, as published
MEAN = (0.485, 0.456, 0.406)
DEVIATION = (0.229, 0.224, 0.225)
WIDTHS = (8, 32, 64, 32, 16, 2)


class SpyNet(nn.Module):
    """Flow between two grey images; the grey image is copied into three channels."""

    def __init__(self, levels: int = 6) -> None:
        """Make a network of as many levels; the finest has the resized image."""
        super().__init__()
        self.register_buffer("mean", torch.tensor(MEAN).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(DEVIATION).view(1, 3, 1, 1))
        self.mean: Tensor
        self.std: Tensor
        self.basic_module = nn.ModuleList(Level() for _ in range(levels))

    def forward(self, reference: Tensor, support: Tensor) -> Tensor:
        """Grey images [N, 1, H, W] in 0 ... 1 -> flow [N, 2, H, W] in px (x, y), on the reference, into the support.

        The coarsest level must have two pixels: with six levels each side must exceed 32 px.
        """
        height, width = reference.shape[2:]
        size = [-side // MULTIPLE * -MULTIPLE for side in (height, width)]
        references, supports = (self.pyramid(image, size) for image in (reference, support))
        flow = None
        for module, ours, theirs in zip(self.basic_module, references, supports, strict=True):
            if flow is None:
                flow = torch.zeros_like(ours[:, :2])
            else:
                flow = 2 * F.interpolate(flow, size=ours.shape[2:], mode="bilinear", align_corners=True)
            flow = flow + module(torch.cat([ours, warp(theirs, flow, "border").to(ours.dtype), flow], dim=1))
        assert flow is not None
        flow = F.interpolate(flow, size=(height, width), mode="bilinear", align_corners=False)
        factors = [flow.new_full((), new / old) for new, old in ((width, size[1]), (height, size[0]))]
        return flow * torch.stack(factors).view(1, 2, 1, 1)

    def pyramid(self, image: Tensor, size: list[int]) -> list[Tensor]:
        """[N, 1, H, W] -> standardised images [N, 3, h, w], coarsest first; the last has the size."""
        standard = (image - self.mean) / self.std
        images = [F.interpolate(standard, size=size, mode="bilinear", align_corners=False)]
        for _ in self.basic_module[1:]:
            images.append(F.avg_pool2d(images[-1], 2))
        return images[::-1]


class Level(nn.Module):
    """The correction of one level: five 7 x 7 convolutions, ReLU between."""

    def __init__(self) -> None:
        """Make the layers, which stand at even places."""
        super().__init__()
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise(WIDTHS):
            layers += [nn.Conv2d(inputs, outputs, 7, padding=3), nn.ReLU()]
        self.basic_module = nn.Sequential(*layers[:-1])

    def forward(self, x: Tensor) -> Tensor:
        """Images and flow [N, 8, h, w] -> correction [N, 2, h, w] in px."""
        return self.basic_module(x)

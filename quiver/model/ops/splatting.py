"""Moves the pixels of an image forward along a flow, and averages those that meet (average splatting)."""

import torch
from torch import Tensor


def average_splat(image: Tensor, flow: Tensor) -> Tensor:
    """Splat an image forward: the pixel p lands at p + flow(p), spread bilinearly over the four pixels around it.

    image [N, C, H, W]; flow [N, 2, H, W] in pixels, channel 0 = x (right), 1 = y (down); result [N, C, H, W] in float32
    or float64: the weighted mean of all that arrives at a pixel, 0 where nothing arrives. What lands outside is lost.
    Differentiable in the image and, through the weights, in the flow. On a GPU the order of the sums, hence the last
    digit, varies from run to run. ValueError if the sizes differ.
    """
    if flow.shape != (image.shape[0], 2, *image.shape[2:]):
        raise ValueError(
            f"average_splat: flow must be {(image.shape[0], 2, *image.shape[2:])}, got {tuple(flow.shape)}; "
            "give one vector per pixel"
        )
    with torch.autocast(image.device.type, enabled=False):
        dtype = torch.promote_types(torch.promote_types(image.dtype, flow.dtype), torch.float32)
        flow = flow.to(dtype)
        height, width = image.shape[2:]
        x = torch.arange(width, dtype=dtype, device=flow.device) + flow[:, 0]
        y = torch.arange(height, dtype=dtype, device=flow.device)[:, None] + flow[:, 1]
        # A channel of ones is splatted along: it adds up the weights that arrive.
        sources = torch.cat([image.to(dtype), image.new_ones(len(image), 1, height, width, dtype=dtype)], dim=1)
        sums = torch.zeros_like(sources).flatten(2)
        for column, share_x in _neighbours(x):
            for row, share_y in _neighbours(y):
                inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
                share = torch.where(inside, share_x * share_y, 0.0)
                place = torch.where(inside, row * width + column, 0.0).long()
                targets = place.view(len(place), 1, -1).expand_as(sums)
                sums = sums.scatter_add(2, targets, (sources * share[:, None]).flatten(2))
        total = sums[:, -1:]
        arrived = total > 0
        mean = torch.where(arrived, sums[:, :-1] / torch.where(arrived, total, 1.0), 0.0)
        return mean.view(len(image), -1, height, width)


def _neighbours(position: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Positions of one axis -> the two pixels around each, and the share that each gets."""
    below = position.detach().floor()
    fraction = position - below
    return [(below, 1 - fraction), (below + 1, fraction)]

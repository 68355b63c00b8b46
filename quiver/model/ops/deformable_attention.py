"""Computes guided deformable attention in plain torch: a pixel attends to moved taps of several images.

A pixel reads each source at the taps of a small kernel, each moved by its own offset. Keys and values lie at different
places. The taps of all sources share one softmax. Sampling and attention are in float32 or float64, also under
autocast.
"""

import torch
from torch import Tensor

from quiver.model.deformable import sample_at

SAMPLES_AT_ONCE = 2**25  # numbers that inference samples at once, in blocks of rows: 128 MiB of float32


def deformable_attention(query: Tensor, key: Tensor, value: Tensor, offset: Tensor, heads: int) -> Tensor:
    """Return the attended values [N, C, H, W] of queries [N, C, H, W].

    key, value [N, S, C, H, W] of S sources; heads and offset groups are blocks of consecutive channels.
    offset [N, S, 2G, K*K, 2, H, W] in pixels, (dy, dx): the first G groups move the key, the others the value.
    Tap (ky, kx) of pixel (y, x) samples row y + ky - K//2 + dy and column x + kx - K//2 + dx, bilinear; neighbours
    outside count as zero. Without gradients the rows are computed in blocks of bounded memory. ValueError if a shape
    does not fit.
    """
    _check(query, key, value, offset, heads)
    with torch.autocast(query.device.type, enabled=False):
        dtype = torch.promote_types(query.dtype, torch.float32)
        query = query.to(dtype)
        offset = offset.to(dtype)
        images = torch.cat([key, value], dim=2).to(dtype)
        y, x = _positions(offset)
        rows = query.shape[2]
        if not torch.is_grad_enabled():
            rows = max(SAMPLES_AT_ONCE * rows // (images.numel() * offset.shape[3]), 1)
        blocks = [slice(start, start + rows) for start in range(0, query.shape[2], rows)]
        return torch.cat([_attend(query[:, :, b], images, y[..., b, :], x[..., b, :], heads) for b in blocks], dim=2)


def _attend(query: Tensor, images: Tensor, y: Tensor, x: Tensor, heads: int) -> Tensor:
    """Queries [N, C, h, W], images [N, S, 2C, H, W], positions [N, S, 2G, K*K, h, W] -> values [N, C, h, W]."""
    count, sources, groups, taps, height, width = y.shape
    folded = images.reshape(count * sources * groups, -1, *images.shape[3:])
    rows, columns = (place.reshape(len(folded), taps * height, width) for place in (y, x))
    sampled = sample_at(folded, columns, rows, "zeros").view(count, sources, 2, heads, -1, taps, height, width)
    queries = query.reshape(count, 1, heads, -1, 1, height, width) * (sampled.shape[4] ** -0.5)
    logits = (queries * sampled[:, :, 0]).sum(dim=3)  # [N, S, heads, K*K, h, W]
    weights = logits.transpose(1, 2).flatten(2, 3).softmax(dim=2).unflatten(2, (sources, taps)).transpose(1, 2)
    return (weights.unsqueeze(3) * sampled[:, :, 1]).sum(dim=(1, 4)).flatten(1, 2)


def _positions(offset: Tensor) -> tuple[Tensor, Tensor]:
    """Offsets [N, S, 2G, K*K, 2, H, W] -> rows and columns [N, S, 2G, K*K, H, W] in pixels."""
    side = round(offset.shape[3] ** 0.5)
    steps = torch.arange(side, dtype=offset.dtype, device=offset.device) - side // 2
    rows, columns = (torch.arange(n, dtype=offset.dtype, device=offset.device) for n in offset.shape[5:])
    y = offset[:, :, :, :, 0] + (steps.repeat_interleave(side)[:, None, None] + rows[:, None])
    x = offset[:, :, :, :, 1] + (steps.repeat(side)[:, None, None] + columns)
    return y, x


def _check(query: Tensor, key: Tensor, value: Tensor, offset: Tensor, heads: int) -> None:
    count, channels, height, width = query.shape
    sources = (count, key.shape[1], channels, height, width)
    if key.shape != sources or value.shape != sources:
        raise ValueError(
            f"deformable_attention: key and value must be {sources}, got {tuple(key.shape)} and {tuple(value.shape)}"
        )
    groups, taps = offset.shape[2:4]
    if offset.shape != (*sources[:2], groups, taps, 2, height, width) or round(taps**0.5) ** 2 != taps:
        raise ValueError(
            f"deformable_attention: offset must be [{count}, {sources[1]}, 2G, K*K, 2, {height}, {width}], "
            f"got {tuple(offset.shape)}"
        )
    if groups % 2 or channels % (groups // 2) or channels % heads:
        raise ValueError(
            f"deformable_attention: {channels} channels divide neither into {groups}/2 offset groups nor {heads} heads"
        )

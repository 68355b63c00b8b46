"""Defines the transformer stacks of RVRT: shifted windows in space, all frames of a clip in one window.

Tensors are [N, D, C, H, W] outside, N clips of D frames; inside a stack they are [N, D, H, W, C].
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

HEADS = 6
WINDOW = 8  # px, rows and columns of a window
SHIFT = 4  # px, of every second layer
OTHER_REGION = -100.0  # added to the logits of pixels that are neighbours only because the image was rolled


class FrameConv(nn.Module):
    """A convolution of every frame alone; its weight has a time axis of length 1, as published."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1) -> None:
        """Begin with the weights of an ordinary convolution."""
        super().__init__()
        plain = nn.Conv2d(inputs, outputs, kernel)
        self.weight, self.bias = nn.Parameter(plain.weight.data.unsqueeze(2)), plain.bias
        self.stride = stride

    def forward(self, x: Tensor) -> Tensor:
        """[N, inputs, H, W] -> [N, outputs, H, W], sides divided by the stride."""
        return F.conv2d(x, self.weight.squeeze(2), self.bias, self.stride, padding=self.weight.shape[-1] // 2)


class MLP(nn.Module):
    """Two linear layers with GELU between, twice as wide inside."""

    def __init__(self, width: int) -> None:
        """Make the layers."""
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, 2 * width), nn.Linear(2 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        """[..., C] -> [..., C]."""
        return self.fc2(F.gelu(self.fc1(x)))


class WindowAttention(nn.Module):
    """Attention among the pixels of each window, with a learnt bias per relative position."""

    def __init__(self, width: int, frames: int) -> None:
        """Make the layers; a window has that many frames."""
        super().__init__()
        self.frames = frames
        side = 2 * WINDOW - 1
        self.relative_position_bias_table = nn.Parameter(torch.zeros((2 * frames - 1) * side**2, HEADS))
        self.register_buffer("relative_position_index", relative_positions(frames))
        self.relative_position_index: Tensor
        self.qkv_self, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)

    def forward(self, x: Tensor, window: tuple[int, int], regions: Tensor | None) -> Tensor:
        """Windows [N, M, n, C] of n = frames * h * w pixels, window = (h, w) <= 8 px -> [N, M, n, C].

        Regions [M, n] are numbers; pixels of different regions hardly see each other.
        """
        q, k, v = self.qkv_self(x).unflatten(-1, (3, HEADS, -1)).movedim(-3, 0).transpose(-2, -3)
        bias = self.bias(window).unsqueeze(0)
        if regions is not None:
            apart = regions[:, None, :, None] != regions[:, None, None, :]
            bias = bias + apart.to(bias.dtype) * OTHER_REGION
        attended = F.scaled_dot_product_attention(q, k, v, attn_mask=bias.to(q.dtype))
        return self.proj(attended.transpose(-2, -3).flatten(-2))

    def bias(self, window: tuple[int, int]) -> Tensor:
        """Return the bias [heads, n, n] of query and key in a window of that many rows and columns."""
        height, width = window
        index = self.relative_position_index.view(2 * (self.frames, WINDOW, WINDOW))
        index = index[:, :height, :width, :, :height, :width].reshape(2 * (self.frames * height * width,))
        return self.relative_position_bias_table[index].permute(2, 0, 1)


class SwinLayer(nn.Module):
    """Window attention, then a network per pixel, each after a normalisation and with a residual."""

    def __init__(self, width: int, frames: int, *, shifted: bool) -> None:
        """Make the layers; a shifted layer rolls the image by half a window."""
        super().__init__()
        self.shifted = shifted
        self.norm1 = nn.LayerNorm(width)
        self.attn = WindowAttention(width, frames)
        self.norm2 = nn.LayerNorm(width)
        self.mlp = MLP(width)

    def forward(self, x: Tensor) -> Tensor:
        """[N, D, H, W, C] -> the same; D is the window's number of frames."""
        x = x + self.attended(self.norm1(x))
        return x + self.mlp(self.norm2(x))

    def attended(self, x: Tensor) -> Tensor:
        """[N, D, H, W, C] -> the same, by attention in windows.

        An axis no longer than a window is one window, unshifted. Others are padded with zeros to whole windows; the
        padded positions take part as keys and values.
        """
        count, frames, height, width, channels = x.shape
        window = min(WINDOW, height), min(WINDOW, width)
        shift = [SHIFT if self.shifted and side > WINDOW else 0 for side in (height, width)]
        x = F.pad(x, (0, 0, 0, -width % window[1], 0, -height % window[0])).roll((-shift[0], -shift[1]), (2, 3))
        rows = x.shape[2] // window[0]
        columns = x.shape[3] // window[1]
        cut = x.view(count, frames, rows, window[0], columns, window[1], channels).permute(0, 2, 4, 1, 3, 5, 6)
        regions = _regions(cut.shape[1:6], shift, x.device) if any(shift) else None
        done = self.attn(cut.reshape(count, rows * columns, -1, channels), window, regions)
        joined = done.view(cut.shape).permute(0, 3, 1, 4, 2, 5, 6).reshape(x.shape)
        return joined.roll((shift[0], shift[1]), (2, 3))[:, :, :height, :width]


class SwinBlock(nn.Module):
    """Two Swin layers, the second one shifted, and a linear layer, with a residual."""

    def __init__(self, width: int, frames: int) -> None:
        """Make the layers."""
        super().__init__()
        layers = nn.ModuleList(SwinLayer(width, frames, shifted=shifted) for shifted in (False, True))
        self.residual_group = nn.ModuleDict({"blocks": layers})
        self.linear = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """[N, D, H, W, C] -> the same."""
        unshifted, shifted = self.residual_group["blocks"].children()
        return x + self.linear(shifted(unshifted(x)))


class SwinStack(nn.Module):
    """A convolution per frame, a normalisation, blocks, a normalisation."""

    def __init__(self, inputs: int, width: int, blocks: int, frames: int) -> None:
        """Make the layers, at their published places."""
        super().__init__()
        self.main = nn.ModuleDict(
            {
                "1": FrameConv(inputs, width, 3),
                "3": nn.LayerNorm(width),
                "5": nn.Sequential(*(SwinBlock(width, frames) for _ in range(blocks))),
                "7": nn.LayerNorm(width),
            }
        )

    def forward(self, x: Tensor) -> Tensor:
        """[N, D, inputs, H, W] -> [N, D, C, H, W]; D is the number of frames of a window."""
        x = self.main["1"](x.flatten(0, 1)).unflatten(0, x.shape[:2]).movedim(2, -1)
        return self.main["7"](self.main["5"](self.main["3"](x))).movedim(-1, 2)


def relative_positions(frames: int) -> Tensor:
    """Return rows [n, n] of the bias table for query and key, n = frames * 64 pixels in order (time, row, column)."""
    places = np.indices((frames, WINDOW, WINDOW)).reshape(3, -1).T
    difference = places[:, None] - places[None, :] + np.array([frames - 1, WINDOW - 1, WINDOW - 1])
    side = 2 * WINDOW - 1
    return torch.from_numpy((difference[..., 0] * side + difference[..., 1]) * side + difference[..., 2])


def _regions(shape: torch.Size, shift: list[int], device: torch.device) -> Tensor:
    """Number the regions of a rolled image, cut as (rows, columns, frames, h, w) windows -> [windows, pixels]."""
    rows, columns, frames, height, width = shape
    labels = []
    for count, side, by in ((rows, height, shift[0]), (columns, width, shift[1])):
        places = torch.arange(count * side, device=device)
        last = count * side - side  # where the last window begins; the wrapped part begins half a window later
        labels.append((places >= last).long() + (places >= last + by).long() if by else torch.zeros_like(places))
    numbers = (3 * labels[0][:, None] + labels[1]).view(rows, 1, height, columns, 1, width)
    numbers = numbers.permute(0, 3, 1, 4, 2, 5).expand(-1, -1, frames, -1, -1, -1)
    return numbers.reshape(rows * columns, frames * height * width)

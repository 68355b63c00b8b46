"""Computes warping and modulated deformable convolution in plain torch, without torchvision.

Both sample images bilinearly at moved positions. Positions are normalised with `align_corners=False`,
u = (2x + 1)/W - 1. Pixel centres are then at integers, also for sides of length 1. Sampling is in float32 or float64,
also under autocast: half precision cannot address a pixel beyond 2048.
"""

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

TAP_LOOP_ABOVE = 2**25  # samples (N*C*K*oh*ow) above which inference computes tap after tap: 128 MiB of float32


def warp(image: Tensor, flow: Tensor, padding: Literal["zeros", "border"] = "zeros") -> Tensor:
    """Warp an image backward: result(p) = image(p + flow(p)).

    image [N, C, H, W]; flow [N, 2, H, W] in pixels, channel 0 = x (right), 1 = y (down); result [N, C, H, W].
    With `zeros` each of the four neighbours outside the image counts as zero; with `border` positions are clamped.
    ValueError if the sizes differ.
    """
    if flow.shape != (image.shape[0], 2, *image.shape[2:]):
        raise ValueError(f"warp: flow must be {(image.shape[0], 2, *image.shape[2:])}, got {tuple(flow.shape)}")
    with torch.autocast(image.device.type, enabled=False):
        image = _at_least_float32(image)
        flow = _at_least_float32(flow)
        image, flow = _same_type(image, flow)
        height, width = image.shape[2:]
        x = torch.arange(width, dtype=flow.dtype, device=flow.device) + flow[:, 0]
        y = torch.arange(height, dtype=flow.dtype, device=flow.device)[:, None] + flow[:, 1]
        return sample_at(image, x, y, padding)


def deform_conv2d(  # noqa: PLR0913 (settings of a public function)
    image: Tensor,
    offset: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    stride: int = 1,
    padding: int = 0,
    dilation: int = 1,
    tap_loop: bool | None = None,
) -> Tensor:
    """Convolve at moved positions with modulated taps (Zhu et al. 2019, "Deformable ConvNets v2").

    image [N, C, H, W]; weight [Co, C/groups, kh, kw] with K = kh*kw taps row by row; result [N, Co, oh, ow].
    offset [N, 2GK, oh, ow] of G groups of channels: channel g*2K + 2k is dy of tap k in pixels, the next one dx.
    mask [N, GK, oh, ow]: channel g*K + k is the factor of tap k.
    Tap (ky, kx) of output (i, j) samples the image at row i*stride - padding + ky*dilation + dy, and likewise in x;
    neighbours outside the image count as zero.

    `tap_loop` computes tap after tap, which needs 1/K of the memory where no gradient is kept. None chooses it for
    large inputs without gradients. Both forms give the same numbers up to rounding. ValueError if a shape does not fit.
    """
    with torch.autocast(image.device.type, enabled=False):
        dtype = _at_least_float32(image).dtype
        image = image.to(dtype)
        offset = offset.to(dtype)
        weight = weight.to(dtype)
        count = image.shape[0]
        channels = image.shape[1]
        taps = weight.shape[2] * weight.shape[3]
        out_size = _output_size(image, weight, stride, padding, dilation)
        if offset.shape[0] != count or offset.shape[1] % (2 * taps) or tuple(offset.shape[2:]) != out_size:
            raise ValueError(
                f"deform_conv2d: offset must be [{count}, 2*G*{taps}, {out_size}], got {tuple(offset.shape)}"
            )
        groups = offset.shape[1] // (2 * taps)
        if channels % groups or channels % weight.shape[1]:
            raise ValueError(
                f"deform_conv2d: {channels} channels divide neither into {groups} offset groups "
                f"nor into convolution groups of {weight.shape[1]}"
            )
        if mask is not None and mask.shape != (count, groups * taps, *out_size):
            raise ValueError(
                f"deform_conv2d: mask must be {(count, groups * taps, *out_size)}, got {tuple(mask.shape)}"
            )
        y, x = _positions(offset, weight.shape[2:], groups, stride, padding, dilation)
        strength = None if mask is None else mask.to(dtype).view(count, groups, 1, taps, *out_size)
        if tap_loop is None:
            # All taps at once keep K samples of each pixel in memory; one after the other, a single one.
            large = count * channels * taps * out_size[0] * out_size[1] > TAP_LOOP_ABOVE
            tap_loop = large and not torch.is_grad_enabled()
        step = 1 if tap_loop else taps
        result = None
        for k in range(0, taps, step):
            part = slice(k, k + step)
            samples = _tap_samples(image, y[:, :, part], x[:, :, part])
            if strength is not None:
                samples = samples * strength[:, :, :, part]
            term = _contract(samples, weight, part)
            result = term if result is None else result.add_(term)
        assert result is not None
        return result if bias is None else result + bias.to(dtype).view(1, -1, 1, 1)


def _output_size(image: Tensor, weight: Tensor, stride: int, padding: int, dilation: int) -> tuple[int, int]:
    size = [
        (length + 2 * padding - dilation * (kernel - 1) - 1) // stride + 1
        for length, kernel in zip(image.shape[2:], weight.shape[2:], strict=True)
    ]
    return size[0], size[1]


def _positions(
    offset: Tensor, kernel: torch.Size, groups: int, stride: int, padding: int, dilation: int
) -> tuple[Tensor, Tensor]:
    """Return the rows and columns [N, G, K, oh, ow], in pixels, at which every tap samples."""
    height, width = offset.shape[2:]
    pairs = offset.view(offset.shape[0], groups, kernel[0] * kernel[1], 2, height, width)
    rows, columns, tap_rows, tap_columns = (
        torch.arange(length, dtype=offset.dtype, device=offset.device) for length in (height, width, *kernel)
    )
    tap_y = tap_rows.repeat_interleave(kernel[1]) * dilation - padding
    tap_x = tap_columns.repeat(kernel[0]) * dilation - padding
    y = pairs[:, :, :, 0] + (rows[:, None] * stride + tap_y[:, None, None])
    x = pairs[:, :, :, 1] + (columns * stride + tap_x[:, None, None])
    return y, x


def _tap_samples(image: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """Return the values [N, G, C/G, K, oh, ow] of an image [N, C, H, W] at positions [N, G, K, oh, ow]."""
    count, groups, taps, height, width = y.shape
    folded = image.reshape(count * groups, image.shape[1] // groups, *image.shape[2:])
    rows, columns = (p.reshape(count * groups, taps * height, width) for p in (y, x))
    return sample_at(folded, columns, rows, "zeros").view(count, groups, -1, taps, height, width)


def _contract(samples: Tensor, weight: Tensor, part: slice) -> Tensor:
    """Sum over channels and taps: [N, G, C/G, k, oh, ow] x [Co, C/groups, kh, kw] -> [N, Co, oh, ow]."""
    count = samples.shape[0]
    height, width = samples.shape[4:]
    out = weight.shape[0]
    fan = weight.shape[1]
    channels = samples.shape[1] * samples.shape[2]
    groups = channels // fan
    kernel = weight.flatten(2)[:, :, part].reshape(groups, out // groups, -1)
    columns = samples.reshape(count, groups, fan * samples.shape[3], height * width)
    return torch.matmul(kernel, columns).view(count, out, height, width)


def sample_at(image: Tensor, x: Tensor, y: Tensor, padding: str) -> Tensor:
    """Sample an image [N, C, H, W] at pixel positions x, y [N, h, w] -> [N, C, h, w]."""
    height, width = image.shape[2:]
    # grid_sample counts from -1 to 1 over the picture with its outer edges.
    grid = torch.stack(((2 * x + 1) / width - 1, (2 * y + 1) / height - 1), dim=-1)
    return F.grid_sample(image, grid, mode="bilinear", padding_mode=padding, align_corners=False)


def _at_least_float32(tensor: Tensor) -> Tensor:
    return tensor if tensor.dtype in (torch.float32, torch.float64) else tensor.float()


def _same_type(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    dtype = torch.promote_types(a.dtype, b.dtype)
    return a.to(dtype), b.to(dtype)

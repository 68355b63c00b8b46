"""Computes the training loss: pixel and gradient differences at three scales, and of the pre-denoised frames.

    l(a, b) = mean|a - b| + w (mean|Dx a - Dx b| + mean|Dy a - Dy b|)
    total   = 0.85 l(O1, G) + 0.10 l(O2, G/2) + 0.05 l(O4, G/4) + 0.20 l(d, all clean frames)

Two more terms are ours. `log-mse` in place of the absolute difference counts every frame in dB. The alignment compares
each clean frame with the one before it, moved along the flow: clean frames are the truth of the flow, too.

The published program and the paper's text differ in w, in the gradient and in the resizing of targets; both are
presets. A model whose output is a plain tensor gets l(O, G) alone. The loss is computed in float32, also under
autocast.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import torch
import torch.nn.functional as functional
from torch import Tensor

from quiver.model.deformable import warp


def without_flow(names: Iterable[str]) -> tuple[str, ...]:
    """Return those of some losses that a network without flow can have."""
    return tuple(name for name in names if name not in PRESETS or not PRESETS[name].alignment)


class MultiScale(Protocol):
    """Output of a network: all frames pre-denoised, the restored ones at scale 1, 1/2, 1/4 (None: not computed)."""

    @property
    def denoised(self) -> Tensor | None: ...

    @property
    def scale1(self) -> Tensor: ...

    @property
    def scale2(self) -> Tensor | None: ...

    @property
    def scale4(self) -> Tensor | None: ...

    @property
    def flows(self) -> Sequence[Tensor] | None: ...


@dataclass(frozen=True)
class Loss:
    """Weights and operators of the loss."""

    gradient_weight: float  # w
    gradient: Literal["sobel", "difference"]  # 3 x 3 (1 2 1), not normalised, no padding | x[i+1] - x[i]
    resize: Literal["bilinear", "bicubic"]  # of the smaller targets, no antialiasing
    scales: tuple[float, float, float] = (0.85, 0.10, 0.05)  # of scale 1, 1/2, 1/4
    denoised: float = 0.20
    alignment: float = 0.0  # of clean frames that are moved along the flow
    measure: Literal["l1", "log-mse"] = "l1"  # of the difference of two frames

    def __post_init__(self) -> None:
        for name in ("gradient_weight", "denoised", "alignment"):
            value = getattr(self, name)
            if not 0 <= value < float("inf"):
                raise ValueError(f"Loss.{name} must be a finite number >= 0, got {value!r}")


PUBLISHED = Loss(gradient_weight=0.5, gradient="sobel", resize="bilinear")
# "horizontal and vertical gradients": read as first differences; "bicubic" as the kernel alone
PAPER = Loss(gradient_weight=1.0, gradient="difference", resize="bicubic")
L1 = Loss(0.0, gradient="difference", resize="bilinear", scales=(1.0, 0.0, 0.0), denoised=0.0)  # of controls
SCALES_L1 = Loss(0.0, gradient="difference", resize="bilinear")  # no gradients: the best PSNR in a short run
LOG_MSE = Loss(0.0, gradient="difference", resize="bilinear", measure="log-mse")
ALIGNED = Loss(0.0, gradient="difference", resize="bilinear", alignment=0.2)
PRESETS = {
    "published": PUBLISHED,
    "paper": PAPER,
    "l1": L1,
    "scales-l1": SCALES_L1,
    "log-mse": LOG_MSE,
    "aligned": ALIGNED,
}
LEAST_ERROR = 1e-5  # mean squared error that is added in log-mse: a perfect frame counts 50 dB


def gradients(image: Tensor, operator: str) -> tuple[Tensor, Tensor]:
    """Return the horizontal and vertical gradient of [N, 1, H, W], without border pixels that lack neighbours."""
    if operator == "difference":
        return image[..., :, 1:] - image[..., :, :-1], image[..., 1:, :] - image[..., :-1, :]
    # Sobel's kernel, (1, 2, 1) down times (-1, 0, 1) to the right, made where the image is: a copy would make the host
    # wait for a GPU. Its transpose is that of the other axis.
    across = torch.arange(-1, 2, dtype=image.dtype, device=image.device)
    kernel = (2 - across.abs())[:, None] * across
    both = functional.conv2d(image, torch.stack([kernel, kernel.T])[:, None])
    return both[:, :1], both[:, 1:]


def pair_loss(output: Tensor, target: Tensor, loss: Loss) -> Tensor:
    """Return l(a, b) of [..., 1, H, W], a scalar; a gradient without pixels (frames of 1 px) counts as 0."""
    a = output.float().flatten(0, -4)
    b = target.float().flatten(0, -4)
    if loss.measure == "log-mse":
        total = ((a - b).square().flatten(1).mean(1) + LEAST_ERROR).log().mean()
    else:
        total = (a - b).abs().mean()
    if loss.gradient_weight == 0 or (loss.gradient == "sobel" and min(a.shape[-2:]) < 3):
        return total
    for da in gradients(a - b, loss.gradient):  # both operators are linear
        if da.numel():
            total = total + loss.gradient_weight * da.abs().mean()
    return total


def shrink(target: Tensor, size: Sequence[int], mode: str) -> Tensor:
    """Resize a target [B, T, 1, H, W]; bilinear by 1/4 is the mean of the central 2 x 2 of each 4 x 4 block."""
    flat = functional.interpolate(target.float().flatten(0, 1), size=list(size), mode=mode, align_corners=False)
    return flat.view(*target.shape[:2], *flat.shape[1:])


def centred(target: Tensor, frames: int, first: int) -> Tensor:
    """Return target frames first ... first + frames - 1 of [B, T, 1, H, W]; ValueError if they do not exist."""
    if first < 0 or first + frames > target.shape[1]:
        raise ValueError(f"output holds frames {first}..{first + frames - 1}, the target only 0..{target.shape[1] - 1}")
    return target[:, first : first + frames]


def training_loss(output: Tensor | MultiScale, target: Tensor, loss: Loss, *, first: int) -> Tensor:
    """Return the loss of a batch, a float32 scalar; target [B, T, 1, H, W], `first` is the first restored frame."""
    with torch.autocast(target.device.type, enabled=False):
        if isinstance(output, Tensor):
            return pair_loss(output, centred(target, output.shape[1], first), loss)
        goal = centred(target, output.scale1.shape[1], first)
        total = loss.scales[0] * pair_loss(output.scale1, goal, loss)
        for weight, smaller in zip(loss.scales[1:], (output.scale2, output.scale4), strict=True):
            if smaller is not None and weight:
                total = total + weight * pair_loss(smaller, shrink(goal, smaller.shape[-2:], loss.resize), loss)
        if output.denoised is not None and loss.denoised:
            total = total + loss.denoised * pair_loss(output.denoised, target, loss)
        if output.flows is not None and loss.alignment:
            total = total + loss.alignment * alignment_loss(output.flows, target, loss)
        return total


def parts_loss(denoised: Tensor | None, flows: Sequence[Tensor] | None, target: Tensor, loss: Loss) -> Tensor:
    """Return the loss of the pre-denoiser and the flow alone, a float32 scalar; None: the network lacks the part."""
    with torch.autocast(target.device.type, enabled=False):
        total = target.new_zeros((), dtype=torch.float32)
        if denoised is not None:
            total = total + pair_loss(denoised, target, loss)
        if flows is not None:
            total = total + alignment_loss(flows, target, loss)
        return total


def alignment_loss(flows: Sequence[Tensor], target: Tensor, loss: Loss) -> Tensor:
    """Return the mean difference of clean frames and the frames before them, moved along flows of several scales.

    flows [B, T-1, 2, h, w] in pixels of their scale, on the grid of frame t+1 and pointing into frame t; target
    [B, T, 1, H, W].
    """
    total = target.new_zeros((), dtype=torch.float32)
    for flow in flows:
        frames = shrink(target, flow.shape[-2:], loss.resize)
        moved = warp(frames[:, :-1].flatten(0, 1), flow.float().flatten(0, 1), "border")
        total = total + (moved - frames[:, 1:].flatten(0, 1)).abs().mean()
    return total / len(flows)

"""Compares the loss with slow NumPy, and tests its published weights and its target frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.signal import convolve2d
from torch import Tensor

from quiver.training.loss import (
    ALIGNED,
    L1,
    LEAST_ERROR,
    LOG_MSE,
    PAPER,
    PUBLISHED,
    SCALES_L1,
    Loss,
    alignment_loss,
    centred,
    pair_loss,
    parts_loss,
    shrink,
    training_loss,
    without_flow,
)


@dataclass
class Output:
    denoised: Tensor | None
    scale1: Tensor
    scale2: Tensor | None
    scale4: Tensor | None
    flows: tuple[Tensor, ...] | None = None


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(0, 1, shape)).float()


def slow_pair_loss(a: np.ndarray, b: np.ndarray, loss: Loss) -> float:
    """Return the loss with every gradient image computed separately by SciPy's convolution."""
    sobel = np.array([[1.0, 0, -1], [2, 0, -2], [1, 0, -1]])
    total = np.abs(a - b).mean()
    for axis in (0, 1):
        if loss.gradient == "sobel":
            kernel = sobel if axis == 1 else sobel.T
            parts = [
                (convolve2d(x, kernel, "valid"), convolve2d(y, kernel, "valid")) for x, y in zip(a, b, strict=True)
            ]
        else:
            parts = [(np.diff(x, axis=axis), np.diff(y, axis=axis)) for x, y in zip(a, b, strict=True)]
        total += loss.gradient_weight * np.mean([np.abs(x - y).mean() for x, y in parts])
    return total


@pytest.mark.parametrize("loss", [PUBLISHED, PAPER, L1])
def test_pair_loss_equals_a_slow_one(loss: Loss):
    a = draw(2, 3, 1, 9, 7)
    b = draw(2, 3, 1, 9, 7, seed=1)
    slow = slow_pair_loss(a.double().numpy().reshape(6, 9, 7), b.double().numpy().reshape(6, 9, 7), loss)
    assert pair_loss(a, b, loss).item() == pytest.approx(slow, rel=1e-5)


def test_a_constant_difference_has_no_gradient():
    assert pair_loss(draw(1, 1, 1, 8, 8) + 0.25, draw(1, 1, 1, 8, 8), PUBLISHED).item() == pytest.approx(0.25, rel=1e-5)


def test_weights_are_those_of_the_paper():
    """A constant error in one output counts 0.85, 0.10, 0.05 and 0.20; in all of them 1.2."""
    target = torch.full((1, 11, 1, 8, 8), 0.5)
    exact = Output(target.clone(), target[:, :1], target[:, :1, :, :4, :4], target[:, :1, :, :2, :2])
    assert training_loss(exact, target, PUBLISHED, first=5).item() == 0
    for field, weight in (("scale1", 0.85), ("scale2", 0.10), ("scale4", 0.05), ("denoised", 0.20)):
        wrong = replace(exact, **{field: getattr(exact, field) + 0.1})
        assert training_loss(wrong, target, PUBLISHED, first=5).item() == pytest.approx(0.1 * weight, rel=1e-4)


def test_outputs_that_are_not_built_cost_nothing():
    target = draw(1, 11, 1, 8, 8)
    bare = Output(None, target[:, 5:6] + 0.1, None, None)
    assert training_loss(bare, target, PUBLISHED, first=5).item() == pytest.approx(0.085, rel=1e-4)
    assert training_loss(bare, target, L1, first=5).item() == pytest.approx(0.1, rel=1e-4)
    assert training_loss(target[:, 5:6] + 0.1, target, L1, first=5).item() == pytest.approx(0.1, rel=1e-4)


def test_the_centre_frame_is_the_target():
    """Of thirteen frames and three outputs from frame 5 on, only frames 5, 6, 7 give zero."""
    target = draw(2, 13, 1, 8, 8)
    assert training_loss(target[:, 5:8], target, L1, first=5).item() == 0
    assert training_loss(target[:, 4:7], target, L1, first=5).item() > 0.1
    with pytest.raises(ValueError, match=r"frames 11\.\.13, the target only 0\.\.12"):
        centred(target, 3, 11)


def test_small_targets():
    """Bilinear by 4 without antialiasing is the mean of the central 2 x 2, by 2 the mean of each 2 x 2 block."""
    target = draw(1, 1, 1, 8, 8)
    blocks = target.view(2, 4, 2, 4)
    quarter = (blocks[:, 1:3][..., 1:3]).mean(dim=(1, 3))
    torch.testing.assert_close(shrink(target, (2, 2), "bilinear")[0, 0, 0], quarter)
    torch.testing.assert_close(shrink(target, (4, 4), "bilinear")[0, 0, 0], target.view(4, 2, 4, 2).mean(dim=(1, 3)))
    assert not torch.allclose(shrink(target, (2, 2), "bicubic")[0, 0, 0], quarter)


def test_low_precision_output_still_gives_a_float32_loss():
    target = draw(1, 11, 1, 8, 8)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss = training_loss(target[:, 5:6].bfloat16(), target, PUBLISHED, first=5)
    assert loss.dtype == torch.float32
    assert 0 < loss.item() < 0.05


@pytest.mark.parametrize("size", [1, 2, 3])
@pytest.mark.parametrize("loss", [PUBLISHED, PAPER])
def test_tiny_frames_stay_finite(size: int, loss: Loss):
    a = draw(1, 1, 1, size, size).requires_grad_()
    value = pair_loss(a, draw(1, 1, 1, size, size, seed=1), loss)
    value.backward()
    assert torch.isfinite(value)
    assert torch.isfinite(a.grad).all()


def test_a_negative_weight_is_refused():
    with pytest.raises(ValueError, match=r"Loss\.gradient_weight must be a finite number >= 0, got -1"):
        Loss(gradient_weight=-1, gradient="sobel", resize="bilinear")


def test_the_logarithm_counts_every_frame_in_decibels():
    """Ten times the squared error of one of two frames adds half of ln 10, at any level."""
    target = torch.zeros(1, 2, 1, 8, 8)
    for level in (0.02, 0.5):
        both = torch.full_like(target, level)
        one = both * torch.tensor([1.0, 10**0.5]).view(1, 2, 1, 1, 1)
        wanted = [math.log(level**2 + LEAST_ERROR), math.log(10 * level**2 + LEAST_ERROR)]
        assert pair_loss(both, target, LOG_MSE).item() == pytest.approx(wanted[0], rel=1e-5)
        assert pair_loss(one, target, LOG_MSE).item() == pytest.approx(sum(wanted) / 2, rel=1e-5)
    perfect = torch.zeros_like(target).requires_grad_()
    pair_loss(perfect, target, LOG_MSE).backward()
    assert torch.isfinite(perfect.grad).all()


def moving(frames: int = 3, side: int = 32, step: int = 4) -> Tensor:
    """Return a smooth picture [1, T, 1, h, w] that moves right by `step` px/frame."""
    x = torch.arange(side, dtype=torch.float32)
    times = torch.arange(frames, dtype=torch.float32)[:, None]
    row = 0.5 + 0.4 * torch.sin((x - step * times) * 2 * torch.pi / 16)
    return row[None, :, None, None, :].expand(1, frames, 1, side, side).contiguous()


def flows_of(frames: Tensor, right: float) -> list[Tensor]:
    """Return flows of scales 1, 2, 4 that point `right` pixels of the full scale to the right."""
    count, _, _, height, width = frames.shape
    found = []
    for s in (1, 2, 4):
        flow = torch.zeros(count, frames.shape[1] - 1, 2, height // s, width // s)
        flow[:, :, 0] = right / s
        found.append(flow)
    return found


def test_the_true_flow_aligns_clean_frames():
    """The flow points into the frame before: a picture that moves right by 4 px comes from 4 px to the left."""
    target = moving()
    true, none, wrong = (alignment_loss(flows_of(target, x), target, SCALES_L1).item() for x in (-4, 0, 4))
    assert true < 0.2 * none  # what came in at the left is not in the frame before
    assert none < wrong
    inside = [flow.requires_grad_() for flow in flows_of(target, -3)]
    alignment_loss(inside, target, SCALES_L1).backward()
    assert all(float(flow.grad[:, :, 0].sum()) > 0 for flow in inside)  # less than -3 is better


def test_parts_count_alone_and_beside_the_pictures():
    target = moving(11)
    flows = flows_of(target, 0.0)
    aligned = alignment_loss(flows, target, ALIGNED).item()
    assert parts_loss(target + 0.1, flows, target, ALIGNED).item() == pytest.approx(0.1 + aligned, rel=1e-4)
    assert parts_loss(None, flows, target, PUBLISHED).item() == pytest.approx(aligned, rel=1e-5)
    assert parts_loss(target + 0.1, None, target, PUBLISHED).item() == pytest.approx(0.1, rel=1e-4)
    output = Output(None, target[:, 5:6], None, None, tuple(flows))
    assert training_loss(output, target, ALIGNED, first=5).item() == pytest.approx(0.2 * aligned, rel=1e-5)
    assert training_loss(output, target, SCALES_L1, first=5).item() == 0
    assert without_flow(("aligned", "own", "l1")) == ("own", "l1")

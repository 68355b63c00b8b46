"""Compares the loss with slow NumPy, and tests its published weights and its target frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.signal import convolve2d
from torch import Tensor

from quiver.training.loss import L1, PAPER, PUBLISHED, Loss, centred, pair_loss, shrink, training_loss


@dataclass
class Output:
    denoised: Tensor | None
    scale1: Tensor
    scale2: Tensor | None
    scale4: Tensor | None


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

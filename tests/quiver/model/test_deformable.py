"""Compares warping and deformable convolution with slow loops, limits and finite differences."""

from itertools import product

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from quiver.model.deformable import deform_conv2d, warp

SIZE = (7, 10)


def draw(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def bilinear(image: np.ndarray, y: float, x: float, padding: str = "zeros") -> float:
    """Return one bilinear sample of [H, W], neighbour by neighbour."""
    height, width = image.shape
    if padding == "border":
        y = min(max(y, 0), height - 1)
        x = min(max(x, 0), width - 1)
    top = int(np.floor(y))
    left = int(np.floor(x))
    total = 0.0
    for i, j in product((top, top + 1), (left, left + 1)):
        if 0 <= i < height and 0 <= j < width:
            total += (1 - abs(y - i)) * (1 - abs(x - j)) * image[i, j]
    return total


def slow_deform(image, offset, weight, bias, mask, stride=1, padding=0, dilation=1) -> np.ndarray:
    """Return the convolution by its definition, sample by sample."""
    count, channels = image.shape[:2]
    out, fan, kh, kw = weight.shape
    taps = kh * kw
    groups = channels // fan
    offset_groups = offset.shape[1] // (2 * taps)
    result = np.tile(bias[None, :, None, None], (count, 1, *offset.shape[2:]))
    for n, co, i, j in np.ndindex(*result.shape):
        for f, k in product(range(fan), range(taps)):
            c = (co // (out // groups)) * fan + f
            g = c // (channels // offset_groups)
            ky, kx = divmod(k, kw)
            y = i * stride - padding + ky * dilation + offset[n, g * 2 * taps + 2 * k, i, j]
            x = j * stride - padding + kx * dilation + offset[n, g * 2 * taps + 2 * k + 1, i, j]
            strength = 1.0 if mask is None else mask[n, g * taps + k, i, j]
            result[n, co, i, j] += weight[co, f, ky, kx] * strength * bilinear(image[n, c], y, x)
    return result


@pytest.mark.parametrize("padding", ["zeros", "border"])
def test_warp_equals_a_slow_loop(padding):
    image = draw(2, 3, *SIZE)
    flow = 4 * draw(2, 2, *SIZE, seed=1)
    wanted = np.zeros(image.shape)
    for n, c, i, j in np.ndindex(*wanted.shape):
        y = i + float(flow[n, 1, i, j])
        x = j + float(flow[n, 0, i, j])
        wanted[n, c, i, j] = bilinear(image[n, c].numpy(), y, x, padding)
    np.testing.assert_allclose(warp(image, flow, padding).numpy(), wanted, atol=1e-12)


def test_warp_by_whole_pixels_moves_the_picture_and_knows_right_from_down():
    image = draw(1, 2, *SIZE)
    flow = torch.zeros(1, 2, *SIZE, dtype=torch.float64)
    assert torch.allclose(warp(image, flow), image, atol=1e-13)
    flow[:, 0] = 2
    moved = warp(image, flow)
    assert torch.allclose(moved[..., :-2], image[..., 2:], atol=1e-12)
    assert torch.equal(moved[..., -1], torch.zeros_like(moved[..., -1]))


@pytest.mark.parametrize("far", [1e3, 1e6, float("1e20")])
def test_warp_beyond_the_frame_is_zero_or_the_border(far):
    image = draw(1, 1, *SIZE, dtype=torch.float32)
    flow = torch.full((1, 2, *SIZE), far)
    assert torch.equal(warp(image, flow), torch.zeros_like(image))
    corner = image[..., -1:, -1:].expand_as(image)
    assert torch.allclose(warp(image, flow, "border"), corner)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (6, 1)])
def test_frames_one_pixel_wide(size):
    image = draw(1, 2, *size)
    none = torch.zeros(1, 2, *size, dtype=torch.float64)
    assert torch.allclose(warp(image, none), image, atol=1e-13)
    weight = draw(3, 2, 3, 3, seed=1)
    offset = torch.zeros(1, 18, *size, dtype=torch.float64)
    assert torch.allclose(deform_conv2d(image, offset, weight, padding=1), F.conv2d(image, weight, padding=1))


def test_warp_gradients():
    """Fractions stay in [0.1, 0.9]: at integer positions bilinear sampling has a kink."""
    image = draw(1, 2, 4, 5).requires_grad_()
    flow = torch.rand(1, 2, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(3)) * 0.8 + 0.1 - 1
    assert torch.autograd.gradcheck(warp, (image, flow.requires_grad_()))


CASES = list(product((1, 2), (1, 2), (1, 2, 4), (0, 1, 2)))


@pytest.mark.parametrize(("stride", "dilation", "groups", "padding"), CASES)
def test_without_offsets_it_is_a_convolution(stride, dilation, groups, padding):
    image = draw(2, 4, *SIZE)
    weight = draw(8, 4 // groups, 3, 3, seed=1)
    bias = draw(8, seed=2)
    options = {"stride": stride, "dilation": dilation, "padding": padding}
    wanted = F.conv2d(image, weight, bias, groups=groups, **options)
    offset = torch.zeros(2, 2 * 18, *wanted.shape[2:], dtype=torch.float64)
    mask = torch.ones(2, 2 * 9, *wanted.shape[2:], dtype=torch.float64)
    ours = deform_conv2d(image, offset, weight, bias, mask, **options)
    assert torch.allclose(ours, wanted, atol=1e-12)


@pytest.mark.parametrize("shift", [(0, 1), (2, 0), (-3, 1), (0, 12), (-9, 0)])
def test_whole_offsets_shift_the_image_also_beyond_its_border(shift):
    """Order (dy, dx): a wrong order fails here, because the shifts are not symmetric."""
    image = draw(1, 2, *SIZE)
    weight = draw(2, 2, 1, 1, seed=1)
    offset = torch.tensor(shift, dtype=torch.float64).view(1, 2, 1, 1).expand(1, 2, *SIZE)
    dy, dx = shift
    wanted = torch.zeros_like(image)
    for i, j in np.ndindex(*SIZE):
        if 0 <= i + dy < SIZE[0] and 0 <= j + dx < SIZE[1]:
            wanted[..., i, j] = image[..., i + dy, j + dx]
    assert torch.allclose(deform_conv2d(image, offset, weight), F.conv2d(wanted, weight), atol=1e-12)
    if wanted.any():
        swapped = deform_conv2d(image, offset.flip(1), weight)
        assert not torch.allclose(swapped, F.conv2d(wanted, weight), atol=1e-3)


@pytest.mark.parametrize("groups", [1, 2, 4])
@pytest.mark.parametrize(("dtype", "limit"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_deformable_convolution_equals_a_slow_loop(groups, dtype, limit):
    """Offsets of several pixels, many beyond the frame; stride 2 and dilation 2 with two convolution groups."""
    image = draw(2, 4, *SIZE, dtype=dtype)
    weight = draw(4, 2, 3, 3, seed=1, dtype=dtype)
    bias = draw(4, seed=2, dtype=dtype)
    options = {"stride": 2, "padding": 1, "dilation": 2}
    offset = 3 * draw(2, groups * 18, 3, 4, seed=3, dtype=dtype)
    mask = torch.sigmoid(draw(2, groups * 9, 3, 4, seed=4, dtype=dtype))
    arrays = [tensor.double().numpy() for tensor in (image, offset, weight, bias, mask)]
    wanted = slow_deform(*arrays, **options)
    scale = np.abs(wanted).max()
    for tap_loop in (False, True):
        ours = deform_conv2d(image, offset, weight, bias, mask, tap_loop=tap_loop, **options)
        np.testing.assert_allclose(ours.numpy(), wanted, atol=limit * scale)


@pytest.mark.parametrize("tap_loop", [False, True])
def test_deformable_convolution_gradients(tap_loop):
    """Fractions stay in [0.1, 0.9], and some samples fall outside."""
    generator = torch.Generator().manual_seed(5)
    fraction = torch.rand(1, 36, 3, 2, dtype=torch.float64, generator=generator) * 0.8 + 0.1
    offset = fraction + torch.randint(-2, 2, fraction.shape, generator=generator)
    mask = torch.rand(1, 18, 3, 2, dtype=torch.float64, generator=generator)
    inputs = [t.requires_grad_() for t in (draw(1, 2, 3, 2), offset, draw(2, 2, 3, 3, seed=1), draw(2, seed=2), mask)]
    assert torch.autograd.gradcheck(
        lambda *t: deform_conv2d(*t, padding=1, tap_loop=tap_loop), inputs, fast_mode=tap_loop
    )


def test_large_inputs_take_the_tap_loop_only_without_gradients(monkeypatch):
    """The number of samples computed at once shows which form runs."""
    import quiver.model.deformable as ops

    drawn = []
    sample = ops.sample_at
    monkeypatch.setattr(ops, "sample_at", lambda *a: drawn.append(a[1].shape[1]) or sample(*a))
    monkeypatch.setattr(ops, "TAP_LOOP_ABOVE", 100)
    image = draw(1, 1, 6, 6)
    offset = draw(1, 18, 6, 6)
    weight = draw(1, 1, 3, 3)
    with torch.no_grad():
        quick = deform_conv2d(image, offset, weight, padding=1)
    assert drawn == [6] * 9
    drawn.clear()
    assert torch.allclose(deform_conv2d(image, offset, weight, padding=1), quick, atol=1e-12)
    assert drawn == [54]


def test_half_precision_is_sampled_in_float32():
    """bfloat16 has 8 bits: positions beyond 256 would be wrong by a pixel or more."""
    image = torch.zeros(1, 1, 1, 600, dtype=torch.bfloat16)
    image[..., 513] = 1
    flow = torch.zeros(1, 2, 1, 600)
    flow[:, 0] = 1
    with torch.autocast("cpu", torch.bfloat16):
        moved = warp(image, flow)
    assert moved.dtype == torch.float32
    assert int(moved.argmax()) == 512


def test_shapes_that_do_not_fit_are_named():
    image = draw(1, 4, 6, 6)
    weight = draw(4, 4, 3, 3)
    with pytest.raises(ValueError, match=r"flow must be \(1, 2, 6, 6\), got \(1, 2, 6, 5\)"):
        warp(image, draw(1, 2, 6, 5))
    with pytest.raises(ValueError, match=r"offset must be \[1, 2\*G\*9, \(6, 6\)\], got \(1, 17, 6, 6\)"):
        deform_conv2d(image, draw(1, 17, 6, 6), weight, padding=1)
    with pytest.raises(ValueError, match="4 channels divide neither into 3 offset groups"):
        deform_conv2d(image, draw(1, 54, 6, 6), weight, padding=1)
    with pytest.raises(ValueError, match=r"mask must be \(1, 9, 6, 6\)"):
        deform_conv2d(image, draw(1, 18, 6, 6), weight, mask=draw(1, 10, 6, 6), padding=1)

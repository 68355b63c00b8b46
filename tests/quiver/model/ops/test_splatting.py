"""Average splatting: identity, shifts, means, a slow loop, gradients."""

import pytest
import torch
from torch import Tensor

from quiver.model.ops.splatting import average_splat


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def constant_flow(x: float, y: float, height: int, width: int) -> Tensor:
    return torch.tensor([x, y], dtype=torch.float64).view(1, 2, 1, 1).expand(1, 2, height, width)


def slow_sums(image: Tensor, flow: Tensor) -> Tensor:
    """Sums and weights [C+1, H, W] of one image, pixel by pixel."""
    channels, height, width = image.shape
    sums = torch.zeros(channels + 1, height, width, dtype=image.dtype)
    for i in range(height):
        for j in range(width):
            x = j + float(flow[0, i, j])
            y = i + float(flow[1, i, j])
            for row in range(height):
                for column in range(width):
                    share = max(0.0, 1 - abs(x - column)) * max(0.0, 1 - abs(y - row))
                    sums[:-1, row, column] += share * image[:, i, j]
                    sums[-1, row, column] += share
    return sums


def test_zero_flow_changes_nothing():
    image = normal(2, 3, 5, 7)
    assert torch.equal(average_splat(image, torch.zeros(2, 2, 5, 7, dtype=torch.float64)), image)


def test_whole_pixels_shift_and_leave_holes_of_zero():
    image = normal(1, 3, 5, 7)
    moved = average_splat(image, constant_flow(2, -1, 5, 7))
    assert torch.equal(moved[..., :4, 2:], image[..., 1:, :5])
    assert torch.equal(moved[..., 4, :], torch.zeros(1, 3, 7, dtype=torch.float64))
    assert torch.equal(moved[..., :2], torch.zeros(1, 3, 5, 2, dtype=torch.float64))


def test_two_sources_on_a_pixel_give_their_mean():
    image = torch.tensor([[[[1.0, 5.0, 9.0]]]])
    flow = torch.zeros(1, 2, 1, 3)
    flow[0, 0, 0, 0] = 1
    assert average_splat(image, flow).flatten().tolist() == [0, 3, 9]


@pytest.mark.parametrize("scale", [0.3, 2.0, 1e9])
def test_it_equals_a_slow_loop(scale):
    image = normal(2, 2, 6, 5)
    flow = scale * normal(2, 2, 6, 5, seed=1)
    found = average_splat(image, flow)
    for n in range(2):
        sums = slow_sums(image[n], flow[n])
        wanted = torch.where(sums[-1] > 0, sums[:-1] / sums[-1], 0.0)
        assert (found[n] - wanted).abs().max() < 1e-12


def test_a_constant_image_stays_constant_where_anything_arrives():
    flow = 2 * normal(1, 2, 9, 8)
    moved = average_splat(torch.ones(1, 1, 9, 8, dtype=torch.float64), flow)
    arrived = slow_sums(torch.ones(1, 9, 8, dtype=torch.float64), flow[0])[-1] > 0
    assert 0 < arrived.sum() < 72
    assert (moved[0, 0] - arrived.double()).abs().max() < 1e-12


def test_gradients_are_those_of_finite_differences():
    """No landing point is near a whole pixel, where the slope jumps."""
    image = normal(1, 2, 3, 4)
    whole = normal(1, 2, 3, 4, seed=1).round()
    flow = whole + 0.5 + 0.3 * torch.tanh(normal(1, 2, 3, 4, seed=2))
    assert torch.autograd.gradcheck(average_splat, (image.requires_grad_(), flow.requires_grad_()))


def test_half_precision_is_summed_in_single():
    image = normal(1, 2, 6, 5).bfloat16()
    flow = normal(1, 2, 6, 5, seed=1).float()
    moved = average_splat(image, flow)
    assert moved.dtype == torch.float32
    assert (moved - average_splat(image.double(), flow.double())).abs().max() < 1e-5
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(average_splat(image, flow), moved)


def test_another_size_is_refused():
    with pytest.raises(ValueError, match=r"average_splat: flow must be \(1, 2, 4, 5\), got \(1, 2, 5, 4\)"):
        average_splat(torch.zeros(1, 3, 4, 5), torch.zeros(1, 2, 5, 4))

"""SpyNet: sizes, levels, and the scale of its flow."""

import pytest
import torch
from golden import draw, fill_by_rule

from quiver.model.rivals.spynet import SpyNet


def test_it_has_the_published_parameters():
    network = SpyNet()
    assert sum(parameter.numel() for parameter in network.parameters()) == 6 * 240_050
    assert sum(parameter.numel() for parameter in network.basic_module[0].parameters()) == 240_050


def test_levels_double_the_flow_and_the_size_scales_it():
    """Constant corrections c add up to c(1 + 2), on images that are resized from 24 x 40 to 32 x 64."""
    network = SpyNet(levels=2).double()
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            parameter.zero_()
            if name.endswith("8.bias"):
                parameter.copy_(torch.tensor([1.0, -2.0]))
        flow = network(draw(1, 1, 24, 40), draw(1, 1, 24, 40, seed=1))
    assert flow.shape == (1, 2, 24, 40)
    assert flow[0, 0].flatten().tolist() == pytest.approx([3 * 40 / 64] * 960)
    assert flow[0, 1].flatten().tolist() == pytest.approx([-6 * 24 / 32] * 960)


def test_the_pyramid_begins_with_the_coarsest_image():
    network = SpyNet(levels=3).double()
    images = network.pyramid(torch.full((1, 1, 30, 33), 0.5, dtype=torch.float64), [32, 64])
    assert [tuple(image.shape) for image in images] == [(1, 3, 8, 16), (1, 3, 16, 32), (1, 3, 32, 64)]
    wanted = [(0.5 - mean) / std for mean, std in zip((0.485, 0.456, 0.406), (0.229, 0.224, 0.225), strict=True)]
    assert images[0][0, :, 0, 0].tolist() == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("levels", [1, 5])
def test_small_images_have_finite_flow_and_gradients(levels):
    network = fill_by_rule(SpyNet(levels)).double()
    flow = network(draw(1, 1, 1, 7), draw(1, 1, 1, 7, seed=1))
    assert flow.shape == (1, 2, 1, 7)
    flow.square().sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in network.parameters())

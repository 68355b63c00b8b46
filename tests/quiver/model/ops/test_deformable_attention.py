"""Deformable attention equals a slow loop, in blocks as well; its gradients are right."""

import pytest
import torch

from quiver.model.ops import deformable_attention as module
from quiver.model.ops.deformable_attention import deformable_attention

HEADS = 3


def inputs(count: int = 2, channels: int = 6, groups: int = 2, height: int = 5, width: int = 4) -> list[torch.Tensor]:
    """Query, key, value of two sources, and offsets of up to a few pixels."""
    generator = torch.Generator().manual_seed(0)
    sources = (count, 2, channels, height, width)
    shapes = [(count, channels, height, width), sources, sources, (count, 2, 2 * groups, 9, 2, height, width)]
    return [torch.randn(shape, generator=generator, dtype=torch.float64) * 1.5 for shape in shapes]


def bilinear(image: torch.Tensor, y: float, x: float) -> torch.Tensor:
    """Value [c] of an image [c, H, W] at a place; zero outside."""
    result = torch.zeros(len(image), dtype=image.dtype)
    row = int(y // 1)
    column = int(x // 1)
    for r in (row, row + 1):
        for c in (column, column + 1):
            if 0 <= r < image.shape[1] and 0 <= c < image.shape[2]:
                result += image[:, r, c] * (1 - abs(y - r)) * (1 - abs(x - c))
    return result


def attended(query, key, value, offset, n: int, y: int, x: int) -> torch.Tensor:
    """Return the result [C] at one pixel, tap by tap."""
    groups = offset.shape[2] // 2
    logits = []
    values = []
    for s in range(key.shape[1]):
        for tap in range(9):
            found = []
            for image, first in ((key[n, s], 0), (value[n, s], groups)):
                parts = []
                for g, part in enumerate(image.chunk(groups)):
                    dy, dx = offset[n, s, first + g, tap, :, y, x].tolist()
                    parts.append(bilinear(part, y + tap // 3 - 1 + dy, x + tap % 3 - 1 + dx))
                found.append(torch.cat(parts).view(HEADS, -1))
            logits.append((query[n, :, y, x].view(HEADS, -1) * found[0]).sum(1) / found[0].shape[1] ** 0.5)
            values.append(found[1])
    weights = torch.stack(logits).softmax(dim=0)
    return (weights[..., None] * torch.stack(values)).sum(0).flatten()


def test_it_equals_a_loop():
    given = inputs()
    result = deformable_attention(*given, HEADS)
    for n in range(2):
        for y in range(5):
            for x in range(4):
                assert (result[n, :, y, x] - attended(*given, n, y, x)).abs().max() < 1e-13


def test_blocks_of_rows_equal_the_whole(monkeypatch):
    given = inputs()
    whole = deformable_attention(*given, HEADS)
    with torch.no_grad():
        for samples in (1, 2 * 2 * 12 * 4 * 9 * 2):
            monkeypatch.setattr(module, "SAMPLES_AT_ONCE", samples)
            assert (deformable_attention(*given, HEADS) - whole).abs().max() < 1e-14


def test_its_gradients_are_right():
    given = [tensor.requires_grad_() for tensor in inputs(count=1, channels=3, groups=1, height=2, width=3)]
    assert torch.autograd.gradcheck(lambda *tensors: deformable_attention(*tensors, HEADS), given)


def test_without_motion_a_constant_stays_inside():
    query, key, _, offset = inputs()
    value = torch.ones_like(key)
    result = deformable_attention(query, key, value, offset * 0, HEADS)
    assert (result[..., 1:-1, 1:-1] - 1).abs().max() < 1e-13


@pytest.mark.parametrize("place", [1, 2, 3])
def test_other_shapes_are_refused(place):
    given = inputs()
    given[place] = given[place][..., :-1]
    with pytest.raises(ValueError, match="deformable_attention: "):
        deformable_attention(*given, HEADS)
    with pytest.raises(ValueError, match="6 channels divide neither into 4/2 offset groups nor 4 heads"):
        deformable_attention(*inputs(), 4)

"""RVRT's stacks: windows, shifts, regions and relative positions."""

import pytest
import torch
from golden import fill_by_rule

from quiver.model.rivals.rvrt import SwinLayer, SwinStack, relative_positions


def reach(layer: torch.nn.Module, x: torch.Tensor, row: int, column: int) -> torch.Tensor:
    """Return which pixels [H, W] of frame 0 change with one pixel of the input [1, D, H, W, C]."""
    other = x.clone()
    other[0, 0, row, column, 3] += 1  # of one channel: a common change is lost in normalisation
    with torch.no_grad():
        return (layer(x) - layer(other)).abs().amax((0, 1, 4)) > 1e-12


def lively(*, shifted: bool, frames: int = 1) -> torch.nn.Module:
    return fill_by_rule(SwinLayer(12, frames, shifted=shifted)).double()


def test_windows_are_eight_pixels_and_shifted_ones_lie_between():
    x = torch.randn(1, 1, 21, 30, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    wanted = torch.zeros(21, 30, dtype=torch.bool)
    wanted[8:16, 16:24] = True
    assert torch.equal(reach(lively(shifted=False), x, 9, 17), wanted)
    wanted[:] = False
    wanted[4:12, 12:20] = True
    assert torch.equal(reach(lively(shifted=True), x, 9, 17), wanted)


def test_opposite_edges_do_not_meet():
    x = torch.randn(1, 1, 16, 16, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    wanted = torch.zeros(16, 16, dtype=torch.bool)
    wanted[:4, :4] = True
    assert torch.equal(reach(lively(shifted=True), x, 0, 0), wanted)


@pytest.mark.parametrize("size", [(8, 8), (5, 7), (1, 1)])
def test_a_short_axis_is_one_window(size):
    x = torch.randn(1, 2, *size, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    shifted = lively(shifted=True, frames=2)
    plain = lively(shifted=False, frames=2)
    with torch.no_grad():
        assert torch.equal(shifted(x), plain(x))
    assert reach(shifted, x, 0, 0).all()


def test_rows_of_the_bias_table_are_differences_of_places():
    index = relative_positions(2)
    assert index.shape == (128, 128)
    for query, key in ((0, 0), (127, 0), (0, 127), (64 + 3 * 8 + 5, 6 * 8 + 1)):
        (qt, qy, qx), (kt, ky, kx) = ((place // 64, place % 64 // 8, place % 8) for place in (query, key))
        assert index[query, key] == ((qt - kt + 1) * 15 + qy - ky + 7) * 15 + qx - kx + 7


def test_frames_of_one_frame_windows_do_not_meet():
    stack = fill_by_rule(SwinStack(5, 12, blocks=1, frames=1)).double()
    x = torch.randn(3, 1, 5, 11, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        together = stack(x)
        alone = torch.cat([stack(part) for part in x.split(1)])
    assert together.shape == (3, 1, 12, 11, 9)
    assert (together - alone).abs().max() < 1e-12

"""Frames seen without the camera's motion, and what a cell tells of it: equal to what states them plainly."""

import pytest
import torch

from quiver.baselines.paths import camera_motion, motion_paths
from quiver.baselines.paths.moved_frames import look_with_noise


def random_motion(generator, frames):
    motion = torch.randn(2, frames, 2, 3, generator=generator) * torch.tensor([4.0, 1.0, 1.0])
    motion[:, frames // 2] = 0
    return motion


@pytest.mark.parametrize("size", [(16, 24), (33, 17)])
def test_a_camera_moves_frames_as_a_path_that_it_leads(size):
    """Beside the border of the frame rounding tells whether a place is inside."""
    generator = torch.Generator().manual_seed(1)
    frames = torch.randn(2, 5, *size, generator=generator)
    motion = random_motion(generator, 5)
    nothing = (torch.zeros(2, 2, *size),) * 2
    expected = look_with_noise(frames, nothing, range(-2, 3), 2, motion)
    found = camera_motion.seen_with_noise(frames, motion, 2)
    for one, other in zip(found, expected, strict=True):
        assert (one - other).abs().gt(1e-4).float().mean() < 2e-3


def test_what_a_cell_tells_is_the_square_of_what_the_motion_changes():
    generator = torch.Generator().manual_seed(2)
    mean = torch.randn(2, 20, 28, generator=generator)
    motion = random_motion(generator, 5)
    changes = (camera_motion.slope(mean)[:, None] * camera_motion.field(motion, 20, 28)).sum(2)
    torch.testing.assert_close(motion_paths.told(mean, motion), changes.square().sum(1), rtol=1e-4, atol=1e-3)


def test_a_host_skips_what_was_not_found():
    assert motion_paths.none_of(torch.tensor([False, False]))
    assert not motion_paths.none_of(torch.tensor([False, True]))
    assert not motion_paths.none_of(torch.zeros(2, dtype=torch.bool, device="meta"))

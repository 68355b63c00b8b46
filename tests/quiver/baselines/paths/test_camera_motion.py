"""The motion of the camera: known motion is found as exactly as the noise allows, and none where there is none."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from shaken import OFFSETS, filmed, pyramid_of, scenery, shake

from quiver.baselines.paths.camera_motion import SMALLEST, _peak, camera_motion, field, seen_without


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("contrast", "most"), [(5.0, 0.1), (1.0, 0.2), (0.5, 0.4)])
def test_shake_is_found_in_noise(seed, contrast, most):
    """Up to noise of twice the deviation of the picture in a pixel; errors are a third to a half of `most`."""
    rng = np.random.default_rng(seed)
    height, width = [int(8 * n) for n in rng.integers(10, 17, 2)]
    truth = shake(rng, 1.0, 0.3)
    frames = filmed(scenery(rng, height, width), truth, height, width)
    noisy = contrast * frames + torch.from_numpy(rng.standard_normal(frames.shape).astype(np.float32))
    found = camera_motion(pyramid_of(noisy[None]), OFFSETS)
    assert found.shape == (1, len(OFFSETS), 2, 3)
    error = (field(found, height, width) - field(truth[None], height, width)).square().mean().sqrt()
    assert field(truth[None], height, width).square().mean().sqrt() > 0.7
    assert float(error) < most  # px


def test_windows_of_a_batch_do_not_touch_each_other():
    rng = np.random.default_rng(7)
    frames = [5 * filmed(scenery(rng, 96, 64), shake(rng, 1.0, 0.2), 96, 64) for _ in range(3)]
    together = camera_motion(pyramid_of(torch.stack(frames)), OFFSETS)
    for n, one in enumerate(frames):
        torch.testing.assert_close(
            together[n : n + 1], camera_motion(pyramid_of(one[None]), OFFSETS), atol=1e-3, rtol=0
        )


def test_frames_seen_without_the_camera_are_alike():
    rng = np.random.default_rng(3)
    truth = shake(rng, 1.5, 0.3)
    frames = filmed(scenery(rng, 96, 96), truth, 96, 96)
    seen, inside = seen_without(frames[None], truth[None])
    reference = frames[OFFSETS.index(0)]
    apart = ((seen - reference) * inside)[..., 8:-8, 8:-8]
    assert float(apart.square().mean()) < 0.02 * float((frames - reference)[..., 8:-8, 8:-8].square().mean())
    assert float(inside.mean()) > 0.9


@pytest.mark.parametrize("offsets", [(0,), (0, 1), (-1, 0), tuple(range(6)), tuple(range(-5, 1))])
def test_the_ends_of_a_stream_have_fewer_frames(offsets):
    rng = np.random.default_rng(4)
    truth = shake(rng, 0.8, 0.1)[[OFFSETS.index(offset) for offset in offsets]]
    frames = 5 * filmed(scenery(rng, 96, 96), truth, 96, 96)
    found = camera_motion(pyramid_of(frames[None]), offsets)
    assert found.shape == (1, len(offsets), 2, 3)
    assert float((found[0, :, :, 0] - truth[..., 0]).abs().max()) < 0.15
    assert float(found[0, offsets.index(0)].abs().max()) == 0.0


def test_small_and_flat_frames_have_no_motion():
    small = torch.rand(1, 11, 4 * SMALLEST - 8, 64)
    assert not camera_motion(pyramid_of(small), OFFSETS).any()
    flat = torch.zeros(1, 11, 64, 64)
    assert torch.isfinite(camera_motion(pyramid_of(flat), OFFSETS)).all()


@pytest.mark.parametrize(("lead", "taken"), [(20.0, 1), (60.0, 4)])
def test_a_facade_is_not_seen_one_window_farther(lead, taken):
    """Three cells farther away its likelihood must be e^30 times as high: walls look alike there but for noise."""
    likeness = torch.zeros(1, 1, 40, 48)
    for column, height in ((1, 100.0), (4, 100.0 + lead)):
        likeness[0, 0, 0, column] = height
    found = _peak(likeness, torch.zeros(1, 1, 2))
    torch.testing.assert_close(found[0, 0], torch.tensor([0.0, float(taken)]), atol=0.1, rtol=0)

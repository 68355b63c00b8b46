"""Where places go: the camera's motion is taken out where the complete frame has one, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as functional
from shaken import OFFSETS, filmed, pyramid_of, scenery, shake

from quiver.baselines.paths.camera_motion import field, parted
from quiver.baselines.paths.motion_paths import moves
from quiver.baselines.paths.moved_frames import look

SIDE = 96


def noisy(frames: torch.Tensor, contrast: float, rng: np.random.Generator) -> torch.Tensor:
    return contrast * frames + torch.from_numpy(rng.standard_normal(frames.shape).astype(np.float32))


def moved(frames: torch.Tensor):
    """Return what `moves` finds in frames [B, K, H, W] whose noise has the deviation 1."""
    codes = functional.avg_pool2d(frames, 2)
    return moves(pyramid_of(frames), OFFSETS, codes, torch.ones(len(frames), 1, *codes.shape[-2:]))


def test_at_rest_the_camera_is_exactly_still():
    """In twenty draws from flat to rich scenes no motion is found, so that rest stays as sharp as without a search."""
    frames = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        rest = filmed(scenery(rng, SIDE, SIDE), torch.zeros(len(OFFSETS), 2, 3), SIDE, SIDE)
        frames.append(noisy(rest, (0.0, 0.2, 1.0, 5.0)[seed % 4], rng))
    assert not moved(torch.stack(frames)).shake.any()


@pytest.mark.parametrize("share", [0.2, 0.4])
def test_a_body_that_moves_before_a_scene_at_rest_is_no_camera(share):
    rng = np.random.default_rng(5)
    rest = filmed(scenery(rng, SIDE, SIDE), torch.zeros(len(OFFSETS), 2, 3), SIDE, SIDE)
    sliding = torch.zeros(len(OFFSETS), 2, 3)
    sliding[:, 1, 0] = 2.0 * torch.tensor(OFFSETS)
    body = filmed(scenery(rng, SIDE, SIDE), sliding, SIDE, SIDE)
    edge = int(SIDE * (1 - share))
    frames = torch.cat([rest[:, :edge], body[:, edge:]], dim=1)
    assert not moved(noisy(frames, 2.0, rng)[None]).shake.any()


def test_hardly_any_scene_at_rest_is_taken_for_a_shaken_one():
    """Bodies of up to half of the frame, any contrast, light that changes by up to 80 %: 2 of 120 other draws were."""
    frames = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        rest = filmed(scenery(rng, SIDE, SIDE), torch.zeros(len(OFFSETS), 2, 3), SIDE, SIDE)
        sliding = torch.zeros(len(OFFSETS), 2, 3)
        sliding[:, :, 0] = torch.tensor(OFFSETS)[:, None] * torch.from_numpy(rng.uniform(-8, 8, 2).astype(np.float32))
        body = filmed(scenery(rng, SIDE, SIDE, 64), sliding, SIDE, SIDE, 64)
        edge = int(SIDE * rng.uniform(0.5, 1))
        light = 1 + float(rng.choice([0.0, 0.4, -0.8])) * torch.tensor(OFFSETS)[:, None, None] / 10
        seen = torch.cat([rest[:, :edge], body[:, edge:]], dim=1) + 3
        frames.append(noisy(seen * light, float(np.exp(rng.uniform(-1.5, 2))), rng))
    assert int(moved(torch.stack(frames)).shake.flatten(1).any(1).sum()) <= 2


def test_paths_and_camera_add_up():
    """A frame seen along both is the reference: a body slides steadily while the camera shakes."""
    rng = np.random.default_rng(6)
    hand = shake(rng, 1.0, 0.1)
    sliding = hand.clone()
    sliding[:, 1, 0] += 1.5 * torch.tensor(OFFSETS)
    sliding -= sliding[OFFSETS.index(0)].clone()
    still, body = (filmed(scenery(rng, SIDE, SIDE), motion, SIDE, SIDE) for motion in (hand, sliding))
    frames = noisy(torch.cat([still[:, :48], body[:, 48:]], dim=1), 5.0, rng)
    found = moved(frames[None])
    assert found.shake.any()
    seen, _ = look(frames[None], found.path, OFFSETS, 1, None, found.shake)
    apart = (seen - frames[OFFSETS.index(0)])[..., 12:-12, 12:-12]
    before = (frames - frames[OFFSETS.index(0)])[..., 12:-12, 12:-12]
    # noise of two frames, of which one is interpolated, leaves 1 to 2; without the motion the scene adds far more
    assert float(before.square().mean()) > 8
    inner = torch.cat([apart[0, :, :24], apart[0, :, 48:]], dim=1)
    assert float(inner.square().mean()) < 2.5


def test_windows_of_a_batch_are_alone():
    rng = np.random.default_rng(8)
    motions = (torch.zeros(len(OFFSETS), 2, 3), shake(rng, 1.0, 0.2))
    frames = [noisy(filmed(scenery(rng, SIDE, SIDE), motion, SIDE, SIDE), 5.0, rng) for motion in motions]
    together = moved(torch.stack(frames))
    assert not together.shake[0].any()
    error = field(together.shake[1:], SIDE, SIDE) - field(parted(motions[1][None], OFFSETS)[1], SIDE, SIDE)
    assert float(error.square().mean().sqrt()) < 0.1
    for n, one in enumerate(frames):
        alone = moved(one[None])
        torch.testing.assert_close(together.shake[n : n + 1], alone.shake, atol=1e-3, rtol=0)
